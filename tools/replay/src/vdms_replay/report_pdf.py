"""A report as PDF: A4, text and plots as vectors, fonts embedded."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeAlias
from xml.sax.saxutils import escape

import matplotlib as mpl
from matplotlib.figure import Figure
from pypdf import PdfReader, PdfWriter, Transformation
from reportlab.lib import colors
from reportlab.lib.enums import TA_RIGHT
from reportlab.lib.pagesizes import A4
from reportlab.lib.styles import ParagraphStyle
from reportlab.lib.units import mm
from reportlab.pdfbase import pdfmetrics
from reportlab.pdfbase.ttfonts import TTFont
from reportlab.platypus import (
    BaseDocTemplate,
    Flowable,
    Frame,
    KeepTogether,
    PageTemplate,
    Paragraph,
    Preformatted,
    Spacer,
)
from reportlab.platypus import Table as Grid

from vdms_replay.figures import styled
from vdms_replay.report_content import (
    Block,
    Drawing,
    Facts,
    Heading,
    Lettering,
    Report,
    Table,
    Words,
    made,
)

MARGIN = 17 * mm
WIDTH = A4[0] - 2 * MARGIN
INK, PALE, RULE = colors.HexColor("#202020"), colors.HexColor("#666666"), colors.HexColor("#c8c8c8")
Places: TypeAlias = dict[int, tuple[int, float, float, float]]
"""Page, left, bottom and width in points of each plot."""
SANS, BOLD, MONO = "DejaVuSans", "DejaVuSans-Bold", "DejaVuSansMono"


class _Place(Flowable):  # type: ignore[misc]
    """Room for a plot, which is laid there once the pages are made."""

    def __init__(self, number: int, figure: Figure, places: Places) -> None:
        super().__init__()
        width, height = figure.get_size_inches()
        self.width, self.height = WIDTH, WIDTH * height / width
        self._number, self._places = number, places

    def draw(self) -> None:
        x, y = self.canv.absolutePosition(0, 0)
        self._places[self._number] = self.canv.getPageNumber() - 1, x, y, self.width


def write_pdf(report: Report, path: Path) -> None:
    """Write a report as PDF. Raises OSError."""
    _fonts()
    styles = _styles()
    places: Places = {}
    figures: list[Figure] = []
    story: list[Any] = [
        Paragraph(escape(report.title), styles["title"]),
        Paragraph(escape(report.subtitle), styles["subtitle"]),
    ]
    held: list[Any] = []
    for block, following in zip(report.blocks, [*report.blocks[1:], None], strict=True):
        made_of = _flowables(block, styles, figures, places)
        leads = isinstance(block, Words) and isinstance(following, Drawing)
        if isinstance(block, Heading) or (held and leads):
            held += made_of
            continue
        if isinstance(block, Drawing):
            story.append(KeepTogether([*held, *made_of]))
        elif held:
            # A heading stays with what it heads.
            story += [KeepTogether([*held, *made_of[:1]]), *made_of[1:]]
        else:
            story += made_of
        held = []
    pages = io.BytesIO()
    document = BaseDocTemplate(
        pages, pagesize=A4, title=report.title, subject=report.subtitle, creator=made(),
        leftMargin=MARGIN, rightMargin=MARGIN, topMargin=MARGIN, bottomMargin=MARGIN,
    )  # fmt: skip
    frame = Frame(MARGIN, MARGIN + 4 * mm, WIDTH, A4[1] - 2 * MARGIN - 4 * mm, 0, 0, 0, 0)
    foot = made()

    def footer(canvas: Any, _: Any) -> None:
        canvas.setFont(SANS, 7)
        canvas.setFillColor(PALE)
        canvas.drawString(MARGIN, MARGIN - 3 * mm, f"{report.subtitle}   -   {foot}")
        canvas.drawRightString(A4[0] - MARGIN, MARGIN - 3 * mm, f"page {canvas.getPageNumber()}")

    document.addPageTemplates([PageTemplate("page", [frame], onPage=footer)])
    document.build(story)
    _laid(pages, figures, places, path)


def _flowables(
    block: Block,
    styles: dict[str, ParagraphStyle],
    figures: list[Figure],
    places: Places,
) -> list[Any]:
    match block:
        case Heading(text):
            return [Paragraph(escape(text), styles["heading"])]
        case Words(text):
            return [Paragraph(escape(text), styles["words"])]
        case Facts(rows):
            return [_facts(rows, styles)]
        case Table(head, rows):
            return [_table(head, rows, styles)]
        case Lettering(text):
            return [Preformatted(text, styles["lettering"], maxLineLength=104), Spacer(1, 3 * mm)]
        case Drawing(figure, caption):
            figures.append(figure)
            place = _Place(len(figures) - 1, figure, places)
            told = Paragraph(escape(caption), styles["caption"]) if caption else Spacer(1, 2 * mm)
            return [place, told]


def _facts(rows: Sequence[tuple[str, str]], styles: dict[str, ParagraphStyle]) -> Any:
    cells = [
        [Paragraph(escape(name), styles["name"]), Paragraph(escape(text), styles["cell"])]
        for name, text in rows
    ]
    return Grid(
        cells,
        colWidths=[46 * mm, WIDTH - 46 * mm],
        style=[
            ("VALIGN", (0, 0), (-1, -1), "TOP"),
            ("LINEBELOW", (0, 0), (-1, -1), 0.3, RULE),
            ("LEFTPADDING", (0, 0), (-1, -1), 0),
            ("TOPPADDING", (0, 0), (-1, -1), 1.6),
            ("BOTTOMPADDING", (0, 0), (-1, -1), 2.2),
        ],
        spaceAfter=3 * mm,
        hAlign="LEFT",
    )


def _table(
    head: Sequence[str], rows: Sequence[Sequence[str]], styles: dict[str, ParagraphStyle]
) -> Any:
    cells = [[Paragraph(escape(text), styles["head" if n else "head-left"])
              for n, text in enumerate(head)]]  # fmt: skip
    cells += [
        [Paragraph(escape(text), styles["number" if n else "cell"]) for n, text in enumerate(row)]
        for row in rows
    ]
    first = 30 * mm
    rest = min(30 * mm, (WIDTH - first) / (len(head) - 1))
    return Grid(
        cells,
        colWidths=[first, *[rest] * (len(head) - 1)],
        repeatRows=1,
        style=[
            ("LINEBELOW", (0, 0), (-1, 0), 0.7, INK),
            ("LINEBELOW", (0, 1), (-1, -1), 0.3, RULE),
            ("VALIGN", (0, 0), (-1, -1), "BOTTOM"),
            ("LEFTPADDING", (0, 0), (-1, -1), 0),
            ("RIGHTPADDING", (0, 0), (-1, -1), 2),
            ("TOPPADDING", (0, 0), (-1, -1), 1.6),
            ("BOTTOMPADDING", (0, 0), (-1, -1), 2.2),
        ],
        spaceAfter=3 * mm,
        hAlign="LEFT",
    )


def _laid(
    pages: io.BytesIO,
    figures: Sequence[Figure],
    places: Places,
    path: Path,
) -> None:
    """Lay the plots into their places and write the file."""
    writer = PdfWriter(clone_from=PdfReader(pages))
    for number, figure in enumerate(figures):
        page, x, y, width = places[number]
        drawn = io.BytesIO()
        with styled():
            figure.savefig(drawn, format="pdf", dpi=200)
        plot = PdfReader(drawn).pages[0]
        scale = width / float(plot.mediabox.width)
        writer.pages[page].merge_transformed_page(
            plot, Transformation().scale(scale).translate(x, y)
        )
    for page_made in writer.pages:
        page_made.compress_content_streams()
    with path.open("wb") as file:
        writer.write(file)


def _fonts() -> None:
    """Register the fonts that the plots use too."""
    folder = Path(mpl.get_data_path()) / "fonts" / "ttf"
    for name in (SANS, BOLD, MONO):
        pdfmetrics.registerFont(TTFont(name, folder / f"{name}.ttf"))


def _styles() -> dict[str, ParagraphStyle]:
    plain = ParagraphStyle("plain", fontName=SANS, fontSize=8, leading=10.6, textColor=INK)

    def style(name: str, **how: Any) -> ParagraphStyle:
        return ParagraphStyle(name, plain, **how)

    return {
        "title": style("title", fontName=BOLD, fontSize=17, leading=21),
        "subtitle": style("subtitle", fontSize=9.5, leading=13, textColor=PALE, spaceAfter=5 * mm),
        "heading": style("heading", fontName=BOLD, fontSize=11, leading=14,
                         spaceBefore=3 * mm, spaceAfter=2 * mm),
        "words": style("words", spaceAfter=3 * mm),
        "caption": style("caption", fontSize=7.5, textColor=PALE, spaceAfter=3 * mm),
        "name": style("name", textColor=PALE),
        "cell": plain,
        "number": style("number", alignment=TA_RIGHT),
        "head": style("head", alignment=TA_RIGHT, textColor=PALE),
        "head-left": style("head-left", textColor=PALE),
        "lettering": style("lettering", fontName=MONO, fontSize=7, leading=9),
    }  # fmt: skip
