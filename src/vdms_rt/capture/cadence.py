"""Do images come at the period that the source is said to have, at another one, or unevenly?

The test is how well stamps fit on a grid: the length of their mean phasor exp(2 pi i stamp/period).
It is sin(a)/a for a lateness uniform over a/pi periods, 0.64 for half a period; frames that are
missing do not change it; stamps of another period spread over all phases and give next to 0.
"""

from __future__ import annotations

from collections import deque
from enum import Enum
from fractions import Fraction
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from vdms_rt.model import NTSC_FRAME_PERIOD_S, PAL_FRAME_PERIOD_S

Floats: TypeAlias = NDArray[np.float64]

STAMPS = 34
"""So many are judged together, and in two halves, of which a source that jumps leaves one whole; a
period off by 4 % is seen in them."""
_ON_GRID = 0.55
_ON_FOUND_GRID = 0.8
"""Of many grids that are tried one or another fits by chance."""
_AS_GOOD = 0.15
_SEARCH = np.linspace(0.75, 1.25, 251)

_STANDARDS_S = tuple(
    period_s / images for period_s in (PAL_FRAME_PERIOD_S, NTSC_FRAME_PERIOD_S) for images in (1, 2)
)
_RATES_HZ = (5, 10, 15, 20, 24, 25, 30, 48, 50, 60, 72, 75, 90, 100, 120)
_ROUND_S = (*(Fraction(1, rate) for rate in _RATES_HZ), Fraction(2, 15), NTSC_FRAME_PERIOD_S)


class Pace(Enum):
    AS_SAID = "as said"
    OTHER = "other"
    UNEVEN = "uneven"


class Cadence:
    """The latest stamps, against a period."""

    def __init__(
        self, period_ns: Fraction, fields: int, analogue: bool, sequence_counts_lost: bool
    ) -> None:
        """`period_ns` is from image to image, of which `fields` make a frame; an `analogue` source
        follows a TV standard."""
        self._period_ns = period_ns
        self._counts_lost = sequence_counts_lost and fields == 1
        known_s = _STANDARDS_S if analogue else _ROUND_S
        self._known_ns = [period_s * 10**9 / fields for period_s in known_s]
        self._stamps: deque[int] = deque(maxlen=STAMPS)
        self._steps: deque[int] = deque(maxlen=STAMPS - 1)
        self._seen = 0
        self._verdict = Pace.AS_SAID

    def add(self, stamp_ns: int, sequence_step: int) -> bool:
        """Take a stamp; return whether it is time to `judge` again."""
        self._stamps.append(stamp_ns)
        self._steps.append(sequence_step)
        self._seen += 1
        return self._seen >= STAMPS and self._seen % 16 == 0

    def forget(self) -> None:
        """Begin anew."""
        self._stamps.clear()
        self._steps.clear()
        self._seen = 0

    def judge(self, even: bool) -> tuple[Pace, Fraction] | None:
        """Return how the images come and the period they come at, in nanoseconds; None if that
        looks otherwise than the last time. `even` tells that they came at the period so far."""
        before = self._verdict
        self._verdict, period_ns = self._verdict_now(even)
        return (self._verdict, period_ns) if self._verdict is before else None

    def _verdict_now(self, even: bool) -> tuple[Pace, Fraction]:
        stamps = np.array([stamp - self._stamps[-1] for stamp in self._stamps], dtype=np.float64)
        half = STAMPS // 2
        parts = (stamps[:half], stamps[half:]) if even else (stamps,)
        on_grid = max(_on_grid(part, float(self._period_ns)) for part in parts) >= _ON_GRID
        if on_grid and not self._none_lost():
            return Pace.AS_SAID, self._period_ns
        median_ns = float(np.median(np.diff(stamps)))
        if on_grid and round(median_ns / self._period_ns) <= 1:
            return Pace.AS_SAID, self._period_ns
        if median_ns > 0:
            found_ns = self._found_ns(stamps, median_ns)
            least = _ON_GRID if found_ns in self._known_ns else _ON_FOUND_GRID
            if _on_grid(stamps, float(found_ns)) >= least:
                return Pace.OTHER, found_ns
        return Pace.UNEVEN, self._period_ns

    def _none_lost(self) -> bool:
        """Tell whether the sequence knows that no image is missing: then the time between two is
        one period, however long."""
        return self._counts_lost and all(step == 1 for step in self._steps)

    def _found_ns(self, stamps: Floats, median_ns: float) -> Fraction:
        """Return the period near a median interval on whose grid the stamps lie best, a usual one
        if it does as well."""
        searched = [float(median_ns * ratio) for ratio in _SEARCH]
        best_ns = max(searched, key=lambda period_ns: _on_grid(stamps, period_ns))
        enough = _on_grid(stamps, best_ns) - _AS_GOOD
        for known_ns in self._known_ns:
            near = abs(float(known_ns) / best_ns - 1) < 0.02
            if near and _on_grid(stamps, float(known_ns)) >= enough:
                return known_ns
        return Fraction(round(best_ns))


def _on_grid(stamps: Floats, period_ns: float) -> float:
    """Return how well stamps lie on a grid of this period, 0 to 1."""
    return abs(complex(np.exp(2j * np.pi / period_ns * stamps).sum())) / len(stamps)
