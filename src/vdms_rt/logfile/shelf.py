"""The room for recordings: how much is free, and what goes when somebody has set a limit."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Generator
from dataclasses import dataclass
from pathlib import Path

from vdms_rt.config import Record
from vdms_rt.logfile.listing import parse_name
from vdms_rt.logfile.reader import LogFileError
from vdms_rt.logfile.thin import THIN_SUFFIX, pixels_may_go, thin
from vdms_rt.model import Severity

FREE_S = 1.0
TIDY_S = 10.0
THIN_SHARE_S = 0.01
"""Of a turn: messages that wait come first."""
ENOUGH = 1.1
"""Pixels are recorded again when there is a tenth more room than they need, lest it flutters."""


@dataclass(frozen=True, slots=True)
class Notice:
    """What there is to tell."""

    severity: Severity
    code: str
    text: str


@dataclass(frozen=True, slots=True)
class _Whole:
    """A file that is complete."""

    path: Path
    order: tuple[str, int]
    run: str
    """The run's own name for all its files; empty outside runs."""
    size_bytes: int


class Shelf:
    """The folder of one station's recordings; used by the record thread alone."""

    def __init__(self, directory: Path, station: str, config: Record) -> None:
        self.free_bytes = 0
        self.tight = False
        """So little room is left that it is kept for displacements."""
        self._directory = directory
        self._station = station
        self._config = config
        self._free_due_s = 0.0
        self._tidy_due_s = 0.0
        self._may_go: dict[Path, bool] = {}
        self._thinning: tuple[Path, Generator[None]] | None = None
        for left in directory.glob(f"{station}_*{THIN_SUFFIX}"):  # by a kill
            with contextlib.suppress(OSError):
                left.unlink()

    def turn(self, current: Path | None, length: int) -> list[Notice]:
        """Look after the room; return what there is to tell.

        `current` is the file being written, by its final name, and `length` its bytes.
        """
        now_s = time.monotonic()
        told: list[Notice] = []
        if now_s >= self._free_due_s:
            self._free_due_s = now_s + FREE_S
            told += self._watch()
        try:
            if now_s >= self._tidy_due_s:
                self._tidy_due_s = now_s + TIDY_S
                told += self._tidy(current, length)
            told += self._thin(now_s + THIN_SHARE_S)
        except (OSError, LogFileError) as error:
            why = str(error)
            if isinstance(error, OSError):
                why = f"{error.filename or self._directory}: {(error.strerror or why).lower()}"
            told.append(Notice(Severity.WARNING, "not-tidied", f"no room could be made: {why}"))
        return told

    def close(self) -> None:
        """Leave nothing half done."""
        if self._thinning is not None:
            self._thinning[1].close()
            self._thinning = None

    def _watch(self) -> list[Notice]:
        try:
            room = os.statvfs(self._directory)
        except OSError:  # the recorder finds that out by itself, and tells it
            return []
        self.free_bytes = room.f_bavail * room.f_frsize
        limit_bytes = self._config.free_mb * 1e6
        tight = self.free_bytes < limit_bytes * (ENOUGH if self.tight else 1.0)
        if tight == self.tight:
            return []
        self.tight = tight
        free = f"{self.free_bytes / 1e6:.0f} MB are free in {self._directory}"
        if not tight:
            return [Notice(Severity.INFO, "room-again", f"{free}: pixels are recorded again")]
        text = (
            f"only {free} (record.free_mb = {self._config.free_mb:g}): from now on no pixels are "
            "recorded, so that the room lasts for displacements; remove what is not needed"
        )
        return [Notice(Severity.WARNING, "room-low", text)]

    def _whole_files(self) -> list[_Whole]:
        """Return the complete recordings of this station, the oldest first."""
        found = []
        for path in self._directory.glob(f"{self._station}_*.mcap"):
            named = parse_name(path.name)
            if named is None or named.station != self._station:
                continue
            with contextlib.suppress(FileNotFoundError):
                run = f"{named.utc}_{named.run}" if named.run else ""
                order = (named.utc, named.part)
                found.append(_Whole(path, order, run, path.stat().st_size))
        return sorted(found, key=lambda whole: whole.order)

    def _tidy(self, current: Path | None, length: int) -> list[Notice]:
        files = self._whole_files()
        told: list[Notice] = []
        if self._config.keep_gb:
            files, told = self._remove_oldest(files, current, length)
        if self._thinning is None:
            self._choose(files, length)
        return told

    def _remove_oldest(
        self, files: list[_Whole], current: Path | None, length: int
    ) -> tuple[list[_Whole], list[Notice]]:
        """Remove what is too much: of runs all files at once, but none of the one under way."""
        named = parse_name(current.name) if current is not None else None
        under_way = f"{named.utc}_{named.run}" if named is not None and named.run else None
        too_much = length + sum(f.size_bytes for f in files) - self._config.keep_gb * 1e9
        gone: list[_Whole] = []
        for file in files:
            if too_much <= 0:
                break
            if file in gone or file.run == under_way:
                continue
            for one in [f for f in files if f.run == file.run] if file.run else [file]:
                one.path.unlink()
                gone.append(one)
                too_much -= one.size_bytes
        if not gone:
            return files, []
        names = ", ".join(one.path.name for one in gone)
        text = (
            f"removed the oldest of the recordings, which were more than record.keep_gb = "
            f"{self._config.keep_gb:g} together: {names}"
        )
        left = [file for file in files if file not in gone]
        return left, [Notice(Severity.INFO, "removed-old", text)]

    def _choose(self, files: list[_Whole], length: int) -> None:
        """Begin with the oldest pixels that newer ones, enough of them, make dispensable."""
        newer_bytes = length
        oldest = None
        known, self._may_go = self._may_go, {}
        for file in reversed(files):
            if file.run:
                continue
            may_go = known.get(file.path)
            if may_go is None:
                try:
                    may_go = pixels_may_go(file.path)
                except LogFileError:
                    may_go = False
            self._may_go[file.path] = may_go
            if may_go:
                if newer_bytes >= self._config.newest_pixels_gb * 1e9:
                    oldest = file.path
                newer_bytes += file.size_bytes
        if oldest is not None:
            self._thinning = (oldest, thin(oldest))

    def _thin(self, until_s: float) -> list[Notice]:
        if self._thinning is None:
            return []
        path, steps = self._thinning
        try:
            for _ in steps:
                if time.monotonic() >= until_s:
                    return []
        except (OSError, LogFileError):
            self._thinning = None
            self._may_go[path] = False
            raise
        self._thinning = None
        self._may_go[path] = False
        self._tidy_due_s = 0.0
        text = (
            f"{path.name}: its pixels were removed, displacements stay; outside runs the newest "
            f"{self._config.newest_pixels_gb:g} GB of them are kept (record.newest_pixels_gb)"
        )
        return [Notice(Severity.INFO, "pixels-removed", text)]
