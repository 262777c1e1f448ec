"""The steady line of a source's times, from its stamps as they come."""

from __future__ import annotations

import math
from fractions import Fraction

import numpy as np

from vdms_rt.capture.envelope import (
    FEW,
    SHAPE_KNOWN,
    SOFT,
    UNSEEN,
    Fit,
    Floats,
    Prior,
    fit,
    fits,
    independent,
    lateness,
    lower_edge,
)

WINDOW = 3600
"""Most stamps in use: two minutes of NTSC."""
ENOUGH = 450
"""Fewest stamps in use once there are more, and"""
ENOUGH_NS = 5e3
"""the error at which no more are needed: the fewer, the less the rate has changed meanwhile."""
DRIFT = 5e-9
"""Change of the rate in a second that goes unseen: 0.3 ppm a minute, of a quartz that warms up."""
RATE_PRIOR = 100e-6
"""Standard deviation of the rate of a source that was not seen before."""
RATE_LOOSE = 0.02
"""The same once the first has proved wrong: the source runs at another nominal rate."""
RATE_KNOWN = 5e-6
"""What the rate of a source may change by in a pause, and"""
RATE_CHANGED = 20e-6
"""where its stamps no longer agree with those before."""
SIGMA_FLOOR_NS = 0.5e3
"""What quartz and interrupts leave, however many stamps there are."""
SETTLED = 48
"""Stamps after which one that does not fit is the source's doing, not the line's."""
EARLY_LIMIT_NS = 0.5e6
"""No stamp is earlier by more than this and six standard deviations of the line."""
LATE_LIMIT_NS = 0.5e6
"""Few stamps are later than 99 % were by more than this."""

_UNSEEN_WEIGHT = 1.0
_SEEN_WEIGHT = 8.0
"""Stamps that the lateness known beforehand counts for, of a driver unseen or seen."""
_SHARP_KNOWN = 1024
_SHARP = 0.15
"""Softness under which an edge that was none is one again, if so many stamps say it."""
_VOTES = 3
_EVERY = 96
"""Stamps from one fit to the next, and"""
_RECHOOSE = 16
"""fits from one comparison of all clips to the next, once there are"""
_MANY = 960
"""stamps."""
_CHANGED = 5.0
"""Standard deviations by which the latest stamps must differ from the rest."""
_EARLIEST = (0.02, 0.05)
_UNEVEN = 2.1
"""Most that the earliest stamps may run ahead of their even spread over time, in the units of
Kolmogorov's distribution; about a line fitted to them 99 % stay below 1.7."""
_LEAST_KEPT = 32


class StampLine:
    """Time against index, from stamps as they come.

    Times are the grid's, `origin + index * period` in integers, plus a float residual of at most
    seconds, so nothing is lost however long it runs.
    """

    def __init__(self, period_ns: Fraction) -> None:
        self._period = float(period_ns)
        self._numerator, self._denominator = period_ns.numerator, period_ns.denominator
        self._x = np.zeros(2 * WINDOW, dtype=np.int64)
        self._y = np.zeros(2 * WINDOW)
        self._first = self._end = 0
        self._origin_ns = 0
        self._lateness = self._before = UNSEEN
        self._weight = _UNSEEN_WEIGHT
        self._prior = Prior(0.0, RATE_PRIOR * self._period)
        self._line = Fit(0, 0.0, 0.0, 0.0, 0.0, 0.0)
        self._middle = 0
        self._depth_ns = 0.0
        self._held_scale_ns: float | None = None
        self._least_variance = SIGMA_FLOOR_NS**2
        self._early_limit_ns = self._period / 4
        self._votes = 0
        self._since = 0
        """Stamps since the last fit."""
        self._until_next = 0
        self._until_choice = 0

    @property
    def count(self) -> int:
        """Stamps in use."""
        return self._end - self._first

    @property
    def settled(self) -> bool:
        return self.count >= SETTLED

    @property
    def jitter_ns(self) -> float:
        """Standard deviation of the stamps about the line."""
        return self._lateness.deviation_ns

    @property
    def rate(self) -> float:
        """Of the source against the computer's clock, less 1; positive when pictures come fast."""
        return -self._line.slope / self._period

    @property
    def early_limit_ns(self) -> float:
        """By how much a stamp may come before `at`, positive."""
        return self._early_limit_ns

    @property
    def late_limit_ns(self) -> float:
        """By how much a stamp comes after `at` at most, but for a rare one."""
        return self._lateness.q99_ns + LATE_LIMIT_NS if self.settled else math.inf

    def begin(self, index: int, stamp_ns: int) -> None:
        """Start anew at a stamp; what was learnt of rate and lateness is kept."""
        if self.count:
            self._before, self._weight = self._lateness, _SEEN_WEIGHT
            known = math.hypot(RATE_KNOWN * self._period, math.sqrt(self._line.var_slope))
            self._prior = Prior(self._line.slope, min(known, RATE_PRIOR * self._period))
        self._origin_ns = stamp_ns - self._grid_ns(index)
        self._first = self._end = 0
        self._line = Fit(0, 0.0, self._line.slope, 0.0, 0.0, 0.0)
        self._middle, self._votes = index, 0
        self.add(index, stamp_ns)

    def add(self, index: int, stamp_ns: int) -> float:
        """Take the stamp of a later index; return by how many nanoseconds that moved `at(index)`.

        Where the latest stamps no longer agree with those of long ago, these are dropped.
        """
        if self._end == len(self._x):
            keep = slice(self._end - WINDOW, self._end)
            self._x[:WINDOW], self._y[:WINDOW] = self._x[keep], self._y[keep]
            self._first, self._end = max(0, self._first - keep.start), WINDOW
        self._x[self._end] = index
        self._y[self._end] = stamp_ns - self._origin_ns - self._grid_ns(index)
        self._end += 1
        self._first = max(self._first, self._end - WINDOW)
        self._since += 1
        self._until_next -= 1
        if self._until_next > 0 and self.count > 8:
            return 0.0
        self._until_next = min(_EVERY, self.count // 8)
        return self._evaluate()

    def take_back(self, index: int) -> None:
        """Forget the latest stamp if it was this index's, which it was not in truth."""
        if self.count > 1 and self._x[self._end - 1] == index:
            self._end -= 1
            self._until_next = 0

    def at(self, index: int) -> int:
        """Return the time of an index in nanoseconds."""
        line = self._line
        residual_ns = line.level + self._depth_ns + line.slope * (index - self._middle)
        return self._origin_ns + self._grid_ns(index) + round(residual_ns)

    def sigma_ns(self, index: int) -> float:
        """Return the standard deviation of `at(index)`, a constant delay aside."""
        return math.sqrt(self._line.variance(index - self._middle) + self._least_variance)

    def _grid_ns(self, index: int) -> int:
        return index * self._numerator // self._denominator

    def _evaluate(self) -> float:
        latest = int(self._x[self._end - 1])
        before, before_ns, sigma_ns = self._line, self.at(latest), self.sigma_ns(latest)
        shape = self._lateness
        keep = _to_keep(self._refit())
        moved = abs(self.at(latest) - before_ns) > _CHANGED * sigma_ns
        if not keep and moved and self.count >= SHAPE_KNOWN:
            keep = max(self._since, _LEAST_KEPT)
        while keep:
            self._first = self._end - keep
            sigma = math.hypot(RATE_CHANGED * self._period, math.sqrt(before.var_slope))
            self._prior = Prior(before.slope, sigma)
            self._before, self._weight, self._votes = shape, _SEEN_WEIGHT, 0
            keep = _to_keep(self._refit())
        self._since = 0
        if self.count > ENOUGH and self._line.variance(latest - self._middle) < ENOUGH_NS**2:
            self._first += (self.count - ENOUGH) // 4
        span_s = self.count * self._period / 1e9
        bend_ns = DRIFT * span_s * span_s / 12 * 1e9
        self._least_variance = bend_ns * bend_ns + SIGMA_FLOOR_NS**2
        below = max(0.0, self._depth_ns - self._lateness.edge_ns - self._lateness.earliest_ns)
        limit_ns = EARLY_LIMIT_NS + 2 * below + 6 * self.sigma_ns(latest)
        self._early_limit_ns = min(self._period / 4, limit_ns)
        return float(self.at(latest) - before_ns)

    def _refit(self) -> Floats:
        used = slice(self._first, self._end)
        middle = int(self._x[self._first] + self._x[self._end - 1]) // 2
        x, y = (self._x[used] - middle).astype(np.float64), self._y[used]
        line, width_ns = self._fitted(x, y, middle)
        if len(x) >= FEW and abs(line.slope - self._prior.mean) > 2.5 * self._prior.sigma:
            self._prior = Prior(line.slope, RATE_LOOSE * self._period)
            line, width_ns = self._fitted(x, y, middle)
        self._line, self._middle = line, middle
        residual: Floats = y - line.level - line.slope * x
        self._lateness = lateness(residual, self._before, self._weight, width_ns)
        self._vote(len(x), self._lateness.scale_ns)
        return residual

    def _fitted(self, x: Floats, y: Floats, middle: int) -> tuple[Fit, float | None]:
        """Return the line about a new middle, and the width of the lateness if it has an edge."""
        before = self._line
        start = before.level + before.slope * (middle - self._middle), before.slope
        if self._held_scale_ns is None:
            self._depth_ns = 0.0
            known = self._before.width_ns, self._weight
            return lower_edge(x, y, self._lateness.width_ns, known, self._prior)
        return self._choose(x, y, self._held_scale_ns, start), None

    def _vote(self, n: int, scale: float) -> None:
        """Hold the distance from line to edge while there is no sharp edge: the line alone tells
        the time then, beside a constant."""
        held = self._held_scale_ns is not None
        known = n >= (_SHARP_KNOWN if held else SHAPE_KNOWN)
        against = self._lateness.softness < _SHARP if held else self._lateness.softness > SOFT
        self._votes = self._votes + 1 if known and against else 0
        if self._votes == _VOTES:
            self._votes = self._until_choice = 0
            self._held_scale_ns = None if held else scale

    def _choose(self, x: Floats, y: Floats, scale: float, start: tuple[float, float]) -> Fit:
        """Return the line that varies least at the latest stamp."""
        now = self._line.clip
        self._until_choice -= 1
        if len(x) >= _MANY and self._until_choice > 0:
            line = fit(x, y, now, scale, start, self._prior)
            if line is not None:
                return line
        self._until_choice = _RECHOOSE
        found = fits(x, y, None, scale, start, self._prior)
        end = float(x[-1])
        best = min(found.values(), key=lambda f: f.variance(end))
        if now in found and found[now].variance(end) < 1.5 * best.variance(end):
            best = found[now]
        if best.clip != now:
            level, slope = (found[now].level, found[now].slope) if now in found else start
            self._depth_ns += level - best.level + (slope - best.slope) * end
        return best


def _to_keep(residual: Floats) -> int:
    """Return how many of the latest stamps to keep because the early ones are not spread evenly
    over time, 0 if they are."""
    n = len(residual)
    if n < SHAPE_KNOWN:
        return 0
    single = math.sqrt(independent(residual))
    early = residual < np.partition(residual, n // 10)[n // 10]
    recent = 64
    while recent <= n // 2:
        part = int(early[-recent:].sum()) / recent
        if _surprise(part, 0.1, recent) * single * math.sqrt(1 - recent / n) > _CHANGED:
            # Where early ones have become rare, the last of them was before the change.
            since = int(np.argmax(early[::-1])) if part < 0.1 else recent
            return max(min(since, recent), _LEAST_KEPT)
        recent *= 2
    for part in _EARLIEST:
        count = int(part * n)
        excess = np.abs(np.cumsum((residual < np.partition(residual, count)[count]) - count / n))
        most = int(np.argmax(excess))
        if excess[most] * single > _UNEVEN * math.sqrt(part * (1 - part) * n):
            return max(n - 1 - most, _LEAST_KEPT)
    return 0


def _surprise(part: float, expected: float, n: int) -> float:
    """Return how many standard deviations a part seen among n is off, by the deviance."""
    terms = 0.0
    if part > 0:
        terms += part * math.log(part / expected)
    if part < 1:
        terms += (1 - part) * math.log((1 - part) / (1 - expected))
    return math.sqrt(max(0.0, 2 * n * terms))
