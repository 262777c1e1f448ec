"""Which recordings lie in a folder: names, lengths, sizes."""

from __future__ import annotations

import calendar
import re
import time
from dataclasses import dataclass
from pathlib import Path

from mcap.exceptions import McapError
from mcap.reader import make_reader

_NAME = re.compile(
    r"(?P<station>.+?)_(?P<utc>\d{8}T\d{6}Z)(?:_(?P<run>.+))?_(?P<part>\d{3,})\.mcap(\.part)?"
)


@dataclass(frozen=True, slots=True)
class FileName:
    """What the name of a recording tells."""

    station: str
    utc: str
    """When the run began, as 20260131T235959Z."""
    run: str
    """That was started by name, or empty."""
    part: int


def parse_name(name: str) -> FileName | None:
    """Return what a recording's file name tells, or None if it is not one's."""
    if (named := _NAME.fullmatch(name)) is None:
        return None
    return FileName(named["station"], named["utc"], named["run"] or "", int(named["part"]))


@dataclass(frozen=True, slots=True)
class Recording:
    """One file."""

    name: str
    run: str
    """That was started by name, or empty."""
    begin_utc_ns: int
    length_s: float
    size_bytes: int
    open: bool
    """It is being written, or was left so."""


def list_recordings(directory: Path) -> list[Recording]:
    """Return the recordings in a folder, the newest first; none where there is no folder.

    Reads only the end of each file.
    """
    recordings = []
    for path in sorted((*directory.glob("*.mcap"), *directory.glob("*.mcap.part"))):
        if (named := parse_name(path.name)) is None:
            continue
        begin_s = calendar.timegm(time.strptime(named.utc, "%Y%m%dT%H%M%SZ"))
        try:
            about = path.stat()
            span_ns = None if path.suffix == ".part" else _span_ns(path)
        except OSError:
            continue  # it was closed and renamed, or removed, just now
        begin_ns, end_ns = span_ns or (begin_s * 10**9, about.st_mtime_ns)
        recordings.append(
            Recording(
                name=path.name.removesuffix(".part"),
                run=named.run,
                begin_utc_ns=begin_ns,
                length_s=max(end_ns - begin_ns, 0) / 1e9,
                size_bytes=about.st_size,
                open=path.suffix == ".part",
            )
        )
    return sorted(recordings, key=lambda r: (r.begin_utc_ns, r.name), reverse=True)


def _span_ns(path: Path) -> tuple[int, int] | None:
    """Return the times of the first and last message, or None where the file does not tell."""
    with path.open("rb") as file:
        try:
            summary = make_reader(file).get_summary()
        except McapError:
            return None
    if summary is None or summary.statistics is None or not summary.statistics.message_count:
        return None
    return summary.statistics.message_start_time, summary.statistics.message_end_time
