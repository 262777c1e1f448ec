"""The line under a source's late stamps: when each picture would have been stamped without delay.

A stamp is the moment of its picture plus a lateness that is never negative: an interrupt waits for
its turn. So the earliest stamps tell the time, whatever load does to the others, as in the clock
skew estimator of Moon, Skelly and Towsley (INFOCOM 1999). The line here minimises the sum of
rho(r) over the residuals r with rho'(r) = min(r, clip): Huber's loss (1964), one-sided. A large
clip makes it least squares, a small one the lower envelope. In use is the clip whose line varies
least by the sandwich estimate of its own covariance, so that stamps whose noise has no sharp lower
edge get least squares.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from fractions import Fraction
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

Floats: TypeAlias = NDArray[np.float64]

WINDOW = 3600
"""Stamps in use: two minutes of NTSC. A quartz that warms up by 0.1 ppm a minute bends the line by
2 us in that time."""
RATE_PRIOR = 100e-6
"""Standard deviation of the rate of a source that was not seen before, or has changed."""
RATE_KNOWN = 5e-6
"""The same for a source that comes back after a pause."""
SIGMA_FLOOR_NS = 2e3
"""What quartz and interrupts leave, however many stamps there are."""
SETTLED = 48
"""Stamps after which one that does not fit is the source's doing, not the line's."""

_CLIPS = (3.0, 0.085, 0.0053, 0.00033)
"""In units of the noise's scale. Of uniform noise all, 1/4, 1/16, 1/64 are less late."""
_TOO_EARLY = -5.0
"""Times the root of the clip: twice as deep as uniform noise reaches below its line."""
_LEAST_ACTIVE = 12
"""So many stamps must be less late than the clip, else the covariance is a guess."""
_FEW = 64
_SHAPE_KNOWN = 256
SOFT = 0.25
"""Softness from which a lower edge is no edge."""
_BLOCK = 32
_EVERY = 96
_RECHOOSE = 16
_CHANGED = 5.0


@dataclass(frozen=True, slots=True)
class Prior:
    """What is known of the slope beforehand, in nanoseconds an index."""

    mean: float
    sigma: float


@dataclass(frozen=True, slots=True)
class Fit:
    """y = level + slope * x, and the covariance of the two."""

    clip: int
    """Which of the clips."""
    level: float
    slope: float
    var_level: float
    cov: float
    var_slope: float

    def variance(self, x: float) -> float:
        return self.var_level + x * (2 * self.cov + x * self.var_slope)


@dataclass(frozen=True, slots=True)
class Lateness:
    """How stamps lie about their line."""

    scale_ns: float
    """Standard deviation, by the quartiles."""
    deviation_ns: float
    """Standard deviation of all of them."""
    edge_ns: float
    """Where the line's lower edge is, on the line's own scale, from the earliest stamps."""
    edge_sigma_ns: float
    earliest_ns: float
    """The next three are above the edge."""
    median_ns: float
    q99_ns: float
    softness: float
    """The 5 % quantile over the median: 0.1 if uniform, 0.07 if exponential, more than 0.3 for
    the tail of a normal distribution."""


UNSEEN = Lateness(2e6, 2e6, 0.0, 3e6, 0.0, 1.5e6, 5e6, 0.1)
"""A driver before its first stamp."""


def fit(
    x: Floats, y: Floats, clip: int, scale: float, start: tuple[float, float], prior: Prior
) -> Fit | None:
    """Return the line of one clip by Newton's method; None if too few stamps carry it.

    x are indices about their middle, y nanoseconds, scale that of the noise, start a level and a
    slope near by.
    """
    limit = _CLIPS[clip] * scale
    bottom = _TOO_EARLY * math.sqrt(_CLIPS[clip]) * scale
    level, slope = start
    square = x * x
    span = float(x[-1] - x[0])
    ridge, trimmed = -1.0, False
    for _ in range(40):
        residual = y - level - slope * x
        psi = np.minimum(residual, limit)
        active = (residual < limit).astype(np.float64)
        count = float(active.sum())
        if count < (_LEAST_ACTIVE if clip else 1):
            return None
        if ridge < 0:
            # The prior's weight, in units in which each active stamp weighs 1.
            ridge = (float(psi @ psi) / count if clip else scale**2) / prior.sigma**2
        sx, sxx = float(active @ x), float(active @ square) + ridge
        determinant = count * sxx - sx * sx
        force = float(psi.sum())
        torque = float(psi @ x) - ridge * (slope - prior.mean)
        d_level = (force * sxx - torque * sx) / determinant
        d_slope = (torque * count - force * sx) / determinant
        level += d_level
        slope += d_slope
        if abs(d_level) + abs(d_slope) * span < 1.0:
            early = residual < bottom
            if trimmed or not 0 < np.count_nonzero(early) <= len(x) // 512:
                break
            trimmed = True
            x, y, square = x[~early], y[~early], square[~early]
    else:
        return None
    j00, j01, j11 = _spread(x, psi, scale)
    few = 1 + 8 / count
    j00, j01, j11 = few * j00, few * j01, few * j11 + ridge**2 * prior.sigma**2
    i00, i01, i11 = sxx / determinant, -sx / determinant, count / determinant
    a0, a1 = i00 * j00 + i01 * j01, i00 * j01 + i01 * j11
    b0, b1 = i01 * j00 + i11 * j01, i01 * j01 + i11 * j11
    return Fit(clip, level, slope, a0 * i00 + a1 * i01, a0 * i01 + a1 * i11, b0 * i01 + b1 * i11)


def _spread(x: Floats, psi: Floats, scale: float) -> tuple[float, float, float]:
    """Return the covariance of (sum psi, sum psi x): of the stamps one by one, or in blocks where
    their lateness hangs together and that gives more."""
    if len(x) < _FEW:
        return len(x) * scale**2, scale**2 * float(x.sum()), scale**2 * float(x @ x)
    moment = psi * x
    single = float(psi @ psi), float(psi @ moment), float(moment @ moment)
    blocks = len(x) // _BLOCK
    if blocks < 30:
        return single
    starts = np.arange(0, len(x), _BLOCK)
    force, torque = np.add.reduceat(psi, starts), np.add.reduceat(moment, starts)
    together = float(force @ force), float(force @ torque), float(torque @ torque)
    return together if together[2] > single[2] else single


def fits(
    x: Floats,
    y: Floats,
    clips: Iterable[int] | None,
    scale: float,
    start: tuple[float, float],
    prior: Prior,
) -> dict[int, Fit]:
    """Return the lines of several clips, by default of all, the widest first, each the start of
    the next; fewer where stamps are too few."""
    found: dict[int, Fit] = {}
    if clips is None:
        clips = range(1 if len(x) < _FEW else len(_CLIPS))
    for clip in clips:
        line = fit(x, y, clip, scale, start, prior)
        if line is None:
            break
        found[clip] = line
        start = line.level, line.slope
    return found


def lateness(residual: Floats, before: Lateness, weight: float) -> Lateness:
    """Return how residuals are distributed; with few of them `before` counts as `weight` more."""
    r = np.sort(residual)
    n = len(r)
    quartiles = 0.7413 * float(r[3 * n // 4] - r[n // 4])
    scale = math.sqrt((weight * before.scale_ns**2 + n * quartiles**2) / (weight + n))
    middle = float(r[n // 2])
    if n < _FEW:
        above = (weight * before.median_ns + (n + 1) * (middle - float(r[0]))) / (weight + n - 1)
        gap = 2 * above / (n + 1)
        edge, sigma = float(r[0]) - gap, gap * (1 + 1 / n)
    else:
        # Not the very first where there are many: a few may be earlier than should be.
        k = min(4, n // 128)
        gap = float(r[k + 8] - r[k]) / 8
        edge, sigma = float(r[k]) - (k + 1) * gap, gap * math.sqrt((k + 1) + (k + 1) ** 2 / 8)
        above = middle - edge
    if n < _SHAPE_KNOWN:
        # Whether the edge is a sharp one is not to be seen yet.
        sigma = max(sigma, 0.15 * above)
    return Lateness(
        scale_ns=scale,
        deviation_ns=math.sqrt(
            (weight * before.deviation_ns**2 + n * float(np.var(r))) / (weight + n)
        ),
        edge_ns=edge,
        edge_sigma_ns=sigma,
        earliest_ns=float(r[0]) - edge,
        median_ns=above,
        q99_ns=max(float(r[99 * n // 100]) - edge, before.q99_ns if n < _FEW else 0.0),
        softness=(float(r[n // 20]) - edge) / above if above > 0 else 0.0,
    )


class StampLine:
    """Time against index, from stamps as they come.

    Times are the grid's, `origin + index * period` in integers, plus a float residual of at most
    seconds, so nothing is lost however long it runs.
    """

    def __init__(self, period_ns: Fraction) -> None:
        self._period_ns = period_ns
        self._x = np.zeros(2 * WINDOW, dtype=np.int64)
        self._y = np.zeros(2 * WINDOW)
        self._first = self._end = 0
        self._origin_ns = 0
        self._lateness, self._weight = UNSEEN, 1.0
        self._prior = Prior(0.0, RATE_PRIOR * float(period_ns))
        self._line = Fit(0, 0.0, 0.0, 0.0, 0.0, 0.0)
        self._middle = 0
        self._depth_ns = 0.0
        self._held_scale_ns: float | None = None
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
        return -self._line.slope / float(self._period_ns)

    @property
    def early_limit_ns(self) -> float:
        """By how much a stamp may come before `at`, positive."""
        quarter_ns = float(self._period_ns) / 4
        if not self.settled:
            return quarter_ns
        below = max(0.0, self._depth_ns - self._lateness.edge_ns - self._lateness.earliest_ns)
        sigma = self.sigma_ns(int(self._x[self._end - 1]))
        return min(quarter_ns, 0.5e6 + 2 * below + 6 * sigma)

    @property
    def late_limit_ns(self) -> float:
        """By how much a stamp comes after `at` at most, but for a rare one."""
        return 1e6 + 1.5 * self._lateness.q99_ns

    def begin(self, index: int, stamp_ns: int) -> None:
        """Start anew at a stamp; what was learnt of rate and lateness is kept."""
        if self.count:
            self._weight = 8.0
            self._prior = Prior(self._line.slope, RATE_KNOWN * float(self._period_ns))
        self._origin_ns = stamp_ns - self._grid_ns(index)
        self._first = self._end = 0
        self._line = Fit(0, 0.0, self._line.slope, 0.0, 0.0, 0.0)
        self._middle = index
        self.add(index, stamp_ns)

    def add(self, index: int, stamp_ns: int) -> float:
        """Take the stamp of a later index. Return 0, or by how many nanoseconds `at(index)` moved
        because the stamps no longer agree with those of long ago, which are dropped then."""
        if self._end == len(self._x):
            keep = slice(self._end - WINDOW, self._end)
            self._x[:WINDOW], self._y[:WINDOW] = self._x[keep], self._y[keep]
            self._first, self._end = 0, WINDOW
        self._x[self._end] = index
        self._y[self._end] = stamp_ns - self._origin_ns - self._grid_ns(index)
        self._end += 1
        self._first = max(self._first, self._end - WINDOW)
        self._until_next -= 1
        if self._until_next > 0 and self.count > 8:
            return 0.0
        self._until_next = min(_EVERY, self.count // 8)
        return self._evaluate()

    def at(self, index: int) -> int:
        """Return the time of an index in nanoseconds."""
        line = self._line
        residual_ns = line.level + self._depth_ns + line.slope * (index - self._middle)
        return self._origin_ns + self._grid_ns(index) + round(residual_ns)

    def sigma_ns(self, index: int) -> float:
        """Return the standard deviation of `at(index)`, a constant delay aside."""
        x = index - self._middle
        if self._held_scale_ns is None:
            variance = self._lateness.edge_sigma_ns**2 + x * x * self._line.var_slope
        else:
            variance = self._line.variance(x)
        return math.sqrt(variance + SIGMA_FLOOR_NS**2)

    def _grid_ns(self, index: int) -> int:
        return index * self._period_ns.numerator // self._period_ns.denominator

    def _evaluate(self) -> float:
        latest = int(self._x[self._end - 1])
        before_ns = self.at(latest)
        residual = self._refit()
        changed = self._change(residual)
        if not changed:
            return 0.0
        while changed:
            self._first = self._end - changed
            self._prior = Prior(self._line.slope, RATE_PRIOR * float(self._period_ns))
            self._weight = 8.0
            residual = self._refit()
            changed = self._change(residual)
        return float(self.at(latest) - before_ns)

    def _refit(self) -> Floats:
        used = slice(self._first, self._end)
        middle = int(self._x[self._first] + self._x[self._end - 1]) // 2
        x, y = (self._x[used] - middle).astype(np.float64), self._y[used]
        line = self._line
        start = line.level + line.slope * (middle - self._middle), line.slope
        scale = self._held_scale_ns or self._lateness.scale_ns
        self._line, self._middle = self._choose(x, y, scale, start), middle
        residual: Floats = y - self._line.level - self._line.slope * x
        self._lateness = lateness(residual, self._lateness, self._weight)
        if self._held_scale_ns is None:
            self._depth_ns = self._lateness.edge_ns
            if len(x) >= _SHAPE_KNOWN and self._lateness.softness > SOFT:
                self._held_scale_ns = scale
        return residual

    def _choose(self, x: Floats, y: Floats, scale: float, start: tuple[float, float]) -> Fit:
        """Return the line that varies least at the latest stamp."""
        now = self._line.clip
        self._until_choice -= 1
        if len(x) >= 960 and self._until_choice > 0:
            line = fit(x, y, now, scale, start, self._prior)
            if line is not None:
                return line
        self._until_choice = _RECHOOSE
        found = fits(x, y, None, scale, start, self._prior)
        end = float(x[-1])
        best = min(found.values(), key=lambda f: f.variance(end))
        if now in found and found[now].variance(end) < 1.5 * best.variance(end):
            best = found[now]
        if self._held_scale_ns is not None and best.clip != now:
            reported = (found[now].level if now in found else start[0]) + self._depth_ns
            self._depth_ns = reported - best.level
        return best

    def _change(self, residual: Floats) -> int:
        """Return how many of the latest stamps to keep because early stamps have become more
        frequent or rarer than they were; 0 if all agree."""
        n = len(residual)
        if n < _SHAPE_KNOWN:
            return 0
        early = residual < np.partition(residual, n // 10)[n // 10]
        worst, keep = _CHANGED, 0
        recent = 64
        while recent <= n // 2:
            z = _surprise(int(early[-recent:].sum()) / recent, 0.1, recent) * math.sqrt(
                1 - recent / n
            )
            if z > worst:
                worst, keep = z, recent
            recent *= 2
        return keep


def _surprise(part: float, expected: float, n: int) -> float:
    """Return how many standard deviations a part seen among n is off, by the deviance."""
    terms = 0.0
    if part > 0:
        terms += part * math.log(part / expected)
    if part < 1:
        terms += (1 - part) * math.log((1 - part) / (1 - expected))
    return math.sqrt(max(0.0, 2 * n * terms))
