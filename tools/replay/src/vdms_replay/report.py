"""`vdms-replay report`: what an engineer hands on."""

from __future__ import annotations

import argparse
from pathlib import Path

from vdms_replay.comparison import add_reference_arguments, compared
from vdms_replay.part import Part, add_part_arguments, read_part
from vdms_replay.source import ReplayError, Source
from vdms_replay.verb import Verbs, make_parser, progress

FORMATS = (".pdf", ".html")


def add_parser(verbs: Verbs) -> None:
    parser = make_parser(
        verbs,
        "report",
        run,
        "write a report of a recording",
        "Time history, peaks, path, spectrum, quality and uncertainty, gaps, the set-up with its "
        "picture, warnings, and with --reference the comparison: a PDF, or an HTML file that needs "
        "nothing else. The files are the parts of one recording.",
    )
    parser.add_argument("files", nargs="+", type=Path, metavar="FILE")
    parser.add_argument(
        "--out", type=Path, required=True, metavar="OUT", help="a .pdf or an .html file"
    )
    parser.add_argument("--title", default="", metavar="TEXT", help="the heading of the report")
    parser.add_argument("--note", default="", metavar="TEXT", help="a paragraph below the heading")
    add_part_arguments(parser)
    add_reference_arguments(parser, several=False)


def run(arguments: argparse.Namespace) -> int:
    out: Path = arguments.out
    if out.suffix.lower() not in FORMATS:
        raise ReplayError(
            f"{out}: a report is a {' or an '.join(FORMATS)} file, "
            f"not {out.suffix or 'one without a suffix'}"
        )
    from vdms_replay.chosen import choose
    from vdms_replay.report_content import NEEDED, report_of

    source = Source(arguments.files)
    with progress("reading", source.size_bytes) as advance:
        part = Part(NEEDED, arguments.marker, arguments.from_s, arguments.to_s)
        recording = read_part(*arguments.files, part=part, advance=advance)
    chosen = choose(recording, arguments.marker, arguments.from_s, arguments.to_s)
    comparison = None
    if arguments.reference is not None:
        comparison = compared(recording, arguments.reference, arguments)
    report = report_of(recording, chosen, comparison, arguments.title, arguments.note)
    try:
        if out.suffix.lower() == ".pdf":
            from vdms_replay.report_pdf import write_pdf

            write_pdf(report, out)
        else:
            from vdms_replay.report_html import write_html

            write_html(report, out)
    except OSError as error:
        raise ReplayError(
            f"{out}: cannot be written: {(error.strerror or str(error)).lower()}"
        ) from None
    print(f"{out}: report of marker {chosen.marker}, {chosen.count} valid samples")
    return 0
