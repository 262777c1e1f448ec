"""The rigid motion of a marker in its own plane, from as many circles as are good.

Plain floats: of so few circles the arithmetic takes less time than the calls of an array library.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

LEAST_CIRCLES = 3
"""Two circles fix x, y and rotation, and would hide a wrong one; the third can contradict."""

HARDLY = (2.1, 1.85)
"""Quantile 0.90 of chi-square over its degrees of freedom, for three circles (3) and for four (5);
more of them lie below."""
BIRGE_LIMIT = (5.4, 4.1)
"""Quantile 0.999."""

Point = tuple[float, float]
Spread = tuple[float, float, float]
"""A symmetric 2 x 2 matrix: xx, xy, yy."""
Symmetric = tuple[float, float, float, float, float, float]
"""A symmetric 3 x 3 matrix over (x, y, rotation): xx, xy, xr, yy, yr, rr."""


@dataclass(frozen=True, slots=True)
class Motion:
    """Where a marker is, and how well that is known."""

    x_mm: float
    y_mm: float
    rotation_mrad: float
    residual_mm: float
    """Root mean square distance of the circles that were used from the rigid marker."""
    covariance: Symmetric
    """Of (x mm, y mm, rotation rad), from the errors of the circles of this picture."""
    chi2: float
    """Weighted squares of the used circles' residuals over their degrees of freedom, 2 n - 3."""
    misfit: tuple[float, ...]
    """Of every circle, used or not: its distance from where the *other* used circles say it is, in
    standard deviations of that distance (Baarda 1968); for a good one its square is chi-square
    with 2 degrees of freedom."""
    used: tuple[bool, ...]


def rigid_motion(
    reference_mm: Sequence[Point],
    now_mm: Sequence[Point],
    covariance_mm2: Sequence[Spread],
    good: Sequence[bool],
    tolerance_mm: float = 0.0,
) -> Motion | None:
    """Return the rotation about the mean of all `reference_mm` and the shift of that mean which
    best carry the good circles' reference to `now_mm`; None with fewer than three good ones.

    Weighted least squares over the circles' covariances. `tolerance_mm` is how far a circle may be
    off for other reasons than its own noise (what the lens bends); it weakens the misfit, and
    nothing else.
    """
    if sum(good) < LEAST_CIRCLES:
        return None
    arms = _arms(reference_mm)
    used = [k for k, usable in enumerate(good) if usable]
    weights = [_inverse(covariance_mm2[k]) for k in used]
    angle = _turn([arms[k] for k in used], [now_mm[k] for k in used])
    shift_x = shift_y = 0.0
    for _ in range(4):
        cos, sin = math.cos(angle), math.sin(angle)
        turned = [(cos * x - sin * y, sin * x + cos * y) for x, y in arms]
        residuals = [
            (nx - rx + ax - tx - shift_x, ny - ry + ay - ty - shift_y)
            for (nx, ny), (rx, ry), (ax, ay), (tx, ty) in zip(
                now_mm, reference_mm, arms, turned, strict=True
            )
        ]
        gradient_x = gradient_y = gradient_r = 0.0
        for k, (wxx, wxy, wyy) in zip(used, weights, strict=True):
            (tx, ty), (rx, ry) = turned[k], residuals[k]
            bx, by = wxx * rx + wxy * ry, wxy * rx + wyy * ry
            gradient_x += bx
            gradient_y += by
            gradient_r += tx * by - ty * bx
        xx, xy, xr, yy, yr, rr = covariance = _covariance([turned[k] for k in used], weights)
        step_x = xx * gradient_x + xy * gradient_y + xr * gradient_r
        step_y = xy * gradient_x + yy * gradient_y + yr * gradient_r
        step_r = xr * gradient_x + yr * gradient_y + rr * gradient_r
        shift_x += step_x
        shift_y += step_y
        angle += step_r
        # What a step leaves is its square's half of the arms: below a nanometre.
        if abs(step_r) < 1e-5:
            break
    squares = chi2 = 0.0
    misfit = []
    for usable, (tx, ty), (rx, ry), (cxx, cxy, cyy) in zip(
        good, turned, residuals, covariance_mm2, strict=True
    ):
        rest_x, rest_y = rx - step_x + ty * step_r, ry - step_y - tx * step_r
        # A used circle has pulled the fit towards itself, so its residual is smaller than its
        # error.
        sign = -1.0 if usable else 1.0
        own = (
            cxx + sign * (xx - 2 * ty * xr + ty * ty * rr) + tolerance_mm * tolerance_mm,
            cxy + sign * (xy + tx * xr - ty * yr - tx * ty * rr),
            cyy + sign * (yy + 2 * tx * yr + tx * tx * rr) + tolerance_mm * tolerance_mm,
        )
        wxx, wxy, wyy = _inverse(own)
        misfit.append(
            math.sqrt(wxx * rest_x * rest_x + 2 * wxy * rest_x * rest_y + wyy * rest_y * rest_y)
        )
        if usable:
            squares += rest_x * rest_x + rest_y * rest_y
            wxx, wxy, wyy = _inverse((cxx, cxy, cyy))
            chi2 += wxx * rest_x * rest_x + 2 * wxy * rest_x * rest_y + wyy * rest_y * rest_y
    return Motion(
        x_mm=shift_x,
        y_mm=shift_y,
        rotation_mrad=1000 * angle,
        residual_mm=math.sqrt(squares / len(used)),
        covariance=covariance,
        chi2=chi2 / (2 * len(used) - 3),
        misfit=tuple(misfit),
        used=tuple(good),
    )


def agreeing_motion(
    reference_mm: Sequence[Point],
    now_mm: Sequence[Point],
    covariance_mm2: Sequence[Spread],
    good: Sequence[bool],
    limit: float,
    tolerance_mm: float = 0.0,
) -> tuple[Motion | None, bool]:
    """Return the motion from the good circles that agree with each other, and whether they do.

    While the worst misfit is above `limit`, that circle is left out, as long as three remain. With
    three left that still contradict each other nobody can say which is wrong: the answer is False.
    """
    good = list(good)
    while True:
        motion = rigid_motion(reference_mm, now_mm, covariance_mm2, good, tolerance_mm)
        if motion is None:
            return None, True
        misfit = [m if usable else 0.0 for m, usable in zip(motion.misfit, good, strict=True)]
        worst = max(misfit)
        if worst <= limit:
            return motion, True
        if sum(good) == LEAST_CIRCLES:
            return motion, False
        good[misfit.index(worst)] = False


def position_covariance(
    motion: Motion, reference_mm: Sequence[Point], reference_covariance_mm2: Sequence[Spread]
) -> Spread:
    """Return the covariance of (x_mm, y_mm), the reference's own share included.

    `reference_covariance_mm2` is that of the circles' reference positions as the current picture
    sees them: their errors carry over to every later sample just as a picture's own do. Where the
    circles disagree by more than noise does in one picture of a thousand, something else is at
    work on them, and their covariances count for as much more (Birge 1932); from one picture in
    ten on, for what they exceed that limit.
    """
    arms = _arms(reference_mm)
    used = [k for k, usable in enumerate(motion.used) if usable]
    weights = [_inverse(reference_covariance_mm2[k]) for k in used]
    own_xx, own_xy, _, own_yy, _, _ = motion.covariance
    xx, xy, _, yy, _, _ = _covariance([arms[k] for k in used], weights)
    four = len(used) > LEAST_CIRCLES
    more = motion.chi2 if motion.chi2 > BIRGE_LIMIT[four] else max(1.0, motion.chi2 / HARDLY[four])
    return more * own_xx + xx, more * own_xy + xy, more * own_yy + yy


def _arms(reference_mm: Sequence[Point]) -> list[Point]:
    n = len(reference_mm)
    mean_x = sum(x for x, _ in reference_mm) / n
    mean_y = sum(y for _, y in reference_mm) / n
    return [(x - mean_x, y - mean_y) for x, y in reference_mm]


def _turn(arms_mm: Sequence[Point], now_mm: Sequence[Point]) -> float:
    """Return the angle in radians by which unweighed arms have turned."""
    n = len(arms_mm)
    arm_x, arm_y = sum(x for x, _ in arms_mm) / n, sum(y for _, y in arms_mm) / n
    cross = dot = 0.0
    # The mean of only one of the two has to be taken off.
    for (ax, ay), (nx, ny) in zip(arms_mm, now_mm, strict=True):
        own_x, own_y = ax - arm_x, ay - arm_y
        cross += own_x * ny - own_y * nx
        dot += own_x * nx + own_y * ny
    return math.atan2(cross, dot)


def _covariance(arms_mm: Sequence[Point], weights: Sequence[Spread]) -> Symmetric:
    """Return the covariance of (x, y, rotation) for circles on these arms with these weights."""
    nxx = nxy = nxr = nyy = nyr = nrr = 0.0
    for (ax, ay), (wxx, wxy, wyy) in zip(arms_mm, weights, strict=True):
        turn_x, turn_y = wxy * ax - wxx * ay, wyy * ax - wxy * ay
        nxx += wxx
        nxy += wxy
        nyy += wyy
        nxr += turn_x
        nyr += turn_y
        nrr += ax * turn_y - ay * turn_x
    cxx, cxy, cxr = nyy * nrr - nyr * nyr, nxr * nyr - nxy * nrr, nxy * nyr - nxr * nyy
    det = nxx * cxx + nxy * cxy + nxr * cxr
    return (
        cxx / det,
        cxy / det,
        cxr / det,
        (nxx * nrr - nxr * nxr) / det,
        (nxy * nxr - nxx * nyr) / det,
        (nxx * nyy - nxy * nxy) / det,
    )


def _inverse(spread: Spread) -> Spread:
    xx, xy, yy = spread
    det = xx * yy - xy * xy
    return yy / det, -xy / det, xx / det
