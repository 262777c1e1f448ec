"""When was a frame: the steady grid behind a driver's stamps, and the middle of the exposure."""

from __future__ import annotations

import math
from dataclasses import dataclass

from vdms_rt.capture.line import StampLine
from vdms_rt.capture.utc import UtcOffset
from vdms_rt.model import Event, Scan, Severity, SourceInfo, StampEvent, Tick

UTC_SAMPLE_NS = 1_000_000_000
STALL_NS = 2_000_000_000
"""After so long without a frame the source's phase is not taken for granted."""
EARLY = 0.25
"""Part of a period by which a stamp may be earlier than foreseen; it may be late by the rest."""
RECORDED = ("clip", "log")
"""Kinds of sources whose stamps are mid-exposure times already, and exact."""


@dataclass(frozen=True, slots=True)
class ClockFigures:
    """How the frame clock is, for `Health`."""

    jitter_us: float
    """Standard deviation of the driver's stamps about the frame clock."""
    sigma_us: float
    """Of the latest time, a constant delay aside."""
    rate_ppm: float
    """Positive when frames come fast."""
    missed: int
    """Frame periods without a frame."""
    segments: int
    utc_state: str


def mid_exposure_ns(info: SourceInfo, exposure_ns: int, chain_delay_ns: int, scan: Scan) -> int:
    """Return what is added to a stamp's true moment to get the middle of the exposure.

    A field's readout takes half a period T and starts as its exposure e ends. So an interlaced
    frame, whose two fields lie T/4 before and after its middle, ends 3T/4 + e/2 after it, a
    progressive one T + e/2, a single field T/2 + e/2.
    """
    exposure_ns = exposure_ns if info.exposure_ns is None else info.exposure_ns
    quarter_ns = info.frame_period_s * 10**9 / 4
    quarters = 3 if scan.interlaced else 4 if scan is Scan.PROGRESSIVE else 2
    match info.stamp_event:
        case StampEvent.END_OF_FRAME:
            return round(-quarters * quarter_ns) - exposure_ns // 2 - chain_delay_ns
        case StampEvent.START_OF_EXPOSURE:
            first_to_middle = 1 if scan.interlaced else 0
            return round(first_to_middle * quarter_ns) + exposure_ns // 2 - chain_delay_ns
        case StampEvent.MID_EXPOSURE:
            return -chain_delay_ns


class FrameClock:
    """Index and mid-exposure time of each frame of one source. Used by the capture thread alone.

    With a source of alternating fields every buffer ticks: the two fields of a frame get the same
    index and times half a period apart.
    """

    def __init__(
        self,
        info: SourceInfo,
        exposure_ns: int,
        chain_delay_ns: int = 0,
        utc: UtcOffset | None = None,
    ) -> None:
        """`exposure_ns` holds where the source does not know its own; `chain_delay_ns` is taken
        off every time but a recording's."""
        self._info = info
        self._per_frame = 2 if info.scan in (Scan.TOP, Scan.BOTTOM) else 1
        self._exact = info.kind in RECORDED
        self._period_ns = info.frame_period_s * 10**9 / self._per_frame
        self._delays = {
            scan: 0 if self._exact else mid_exposure_ns(info, exposure_ns, chain_delay_ns, scan)
            for scan in Scan
        }
        self._utc = (utc or UtcOffset()) if info.live else None
        self._utc_due_ns = 0
        self._line = StampLine(self._period_ns)
        self._slot = -1
        self._stamp_ns = 0
        self._sequence = 0
        self._first_scan: Scan | None = None
        self._segment = 0
        self._missed = 0
        self._sigma_ns = 0.0
        self._events: list[Event] = []

    def tick(self, stamp_ns: int, sequence: int, scan: Scan | None = None) -> Tick:
        """Return when the frame with this stamp was; call it once for every image delivered.

        `scan` tells which field an image of alternating fields is.
        """
        scan = self._info.scan if scan is None else scan
        if stamp_ns >= self._utc_due_ns:
            self.sample_utc()
            self._utc_due_ns = stamp_ns + UTC_SAMPLE_NS
        if self._slot < 0:
            self._slot = 0
            self._line.begin(0, stamp_ns)
        else:
            self._advance(stamp_ns, sequence)
        self._stamp_ns, self._sequence = stamp_ns, sequence
        t_ns = stamp_ns if self._exact else self._line.at(self._slot) + self._delays[scan]
        self._sigma_ns = 0.0 if self._exact else self._line.sigma_ns(self._slot)
        return Tick(
            index=self._slot // self._per_frame,
            t_ns=t_ns,
            sigma_t_ns=math.ceil(self._sigma_ns),
            segment=self._segment,
            utc_ns=t_ns + self._utc.offset_ns if self._utc else 0,
        )

    def sample_utc(self) -> None:
        """Read the UTC clock; `tick` does it once a second."""
        if self._utc:
            _, events = self._utc.sample()
            self._events += events

    def take_events(self) -> list[Event]:
        """Return what happened since the last call."""
        events, self._events = self._events, []
        return events

    @property
    def figures(self) -> ClockFigures:
        return ClockFigures(
            jitter_us=0.0 if self._exact else self._line.jitter_ns / 1e3,
            sigma_us=self._sigma_ns / 1e3,
            rate_ppm=self._line.rate * 1e6,
            missed=self._missed,
            segments=self._segment + 1,
            utc_state=self._utc.state if self._utc else "unknown",
        )

    def _advance(self, stamp_ns: int, sequence: int) -> None:
        if stamp_ns < self._stamp_ns or stamp_ns - self._stamp_ns > STALL_NS:
            self._break(stamp_ns)
            return
        late_ns = stamp_ns - self._line.at(self._slot + 1)
        lost = max(0, math.floor(late_ns / self._period_ns + EARLY))
        if self._info.sequence_counts_lost and not self._exact and self._per_frame == 1:
            lost = max(0, sequence - self._sequence - 1)
        if lost and not self._exact:
            self._miss(lost, stamp_ns)
        self._slot += 1 + lost
        self._line.add(self._slot, stamp_ns)

    def _miss(self, lost: int, stamp_ns: int) -> None:
        self._missed += lost
        self._event(
            Severity.WARNING,
            "frames-missed",
            f"{lost} frame{'s' if lost > 1 else ''} missed after frame "
            f"{self._slot // self._per_frame}.",
            stamp_ns,
        )

    def _break(self, stamp_ns: int) -> None:
        gap_ns = stamp_ns - self._stamp_ns
        self._segment += 1
        self._slot += max(1, round(gap_ns / self._period_ns))
        self._line.begin(self._slot, stamp_ns)
        how = f"a pause of {gap_ns / 1e9:.3f} s" if gap_ns > 0 else "stamps that went back"
        self._event(
            Severity.WARNING, "clock-jump", f"Frame times start anew after {how}.", stamp_ns
        )

    def _event(self, severity: Severity, code: str, text: str, t_ns: int) -> None:
        utc_ns = t_ns + self._utc.offset_ns if self._utc else 0
        self._events.append(Event(severity, code, text, t_ns, utc_ns))
