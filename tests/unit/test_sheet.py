"""The printable sheet, read back by other code: pypdf for PDF, an XML parser for SVG."""

from __future__ import annotations

import itertools
import math
import xml.etree.ElementTree as ET
from collections.abc import Callable
from pathlib import Path

import pypdf
import pytest

from vdms_rt.measure.regions import SHEET_MARGIN
from vdms_rt.model import MarkerShape
from vdms_rt.sheet import Paper, SheetError, pdf_bytes, sheet_page, svg_bytes, write_sheet

SVG = "{http://www.w3.org/2000/svg}"
POINT_MM = 25.4 / 72

Discs = list[tuple[float, float, float, float]]
"""(x, y down, diameter, grey) in mm of the page."""
Boxes = list[tuple[float, float, float, float, float]]
"""(left, top, width, height, grey) in mm of the page."""
Strokes = list[tuple[float, float, float, float]]


def square(spacing_mm: float, diameter_mm: float, white_on_black: bool = True) -> MarkerShape:
    half = spacing_mm / 2
    return MarkerShape(
        "m1",
        ((-half, half), (half, half), (-half, -half), (half, -half)),
        diameter_mm,
        white_on_black,
    )


DEFAULT = square(120, 50)
A4 = square(108, 45)
BLACK_ON_WHITE = square(60.5, 20.25, white_on_black=False)
ROW = MarkerShape("deck", ((0, 0), (80, 5), (160, -5), (240, 0), (330, 10)), 25)
SHAPES = [DEFAULT, A4, BLACK_ON_WHITE, ROW, square(1000, 300), square(12, 5)]


def read_pdf(path: Path) -> tuple[tuple[float, float], Discs, Boxes, Strokes, str]:
    """Return size, discs, boxes, lines and text of a one-page PDF, in mm with y down."""
    [page] = pypdf.PdfReader(path).pages
    height = float(page.mediabox.height)
    scale = (1.0, 1.0, 0.0, 0.0)
    discs: Discs = []
    boxes: Boxes = []
    strokes: Strokes = []
    grey = 0.0
    start = (0.0, 0.0)
    path_points: list[tuple[float, float]] = []
    curves = 0

    def at(x: float, y: float) -> tuple[float, float]:
        return (
            (scale[0] * x + scale[2]) * POINT_MM,
            (height - scale[1] * y - scale[3]) * POINT_MM,
        )

    for operands, operator in pypdf.generic.ContentStream(page.get_contents(), None).operations:
        values = [float(v) for v in operands if isinstance(v, (int, float))]
        match operator.decode():
            case "cm":
                a, b, c, d, e, f = values
                assert (b, c) == (0, 0)
                scale = (scale[0] * a, scale[1] * d, scale[2] + e, scale[3] + f)
            case "g":
                [grey] = values
            case "re":
                x, y, width, height_mm = values
                left, bottom = at(x, y)
                right, top = at(x + width, y + height_mm)
                boxes.append((left, top, right - left, bottom - top, grey))
            case "m":
                start = at(*values)
                path_points, curves = [start], 0
            case "c":
                path_points.append(at(*values[4:]))
                curves += 1
            case "l":
                path_points.append(at(*values))
            case "S":
                strokes.append((*path_points[0], *path_points[1]))
            case "f" | "f*" if curves == 4:
                xs, ys = zip(*path_points, strict=True)
                width, tall = max(xs) - min(xs), max(ys) - min(ys)
                assert width == pytest.approx(tall, abs=1e-3)
                discs.append(((max(xs) + min(xs)) / 2, (max(ys) + min(ys)) / 2, width, grey))
    size = float(page.mediabox.width) * POINT_MM, height * POINT_MM
    return size, discs, boxes, strokes, page.extract_text()


def read_svg(path: Path) -> tuple[tuple[float, float], Discs, Boxes, Strokes, str]:
    """Return the same of an SVG."""
    root = ET.fromstring(path.read_bytes())
    size = tuple(float(root.attrib[side].removesuffix("mm")) for side in ("width", "height"))
    assert root.attrib["viewBox"] == f"0 0 {size[0]:g} {size[1]:g}"

    def numbers(element: ET.Element, *names: str) -> tuple[float, ...]:
        return tuple(float(element.attrib[name]) for name in names)

    def grey(element: ET.Element) -> float:
        return int(element.attrib["fill"][1:3], 16) / 255

    discs = [
        (x, y, 2 * r, grey(e))
        for e in root.iter(f"{SVG}circle")
        for x, y, r in [numbers(e, "cx", "cy", "r")]
    ]
    boxes = [
        (*numbers(e, "x", "y", "width", "height"), grey(e))
        for e in root.iter(f"{SVG}rect")
        if "x" in e.attrib
    ]
    strokes = [numbers(e, "x1", "y1", "x2", "y2") for e in root.iter(f"{SVG}line")]
    text = "\n".join(e.text or "" for e in root.iter(f"{SVG}text"))
    return (size[0], size[1]), discs, boxes, strokes, text  # type: ignore[return-value]


READERS = {".pdf": read_pdf, ".svg": read_svg}


@pytest.fixture(params=READERS)
def reader(request: pytest.FixtureRequest, tmp_path: Path) -> Callable[..., tuple]:  # type: ignore[type-arg]
    def write_and_read(shape: MarkerShape, paper: Paper = "auto") -> tuple:  # type: ignore[type-arg]
        path = tmp_path / f"marker{request.param}"
        write_sheet(shape, path, paper)
        return READERS[request.param](path)

    return write_and_read


@pytest.mark.parametrize("shape", SHAPES, ids=lambda s: f"{s.name}-{s.diameter_mm:g}")
def test_every_circle_is_true_to_scale(reader, shape: MarkerShape) -> None:
    _, discs, boxes, _, _ = reader(shape)
    ink, ground = (1.0, 0.0) if shape.white_on_black else (0.0, 1.0)
    sheet = boxes[0]
    assert sheet[4] == ground
    marker = discs[: len(shape.circles_mm)]
    for _, _, diameter_mm, grey in marker:
        assert diameter_mm == pytest.approx(shape.diameter_mm, abs=1e-3)
        assert grey == ink
    for (a, seen_a), (b, seen_b) in itertools.combinations(
        zip(shape.circles_mm, marker, strict=True), 2
    ):
        assert seen_b[0] - seen_a[0] == pytest.approx(b[0] - a[0], abs=1e-3)
        assert seen_b[1] - seen_a[1] == pytest.approx(a[1] - b[1], abs=1e-3)


@pytest.mark.parametrize("shape", SHAPES, ids=lambda s: f"{s.name}-{s.diameter_mm:g}")
def test_the_background_reaches_as_far_as_regions_rely_on(reader, shape: MarkerShape) -> None:
    size, discs, boxes, strokes, _ = reader(shape)
    left, top, width, height, _ = boxes[0]
    marker = discs[: len(shape.circles_mm)]
    beyond_mm = (0.5 + SHEET_MARGIN) * shape.diameter_mm
    assert left == pytest.approx(min(d[0] for d in marker) - beyond_mm, abs=1e-3)
    assert left + width == pytest.approx(max(d[0] for d in marker) + beyond_mm, abs=1e-3)
    assert top == pytest.approx(min(d[1] for d in marker) - beyond_mm, abs=1e-3)
    assert top + height == pytest.approx(max(d[1] for d in marker) + beyond_mm, abs=1e-3)
    assert left >= 5 - 1e-3
    assert left + width <= size[0] - 5 + 1e-3
    cut = {tuple(round(v, 2) for v in s) for s in strokes}
    assert tuple(round(v, 2) for v in (left, top, left + width, top)) in cut


def test_the_ruler_is_100_mm_with_a_tick_each(reader) -> None:
    size, _, boxes, strokes, text = reader(A4)
    sheet_bottom = boxes[0][1] + boxes[0][3]
    below = [s for s in strokes if min(s[1], s[3]) > sheet_bottom + 1]
    [base] = [s for s in below if s[1] == s[3]]
    assert base[2] - base[0] == pytest.approx(100.0, abs=1e-3)
    ticks = sorted(s[0] for s in below if s[0] == s[2])
    assert ticks == pytest.approx([base[0] + mm for mm in range(101)], abs=1e-3)
    assert max(s[3] for s in below) < size[1] - 5
    assert "it must be 100.0 mm long" in text


def test_the_page_says_what_it_is_and_how_to_print_it(reader) -> None:
    *_, text = reader(A4)
    assert "4 circles white on black, diameter 45 mm, spacing 108 mm, scale 1:1" in text
    assert "Print at 100 %, not fitted to the page." in text
    assert "Cut along the dashed line; mount flat, arrow up." in text
    assert text.split().count("up") == 2
    assert [word for word in ("1", "2", "3", "4") if word in text.split()] == ["1", "2", "3", "4"]


@pytest.mark.parametrize(
    ("shape", "paper", "size"),
    [
        (A4, "auto", (210, 297)),
        (DEFAULT, "auto", (297, 420)),
        (square(112, 46), "auto", (215.9, 279.4)),
        (A4, "A3", (297, 420)),
        (A4, "Letter", (215.9, 279.4)),
        (MarkerShape("wide", ((0, 0), (60, 5), (120, -5), (190, 0)), 25), "auto", (297, 210)),
        (square(1000, 300), "auto", (1610, 1655)),
    ],
)
def test_the_paper_is_the_smallest_that_holds_the_sheet(
    reader, shape: MarkerShape, paper: Paper, size: tuple[float, float]
) -> None:
    assert reader(shape, paper)[0] == pytest.approx(size, abs=1e-3)


def test_both_formats_and_every_time_the_same() -> None:
    page = sheet_page(A4)
    assert pdf_bytes(page) == pdf_bytes(page)
    assert svg_bytes(page) == svg_bytes(page)


def test_viewers_are_asked_not_to_scale(tmp_path: Path) -> None:
    path = tmp_path / "marker.pdf"
    write_sheet(A4, path)
    assert pypdf.PdfReader(path).root_object["/ViewerPreferences"]["/PrintScaling"] == "/None"


def test_the_answer_says_what_to_do(tmp_path: Path) -> None:
    path = tmp_path / "marker.pdf"
    assert write_sheet(A4, path) == (
        f"{path}: 4 circles white on black, diameter 45 mm, spacing 108 mm, on A4 (210 x 297 mm). "
        "Print it at 100 %, not fitted to the page, and measure the ruler: it must be 100.0 mm "
        "long."
    )
    assert write_sheet(DEFAULT, path).endswith(" At 90 % of these dimensions it would fit on A4.")
    assert sheet_page(square(0.9 * 120, 0.9 * 50)).name == "A4"


@pytest.mark.parametrize(
    ("shape", "name", "paper", "sentence"),
    [
        (square(50, 50), "m.pdf", "auto", "circles 1 and 2 overlap: their centres lie 50 mm apart"),
        (square(40, 50), "m.svg", "auto", "give a larger --spacing-mm or a smaller --diameter-mm"),
        (square(120, 0), "m.pdf", "auto", "a diameter of 0 mm cannot be printed"),
        (square(120, math.nan), "m.pdf", "auto", "a diameter of nan mm cannot be printed"),
        (square(4000, 1000), "m.pdf", "auto", "the sheet is 6000 x 6000 mm, more than a page can"),
        (DEFAULT, "m.pdf", "A4", "the sheet is 220 x 220 mm, too large for A4"),
        (DEFAULT, "m.png", "auto", "the sheet can be .pdf or .svg"),
        (DEFAULT, "none/m.pdf", "auto", "none/m.pdf: No such file or directory; name another with"),
    ],
)
def test_what_cannot_be_is_one_sentence(
    tmp_path: Path, shape: MarkerShape, name: str, paper: Paper, sentence: str
) -> None:
    with pytest.raises(SheetError) as fault:
        write_sheet(shape, tmp_path / name, paper)
    assert sentence in str(fault.value)
    assert "\n" not in str(fault.value)
    assert not (tmp_path / name).exists()
