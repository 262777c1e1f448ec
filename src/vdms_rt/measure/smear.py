"""What an exposure does to the edge of a moving circle, and how much of it the weights let through.

While the shutter is open a circle goes along a path q(t) = v t + a t^2 / 2. Its edge, of width s
at rest, is the mean of the edges on that path. Weights that are not proportional to the light do
not give the path's mean, by a T^2 / 24 beyond its middle, but only a part of that, which depends on
how the way compares with the edge: what is missing is known, and added. The same integrals give
what the weighed second moments and the noise gain.

All figures are per unit of s, for a way of `way` edge widths, and averaged over the outline of an
ellipse: the narrower it is along the way, the more of its outline faces that way. A table each for
both weights of `edge`.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vdms_rt.measure.edge import profile, slope, weight

STEP = 0.5
"""Of the tables, in edge widths."""
LONGEST = 24.0
FINE = 1 / 16
ASPECT_STEP = 0.5
"""Of the tables, in octaves."""
MIDDLE = 4
ASPECTS = tuple(2.0 ** ((i - MIDDLE) * ASPECT_STEP) for i in range(2 * MIDDLE + 1))
"""1/4 to 4: beyond 75 deg no marker is measured."""
Curve = NDArray[np.float64]
SMEARED_WAY = 2.5
"""In edge widths: beyond this way the weights that are nearly proportional to the light cost less
by their noise (9 % at 2 widths, 3 % at 8) than the others by what is known badly of their bias."""


class Smear(NamedTuple):
    """What a way does, along it and across it."""

    missing_along: float
    """Part of the path's mean that is missing in the centre, where the acceleration is along the
    way, and (`missing_across`) where it is across."""
    missing_across: float
    moment_along: float
    """What the second moment gains over that of the usual weights at rest, in s^2."""
    moment_across: float
    noise_along: float
    """Factor on the variance that the centre has with the usual weights at rest."""
    noise_across: float


_Row = tuple[Smear, ...]


@lru_cache(maxsize=2)
def _table(smeared: bool) -> tuple[_Row, ...]:
    """Return a row of ways for each of ASPECTS."""
    d = np.arange(-LONGEST / 2 - 6, LONGEST / 2 + 6, FINE)[:, None]
    t, share = np.polynomial.legendre.leggauss(48)
    t, share = t / 2, share / 2
    ways = np.arange(0, LONGEST + 2 * STEP, STEP)
    bent = 0.25

    def of_path(way: float, bend: float) -> Curve:
        edge: Curve = profile(way * t + bend * t * t - d) @ share
        return edge

    passed, spread, noise = [], [], []
    at_rest = (d[:, 0] < 0).astype(float)
    for way in ways.tolist():
        there, back = (weight(of_path(way, b), smeared) - at_rest for b in (bent, -bent))
        # Of the mean of bend t^2, which is bend / 12.
        passed.append(float((there - back).sum()) * FINE * 12 / (2 * bent))
        edge = of_path(way, 0.0)
        weighed = weight(edge, smeared)
        spread.append(2 * FINE * float((weighed - at_rest) @ d[:, 0]))
        noise.append(float((slope(edge, smeared) ** 2).sum()) * FINE)
    # The size at rest is learnt with the usual weights.
    resting = of_path(0.0, 0.0)
    usual = weight(resting)
    at_rest_noise = FINE * float((slope(resting) ** 2).sum())
    at_rest_spread = 2 * FINE * float((usual - at_rest) @ d[:, 0])
    edges = _Edges(ways, *(np.array(v) for v in (passed, spread, noise)))
    edges = edges._replace(spread=edges.spread - at_rest_spread, noise=edges.noise / at_rest_noise)
    return tuple(
        tuple(_around(edges, way, aspect) for way in ways[:-1].tolist()) for aspect in ASPECTS
    )


class _Edges(NamedTuple):
    """What a straight edge makes of each way across it."""

    ways: Curve
    passed: Curve
    spread: Curve
    noise: Curve


def _around(edges: _Edges, way: float, aspect: float) -> Smear:
    """Return the means over the outline of an ellipse `aspect` times as long across its way."""
    turn = (np.arange(90) + 0.5) * math.pi / 180
    cos2, sin2 = np.cos(turn) ** 2, np.sin(turn) ** 2
    # How the outline's angle, as a circle that is stretched has it, changes along its normal: the
    # root of `steep2` for a semi-axis of 1 along the way.
    steep2 = cos2 + sin2 / aspect**2
    facing = np.cos(turn) / np.sqrt(steep2)
    length = np.sqrt(sin2 + aspect**2 * cos2)
    g, v, n = (np.interp(way * facing, edges.ways, curve) for curve in edges[1:])
    # A blurred edge of variance v, and what the way along the edge bends it inwards.
    grown = v * steep2
    return Smear(
        missing_along=1 - 2 * float((g * cos2).mean()),
        missing_across=1 - 2 * float((g * sin2).mean()),
        moment_along=float((3 * grown * cos2 - grown / 4).mean()),
        moment_across=aspect**2 * (float((3 * grown * sin2 - grown / 4).mean()) - way * way / 48),
        noise_along=float(n @ (cos2 * length)) / float(cos2 @ length),
        noise_across=float(n @ (sin2 * length)) / float(sin2 @ length),
    )


def smear(way: float, smeared: bool, aspect: float = 1.0) -> Smear:
    """Return what a way of so many edge widths does to an ellipse `aspect` times as long across the
    way as along it, with the weights for long ways (`smeared`) or the usual ones."""
    table = _table(smeared)
    row = min(max(math.log2(aspect) / ASPECT_STEP + MIDDLE, 0.0), len(table) - 1.001)
    column = min(abs(way) / STEP, len(table[0]) - 1.001)
    i, k = int(row), int(column)
    down, right = row - i, column - k
    corners = (
        ((1 - down) * (1 - right), table[i][k]),
        ((1 - down) * right, table[i][k + 1]),
        (down * (1 - right), table[i + 1][k]),
        (down * right, table[i + 1][k + 1]),
    )
    return Smear(*(sum(part * corner[n] for part, corner in corners) for n in range(6)))
