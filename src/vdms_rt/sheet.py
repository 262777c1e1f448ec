"""The printable marker, true to scale: PDF and SVG from one list of shapes."""

from __future__ import annotations

import io
import itertools
import math
import xml.etree.ElementTree as ET
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypeAlias

from reportlab.pdfbase.pdfmetrics import stringWidth
from reportlab.pdfgen.canvas import Canvas

from vdms_rt.model import MarkerShape, VdmsError

Paper = Literal["auto", "A4", "Letter", "A3"]

SHEET_MARGIN = 0.5
"""Background beyond the outermost circles' edges, in diameters; regions reach half of it."""
PAPERS_MM = {"A4": (210.0, 297.0), "Letter": (215.9, 279.4), "A3": (297.0, 420.0)}
UNPRINTABLE_MM = 5.0
HEADER_MM = 9.0
FOOTER_MM = 36.0
LEAST_CUSTOM_WIDTH_MM = 180.0
LARGEST_PAGE_MM = 5080.0
"""14400 points, the most that a PDF page can be (ISO 32000-1, annex C)."""
RULER_MM = 100
LEAST_TEXT_MM = 1.5
POINTS_PER_MM = 72 / 25.4

BLACK, GREY, PALE, WHITE = 0.0, 0.3, 0.75, 1.0
"""Grey levels, 0 is ink. `GREY` on black and `PALE` on white are for the eye that is near."""


class SheetError(VdmsError):
    """The sheet cannot be made as asked for."""


@dataclass(frozen=True, slots=True)
class Rectangle:
    """Filled; in mm of the page, origin at its top left, y down, as everything here."""

    x_mm: float
    y_mm: float
    width_mm: float
    height_mm: float
    grey: float


@dataclass(frozen=True, slots=True)
class Disc:
    x_mm: float
    y_mm: float
    diameter_mm: float
    grey: float


@dataclass(frozen=True, slots=True)
class Polygon:
    points_mm: tuple[tuple[float, float], ...]
    grey: float


@dataclass(frozen=True, slots=True)
class Line:
    x0_mm: float
    y0_mm: float
    x1_mm: float
    y1_mm: float
    width_mm: float = 0.2
    dashed: bool = False


@dataclass(frozen=True, slots=True)
class Words:
    x_mm: float
    y_mm: float
    """Of the base line."""
    text: str
    size_mm: float
    grey: float = BLACK
    centred: bool = False


Mark: TypeAlias = Rectangle | Disc | Polygon | Line | Words


@dataclass(frozen=True, slots=True)
class Page:
    name: str
    width_mm: float
    height_mm: float
    marks: tuple[Mark, ...]
    """In the order of painting."""


def write_sheet(shape: MarkerShape, out: Path, paper: Paper = "auto") -> str:
    """Write the marker at scale 1:1 to `out`, .pdf or .svg; return what to do with it, in words.

    "auto" is the smallest paper on which it fits, or a page of its own size. Raises SheetError
    with a sentence.
    """
    writers = {".pdf": pdf_bytes, ".svg": svg_bytes}
    writer = writers.get(out.suffix.lower())
    if writer is None:
        raise SheetError(f"{out}: the sheet can be .pdf or .svg; name it marker.pdf or marker.svg")
    page = sheet_page(shape, paper)
    try:
        out.write_bytes(writer(page))
    except OSError as error:
        raise SheetError(f"cannot write {out}: {error.strerror}; name another with --out") from None
    size = f"{page.width_mm:g} x {page.height_mm:g} mm"
    return (
        f"{out}: {describe(shape)}, on {page.name if page.name in PAPERS_MM else 'a page'} "
        f"({size}). Print it at 100 %, not fitted to the page, and measure the ruler: it must be "
        f"{RULER_MM}.0 mm long.{_hint(shape, page)}"
    )


def describe(shape: MarkerShape) -> str:
    """Return the marker in words: number, diameter and distance of its circles."""
    spacing_mm = min(math.dist(a, b) for a, b in itertools.combinations(shape.circles_mm, 2))
    colour = "white on black" if shape.white_on_black else "black on white"
    return (
        f"{len(shape.circles_mm)} circles {colour}, diameter {shape.diameter_mm:g} mm, "
        f"spacing {spacing_mm:g} mm"
    )


def sheet_page(shape: MarkerShape, paper: Paper = "auto") -> Page:
    """Return the page with the marker, its cut line, the ruler and what a person must know.

    Raises SheetError with a sentence if the circles overlap or the paper is too small.
    """
    _check(shape)
    left_mm, top_mm, width_mm, height_mm = _extent(shape)
    name, page_width_mm, page_height_mm = _paper(width_mm, height_mm, paper)
    x_mm = (page_width_mm - width_mm) / 2
    y_mm = UNPRINTABLE_MM + HEADER_MM
    ink, ground = (WHITE, BLACK) if shape.white_on_black else (BLACK, WHITE)
    marks: list[Mark] = [Rectangle(x_mm, y_mm, width_mm, height_mm, ground)]
    marks += [
        Disc(x_mm + cx - left_mm, y_mm + top_mm - cy, shape.diameter_mm, ink)
        for cx, cy in shape.circles_mm
    ]
    marks += _label(shape, x_mm + width_mm / 2, y_mm + height_mm)
    marks += _cut_line(x_mm, y_mm, width_mm, height_mm)
    marks += _arrow(page_width_mm / 2, y_mm - 2.5, 5.0, BLACK)
    marks.append(Words(page_width_mm / 2 + 4, y_mm - 3.2, "up", 4.0))
    marks += _footer(shape, page_width_mm, y_mm + height_mm + 5)
    return Page(name, page_width_mm, page_height_mm, tuple(marks))


def pdf_bytes(page: Page) -> bytes:
    """Return the page as a PDF of exactly its size, which asks viewers not to scale it."""
    file = io.BytesIO()
    canvas = Canvas(
        file,
        pagesize=(page.width_mm * POINTS_PER_MM, page.height_mm * POINTS_PER_MM),
        invariant=True,
    )
    canvas.setTitle("vdms-rt marker")
    canvas.setViewerPreference("PrintScaling", "None")
    canvas.scale(POINTS_PER_MM, POINTS_PER_MM)
    for mark in page.marks:
        _draw(canvas, page.height_mm, mark)
    canvas.showPage()
    canvas.save()
    return file.getvalue()


def svg_bytes(page: Page) -> bytes:
    """Return the page as an SVG whose user unit is the millimetre."""
    size = {"width": f"{page.width_mm:g}mm", "height": f"{page.height_mm:g}mm"}
    root = ET.Element(
        "svg",
        {
            "xmlns": "http://www.w3.org/2000/svg",
            **size,
            "viewBox": f"0 0 {page.width_mm:g} {page.height_mm:g}",
        },
    )
    ET.SubElement(root, "title").text = "vdms-rt marker"
    ET.SubElement(root, "rect", {"width": "100%", "height": "100%", "fill": _css(WHITE)})
    for mark in page.marks:
        root.append(_element(mark))
    ET.indent(root)
    text: bytes = ET.tostring(root, encoding="utf-8", xml_declaration=True)
    return text + b"\n"


def _check(shape: MarkerShape) -> None:
    if not (math.isfinite(shape.diameter_mm) and shape.diameter_mm > 0):
        raise SheetError(
            f"a diameter of {shape.diameter_mm:g} mm cannot be printed; give --diameter-mm above 0"
        )
    for (i, a), (j, b) in itertools.combinations(enumerate(shape.circles_mm, 1), 2):
        if math.dist(a, b) <= shape.diameter_mm:
            raise SheetError(
                f"circles {i} and {j} overlap: their centres lie {math.dist(a, b):g} mm apart and "
                f"their diameter is {shape.diameter_mm:g} mm; give a larger --spacing-mm or a "
                "smaller --diameter-mm"
            )


def _extent(shape: MarkerShape) -> tuple[float, float, float, float]:
    """Return left, top (y up), width and height of the sheet, in mm of the marker's plane."""
    beyond_mm = (0.5 + SHEET_MARGIN) * shape.diameter_mm
    xs_mm, ys_mm = zip(*shape.circles_mm, strict=True)
    left_mm, top_mm = min(xs_mm) - beyond_mm, max(ys_mm) + beyond_mm
    return left_mm, top_mm, max(xs_mm) + beyond_mm - left_mm, top_mm - min(ys_mm) + beyond_mm


def _paper(width_mm: float, height_mm: float, paper: Paper) -> tuple[str, float, float]:
    needed_width_mm = width_mm + 2 * UNPRINTABLE_MM
    needed_height_mm = height_mm + 2 * UNPRINTABLE_MM + HEADER_MM + FOOTER_MM
    for name in PAPERS_MM if paper == "auto" else (paper,):
        short_mm, long_mm = PAPERS_MM[name]
        for page_width_mm, page_height_mm in ((short_mm, long_mm), (long_mm, short_mm)):
            if needed_width_mm <= page_width_mm and needed_height_mm <= page_height_mm:
                return name, page_width_mm, page_height_mm
    if paper != "auto":
        raise SheetError(
            f"the sheet is {width_mm:g} x {height_mm:g} mm, too large for {paper}; give a smaller "
            "--spacing-mm and --diameter-mm, or a larger paper"
        )
    page_width_mm = math.ceil(max(needed_width_mm, LEAST_CUSTOM_WIDTH_MM))
    page_height_mm = math.ceil(needed_height_mm)
    if max(page_width_mm, page_height_mm) > LARGEST_PAGE_MM:
        raise SheetError(
            f"the sheet is {width_mm:g} x {height_mm:g} mm, more than a page can be "
            f"({LARGEST_PAGE_MM:g} mm); give a smaller --spacing-mm or --diameter-mm"
        )
    return "custom", page_width_mm, page_height_mm


def _hint(shape: MarkerShape, page: Page) -> str:
    if page.name in ("A4", "Letter"):
        return ""
    _, _, width_mm, height_mm = _extent(shape)
    paper_width_mm, paper_height_mm = PAPERS_MM["A4"]
    scale = min(
        (paper_width_mm - 2 * UNPRINTABLE_MM) / width_mm,
        (paper_height_mm - 2 * UNPRINTABLE_MM - HEADER_MM - FOOTER_MM) / height_mm,
    )
    return f" At {math.floor(scale * 100)} % of these dimensions it would fit on A4."


def _label(shape: MarkerShape, x_mm: float, bottom_mm: float) -> list[Mark]:
    """Return the words that stay on the sheet when it is cut: faint, and outside the regions."""
    size_mm = min(0.12 * shape.diameter_mm, 5.0)
    if size_mm < LEAST_TEXT_MM:
        return []
    grey = GREY if shape.white_on_black else PALE
    base_mm = bottom_mm - (SHEET_MARGIN / 4) * shape.diameter_mm + 0.35 * size_mm
    text = f"up    vdms-rt {shape.name}    {describe(shape)}"
    _, _, sheet_width_mm, _ = _extent(shape)
    # An SVG viewer without Helvetica takes a font up to a fifth wider.
    per_size = 1.2 * stringWidth(text, "Helvetica", 1) + 1
    size_mm = min(size_mm, 0.9 * sheet_width_mm / per_size)
    left_mm = x_mm - size_mm * per_size / 2
    return [
        *_arrow(left_mm + 0.4 * size_mm, base_mm, size_mm, grey),
        Words(left_mm + size_mm, base_mm, text, size_mm, grey),
    ]


def _arrow(x_mm: float, bottom_mm: float, height_mm: float, grey: float) -> list[Mark]:
    h = height_mm
    outline = (
        (0, -1),
        (0.4, -0.5),
        (0.14, -0.5),
        (0.14, 0),
        (-0.14, 0),
        (-0.14, -0.5),
        (-0.4, -0.5),
    )
    return [Polygon(tuple((x_mm + dx * h, bottom_mm + dy * h) for dx, dy in outline), grey)]


def _cut_line(x_mm: float, y_mm: float, width_mm: float, height_mm: float) -> list[Mark]:
    right_mm, bottom_mm = x_mm + width_mm, y_mm + height_mm
    corners = ((x_mm, y_mm), (right_mm, y_mm), (right_mm, bottom_mm), (x_mm, bottom_mm))
    return [Line(*a, *b, dashed=True) for a, b in itertools.pairwise((*corners, corners[0]))]


def _footer(shape: MarkerShape, page_width_mm: float, y_mm: float) -> list[Mark]:
    """Return map and ruler: 31 mm high, below `y_mm`."""
    x_mm = (page_width_mm - 140) / 2
    text_mm = x_mm + 36
    lines = (
        describe(shape) + ", scale 1:1",
        "Print at 100 %, not fitted to the page. Cut along the dashed line; mount flat, arrow up.",
        f"Measure this: it must be {RULER_MM}.0 mm long, or every displacement is wrong as much.",
    )
    words = [Words(text_mm, y_mm + 3 + 4.2 * i, line, 2.8) for i, line in enumerate(lines)]
    return [*_map(shape, x_mm, y_mm, 30.0), *words, *_ruler(text_mm, y_mm + 18)]


def _map(shape: MarkerShape, x_mm: float, y_mm: float, size_mm: float) -> list[Mark]:
    """Return a small picture of the circles with their numbers, in the order of configuration."""
    left_mm, top_mm, width_mm, height_mm = _extent(shape)
    scale = size_mm / max(width_mm, height_mm)
    marks: list[Mark] = [Rectangle(x_mm, y_mm, width_mm * scale, height_mm * scale, PALE)]
    diameter_mm = shape.diameter_mm * scale
    for number, (cx, cy) in enumerate(shape.circles_mm, 1):
        centre_x_mm, centre_y_mm = x_mm + (cx - left_mm) * scale, y_mm + (top_mm - cy) * scale
        text_mm = 0.7 * diameter_mm
        marks += [
            Disc(centre_x_mm, centre_y_mm, diameter_mm, WHITE),
            Words(centre_x_mm, centre_y_mm + 0.35 * text_mm, str(number), text_mm, centred=True),
        ]
    return marks


def _ruler(x_mm: float, y_mm: float) -> list[Mark]:
    marks: list[Mark] = [Line(x_mm, y_mm, x_mm + RULER_MM, y_mm)]
    for mm in range(RULER_MM + 1):
        length_mm = 6.0 if mm % 10 == 0 else 4.0 if mm % 5 == 0 else 2.5
        marks.append(Line(x_mm + mm, y_mm, x_mm + mm, y_mm + length_mm, 0.1))
        if mm % 10 == 0:
            marks.append(Words(x_mm + mm, y_mm + 9.5, str(mm), 2.8, centred=True))
    marks.append(Words(x_mm + RULER_MM + 3.5, y_mm + 9.5, "mm", 2.8))
    return marks


def _draw(canvas: Canvas, page_height_mm: float, mark: Mark) -> None:
    """Paint one mark; the canvas is in mm, y up."""
    match mark:
        case Rectangle(x, y, width, height, grey):
            canvas.setFillGray(grey)
            canvas.rect(x, page_height_mm - y - height, width, height, stroke=0, fill=1)
        case Disc(x, y, diameter, grey):
            canvas.setFillGray(grey)
            canvas.circle(x, page_height_mm - y, diameter / 2, stroke=0, fill=1)
        case Polygon(points, grey):
            canvas.setFillGray(grey)
            path = canvas.beginPath()
            path.moveTo(points[0][0], page_height_mm - points[0][1])
            for x, y in points[1:]:
                path.lineTo(x, page_height_mm - y)
            path.close()
            canvas.drawPath(path, stroke=0, fill=1)
        case Line(x0, y0, x1, y1, width, dashed):
            canvas.setStrokeGray(0.5 if dashed else BLACK)
            canvas.setDash((2, 2) if dashed else ())
            canvas.setLineWidth(width)
            canvas.line(x0, page_height_mm - y0, x1, page_height_mm - y1)
        case Words(x, y, text, size, grey, centred):
            canvas.setFillGray(grey)
            canvas.setFont("Helvetica", size)
            draw = canvas.drawCentredString if centred else canvas.drawString
            draw(x, page_height_mm - y, text)


def _element(mark: Mark) -> ET.Element:
    match mark:
        case Rectangle(x, y, width, height, grey):
            return ET.Element(
                "rect", _numbers(x=x, y=y, width=width, height=height) | {"fill": _css(grey)}
            )
        case Disc(x, y, diameter, grey):
            return ET.Element("circle", _numbers(cx=x, cy=y, r=diameter / 2) | {"fill": _css(grey)})
        case Polygon(points, grey):
            outline = " ".join(f"{x:.6g},{y:.6g}" for x, y in points)
            return ET.Element("polygon", {"points": outline, "fill": _css(grey)})
        case Line(x0, y0, x1, y1, width, dashed):
            stroke = {"stroke": _css(0.5 if dashed else BLACK), "stroke-width": f"{width:g}"}
            dash = {"stroke-dasharray": "2 2"} if dashed else {}
            return ET.Element("line", _numbers(x1=x0, y1=y0, x2=x1, y2=y1) | stroke | dash)
        case Words(x, y, text, size, grey, centred):
            look = {
                "font-family": "Helvetica, Arial, sans-serif",
                "font-size": f"{size:.6g}",
                "fill": _css(grey),
                "text-anchor": "middle" if centred else "start",
                "xml:space": "preserve",
            }
            element = ET.Element("text", _numbers(x=x, y=y) | look)
            element.text = text
            return element


def _numbers(**values_mm: float) -> dict[str, str]:
    return {name: f"{value:.9g}" for name, value in values_mm.items()}


def _css(grey: float) -> str:
    level = round(grey * 255)
    return f"#{level:02x}{level:02x}{level:02x}"
