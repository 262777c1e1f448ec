"""`vdms-replay recover`: completes what a kill or a pulled plug left unfinished."""

from __future__ import annotations

import argparse
import contextlib
import os
from pathlib import Path

from vdms_replay.source import ReplayError, open_log
from vdms_replay.verb import Verbs, make_parser, progress
from vdms_rt.logfile.reader import LogFileError
from vdms_rt.logfile.repair import copy_readable, repair
from vdms_rt.logfile.writer import PART_SUFFIX


def add_parser(verbs: Verbs) -> None:
    parser = make_parser(
        verbs,
        "recover",
        run,
        "complete an unfinished or damaged recording",
        "An unfinished file (.mcap.part) is completed in its place, as the daemon does at its next "
        "start: everything whose checksum holds is kept. Of a damaged .mcap the readable part is "
        "written beside it, and the damaged file stays.",
    )
    parser.add_argument("files", nargs="+", type=Path, metavar="FILE")
    parser.add_argument(
        "--out", type=Path, metavar="FILE", help="write the completed copy here; FILE stays"
    )


def run(arguments: argparse.Namespace) -> int:
    if arguments.out is not None and len(arguments.files) > 1:
        raise ReplayError("--out takes one file; name one recording")
    for path in arguments.files:
        print(recover(path, arguments.out))
    return 0


def recover(path: Path, out: Path | None = None) -> str:
    """Complete one recording and return a sentence about what became of it.

    Without `out` a `.part` is completed in its place, a damaged `.mcap` into `NAME-recovered.mcap`,
    and a whole one is left alone. A terminal gets a bar. Raises ReplayError.
    """
    try:
        if out is None and path.name.endswith(PART_SUFFIX):
            with progress(f"recovering {path.name}", _size_bytes(path)) as advance:
                return repair(path, advance).sentence
        return _copy(path, out)
    except BlockingIOError:
        raise ReplayError(
            f"{path}: is being recorded right now; stop the recording first"
        ) from None
    except LogFileError as error:
        raise ReplayError(f"{error}; name a recording of vdms-rt, an .mcap file") from None
    except OSError as error:
        where = error.filename or path
        raise ReplayError(f"{where}: {(error.strerror or str(error)).lower()}") from None


def _size_bytes(path: Path) -> int:
    return path.stat().st_size if path.is_file() else 0


def _copy(path: Path, out: Path | None) -> str:
    target = out or path.with_name(f"{path.name.partition('.mcap')[0]}-recovered.mcap")
    with open_log(path) as reader:
        if out is None and reader.complete:
            with progress(f"checking {path.name}", _size_bytes(path)) as advance:
                for block in reader.blocks():
                    advance(len(block.content))
            if not reader.dropped_bytes:
                return f"{path}: whole, nothing to recover"
    with open_log(path) as reader, target.open("xb") as file:
        try:
            with progress(f"recovering {path.name}", _size_bytes(path)) as advance:
                messages = copy_readable(reader, file, advance)
            file.flush()
            os.fsync(file.fileno())
        except OSError:
            with contextlib.suppress(OSError):
                target.unlink()
            raise
    left_out = f", {reader.dropped_bytes} unreadable bytes left out" if reader.dropped_bytes else ""
    return f"{target}: recovered from {path.name}, {messages} messages{left_out}"
