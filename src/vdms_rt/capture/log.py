"""Frames out of an MCAP of ours: whole, or put together from the regions that were recorded.

A picture made of regions has the recorded size and is black outside of them, also around a black
marker on white: nothing is measured there. Field order, times and damage are as they were recorded.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from typing import TypeVar

from google.protobuf.message import DecodeError, Message

from vdms_rt.config import Log
from vdms_rt.logfile.reader import LogFileError, LogReader, StoredMessage
from vdms_rt.model import (
    NTSC_FRAME_PERIOD_S,
    PAL_FRAME_PERIOD_S,
    Damage,
    Grab,
    Luma,
    Scan,
    SourceEnded,
    SourceError,
    SourceInfo,
    StampEvent,
    Tick,
)
from vdms_rt.setup import SetUp, set_up_from_json
from vdms_rt.wire import vdms_pb2 as pb
from vdms_rt.wire.convert import paste_pixels

LONGEST_GAP_NS = 1_000_000_000
"""A longer one in the recording, or a step back, is not waited for at pace realtime."""

M = TypeVar("M", bound=Message)


class LogSource:
    """Gives the frames of one recording, also of an unfinished or damaged one."""

    def __init__(self, config: Log) -> None:
        """Open the recording. Raises SourceError if there is none or it holds no pixels."""
        self._path = Path(config.path).expanduser()
        self._realtime = config.pace == "realtime"
        self._reader = _open(self._path)
        self._anchor: tuple[int, float] | None = None
        """A recorded time and the moment, in seconds, at which it is played."""
        self._last_t_ns = 0
        self._frames = 0
        self._facts: list[tuple[str, str]] = []
        self._known = False
        """Something of ours stood in the file."""
        self._pixels = self._messages()
        self._next: pb.Pixels | None = None
        try:
            self._info = self._begin()
        except SourceError:
            self.close()
            raise

    @property
    def info(self) -> SourceInfo:
        return self._info

    def read(self, out: Luma, timeout_s: float) -> Grab | None:
        """Fill `out` with the next recorded picture; see `Source.read`."""
        pixels = self._next
        if pixels is None:
            raise SourceEnded(self._ending())
        if self._realtime and not self._is_due(pixels.t_ns, timeout_s):
            return None
        if (pixels.height_px, pixels.width_px) != out.shape:
            raise SourceError(
                f"{self._path}: from frame {self._frames + 1} on the pictures are "
                f"{pixels.width_px} x {pixels.height_px} px and no longer "
                f"{out.shape[1]} x {out.shape[0]} px; only the part before can be measured again"
            )
        try:
            paste_pixels(pixels, out)
        except ValueError as error:
            raise SourceError(f"{self._path}: frame {self._frames + 1} has {error}") from None
        self._frames += 1
        self._next = next(self._pixels, None)
        return Grab(
            stamp_ns=pixels.stamp_ns,
            sequence=pixels.frame_seq,
            scan=Scan(pixels.scan),
            damage=Damage(pixels.damage),
            tick=Tick(
                index=pixels.frame_seq,
                t_ns=pixels.t_ns,
                sigma_t_ns=pixels.sigma_t_ns,
                segment=pixels.segment,
                utc_ns=pixels.utc_ns,
            ),
        )

    def close(self) -> None:
        self._reader.close()

    def _messages(self) -> Iterator[pb.Pixels]:
        for record in self._reader:
            if not isinstance(record, StoredMessage) or record.schema is None:
                continue
            self._known = self._known or record.schema.name.startswith("vdms.")
            if record.schema.name == "vdms.Pixels":
                yield _decoded(self._path, pb.Pixels, record)
            elif record.schema.name == "vdms.Run" and not self._facts:
                self._facts = _facts(_decoded(self._path, pb.Run, record))

    def _begin(self) -> SourceInfo:
        pixels = self._next = next(self._pixels, None)
        if pixels is None:
            raise SourceError(self._why_no_pixels())
        if not (pixels.width_px and pixels.height_px and pixels.period_ns):
            raise SourceError(f"{self._path}: its pixels have no size or no frame period")
        scan = Scan(pixels.scan)
        return SourceInfo(
            kind="log",
            name=f"recording {self._path.name}",
            width_px=pixels.width_px,
            height_px=pixels.height_px,
            frame_period_s=_period_s(pixels.period_ns),
            scan=Scan.TOP if scan is Scan.BOTTOM else scan,
            live=self._realtime,
            stamp_event=StampEvent.MID_EXPOSURE,
            sequence_counts_lost=True,
            scan_known=scan is Scan.PROGRESSIVE or pixels.order_known,
            exposure_ns=pixels.exposure_ns if pixels.HasField("exposure_ns") else None,
            facts=(("file", str(self._path)), *self._facts),
        )

    def _is_due(self, t_ns: int, timeout_s: float) -> bool:
        """Wait for the frame's turn; False if it does not come within `timeout_s`."""
        gap_ns = t_ns - self._last_t_ns
        if self._anchor is None or not 0 <= gap_ns <= LONGEST_GAP_NS:
            self._anchor = t_ns, time.monotonic()
        self._last_t_ns = t_ns
        anchor_t_ns, anchor_s = self._anchor
        wait_s = anchor_s + (t_ns - anchor_t_ns) / 1e9 - time.monotonic()
        time.sleep(min(max(wait_s, 0.0), timeout_s))
        return wait_s <= timeout_s

    def _why_no_pixels(self) -> str:
        if self._reader.faults:
            return f"{self._path}: damaged, no pixels can be read: {self._reader.faults[0]}"
        if not self._known:
            return f"{self._path}: an MCAP, but not one that vdms-rt recorded"
        return (
            f"{self._path}: holds no pixels, so nothing can be measured again; record with "
            'record.pixels = "regions" or "frames"'
        )

    def _ending(self) -> str:
        damage = ""
        if self._reader.dropped_bytes:
            damage = f"; {self._reader.dropped_bytes} bytes of it were not readable"
        return f"{self._path.name} ended after {self._frames} frames{damage}"


def recorded_set_up(config: Log) -> SetUp | None:
    """Return the set-up with which the recording's pixels were measured first, None without one.

    Raises SourceError if the recording cannot be read, SetUpError if its set-up cannot be used.
    """
    found: dict[int, str] = {}
    with _open(Path(config.path).expanduser()) as reader:
        for record in reader:
            if not isinstance(record, StoredMessage) or record.schema is None:
                continue
            if record.schema.name == "vdms.SetUp":
                set_up = _decoded(reader.path, pb.SetUp, record)
                found[set_up.revision] = set_up.json
            elif record.schema.name == "vdms.Pixels":
                revision = _decoded(reader.path, pb.Pixels, record).setup_revision
                if revision in found:
                    return set_up_from_json(found[revision])
    return None


def _open(path: Path) -> LogReader:
    try:
        return LogReader(path)
    except LogFileError as error:
        raise SourceError(
            f"{error}; log.path must name a recording of vdms-rt, an .mcap or .mcap.part file"
        ) from None


def _decoded(path: Path, type_: type[M], record: StoredMessage) -> M:
    try:
        return type_.FromString(record.message.data)
    except DecodeError:
        raise SourceError(
            f"{path}: holds a {type_.DESCRIPTOR.full_name} that cannot be decoded; was it recorded "
            "by a newer version of vdms-rt?"
        ) from None


def _facts(run: pb.Run) -> list[tuple[str, str]]:
    own = [("recorded by", f"vdms-rt {run.version}"), ("recorded at", run.station)]
    return own + [(f"recorded {fact.name}", fact.value) for fact in run.facts]


def _period_s(period_ns: int) -> Fraction:
    """Return the standard's exact period where the recorded one is it, rounded."""
    for period_s in (NTSC_FRAME_PERIOD_S, PAL_FRAME_PERIOD_S):
        if round(period_s * 1_000_000_000) == period_ns:
            return period_s
    return Fraction(period_ns, 1_000_000_000)
