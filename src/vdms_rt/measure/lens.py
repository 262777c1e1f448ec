"""What the lens bends: from where a point is seen to where a pinhole would show it, and back."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vdms_rt.model import ConfigError, Points

FARTHEST_SEEN = 2.25
"""Most that the seen radius is of the ideal one without a fold: there 9 k1^2 < -20 k2, so that
1 - k1 s - k2 s^2 stays above 4/9."""


@dataclass(frozen=True, slots=True)
class Lens:
    """A radial distortion (Brown 1966), in terms of the radius that is seen.

    With rho = r / R for the radius r in the picture, measured from `centre_px` in rows, and half
    the picture's diagonal R, the ideal radius is r (1 - k1 rho^2 - k2 rho^4). So k1 + k2 is the
    displacement in the picture's corner as a part of its radius; negative is barrel.
    """

    k1: float
    k2: float
    centre_px: tuple[float, float]
    half_diagonal_px: float
    """Of the whole frame, in rows: a column counts 1 / pixel_aspect."""
    pixel_aspect: float
    """Pixels per unit length along a row over pixels along a column."""


def lens_for(
    k1: float,
    k2: float,
    centre_px: tuple[float, float] | None,
    pixel_aspect: float,
    width_px: int,
    height_px: int,
) -> Lens | None:
    """Return the lens before a picture of this size (of a whole frame), None if it bends nothing.

    Without `centre_px` the middle of the picture is the centre. Raises ConfigError for a centre
    outside of the picture, and for a lens that would show two places of the scene in one pixel.
    """
    middle_px = (width_px - 1) / 2, (height_px - 1) / 2
    x_px, y_px = centre_px or middle_px
    if not (0 <= x_px <= width_px - 1 and 0 <= y_px <= height_px - 1):
        raise ConfigError(
            f"lens.centre_px = [{x_px:g}, {y_px:g}] lies outside of the picture of {width_px} x "
            f"{height_px} px; leave it out unless the lens is known to sit off the middle"
        )
    if k1 == 0 and k2 == 0:
        return None
    half_diagonal_px = math.hypot(width_px / 2 / pixel_aspect, height_px / 2)
    lens = Lens(k1, k2, (x_px, y_px), half_diagonal_px, pixel_aspect)
    across = (abs(x_px - middle_px[0]) + width_px / 2) / pixel_aspect
    farthest = math.hypot(across, abs(y_px - middle_px[1]) + height_px / 2) / half_diagonal_px
    if fold_radius(k1, k2) <= farthest:
        raise ConfigError(
            f"lens.k1 = {k1:g} with lens.k2 = {k2:g} folds the picture over before its corner, "
            "which no lens does; take both from one `vdms-rt lens`"
        )
    return lens


def fold_radius(k1: float, k2: float) -> float:
    """Return the seen radius, in halves of the diagonal, from which on the ideal radius would
    shrink again; infinity if there is none."""
    # 1 - 3 k1 s - 5 k2 s^2 = 0 for s = rho^2, solved without cancellation.
    root = 9 * k1 * k1 + 20 * k2
    if root < 0:
        return math.inf
    divisor = 3 * k1 + math.sqrt(root)
    return math.sqrt(2 / divisor) if divisor > 0 else math.inf


def undistort_px(
    lens: Lens | None, points_px: Points, spread_px2: NDArray[np.float64] | None = None
) -> Points:
    """Return where a lens that bends nothing would show the points that are seen at `points_px`,
    (n, 2) whole-frame pixels; without a lens the points themselves.

    The centroid of a disc is not where its centre is seen, since the lens bends one side of it more
    than the other. With `spread_px2`, the second central moments of each disc's area as it is seen,
    (n, 2, 2), points are such centroids, and the result the ideal disc's, to second order in the
    disc's size. Without, what is left is a change of scale that a homography takes up, and less
    than a hundredth of the distortion.
    """
    if lens is None:
        return points_px
    offsets, square = _about_centre(lens, points_px)
    shrink = 1 - square * (lens.k1 + lens.k2 * square)
    if spread_px2 is not None:
        shift = _disc_shift(lens, offsets, square, spread_px2)
        return np.asarray(lens.centre_px + offsets * shrink[..., None] + shift)
    return np.asarray(lens.centre_px + offsets * shrink[..., None])


def distort_px(lens: Lens | None, ideal_px: Points) -> Points:
    """Return where the lens shows the points that belong at `ideal_px`, (n, 2) whole-frame pixels:
    the inverse of `undistort_px`, to 1e-10 px.

    NaN for a point that the lens shows nowhere; it is never one of the picture.
    """
    if lens is None:
        return ideal_px
    offsets, square = _about_centre(lens, ideal_px)
    ideal = np.sqrt(square)
    fold = fold_radius(lens.k1, lens.k2)
    # The seen radius lies between these two, and the ideal one rises all the way.
    low = np.zeros_like(ideal)
    high = np.minimum(FARTHEST_SEEN * ideal, fold)
    lost = _ideal_radius(lens, high)[0] < ideal
    seen = np.minimum(ideal, high)
    for _ in range(60):
        value, slope = _ideal_radius(lens, seen)
        low = np.where(value <= ideal, seen, low)
        high = np.where(value >= ideal, seen, high)
        with np.errstate(divide="ignore", invalid="ignore"):
            newton = seen - (value - ideal) / slope
        inside = (newton >= low) & (newton <= high)
        after = np.where(inside, newton, (low + high) / 2)
        done = np.abs(after - seen).max(initial=0.0) < 1e-14
        seen = after
        if done:
            break
    stretch = np.divide(seen, ideal, out=np.ones_like(ideal), where=ideal > 0)
    stretch[lost] = math.nan
    return np.asarray(lens.centre_px + offsets * stretch[..., None])


def distort_point(
    lens: Lens, x_px: float, y_px: float
) -> tuple[float, float, float, float, float, float]:
    """Return where the lens shows one point that belongs at (x_px, y_px), and d(seen)/d(ideal)
    there, row by row: `distort_px` and its slope in plain floats, for where time counts.

    For points near the picture; beyond the fold the answer is some place outside of it.
    """
    off_x, off_y = x_px - lens.centre_px[0], y_px - lens.centre_px[1]
    row = off_x / lens.pixel_aspect
    ideal = math.hypot(row, off_y) / lens.half_diagonal_px
    k1, k2 = lens.k1, lens.k2
    rho = ideal
    for _ in range(8):
        square = rho * rho
        error = rho * (1 - square * (k1 + k2 * square)) - ideal
        slope = max(1 - square * (3 * k1 + 5 * k2 * square), 0.1)
        rho -= error / slope
        if abs(error) < 1e-12:
            break
    square = rho * rho
    shrink = 1 - square * (k1 + k2 * square)
    off_x, off_y = off_x / shrink, off_y / shrink
    bend = -2 * (k1 + 2 * k2 * square) / lens.half_diagonal_px**2
    to_x, to_y = bend * off_x / lens.pixel_aspect**2, bend * off_y
    a, b, c, d = shrink + off_x * to_x, off_x * to_y, off_y * to_x, shrink + off_y * to_y
    det = a * d - b * c
    return (
        lens.centre_px[0] + off_x,
        lens.centre_px[1] + off_y,
        d / det,
        -b / det,
        -c / det,
        a / det,
    )


def undistort_jacobian(lens: Lens | None, points_px: Points) -> NDArray[np.float64]:
    """Return d(ideal px)/d(seen px) at seen points (n, 2), as (n, 2, 2): row = ideal axis.

    It carries a covariance of seen centres, J C J^T; its inverse is the slope of `distort_px`.
    """
    if lens is None:
        return np.broadcast_to(np.eye(2), (*points_px.shape[:-1], 2, 2))
    offsets, square = _about_centre(lens, points_px)
    shrink = 1 - square * (lens.k1 + lens.k2 * square)
    slope = -2 * (lens.k1 + 2 * lens.k2 * square) / lens.half_diagonal_px**2
    towards = offsets / [lens.pixel_aspect**2, 1.0] * slope[..., None]
    result: NDArray[np.float64] = offsets[..., :, None] * towards[..., None, :]
    result[..., 0, 0] += shrink
    result[..., 1, 1] += shrink
    return result


def _about_centre(lens: Lens, points_px: Points) -> tuple[Points, NDArray[np.float64]]:
    """Return the offsets from the centre in pixels, and the square of rho."""
    offsets = points_px - lens.centre_px
    rows = offsets[..., 0] / lens.pixel_aspect
    square = (rows * rows + offsets[..., 1] * offsets[..., 1]) / lens.half_diagonal_px**2
    return offsets, square


def _ideal_radius(
    lens: Lens, rho: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the ideal radius of a seen one, and its slope, in halves of the diagonal."""
    square = rho * rho
    value = rho * (1 - square * (lens.k1 + lens.k2 * square))
    return value, 1 - square * (3 * lens.k1 + 5 * lens.k2 * square)


def _disc_shift(
    lens: Lens,
    offsets_px: Points,
    square: NDArray[np.float64],
    spread_px2: NDArray[np.float64],
) -> Points:
    """Return how far an ideal disc's centroid lies from the ideal place of the seen one's, (n, 2).

    With u the undistorted place, C the spread and J = du/dx it is u'' : C / 2 (the mean of u over
    the seen disc) + J C grad log det J (as the ideal disc weighs the seen area by det J).
    """
    unit = np.array([lens.pixel_aspect, 1.0]) * lens.half_diagonal_px
    u = offsets_px / unit
    spread = spread_px2 / (unit[:, None] * unit)
    value = 1 - square * (lens.k1 + lens.k2 * square)
    slope = -(lens.k1 + 2 * lens.k2 * square)
    bend = -2 * lens.k2
    pulled = (spread @ u[..., None])[..., 0]
    pull = (u * pulled).sum(axis=-1)
    trace = spread[..., 0, 0] + spread[..., 1, 1]
    mean = 2 * slope[..., None] * pulled + (slope * trace + 2 * bend * pull)[..., None] * u
    density = slope / value + (3 * slope + 2 * square * bend) / (value + 2 * square * slope)
    weighed = value[..., None] * pulled + 2 * (slope * pull)[..., None] * u
    return np.asarray(unit * (mean + 2 * density[..., None] * weighed))
