"""Taking the pixels out of a recording, and nothing else."""

from __future__ import annotations

import os
from collections.abc import Generator
from pathlib import Path

from mcap.records import Metadata

from vdms_rt.logfile.reader import LogReader
from vdms_rt.logfile.repair import Copy
from vdms_rt.logfile.writer import sync_directory
from vdms_rt.wire import vdms_pb2 as pb

THIN_SUFFIX = ".thin"
ABOUT = "vdms"
"""The metadata record at the head of each file."""
KEEP_PIXELS = "keep_pixels"
"""In that record: "always", "newest" (they may go when newer ones need the room) or "removed"."""
PIXELS = frozenset(m.DESCRIPTOR.full_name for m in (pb.Pixels, pb.Checkpoint))


def thin(path: Path) -> Generator[None]:
    """Take the pixels out of a complete recording, chunk by chunk with each step.

    The new file takes the place of the old one at the last step, when it is on the disk. Raises
    LogFileError and OSError; given up half-way, it leaves the recording as it was.
    """
    new = path.with_name(path.name + THIN_SUFFIX)
    try:
        with LogReader(path) as reader, new.open("wb") as out:
            copy = Copy(out, without=PIXELS)
            for block in reader.blocks():
                for record in block.records:
                    if isinstance(record, Metadata) and record.name == ABOUT:
                        record.metadata[KEEP_PIXELS] = "removed"
                copy.add(block)
                yield
            copy.finish()
            out.flush()
            os.fsync(out.fileno())
        new.replace(path)
        sync_directory(path.parent)
    finally:
        new.unlink(missing_ok=True)


def pixels_may_go(path: Path) -> bool:
    """Whether the pixels of a recording are kept only as long as there is room."""
    with LogReader(path) as reader:
        for block in reader.blocks():
            for record in block.records:
                if isinstance(record, Metadata) and record.name == ABOUT:
                    return record.metadata.get(KEEP_PIXELS) == "newest"
            if block.chunk is not None:
                break
    return False
