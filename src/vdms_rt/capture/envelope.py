"""The line under late stamps: when each would have been without delay.

A stamp is the moment of its picture plus a lateness that is never negative: an interrupt waits for
its turn. So the earliest stamps tell the time, whatever load does to the others, as in the clock
skew estimator of Moon, Skelly and Towsley (INFOCOM 1999). The line here minimises the sum of
rho(r) over the residuals r with rho'(r) = min(r, clip): Huber's loss (1964), one-sided. A large
clip makes it least squares, a small one the lower envelope. Of several clips that one is to be
used whose line varies least by the sandwich estimate of its covariance: stamps whose noise has no
sharp lower edge then get least squares.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

Floats: TypeAlias = NDArray[np.float64]

CLIPS = (3.0, 0.085, 0.0053, 0.00033)
"""In units of the noise's scale. Of uniform noise all, 1/4, 1/16, 1/64 are less late."""
FEW = 64
"""Below so many stamps there is only least squares."""
SHAPE_KNOWN = 256
"""From so many stamps on it is seen whether their lower edge is sharp."""
SOFT = 0.25
"""Softness from which a lower edge is no edge."""

_TOO_EARLY = -5.0
"""Times the root of the clip: twice as deep as uniform noise reaches below its line."""
_LEAST_ACTIVE = 12
"""So many stamps must be less late than the clip, else the covariance is a guess."""
_SCALE_FLOOR_NS = 1e3
_BLOCK = 32
"""Lateness may hang together over a second."""


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
    limit = CLIPS[clip] * scale
    bottom = _TOO_EARLY * math.sqrt(CLIPS[clip]) * scale
    level, slope = start
    square = x * x
    span = float(x[-1] - x[0])
    ridge, trimmed = -1.0, False
    for _ in range(40):
        residual = y - level - slope * x
        psi = np.minimum(residual, limit)
        active = (residual < limit).astype(np.float64)
        count = float(active.sum())
        if clip and count < _LEAST_ACTIVE:
            return None
        if not count:
            level += float(np.median(residual))
            continue
        if ridge < 0:
            # The prior's weight, in units in which each active stamp weighs 1.
            ridge = (float(psi @ psi) / count if clip else scale**2) / prior.sigma**2
        sx, sxx = float(active @ x), float(active @ square) + ridge
        # count * sxx - sx * sx, which loses all its digits where few stamps are active
        determinant = count * (float(active @ (x - sx / count) ** 2) + ridge)
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
        if clip:
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
    if len(x) < FEW:
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
        clips = range(1 if len(x) < FEW else len(CLIPS))
    for clip in clips:
        line = fit(x, y, clip, scale, start, prior)
        if line is None:
            break
        found[clip] = line
        start = line.level, line.slope
    return found


def lateness(residual: Floats, before: Lateness, weight: float) -> Lateness:
    """Return how residuals are distributed; while they are few `before` counts as `weight` more."""
    r = np.sort(residual)
    n = len(r)
    middle = float(r[n // 2])
    if n < FEW:
        above = (weight * before.median_ns + (n + 1) * (middle - float(r[0]))) / (weight + n - 1)
        gap = 2 * above / (n + 1)
        edge, sigma = float(r[0]) - gap, gap * (1 + 4 / (n + 2))
    else:
        weight = 0.0
        # Not the very first where there are many: a few may be earlier than should be.
        k = min(4, n // 128)
        gap = float(r[k + 8] - r[k]) / 8
        edge, sigma = float(r[k]) - (k + 1) * gap, gap * math.sqrt((k + 1) + (k + 1) ** 2 / 8)
        above = middle - edge
    if n < SHAPE_KNOWN:
        # Whether the edge is a sharp one is not to be seen yet.
        sigma = max(sigma, 0.15 * above)

    def together(own: float, known: float) -> float:
        return math.sqrt((weight * known**2 + n * own**2) / (weight + n))

    quartiles = 0.7413 * float(r[3 * n // 4] - r[n // 4])
    return Lateness(
        scale_ns=max(together(quartiles, before.scale_ns), _SCALE_FLOOR_NS),
        deviation_ns=together(float(np.std(r)), before.deviation_ns),
        edge_ns=edge,
        edge_sigma_ns=sigma,
        earliest_ns=float(r[0]) - edge,
        median_ns=above,
        q99_ns=max(float(r[99 * n // 100]) - edge, before.q99_ns if weight else 0.0),
        softness=(float(r[n // 20]) - edge) / above if above > 0 else 0.0,
    )
