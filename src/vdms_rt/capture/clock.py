"""When was a frame: the steady grid behind a driver's stamps, and the middle of the exposure."""

from __future__ import annotations

import dataclasses
import math
from collections import deque
from dataclasses import dataclass
from fractions import Fraction

from vdms_rt.capture.cadence import STAMPS, Cadence, Pace
from vdms_rt.capture.line import StampLine
from vdms_rt.capture.phase import PhaseWatch
from vdms_rt.capture.turns import FieldTurns
from vdms_rt.capture.utc import UtcOffset
from vdms_rt.model import Event, Scan, Severity, SourceInfo, StampEvent, Tick

UTC_SAMPLE_NS = 1_000_000_000
STALL_NS = 2_000_000_000
"""After so long without an image the source's phase is not taken for granted."""
DISTRUST = 3
"""Images in a row after which their stamps are believed and not a sequence that saw no loss."""
RATE_LIMIT = 400e-6
"""No quartz is off by more: the source runs at another rate than it says."""
RATE_SURE = 900
"""Stamps after which the rate is known well enough for that."""
SHIFT_NS = 300_000
"""A grid that moves by more has a new segment."""
FREE_SIGMA_NS = 3_000_000
"""Of one stamp by itself, which may be late by a few milliseconds."""
RECORDED = ("clip", "log")
"""Kinds of sources whose stamps are mid-exposure times already, and exact."""


@dataclass(frozen=True, slots=True)
class ClockFigures:
    """How the frame clock is, for `Health`."""

    jitter_us: float
    """Standard deviation of the driver's stamps about the frame clock."""
    sigma_us: float
    """Of the latest time, as `Tick.sigma_t_ns`."""
    rate_ppm: float
    """Of the source against the computer's clock; positive when frames come fast."""
    missed: int
    """Images that never came while others did: frames, or fields of a source that alternates. The
    time of a source that was off for over two seconds or opened anew is not among them, though
    the index goes on with it; the event of the new segment tells how many it was."""
    segments: int
    settling: bool
    """Too few stamps so far for times at their best."""
    utc_state: str
    """`synchronised`, `not synchronised` or `unknown`."""


def mid_exposure_ns(info: SourceInfo, exposure_ns: int, chain_delay_ns: int, scan: Scan) -> int:
    """Return what is added to the undelayed stamp of an image to get the middle of its exposure.

    A field's readout takes half the frame period T and starts as its exposure e ends. So an
    interlaced frame, whose two fields lie T/4 before and after its middle, ends 3T/4 + e/2 after
    it, a progressive one T + e/2, a single field T/2 + e/2. `exposure_ns` holds where the source
    does not know its own.
    """
    exposure_ns = exposure_ns if info.exposure_ns is None else info.exposure_ns
    quarter_ns = info.frame_period_s * 10**9 / 4
    match info.stamp_event:
        case StampEvent.END_OF_FRAME:
            quarters = 3 if scan.interlaced else 4 if scan is Scan.PROGRESSIVE else 2
            return round(-quarters * quarter_ns) - exposure_ns // 2 - chain_delay_ns
        case StampEvent.START_OF_EXPOSURE:
            quarters = 1 if scan.interlaced else 0
            return round(quarters * quarter_ns) + exposure_ns // 2 - chain_delay_ns
        case StampEvent.MID_EXPOSURE:
            return -chain_delay_ns


class FrameClock:
    """Index and mid-exposure time of each image of a source. Used by the capture thread alone.

    Images are frames, or with a source of alternating fields (`SourceInfo.scan` TOP) fields: the
    two of a frame get the same index and times half a period apart. An image's place on the grid
    is found from its stamp, as most drivers leave no gap in their sequence where they lose a frame.
    A recording's stamps are its times, untouched.

    `Tick.sigma_t_ns` is the standard deviation of what the stamps' lateness leaves: of the time
    against the earliest that the driver ever stamps (or, where its lateness has no sharp lower
    edge, against a constant above that), from the first image on. What is constant in the chain is
    not in it, as no stamp can show it: it shifts a record as a whole and bends nothing.
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
        self._exact = info.kind in RECORDED
        self._fields = 2 if info.scan in (Scan.TOP, Scan.BOTTOM) else 1
        self._exposure_ns, self._chain_delay_ns = exposure_ns, chain_delay_ns
        self._utc = (utc or UtcOffset()) if info.live else None
        self._utc_at_ns: int | None = None
        self._slept = False
        self._set_period(info.frame_period_s * 10**9 / self._fields)
        self._slot: int | None = None
        """Place of the latest image on the grid of the line."""
        self._shift = 0
        """Added to a slot it gives the place that was told."""
        self._stamp_ns = 0
        self._sequence = 0
        self._turns = FieldTurns() if self._fields == 2 else None
        self._free = False
        """Images come unevenly: there is no grid."""
        self._just_missed = 0
        self._calls, self._taken_back = 0, 0
        """How often images were called missed, and how often in error."""
        self._lately_missed: deque[int] = deque(maxlen=2 * STAMPS)
        self._doubts: list[int] = []
        self._phase = PhaseWatch()
        self._segment = 0
        self._missed = 0
        self._sigma_ns = self._line_sigma_ns = 0.0
        self._events: list[Event] = []

    def tick(self, stamp_ns: int, sequence: int, scan: Scan | None = None) -> Tick:
        """Return when the image with this stamp was; call it once for every one delivered.

        `scan` tells which field an image of alternating fields is. Costs some microseconds.
        """
        scan = self._info.scan if scan is None else scan
        if self._utc_at_ns is None or abs(stamp_ns - self._utc_at_ns) >= UTC_SAMPLE_NS:
            self.sample_utc()
            self._utc_at_ns = stamp_ns
        if self._slot is None:
            self._slot = 0
            self._line.begin(0, stamp_ns)
        else:
            self._slot = self._advance(self._slot, stamp_ns, sequence, scan)
        if self._turns:
            self._shift += self._turns.shift(self._slot + self._shift, sequence, scan)
        self._stamp_ns, self._sequence = stamp_ns, sequence
        if self._exact:
            t_ns, self._sigma_ns = stamp_ns, 0.0
        elif self._free:
            t_ns, self._sigma_ns = stamp_ns + self._delays_ns[scan], FREE_SIGMA_NS
        else:
            t_ns = self._line.at(self._slot) + self._delays_ns[scan]
            self._line_sigma_ns = self._line.sigma_ns(self._slot)
            self._sigma_ns = math.hypot(
                self._line_sigma_ns,
                self._phase.doubt_ns,
                self._phase.step_sigma_ns,
                self._held_up_ns(),
                self._doubts[-1] * self._period if self._doubts else 0.0,
            )
        return Tick(
            index=(self._slot + self._shift) // self._fields,
            t_ns=t_ns,
            sigma_t_ns=math.ceil(self._sigma_ns),
            segment=self._segment,
            utc_ns=t_ns + self._utc.offset_ns if self._utc else 0,
        )

    def sample_utc(self) -> None:
        """Read the UTC clock; `tick` does it once a second."""
        if self._utc:
            slept, events = self._utc.sample()
            self._slept = self._slept or slept
            self._events += events

    def take_events(self) -> list[Event]:
        """Return what happened since the last call."""
        events, self._events = self._events, []
        return events

    @property
    def period_ns(self) -> Fraction:
        """Of a frame: what the source said, or what its stamps have shown instead."""
        return self._period_ns * self._fields

    @property
    def figures(self) -> ClockFigures:
        return ClockFigures(
            jitter_us=0.0 if self._exact else self._line.jitter_ns / 1e3,
            sigma_us=self._sigma_ns / 1e3,
            rate_ppm=0.0 if self._exact else self._line.rate * 1e6,
            missed=self._missed,
            segments=self._segment + 1,
            settling=not self._exact and (self._free or not self._line.settled),
            utc_state=self._utc.state if self._utc else "unknown",
        )

    def _advance(self, slot: int, stamp_ns: int, sequence: int, scan: Scan) -> int:
        """Return the slot of the next image."""
        gap_ns = stamp_ns - self._stamp_ns
        step = (sequence - self._sequence + 2**31) % 2**32 - 2**31
        if self._exact:
            if gap_ns <= 0:
                self._segment += 1
            return slot + max(1, round(gap_ns / self._period_ns))
        broken = self._broken(gap_ns, step)
        if broken:
            # A source that was off or opened anew has missed nothing that it should have given.
            skipped = max(0, round(gap_ns / self._period_ns) - 1)
            self._lately_missed.clear()
            slot += 1 + skipped
            self._restart([(slot, stamp_ns)])
            self._jump(broken, skipped)
            return slot
        if self._cadence.add(stamp_ns, step):
            verdict = self._cadence.judge(not self._free)
            if verdict and verdict[0] is not (Pace.UNEVEN if self._free else Pace.AS_SAID):
                self._change_pace(slot + 1, stamp_ns, *verdict)
                return slot + 1
        if self._free:
            skipped = step - 1 if self._counts_lost else round(gap_ns / self._period_ns) - 1
            self._miss(slot, max(0, skipped))
            return slot + 1 + max(0, skipped)
        return self._place(slot, stamp_ns, gap_ns, step, scan)

    def _broken(self, gap_ns: int, step: int) -> str:
        """Return why nothing follows from the stamps before; empty if something does."""
        slept, self._slept = self._slept, False
        if slept:
            return "the computer slept"
        if gap_ns < 0:
            return f"the driver's stamps went back by {-gap_ns / 1e9:.3f} s"
        if step < 0:
            return "the driver began to count anew"
        if gap_ns > STALL_NS:
            return f"nothing came for {gap_ns / 1e9:.1f} s"
        return ""

    def _place(self, slot: int, stamp_ns: int, gap_ns: int, step: int, scan: Scan) -> int:
        """Return the slot of an image on the grid, and count those missed before it."""
        line, period = self._line, self._period
        early_ns = line.early_limit_ns
        late_ns = stamp_ns - line.at(slot + 1)
        if late_ns < -early_ns and self._just_missed and not self._counts_lost:
            slot = self._take_back(slot, stamp_ns)
            late_ns = stamp_ns - line.at(slot + 1)
        # Images that were held up come one upon the other, and nothing is missing between them.
        close = gap_ns < period - early_ns
        missed = 0 if close else max(0, math.floor((late_ns + early_ns) / period))
        if self._counts_lost and step > 0:
            missed, lost_count = self._believe(missed, step - 1)
            if lost_count:
                return self._leave_grid(slot + step, stamp_ns)
        if self._turns:
            missed = self._turns.missed(slot + 1 + self._shift, missed, scan)
        self._just_missed = missed
        self._calls += missed > 0
        self._miss(slot, missed)
        slot += 1 + missed
        late_ns = stamp_ns - line.at(slot)
        moved_ns = 0.0
        images = self._phase.look(slot, stamp_ns, late_ns, early_ns, line.late_limit_ns)
        if images and not line.settled:
            return self._leave_grid(slot, stamp_ns)
        if images:
            before_ns = line.at(slot)
            self._restart(images)
            moved_ns = float(line.at(slot) - before_ns)
        elif abs(late_ns) < period:
            moved_ns = line.add(slot, stamp_ns)
        shift_ns = max(SHIFT_NS, 5 * self._line_sigma_ns)
        if images or (line.settled and abs(moved_ns) > shift_ns):
            self._phase.moved(moved_ns)
            self._jump(f"the source moved by {moved_ns / 1e6:+.1f} ms against its stamps before")
        if not self._rate_told and line.count >= RATE_SURE and abs(line.rate) > RATE_LIMIT:
            self._tell_rate(line.rate)
        return slot

    @property
    def _counts_lost(self) -> bool:
        return self._info.sequence_counts_lost and self._fields == 1

    def _believe(self, by_time: int, by_sequence: int) -> tuple[int, bool]:
        """Return how many images are missing where the sequence should know, and whether the
        stamps leave the grid: ever later, though nothing is missing."""
        if by_sequence >= by_time:
            self._doubts.clear()
            # A stamp may be late but not early: more do not fit into the interval.
            return (by_time if self._line.settled else by_sequence), False
        self._doubts.append(by_time)
        if len(self._doubts) < DISTRUST:
            return by_sequence, False
        later = self._doubts[-1] > self._doubts[0]
        self._doubts.clear()
        return by_time, later

    def _leave_grid(self, slot: int, stamp_ns: int) -> int:
        """Give each image its own stamp's time until they come evenly again."""
        self._change_pace(slot, stamp_ns, Pace.UNEVEN, self._period_ns)
        return slot

    def _restart(self, images: list[tuple[int, int]]) -> None:
        """Begin the line anew with slots and stamps that belong together."""
        self._line.begin(*images[0])
        for slot, stamp_ns in images[1:]:
            self._line.add(slot, stamp_ns)
        self._phase.forget()
        self._cadence.forget()
        self._doubts.clear()
        self._just_missed = 0

    def _change_pace(self, slot: int, stamp_ns: int, pace: Pace, period_ns: Fraction) -> None:
        """Go on at another period, or without one."""
        said_hz = float(10**9 / self._period_ns)
        self._free = pace is Pace.UNEVEN
        if pace is Pace.OTHER:
            self._missed -= sum(self._lately_missed)
            self._lately_missed.clear()
            why = (
                f"images come at {float(10**9 / period_ns):.3f} Hz and not at {said_hz:.3f} Hz; "
                "look whether the camera's standard and rate are those of the configuration"
            )
        elif self._free:
            why = (
                f"images do not come at an even {said_hz:.3f} Hz; each has its own stamp's time "
                "until they come evenly"
            )
        else:
            why = f"images come at an even {said_hz:.3f} Hz again"
        self._set_period(period_ns)
        self._restart([(slot, stamp_ns)])
        self._jump(why)

    def _set_period(self, period_ns: Fraction) -> None:
        self._period_ns, self._period = period_ns, float(period_ns)
        self._info = dataclasses.replace(
            self._info, frame_period_s=period_ns * self._fields / 10**9
        )
        self._delays_ns = {
            scan: mid_exposure_ns(self._info, self._exposure_ns, self._chain_delay_ns, scan)
            for scan in Scan
        }
        self._line = StampLine(period_ns)
        analogue = self._info.scan is not Scan.PROGRESSIVE
        self._cadence = Cadence(period_ns, self._fields, analogue, self._info.sequence_counts_lost)
        self._rate_told = False

    def _miss(self, slot: int, missed: int) -> None:
        self._lately_missed.append(missed)
        if not missed:
            return
        self._missed += missed
        what = "frame" if self._fields == 1 else "field"
        self._tell(
            Severity.WARNING,
            "frames-missed",
            f"{missed} {what}{'s' if missed > 1 else ''} missed after frame "
            f"{(slot + self._shift) // self._fields}",
            (("missed", str(missed)), ("total", str(self._missed))),
        )

    def _take_back(self, slot: int, stamp_ns: int) -> int:
        """Undo the last call of images missed: they were held up and come now."""
        missed = self._just_missed
        self._taken_back += 1
        self._line.take_back(slot)
        self._phase.forget()
        self._missed -= missed
        self._shift += missed
        self._just_missed = 0
        self._lately_missed.append(-missed)
        held_ms = (stamp_ns - self._line.at(slot - missed)) / 1e6
        self._jump(f"the last {missed} called missed came after all, held up for {held_ms:.0f} ms")
        return slot - missed

    def _held_up_ns(self) -> float:
        """Return what it means for the latest time that images called missed were sometimes only
        held up, which the image after them shows."""
        error_ns = self._just_missed * self._period
        return error_ns * math.sqrt(self._taken_back / (self._calls + 1))

    def _jump(self, why: str, without: int = 0) -> None:
        """Begin a segment, `without` images of the time before it."""
        self._segment += 1
        self._tell(
            Severity.WARNING,
            "clock-jump",
            f"frame times begin segment {self._segment}: {why}",
            (("segment", str(self._segment)), ("without", str(without))),
        )

    def _tell_rate(self, rate: float) -> None:
        self._rate_told = True
        said_hz = float(10**9 / self._period_ns)
        self._tell(
            Severity.WARNING,
            "clock-rate",
            f"images come at {said_hz * (1 + rate):.4f} Hz, {rate * 1e6:+.0f} ppm off "
            f"{said_hz:.4f} Hz, which is more than quartz is off; look at the camera's rate",
            (("rate_ppm", f"{rate * 1e6:.1f}"),),
        )

    def _tell(
        self, severity: Severity, code: str, text: str, facts: tuple[tuple[str, str], ...]
    ) -> None:
        t_ns = self._stamp_ns
        utc_ns = t_ns + self._utc.offset_ns if self._utc else 0
        self._events.append(Event(severity, code, text, t_ns, utc_ns, facts))
