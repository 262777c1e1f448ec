"""The line under late stamps: when each would have been without delay.

A stamp is the moment of its picture plus a lateness that is never negative: an interrupt waits for
its turn. So the earliest stamps tell the time, whatever load does to the others, as in the clock
skew estimator of Moon, Skelly and Towsley (INFOCOM 1999).

Where the lateness begins with a sharp edge, `lower_edge` gives the mean and covariance of all lines
that no stamp lies below, each as likely as the stamps leave it (Bayes): the error falls with the
number of stamps, not with its root.

Where it does not, `fits` minimises the sum of rho(r) over the residuals r with
rho'(r) = min(r, clip): Huber's loss (1964), one-sided. A large clip makes it least squares, a small
one a soft lower envelope. Of several clips that one is to be used whose line varies least by the
sandwich estimate of its covariance.
"""

from __future__ import annotations

import dataclasses
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

EDGE = -1
"""In place of a clip: the line of `lower_edge`."""
_LIKELY = 16.0
"""Log of the odds under which a slope does not count."""
_FAR_BELOW = 12.0
"""So many mean gaps, and three more for each that is left out, lie stamps below the others that
are earlier than can be."""


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
    width_ns: float
    """Over which the stamps would be spread were they everywhere as dense as above the edge."""
    edge_ns: float
    """Where the lower edge is, from the line."""
    earliest_ns: float
    """The next three are above the edge."""
    median_ns: float
    q99_ns: float
    softness: float
    """The 5 % quantile over the median: 0.1 if uniform, 0.07 if exponential, more than 0.3 for
    the tail of a normal distribution."""


UNSEEN = Lateness(2e6, 2e6, 3e6, 0.0, 0.0, 1.5e6, 5e6, 0.1)
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


def lower_edge(
    x: Floats, y: Floats, width_ns: float, known: tuple[float, float], prior: Prior
) -> tuple[Fit, float]:
    """Return the line under the stamps and the width of their lateness, in nanoseconds.

    `width_ns` is one to begin with; `known` what is known of it beforehand, and the number of
    stamps that this counts for. Stamps that are far below all others are left out, one in 512.
    """
    n = len(x)
    # How dense the stamps are above the edge is told by the earliest quarter, by more while that is
    # few.
    k = min(n - 1, max(4, min(n // 2, 16), n // 4))
    weight = known[1] + k
    about = prior.mean, 40 * prior.sigma
    single = 1.0
    for turn in range(4):
        gap_ns = width_ns / (single * len(x) + 1)
        line, about = _all_lines(x, y, gap_ns, prior, about)
        residual = y - line.level - line.slope * x
        if turn == 2 and (early := n // 512):
            limit = np.partition(residual, early)[early] - (_FAR_BELOW + 3 * early) * gap_ns
            x, y, residual = (v[residual >= limit] for v in (x, y, residual))
        single = independent(residual)
        above_ns = float(np.partition(residual, k)[k] - residual.min()) + width_ns / (n + 1)
        above_ns = max(above_ns * (n + 1) / (k + 1), _SCALE_FLOOR_NS)
        width_ns = math.exp((known[1] * math.log(known[0]) + k * math.log(above_ns)) / weight)
    # Not even the density is known when stamps are few; and where it goes on to rise above the
    # earliest ones, what looks like an edge may be the beginning of a slope.
    vague = 1 + 3 / weight
    tenth, median = np.quantile(residual, (0.1, 0.5))
    soft_ns = 2 * max(0.0, float(tenth) - float(median) * (0.2 + 1 / math.sqrt(n)))
    line = dataclasses.replace(
        line,
        var_level=vague * line.var_level + soft_ns**2,
        cov=vague * line.cov,
        var_slope=vague * line.var_slope,
    )
    return line, width_ns


def independent(residual: Floats) -> float:
    """Return the part of the stamps that count as independent: less than 1 where late ones follow
    late ones, as under load."""
    n = len(residual)
    late = np.sign(residual - np.median(residual))
    alike = float(late[1:] @ late[:-1]) / n
    if n < FEW or alike < 3 / math.sqrt(n):
        return 1.0
    return max(1 - alike, 1 / n) / (1 + alike)


def _all_lines(
    x: Floats, y: Floats, gap_ns: float, prior: Prior, about: tuple[float, float]
) -> tuple[Fit, tuple[float, float]]:
    """Return mean and covariance of the lines under the stamps, whose earliest are `gap_ns` apart
    if there are no more to come, and the slope and reach within which likely ones were found.

    Of one slope, the highest line touches the lowest stamp, and the distance from the true one is
    exponential with mean `gap_ns`; a slope is likely as its highest line, at the stamps' middle, is
    high. `about` is a slope and a reach to begin the search with.
    """
    middle = float(x.mean())
    centred = x - middle
    centre, reach = about
    for _ in range(60):
        slopes = np.linspace(centre - reach, centre + reach, 41)
        heights = (y - slopes[:, None] * centred).min(axis=1)
        odds = heights / gap_ns - 0.5 * ((slopes - prior.mean) / prior.sigma) ** 2
        best = int(np.argmax(odds))
        likely = np.flatnonzero(odds > odds[best] - _LIKELY)
        first, last = int(likely[0]), int(likely[-1])
        if first == 0 or last == 40:
            centre, reach = float(slopes[best]), 2 * reach
        elif last - first >= 16:
            break
        else:
            low, high = float(slopes[first - 1]), float(slopes[last + 1])
            centre, reach = (low + high) / 2, (high - low) / 2
    weights = np.exp(odds - odds[best])
    weights /= weights.sum()
    height, slope = float(weights @ heights), float(weights @ slopes)
    high, steep = heights - height, slopes - slope
    var_height = float(weights @ high**2) + gap_ns**2
    cov, var_slope = float(weights @ (high * steep)), float(weights @ steep**2)
    line = Fit(
        clip=EDGE,
        level=height - gap_ns - slope * middle,
        slope=slope,
        var_level=var_height - 2 * middle * cov + middle * middle * var_slope,
        cov=cov - middle * var_slope,
        var_slope=var_slope,
    )
    return line, (slope, 8 * math.sqrt(var_slope))


def lateness(
    residual: Floats, before: Lateness, weight: float, width_ns: float | None = None
) -> Lateness:
    """Return how residuals are distributed; while they are few `before` counts as `weight` more.

    They are those about the lower edge if `width_ns` is given, of their lateness.
    """
    r = np.sort(residual)
    n = len(r)
    middle = float(r[n // 2])
    edge = 0.0
    if width_ns is None:
        # Not the very first where there are many: a few may be earlier than should be.
        k = min(4, n // 128)
        reach = min(8, n - 1 - k)
        gap = float(r[k + reach] - r[k]) / max(reach, 1)
        edge = float(r[k]) - (k + 1) * gap
    above = middle - edge
    weight = weight if n < FEW else 0.0

    def together(own: float, known: float) -> float:
        return math.sqrt((weight * known**2 + n * own**2) / (weight + n))

    quartiles = 0.7413 * float(r[3 * n // 4] - r[n // 4])
    return Lateness(
        scale_ns=max(together(quartiles, before.scale_ns), _SCALE_FLOOR_NS),
        deviation_ns=together(float(np.std(r)), before.deviation_ns),
        width_ns=before.width_ns if width_ns is None else width_ns,
        edge_ns=edge,
        earliest_ns=float(r[0]) - edge,
        median_ns=above,
        q99_ns=max(float(r[99 * n // 100]) - edge, before.q99_ns if weight else 0.0),
        softness=(float(r[n // 20]) - edge) / above if above > 0 else 0.0,
    )
