"""A report as one HTML file that needs nothing else: plots are vectors within it."""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from html import escape
from pathlib import Path

from matplotlib.figure import Figure

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

STYLE = """
:root { color-scheme: light; }
body { font: 15px/1.45 "DejaVu Sans", "Segoe UI", "Helvetica Neue", Arial, sans-serif;
  color: #202020; background: #fff; max-width: 60rem; margin: 2.5rem auto; padding: 0 1.25rem; }
h1 { font-size: 1.9rem; margin: 0; }
.subtitle, .caption, footer, dt, th { color: #5c5c5c; }
.subtitle { margin: .2rem 0 1.6rem; font-size: 1.05rem; }
h2 { font-size: 1.25rem; margin: 2.2rem 0 .6rem; }
figure { margin: .6rem 0 1.2rem; }
figure svg { width: 100%; height: auto; display: block; }
.caption { font-size: .87rem; margin: .2rem 0 0; }
dl { display: grid; grid-template-columns: minmax(9rem, 15rem) 1fr; margin: .4rem 0 1.2rem; }
dt, dd { margin: 0; padding: .28rem 1rem .28rem 0; border-bottom: 1px solid #ddd;
  overflow-wrap: anywhere; }
.wide { overflow-x: auto; margin: .4rem 0 1.2rem; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
th { font-weight: normal; text-align: right; border-bottom: 1.5px solid #202020; }
td { text-align: right; border-bottom: 1px solid #ddd; white-space: nowrap; }
th, td { padding: .28rem 0 .28rem 1.6rem; }
th:first-child, td:first-child { text-align: left; padding-left: 0; }
pre { font-size: .85rem; overflow-x: auto; background: #f5f5f5; padding: .8rem 1rem; }
footer { margin: 3rem 0 0; font-size: .87rem; }
@media print { body { margin: 0; max-width: none; font-size: 10pt; }
  figure, dl, table, pre { break-inside: avoid; } h2 { break-after: avoid; } }
"""


def write_html(report: Report, path: Path) -> None:
    """Write a report as HTML. Raises OSError."""
    body = "\n".join(_element(block, number) for number, block in enumerate(report.blocks))
    path.write_text(
        "<!doctype html>\n"
        f'<html lang="en"><head><meta charset="utf-8"><title>{escape(report.title)}, '
        f"{escape(report.subtitle)}</title>\n"
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<style>{STYLE}</style></head>\n<body>\n<h1>{escape(report.title)}</h1>\n"
        f'<p class="subtitle">{escape(report.subtitle)}</p>\n{body}\n'
        f"<footer>{escape(made())}</footer>\n</body></html>\n",
        encoding="utf-8",
    )


def _element(block: Block, number: int) -> str:
    match block:
        case Heading(text):
            return f"<h2>{escape(text)}</h2>"
        case Words(text):
            return f"<p>{escape(text)}</p>"
        case Facts(rows):
            inner = "".join(f"<dt>{escape(n)}</dt><dd>{escape(text)}</dd>" for n, text in rows)
            return f"<dl>{inner}</dl>"
        case Table(head, rows):
            return f'<div class="wide"><table>{_row("th", head)}{_rows(rows)}</table></div>'
        case Lettering(text):
            return f"<pre>{escape(text)}</pre>"
        case Drawing(figure, caption):
            told = f'<p class="caption">{escape(caption)}</p>' if caption else ""
            return f"<figure>{_svg(figure, number)}{told}</figure>"


def _rows(rows: Sequence[Sequence[str]]) -> str:
    return "".join(_row("td", row) for row in rows)


def _row(tag: str, cells: Sequence[str]) -> str:
    return "<tr>" + "".join(f"<{tag}>{escape(cell)}</{tag}>" for cell in cells) + "</tr>"


def _svg(figure: Figure, number: int) -> str:
    """Return a figure as an SVG element whose ids are its own on the page."""
    drawn = io.StringIO()
    with styled():
        figure.savefig(drawn, format="svg", dpi=200)
    text = drawn.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r'\bid="', f'id="p{number}-', text)
    return re.sub(r'(href="|url\()#', rf"\1#p{number}-", text)
