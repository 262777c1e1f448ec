"""Has a source moved against its grid? One late stamp may be load; many, or early ones, are not."""

from __future__ import annotations

import math
from collections import deque

LATE_RUN = 12
"""Images in a row, all later than 99 % were, that are no load: load holds up two or three."""
EARLY_RUN = 3
"""Images among the last eight that are earlier than any can be."""
_ALIKE = 0.2


class PhaseWatch:
    """The latest images and how late they came."""

    def __init__(self) -> None:
        self._recent: deque[tuple[int, int, bool]] = deque(maxlen=LATE_RUN)
        self._late_run = 0
        self._moves_ns: deque[float] = deque(maxlen=2)
        self.doubt_ns = 0.0
        """By how much the time of the latest image may be wrong, should the source have moved."""

    def look(
        self, slot: int, stamp_ns: int, late_ns: int, early_limit_ns: float, late_limit_ns: float
    ) -> list[tuple[int, int]]:
        """Take an image; return the slots and stamps of those that show that the source has moved,
        the first of them the first in its new place, or nothing."""
        early = late_ns < -early_limit_ns
        self._recent.append((slot, stamp_ns, early))
        self._late_run = self._late_run + 1 if late_ns > late_limit_ns else 0
        self.doubt_ns = abs(float(late_ns)) if early or self._late_run > 2 else 0.0
        images: list[tuple[int, int, bool]] = []
        if early:
            images = list(self._recent)[-8:]
            while not images[0][2]:
                del images[0]
            if sum(came_early for _, _, came_early in images) < EARLY_RUN:
                images = []
        elif self._late_run >= LATE_RUN:
            images = list(self._recent)
        return [(slot, stamp_ns) for slot, stamp_ns, _ in images]

    def forget(self) -> None:
        """Begin anew: the grid has been found again."""
        self._recent.clear()
        self._late_run = 0
        self.doubt_ns = 0.0

    def moved(self, by_ns: float) -> None:
        """Take note that the grid moved."""
        self._moves_ns.append(by_ns)

    @property
    def step_sigma_ns(self) -> float:
        """Standard deviation that the coarseness of stamps leaves, 0 if they are fine.

        A bus that completes transfers every 1 ms stamps a source whose period is a whole number of
        them with the same lateness for a long time, and then moves by 1 ms: two moves alike.
        """
        if len(self._moves_ns) < 2:
            return 0.0
        first, second = self._moves_ns
        alike = abs(first - second) <= _ALIKE * abs(second)
        return abs(second) / math.sqrt(12) if alike else 0.0
