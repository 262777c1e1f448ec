"""The line through the stamps of a source: time against index."""

from __future__ import annotations

import math
from fractions import Fraction

RATE_PRIOR = 100e-6
"""Standard deviation of a source's rate before it has been seen."""
JITTER_PRIOR_NS = 2e6
_PRIOR_WEIGHT = 2.0


class StampLine:
    """Recursive least squares of stamp against index, on a grid of exact integers.

    Times are the grid's, `origin + index * period` in integers, plus a small float residual that
    stays exact for years.
    """

    def __init__(self, period_ns: Fraction) -> None:
        self._period_ns = period_ns
        self._origin_ns = 0
        self._index = 0
        self._phase_ns = 0.0
        self._rate_ns = 0.0
        self._square_sum = _PRIOR_WEIGHT * JITTER_PRIOR_NS**2
        self._weight = _PRIOR_WEIGHT
        self._rate_variance = (RATE_PRIOR * float(period_ns)) ** 2
        self.count = 0

    @property
    def jitter_ns(self) -> float:
        """Standard deviation of the stamps about the line."""
        return math.sqrt(self._square_sum / self._weight)

    @property
    def rate(self) -> float:
        """Of the source against the computer's clock, less 1; positive when pictures come fast."""
        return -self._rate_ns / float(self._period_ns)

    def begin(self, index: int, stamp_ns: int) -> None:
        """Start anew at a stamp; the rate and the jitter found so far are kept."""
        self._origin_ns = stamp_ns - self._grid_ns(index)
        self._index = index
        self._phase_ns = 0.0
        self._p00 = self.jitter_ns**2
        self._p01 = 0.0
        self._p11 = self._rate_variance
        self.count = 1

    def add(self, index: int, stamp_ns: int) -> None:
        """Take the stamp of a later index."""
        self._move(index)
        innovation_ns = float(stamp_ns - self.at(index))
        limit_ns = 3 * math.sqrt(self._p00 + self.jitter_ns**2)
        innovation_ns = max(-limit_ns, min(limit_ns, innovation_ns))
        variance = self._p00 + self.jitter_ns**2
        gain0, gain1 = self._p00 / variance, self._p01 / variance
        self._phase_ns += gain0 * innovation_ns
        self._rate_ns += gain1 * innovation_ns
        self._p11 -= gain1 * self._p01
        self._p01 -= gain0 * self._p01
        self._p00 -= gain0 * self._p00
        self._square_sum += innovation_ns**2 * self.jitter_ns**2 / variance
        self._weight += 1
        self.count += 1

    def at(self, index: int) -> int:
        """Return the time of an index in nanoseconds."""
        residual_ns = self._phase_ns + self._rate_ns * (index - self._index)
        return self._origin_ns + self._grid_ns(index) + round(residual_ns)

    def sigma_ns(self, index: int) -> float:
        """Return the standard deviation of `at(index)`, a constant delay aside."""
        ahead = index - self._index
        return math.sqrt(self._p00 + ahead * (2 * self._p01 + ahead * self._p11))

    def _grid_ns(self, index: int) -> int:
        return index * self._period_ns.numerator // self._period_ns.denominator

    def _move(self, index: int) -> None:
        ahead = index - self._index
        self._phase_ns += self._rate_ns * ahead
        self._p00 += ahead * (2 * self._p01 + ahead * self._p11)
        self._p01 += ahead * self._p11
        self._index = index
