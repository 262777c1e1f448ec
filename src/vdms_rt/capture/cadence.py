"""Do frames come at the period that the source is said to have, at another one, or unevenly?"""

from __future__ import annotations

from collections import deque
from enum import Enum
from fractions import Fraction

from vdms_rt.model import NTSC_FRAME_PERIOD_S, PAL_FRAME_PERIOD_S

INTERVALS = 32
"""So many are judged together."""
_STEADY = 0.75
"""Part of the intervals that must be alike for a steady pace; the others are beside lost frames."""
_ALIKE = 0.25
_OFF = 0.03
"""Relative difference of two periods that are not the same: those of PAL and NTSC differ by 0.2,
those of film and PAL by 0.04."""
_UNEVEN = 0.18
"""Median distance of the intervals from whole periods, in periods: 0.25 if they are at random, 0.15
if the lateness is uniform over half a period."""
_NEAR = 0.005

_STANDARDS_S = (NTSC_FRAME_PERIOD_S, PAL_FRAME_PERIOD_S)
_RATES_HZ = (5, 10, 15, 20, 24, 25, 30, 48, 50, 60, 72, 75, 90, 100, 120)
_ROUND_S = (*(Fraction(1, rate) for rate in _RATES_HZ), Fraction(2, 15), NTSC_FRAME_PERIOD_S)


class Pace(Enum):
    AS_SAID = "as said"
    OTHER = "other"
    UNEVEN = "uneven"


class Cadence:
    """The last intervals between images, against a period."""

    def __init__(
        self, period_ns: Fraction, fields: int, analogue: bool, sequence_counts_lost: bool
    ) -> None:
        """`period_ns` is from image to image, of which `fields` make a frame; an `analogue` source
        follows a TV standard."""
        self._period_ns = period_ns
        self._counts_lost = sequence_counts_lost and fields == 1
        known_s = _STANDARDS_S if analogue else _ROUND_S
        self._known_ns = [period_s * 10**9 / fields for period_s in known_s]
        self._intervals: deque[int] = deque(maxlen=INTERVALS)
        self._steps: deque[int] = deque(maxlen=INTERVALS)
        self._seen = 0

    def add(self, interval_ns: int, sequence_step: int) -> bool:
        """Take an interval; return whether it is time to `judge` again."""
        self._intervals.append(interval_ns)
        self._steps.append(sequence_step)
        self._seen += 1
        return self._seen >= INTERVALS and self._seen % 8 == 0

    def judge(self) -> tuple[Pace, Fraction]:
        """Return how the images come and the period they come at, in nanoseconds."""
        intervals = sorted(self._intervals)
        median = intervals[len(intervals) // 2]
        alike = [i for i in intervals if abs(i - median) <= _ALIKE * median]
        period = float(self._period_ns)
        if median > 0 and len(alike) >= _STEADY * len(intervals):
            mean = sum(alike) / len(alike)
            none_lost = self._counts_lost and all(step == 1 for step in self._steps)
            periods = 1 if none_lost else max(1, round(mean / period))
            # Late stamps in a row pull the mean, jitter the median, hardly both.
            if min(abs(x / period - periods) for x in (mean, median)) > _OFF * periods:
                return Pace.OTHER, self._nominal_ns(mean)
            return Pace.AS_SAID, self._period_ns
        off = sorted(abs(i / period - max(1, round(i / period))) for i in intervals)
        uneven = off[len(off) // 2] > _UNEVEN
        return (Pace.UNEVEN if uneven else Pace.AS_SAID), self._period_ns

    def _nominal_ns(self, mean_ns: float) -> Fraction:
        nearest = min(self._known_ns, key=lambda known_ns: abs(float(known_ns) / mean_ns - 1))
        return nearest if abs(float(nearest) / mean_ns - 1) < _NEAR else Fraction(round(mean_ns))
