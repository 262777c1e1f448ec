"""Frames out of recorded files: a lossless video, or a folder of PNG or PGM pictures."""

from __future__ import annotations

import re
import time
from fractions import Fraction
from pathlib import Path
from typing import Protocol

from vdms_rt import codec
from vdms_rt.capture.video import Video
from vdms_rt.config import Clip
from vdms_rt.model import (
    Grab,
    Luma,
    Scan,
    SourceEnded,
    SourceError,
    SourceInfo,
    StampEvent,
)

SUFFIXES = (".png", ".pgm")
SCANS = {
    "progressive": Scan.PROGRESSIVE,
    "top-first": Scan.TOP_FIRST,
    "bottom-first": Scan.BOTTOM_FIRST,
}


class Reel(Protocol):
    """Pictures one after the other."""

    width_px: int
    height_px: int

    @property
    def facts(self) -> tuple[tuple[str, str], ...]: ...

    def next(self) -> Luma | None:
        """Return the next picture, or None after the last; raises SourceError."""
        ...

    def rewind(self) -> None: ...

    def close(self) -> None: ...


class ClipSource:
    """Gives the pictures of a clip at `rate_hz`, as fast as they are taken or in their own time.

    The stamp of picture i is i / rate, exact to the nanosecond (a quarter of a period later for an
    interlaced one, whose earlier field is then at i / rate), from the beginning of the clip at
    pace fast and from the first read at pace realtime. A loop goes on counting.
    """

    def __init__(self, config: Clip) -> None:
        """Open the clip. Raises SourceError if it is not there or cannot be read."""
        path = Path(config.path).expanduser()
        self._reel = _open(path)
        self._rate_hz = config.rate_hz
        self._loop = config.loop
        self._realtime = config.pace == "realtime"
        self._start_ns: int | None = None
        self._index = 0
        self._waiting: Luma | None = None
        """The next picture, while its time has not come."""
        self._info = SourceInfo(
            kind="clip",
            name=f"clip {path.name}",
            width_px=self._reel.width_px,
            height_px=self._reel.height_px,
            frame_period_s=1 / Fraction(config.rate_hz),
            scan=SCANS[config.field_order],
            live=self._realtime,
            stamp_event=StampEvent.MID_EXPOSURE,
            sequence_counts_lost=True,
            scan_known=True,
            facts=(("file", str(path)), *self._reel.facts),
        )

    @property
    def info(self) -> SourceInfo:
        return self._info

    def read(self, out: Luma, timeout_s: float) -> Grab | None:
        """Fill `out` with the next picture; see `Source.read`."""
        if self._waiting is None:
            self._waiting = self._next()
        # Of an interlaced picture the earlier field is at i / rate, so that no time is before 0;
        # the stamp is the middle of both.
        quarters = 4 * self._index + self._info.scan.interlaced
        stamp_ns = round(Fraction(quarters * 250_000_000) / self._rate_hz)
        if self._realtime:
            if self._start_ns is None:
                self._start_ns = time.monotonic_ns()
            stamp_ns += self._start_ns
            wait_s = (stamp_ns - time.monotonic_ns()) / 1e9
            time.sleep(min(max(wait_s, 0.0), timeout_s))
            if wait_s > timeout_s:
                return None
        out[:] = self._waiting
        self._waiting = None
        grab = Grab(stamp_ns=stamp_ns, sequence=self._index, scan=self._info.scan)
        self._index += 1
        return grab

    def close(self) -> None:
        self._reel.close()

    def _next(self) -> Luma:
        picture = self._reel.next()
        if picture is None and self._loop and self._index:
            self._reel.rewind()
            picture = self._reel.next()
        if picture is None:
            raise SourceEnded(f"{self._info.name} ended after {self._index} frames")
        return picture


class Folder:
    """The pictures of a folder in the order of their names, numbers in them by value."""

    def __init__(self, directory: Path, paths: list[Path]) -> None:
        """Raises SourceError if there is none or the first cannot be read."""
        if not paths:
            raise SourceError(
                f"clip.path = {directory}: a folder without PNG or PGM pictures; "
                "convert the pictures, or name another folder"
            )
        self._paths = paths
        self._position = 0
        first, self._exact = self._read(paths[0])
        self.height_px, self.width_px = first.shape

    @property
    def facts(self) -> tuple[tuple[str, str], ...]:
        luma = "exact" if self._exact else "made from colours (Rec. 601) or from 16 bits"
        return (("pictures", str(len(self._paths))), ("luma", luma))

    def next(self) -> Luma | None:
        if self._position == len(self._paths):
            return None
        path = self._paths[self._position]
        self._position += 1
        picture, _ = self._read(path)
        if picture.shape != (self.height_px, self.width_px):
            raise SourceError(
                f"{path}: the picture is {picture.shape[1]} x {picture.shape[0]} px, but "
                f"{self._paths[0].name} is {self.width_px} x {self.height_px} px; the pictures of "
                "a clip must have one size"
            )
        return picture

    def rewind(self) -> None:
        self._position = 0

    def close(self) -> None:
        """Nothing is open between two pictures."""

    def _read(self, path: Path) -> tuple[Luma, bool]:
        try:
            decoded = codec.decode_picture(path.read_bytes())
        except OSError as error:
            raise SourceError(
                f"{path}: cannot be read: {(error.strerror or str(error)).lower()}"
            ) from None
        if decoded is None:
            raise SourceError(f"{path}: not a picture that can be read; remove or replace it")
        return decoded


def _open(path: Path) -> Reel:
    try:
        if path.is_dir():
            pictures = [p for p in path.iterdir() if p.suffix.lower() in SUFFIXES]
            return Folder(path, sorted(pictures, key=_natural))
        path.stat()
    except OSError as error:
        raise SourceError(
            f"clip.path = {path}: {(error.strerror or str(error)).lower()}; name a lossless video "
            "or a folder of PNG or PGM pictures"
        ) from None
    if path.suffix.lower() in SUFFIXES:
        return Folder(path.parent, [path])
    return Video(path)


def _natural(path: Path) -> list[tuple[int, str]]:
    """Return a sort key by which img2 comes before img10."""
    parts = re.split(r"(\d+)", path.name)
    return [(int(part), part) if i % 2 else (-1, part) for i, part in enumerate(parts)]
