"""The printed page is true to scale, read back by other code than wrote it."""

import itertools
import math
import re
from pathlib import Path
from xml.etree import ElementTree

import pytest
from pypdf import PdfReader
from pypdf.generic import ContentStream

from vdms_rt import cli
from vdms_rt.model import MarkerShape
from vdms_rt.sheet import SheetError, write_sheet

SVG = "{http://www.w3.org/2000/svg}"
MM_PER_PT = 25.4 / 72


def square(spacing_mm: float, diameter_mm: float, *, white_on_black: bool = True) -> MarkerShape:
    half = spacing_mm / 2
    circles = ((-half, half), (half, half), (-half, -half), (half, -half))
    return MarkerShape("m1", circles, diameter_mm, white_on_black)


class Printed:
    """What a page shows, in millimetres, x right and y down from the top left corner."""

    def __init__(self, path: Path) -> None:
        self.discs: list[tuple[float, float, float, float, str]] = []
        """Centre x, y, width, height, colour."""
        self.boxes: list[tuple[float, float, float, float, str]] = []
        """Left, top, width, height, colour."""
        self.lines: list[tuple[float, float, float, float, bool]] = []
        """Ends, sorted, and whether dashed."""
        self.arrows: list[list[tuple[float, float]]] = []
        self.text = ""
        (self._read_pdf if path.suffix == ".pdf" else self._read_svg)(path)

    def _read_svg(self, path: Path) -> None:
        root = ElementTree.parse(path).getroot()
        assert root.attrib["width"].endswith("mm")
        assert root.attrib["height"].endswith("mm")
        self.size = (float(root.attrib["width"][:-2]), float(root.attrib["height"][:-2]))
        # One user unit is one millimetre only if the view box is the page.
        assert [float(v) for v in root.attrib["viewBox"].split()] == [0, 0, *self.size]
        for item in root:
            number = {k: float(v) for k, v in item.attrib.items() if re.fullmatch(r"[\d.]+", v)}
            fill = item.get("fill", "")
            if item.tag == f"{SVG}circle":
                d = 2 * number["r"]
                self.discs.append((number["cx"], number["cy"], d, d, fill))
            elif item.tag == f"{SVG}rect":
                box = (number["x"], number["y"], number["width"], number["height"])
                self.boxes.append((*box, fill))
            elif item.tag == f"{SVG}line":
                ends = (number["x1"], number["y1"]), (number["x2"], number["y2"])
                self._line(ends, dashed="stroke-dasharray" in item.attrib)
            elif item.tag == f"{SVG}polygon":
                corners = [tuple(map(float, c.split(","))) for c in item.attrib["points"].split()]
                self.arrows.append(corners)
            elif item.tag == f"{SVG}text":
                self.text += f"{item.text}\n"

    def _read_pdf(self, path: Path) -> None:
        reader = PdfReader(path)
        (page,) = reader.pages
        self.text = page.extract_text()
        self.size = (
            float(page.mediabox.width) * MM_PER_PT,
            float(page.mediabox.height) * MM_PER_PT,
        )
        self.print_scaling = reader.root_object["/ViewerPreferences"]["/PrintScaling"]
        points: list[tuple[float, float]] = []
        rectangle: tuple[float, ...] = ()
        curves, fill, dashed = 0, "", False
        for operands, operator in ContentStream(page.get_contents(), reader).operations:
            if operator == b"cm":
                assert [float(v) for v in operands] == [1, 0, 0, 1, 0, 0]
            elif operator in (b"g", b"rg"):
                fill = {0.0: "black", 1.0: "white"}[float(operands[0])]
            elif operator == b"d":
                dashed = len(operands[0]) > 0
            elif operator in (b"m", b"l", b"c"):
                curves += operator == b"c"
                points.append(self._at(*operands[-2:]))
            elif operator == b"re":
                rectangle = tuple(float(v) for v in operands)
            elif operator == b"S":
                self._line((points[0], points[1]), dashed=dashed)
            elif operator in (b"f", b"f*"):
                self._filled(points, rectangle, curves, fill)
            if operator in (b"S", b"f", b"f*", b"n"):
                points, rectangle, curves = [], (), 0

    def _at(self, x: float, y: float) -> tuple[float, float]:
        return float(x) * MM_PER_PT, self.size[1] - float(y) * MM_PER_PT

    def _filled(
        self,
        points: list[tuple[float, float]],
        rectangle: tuple[float, ...],
        curves: int,
        fill: str,
    ) -> None:
        if rectangle:
            x, y, width, height = rectangle
            left, top = self._at(x, y + height)
            self.boxes.append((left, top, width * MM_PER_PT, height * MM_PER_PT, fill))
        elif curves:
            xs, ys = zip(*points, strict=True)
            middle = (min(xs) + max(xs)) / 2, (min(ys) + max(ys)) / 2
            self.discs.append((*middle, max(xs) - min(xs), max(ys) - min(ys), fill))
        else:
            self.arrows.append(points)

    def _line(self, ends: tuple[tuple[float, float], ...], *, dashed: bool) -> None:
        self.lines.append((*min(ends), *max(ends), dashed))


@pytest.fixture(params=["pdf", "svg"])
def out(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    return tmp_path / f"marker.{request.param}"


@pytest.mark.parametrize("white_on_black", [True, False])
@pytest.mark.parametrize(("spacing_mm", "diameter_mm"), [(120, 50), (33.3, 12.5), (700, 300)])
def test_circles_and_sheet_are_true_to_scale(
    out: Path, spacing_mm: float, diameter_mm: float, white_on_black: bool
) -> None:
    shape = square(spacing_mm, diameter_mm, white_on_black=white_on_black)
    write_sheet(shape, out)
    printed = Printed(out)
    ground, disc = ("black", "white") if white_on_black else ("white", "black")

    ((left, top, width, height, fill),) = printed.boxes
    assert fill == ground
    assert (width, height) == pytest.approx((spacing_mm + 2 * diameter_mm,) * 2, abs=2e-3)
    middle = left + width / 2, top + height / 2
    for seen, (x, y) in zip(printed.discs, shape.circles_mm, strict=True):
        assert seen[:2] == pytest.approx((middle[0] + x, middle[1] - y), abs=2e-3)
        assert seen[2:4] == pytest.approx((diameter_mm, diameter_mm), abs=2e-3)
        assert seen[4] == disc


def test_uneven_marker_keeps_its_handedness(out: Path) -> None:
    shape = MarkerShape("m1", ((0, 0), (90, 5), (10, 60), (70, 80), (40, 30)), 20)
    write_sheet(shape, out)
    seen = [d[:2] for d in Printed(out).discs]
    moved = [(x - seen[0][0], seen[0][1] - y) for x, y in seen]
    assert moved == [pytest.approx(c, abs=2e-3) for c in shape.circles_mm]
    (box,) = Printed(out).boxes
    assert box[2:4] == pytest.approx((90 + 40, 80 + 40), abs=2e-3)


def test_ruler_is_100_mm_outside_the_sheet(out: Path) -> None:
    write_sheet(square(120, 50), out)
    printed = Printed(out)
    ((_, top, _, height, _),) = printed.boxes
    below = [line for line in printed.lines if line[1] > top + height and not line[4]]
    (base,) = [line for line in below if line[1] == pytest.approx(line[3])]
    ticks = sorted(line[0] for line in below if line[0] == pytest.approx(line[2]))
    assert base[2] - base[0] == pytest.approx(100, abs=2e-3)
    assert [t - base[0] for t in ticks] == pytest.approx(range(0, 101, 10), abs=2e-3)
    assert "must measure 100.0 mm" in printed.text


def test_page_says_what_to_do(out: Path) -> None:
    write_sheet(square(120, 50), out)
    text = Printed(out).text
    assert "print at 100 %, do not fit to page" in text
    assert "circles 50 mm in diameter, white on black, nearest centres 120 mm apart" in text
    assert "cut along the dashed line" in text


def test_cut_line_goes_round_sheet_and_arrow(out: Path) -> None:
    write_sheet(square(120, 50), out)
    printed = Printed(out)
    ((left, top, width, height, _),) = printed.boxes
    dashed = [line for line in printed.lines if line[4]]
    xs = sorted({round(v, 2) for line in dashed for v in (line[0], line[2])})
    ys = sorted({round(v, 2) for line in dashed for v in (line[1], line[3])})
    assert len(dashed) == 4
    assert xs[0] < left < left + width < xs[-1]
    ((tip, right, other),) = printed.arrows
    assert tip[1] < right[1] == pytest.approx(other[1])
    assert ys[0] < tip[1] < other[1] < top < top + height < ys[-1]
    assert "up" in printed.text.split()


@pytest.mark.parametrize(
    ("shape", "paper", "size"),
    [
        (square(20, 10), "A4 portrait", (210, 297)),
        (square(120, 27), "A4 portrait", (210, 297)),
        (square(120, 27.1), "A3 portrait", (297, 420)),
        (square(120, 50), "A3 portrait", (297, 420)),
        (
            MarkerShape("m1", ((0, 0), (70, 0), (140, 0), (210, 0)), 20),
            "A4 landscape",
            (297, 210),
        ),
        (
            MarkerShape("m1", ((0, 0), (100, 0), (200, 0), (300, 0)), 40),
            "A3 landscape",
            (420, 297),
        ),
        (square(200.5, 50), "a page larger than A3", (337, 374)),
    ],
)
def test_smallest_paper_that_holds_all(
    out: Path, shape: MarkerShape, paper: str, size: tuple[float, float]
) -> None:
    sentence = write_sheet(shape, out)
    printed = Printed(out)
    assert printed.size == pytest.approx(size, abs=2e-3)
    assert sentence == (
        f"Wrote {out} for {paper} ({size[0]} x {size[1]} mm): print at 100 %, then measure the "
        "ruler, which must be 100.0 mm long."
    )
    xs = [x for line in printed.lines for x in (line[0], line[2])]
    ys = [y for line in printed.lines for y in (line[1], line[3])]
    assert min(*xs, *ys) >= 10 - 2e-3
    assert max(xs) <= size[0] - 10 + 2e-3
    assert max(ys) <= size[1] - 10 + 2e-3


def test_same_shape_gives_same_bytes(out: Path) -> None:
    write_sheet(square(120, 50), out)
    first = out.read_bytes()
    write_sheet(square(120, 50), out)
    assert out.read_bytes() == first


def test_pdf_asks_the_viewer_not_to_scale(tmp_path: Path) -> None:
    write_sheet(square(120, 50), tmp_path / "marker.pdf")
    assert Printed(tmp_path / "marker.pdf").print_scaling == "/None"


@pytest.mark.parametrize("spacing_mm", [40, 50])
def test_circles_that_overlap_or_touch(out: Path, spacing_mm: float) -> None:
    with pytest.raises(SheetError) as caught:
        write_sheet(square(spacing_mm, 50), out)
    assert str(caught.value) == (
        f"circles of 50 mm diameter with centres only {spacing_mm} mm apart overlap or touch; "
        "make the spacing larger or the diameter smaller"
    )
    assert not out.exists()


@pytest.mark.parametrize("name", ["marker.png", "marker"])
def test_other_suffix(tmp_path: Path, name: str) -> None:
    out = tmp_path / name
    with pytest.raises(SheetError, match=r"ends in neither \.pdf nor \.svg; name the file with"):
        write_sheet(square(120, 50), out)
    assert not out.exists()


def test_suffix_in_capitals(tmp_path: Path) -> None:
    write_sheet(square(120, 50), tmp_path / "MARKER.PDF")
    assert (tmp_path / "MARKER.PDF").read_bytes().startswith(b"%PDF-")


def test_folder_that_is_not_there(out: Path) -> None:
    lost = out.parent / "lost" / out.name
    with pytest.raises(SheetError) as caught:
        write_sheet(square(120, 50), lost)
    assert str(caught.value) == (
        f"{lost} cannot be written (No such file or directory); "
        "name a file in a folder you can write to"
    )


def test_page_too_large_for_pdf_goes_to_svg(tmp_path: Path) -> None:
    shape = square(5000, 50)
    with pytest.raises(SheetError, match=r"5136 x 5173 mm, and a PDF page is at most 5080 mm"):
        write_sheet(shape, tmp_path / "marker.pdf")
    write_sheet(shape, tmp_path / "marker.svg")
    assert Printed(tmp_path / "marker.svg").size == (5136, 5173)


def test_verb_marker(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "marker.svg"
    spec = ["--spacing-mm", "80", "--diameter-mm", "30", "--black-on-white", "--out", str(out)]
    assert cli.run(["marker", *spec]) == cli.EXIT_STOPPED
    assert capsys.readouterr().out.startswith(f"Wrote {out} for A4 portrait")
    discs = Printed(out).discs
    assert {d[2] for d in discs} == {30.0}
    assert {d[4] for d in discs} == {"black"}
    nearest = min(math.dist(a[:2], b[:2]) for a, b in itertools.combinations(discs, 2))
    assert nearest == pytest.approx(80)

    assert cli.run(["marker", "--spacing-mm", "30", "--out", str(out)]) == cli.EXIT_FAILED
    assert "overlap" in capsys.readouterr().err
