"""What the lens bends, from a marker that moved across the picture: a rigid sheet stays rigid."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from vdms_rt.measure.homography import (
    Matrix,
    homography_normalised,
    jacobian_px_per_mm,
    to_image_px,
    to_marker_mm,
)
from vdms_rt.measure.lens import Lens, fold_radius, undistort_jacobian, undistort_px
from vdms_rt.model import MarkerShape, Points, VdmsError

Floats = NDArray[np.float64]
Seen = NDArray[np.bool_]

PRINT_MM = 0.1
"""Standard deviation of a printed circle's place from where the sheet's design has it."""
MOST_PICTURES = 3000
LEAST_PLACES = 30
"""Fewer cannot tell their own scatter."""
PLACE_PX = 2.0
"""Pictures of a marker that stands within this share their errors: pixels, light, print."""
LARGEST_SIGMA = 0.005
"""Of the displacement in the corner, as a part of its radius: 0.04 % of a displacement of 10 mm
that fills the picture as in the paper."""
TOLD_SIGMAS = 4.0
"""From which on a coefficient is told from 0."""
OUTLIER_SIGMAS = 6.0
LEAST_NOISE_PX = 1e-3
MAX_STEPS = 40
MAX_ROUNDS = 3
MOST_STILLS = 30
HOMOGRAPHY_TERMS = 5
"""Scale, stretch, shear and two of perspective: its shift and turn are those of all poses."""
_UNFIT = (
    "the circles fit no rigid marker before a camera that stands still; move the marker in its own "
    "plane, and nothing else"
)


class LensError(VdmsError):
    """The pictures hold no estimate of the lens."""


@dataclass(frozen=True, slots=True)
class LensEstimate:
    """A lens, how sure it is, and what it does in the pictures that it was found from."""

    lens: Lens
    sigma_k1: float
    sigma_k2: float
    """0 where k2 is 0, because it was not told from that."""
    sigma_corner: float
    """Standard error of k1 + k2, the displacement in the corner as a part of its radius."""
    residual_before_mm: float
    """Root mean square distance of the circles from the rigid marker, with the homography of the
    first stills, without the lens."""
    residual_after_mm: float
    """The same with the lens."""
    effect_mm: float
    """The largest change that the lens makes to a displacement in the pictures."""
    travel_mm: float
    """The largest displacement."""
    reach: float
    """The largest radius at which a circle was seen, in halves of the picture's diagonal."""
    pictures: int
    places: int
    """Poses of the marker that are 2 px apart or more."""
    shortfall: str
    """One sentence on why this is not enough to go by, or empty."""

    @property
    def enough(self) -> bool:
        return not self.shortfall

    @property
    def bends(self) -> bool:
        """The lens is told from one that bends nothing."""
        return abs(self.lens.k1 + self.lens.k2) > TOLD_SIGMAS * self.sigma_corner


@dataclass(frozen=True, slots=True)
class _Pictures:
    """All that is known. The marker's plane has its zero in the middle of the circles, and their
    mean distance from there as its unit."""

    centres_px: Floats
    """Seen, (pictures, circles, 2); a circle that is not good stands in the middle of the good."""
    good: Seen
    circles: Points
    radius: float
    unit_mm: float


@dataclass(frozen=True, slots=True)
class _Fit:
    """All that is sought."""

    lens: Lens
    h: Matrix
    circles: Points
    turn: Floats
    """Of each picture's pose, rad."""
    shift: Points


@dataclass(frozen=True, slots=True)
class _Solution:
    fit: _Fit
    residuals_px: Floats
    """In the picture as it is seen, (pictures, circles, 2)."""
    covariance: Floats
    """Of k1, or of k1 and k2."""
    places: int


def estimate_lens(
    shape: MarkerShape,
    centres_px: Floats,
    width_px: int,
    height_px: int,
    pixel_aspect: float,
    centre_px: tuple[float, float] | None = None,
) -> LensEstimate:
    """Return the radial distortion with which the marker stays rigid in all pictures.

    `centres_px` is (pictures, circles, 2), seen centres in whole-frame pixels, NaN for a circle
    that was not good, in the order of time; the camera stands still and the marker moves in its own
    plane. `centre_px` is the lens's centre, without it the middle of the picture.

    Least squares in the picture over k1 (and k2 where it is told from 0), one homography, a rigid
    pose for each picture, and the circles' places on the print within PRINT_MM; Gauss-Newton, the
    poses eliminated. Standard errors are the larger of those from the residuals' scatter and of the
    sandwich over places (Liang and Zeger 1986), as errors of pictures in one place are not
    independent.

    Raises LensError where the pictures hold no estimate.
    """
    pictures = _pictures(shape, centres_px)
    middle_px = ((width_px - 1) / 2, (height_px - 1) / 2)
    half_diagonal_px = math.hypot(width_px / 2 / pixel_aspect, height_px / 2)
    none = Lens(0.0, 0.0, centre_px or middle_px, half_diagonal_px, pixel_aspect)
    solution = _solve(pictures, _begin(pictures, none), 1)
    for _ in range(MAX_ROUNDS):
        both = _solve(pictures, solution.fit, 2)
        if _second_is_told(both):
            solution = both
        steady = _without_outliers(pictures, solution.residuals_px)
        if steady is None:
            break
        pictures = steady
        fit = replace(solution.fit, lens=replace(solution.fit.lens, k2=0.0))
        solution = _solve(pictures, fit, 1)
    return _estimate(pictures, none, solution)


def _pictures(shape: MarkerShape, centres_px: Floats) -> _Pictures:
    good = np.asarray(np.isfinite(centres_px).all(axis=2))
    chosen = np.flatnonzero(good.sum(axis=1) >= 3)
    if not good.all(axis=1).any():
        raise LensError("no picture shows all circles of the marker")
    if len(chosen) > MOST_PICTURES:
        chosen = chosen[np.linspace(0, len(chosen) - 1, MOST_PICTURES).round().astype(np.intp)]
    circles_mm = np.array(shape.circles_mm)
    circles_mm = circles_mm - circles_mm.mean(axis=0)
    unit_mm = float(np.hypot(*circles_mm.T).mean())
    return _Pictures(
        centres_px=np.where(
            good[chosen][..., None],
            centres_px[chosen],
            np.nanmean(centres_px[chosen], axis=1, keepdims=True),
        ),
        good=good[chosen],
        circles=circles_mm / unit_mm,
        radius=shape.diameter_mm / 2 / unit_mm,
        unit_mm=unit_mm,
    )


def _begin(pictures: _Pictures, lens: Lens) -> _Fit:
    first = int(np.flatnonzero(pictures.good.all(axis=1))[0])
    h = homography_normalised(pictures.circles, pictures.centres_px[first])
    turn, shift = _poses(pictures, _each(to_marker_mm, h, pictures.centres_px))
    return _Fit(lens, h, pictures.circles, turn, shift)


def _poses(pictures: _Pictures, plane: Floats) -> tuple[Floats, Points]:
    """Return the turn of each picture's marker and the shift of its middle, by least squares over
    the good circles (Schoenemann 1966)."""
    weight = pictures.good[..., None] / pictures.good.sum(axis=1)[:, None, None]
    then = (weight * pictures.circles).sum(axis=1)
    now = (weight * plane).sum(axis=1)
    a, b = weight * (pictures.circles - then[:, None]), plane - now[:, None]
    cross = (a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]).sum(axis=1)
    turn = np.arctan2(cross, (a * b).sum(axis=(1, 2)))
    return turn, now - (_rotations(turn) @ then[..., None])[..., 0]


def _solve(pictures: _Pictures, fit: _Fit, coefficients: int) -> _Solution:
    """Return the fit over k1 (coefficients 1) or k1 and k2 (2) with all the rest."""
    lengths = pictures.circles.size
    count = coefficients + HOMOGRAPHY_TERMS + lengths
    freedom = 2 * int(pictures.good.sum()) - 3 * len(pictures.good) - count + lengths
    for _ in range(MAX_STEPS):
        residuals, shared, own = _equations(pictures, fit, coefficients)
        across = own.transpose(0, 2, 1)
        with_residuals = np.concatenate([shared, residuals[..., None]], axis=2)
        solved = np.linalg.solve(across @ own, across @ with_residuals)
        left = with_residuals - own @ solved
        pulls = (shared.transpose(0, 2, 1) @ left[..., -1:])[..., 0]
        variance = float((residuals**2).sum()) / freedom
        noise_px = max(math.sqrt(variance), LEAST_NOISE_PX)
        hold = np.zeros(count)
        hold[-lengths:] = (noise_px * pictures.unit_mm / PRINT_MM) ** 2
        print_off = np.zeros(count)
        print_off[-lengths:] = (fit.circles - pictures.circles).ravel()
        normal = np.einsum("pij,pik->jk", shared, left[..., :-1]) + np.diag(hold)
        step = -np.linalg.solve(normal, pulls.sum(axis=0) + hold * print_off)
        own_step = -(solved[..., -1] + solved[..., :-1] @ step)
        fit = _stepped(fit, step, own_step, coefficients)
        if max(np.abs(step).max(), np.abs(own_step).max()) < 1e-8:
            break
    else:
        raise LensError(_UNFIT)
    inverse_normal = np.linalg.inv(normal)
    place = _places(fit)
    places = int(place.max()) + 1
    if places < max(LEAST_PLACES, count + 1):
        raise LensError(
            f"the marker stood in {places} places of the picture, and at least {LEAST_PLACES} are "
            "needed; move it slowly, as far as the picture goes"
        )
    summed = np.zeros((places, count))
    np.add.at(summed, place, pulls)
    meat = (summed.T @ summed) * places / (places - count) + noise_px**2 * np.diag(hold)
    sandwich = inverse_normal @ meat @ inverse_normal
    plain = noise_px**2 * inverse_normal
    k = slice(coefficients)
    larger = plain if np.trace(plain[k, k]) > np.trace(sandwich[k, k]) else sandwich
    return _Solution(fit, residuals.reshape(pictures.centres_px.shape), larger[k, k], places)


def _equations(pictures: _Pictures, fit: _Fit, coefficients: int) -> tuple[Floats, Floats, Floats]:
    """Return residuals in the seen picture, and their slopes along what all pictures share
    (coefficients, homography, print) and along each one's own pose."""
    count, circles = pictures.good.shape
    rotations = _rotations(fit.turn)
    arms = fit.circles @ rotations.transpose(0, 2, 1)
    plane = arms + fit.shift[:, None]
    to_ideal = _each(jacobian_px_per_mm, fit.h, plane)
    to_seen = np.linalg.inv(undistort_jacobian(fit.lens, pictures.centres_px))
    slopes = to_seen @ to_ideal
    spread_px2 = (pictures.radius / 2) ** 2 * (slopes @ slopes.transpose(0, 1, 3, 2))
    ideal = undistort_px(fit.lens, pictures.centres_px, spread_px2)
    residuals = (to_seen @ (ideal - _each(to_image_px, fit.h, plane))[..., None])[..., 0]

    shared = np.zeros((count, circles, 2, coefficients + HOMOGRAPHY_TERMS + 2 * circles))
    for n, name in enumerate(("k1", "k2")[:coefficients]):
        more = replace(fit.lens, **{name: getattr(fit.lens, name) + 1e-4})
        change = (undistort_px(more, pictures.centres_px, spread_px2) - ideal) / 1e-4
        shared[..., n] = (to_seen @ change[..., None])[..., 0]
    x, y = plane[..., 0], plane[..., 1]
    ways = np.stack(
        [
            plane,
            np.stack([x, -y], axis=-1),
            np.stack([y, x], axis=-1),
            -x[..., None] * plane,
            -y[..., None] * plane,
        ],
        axis=-1,
    )
    shared[..., coefficients : coefficients + HOMOGRAPHY_TERMS] = -slopes @ ways
    for n in range(circles):
        at = coefficients + HOMOGRAPHY_TERMS + 2 * n
        shared[:, n, :, at : at + 2] = -slopes[:, n] @ rotations
    turned = np.stack([-arms[..., 1], arms[..., 0]], axis=-1)
    own = -np.concatenate([slopes, slopes @ turned[..., None]], axis=-1)

    weight = pictures.good.astype(np.float64)[..., None]
    return (
        (weight * residuals).reshape(count, 2 * circles),
        (weight[..., None] * shared).reshape(count, 2 * circles, -1),
        (weight[..., None] * own).reshape(count, 2 * circles, 3),
    )


def _stepped(fit: _Fit, step: Floats, own_step: Floats, coefficients: int) -> _Fit:
    k = step[:coefficients]
    scale, stretch, shear, tilt_x, tilt_y = step[coefficients : coefficients + HOMOGRAPHY_TERMS]
    change = [[1 + scale + stretch, shear, 0], [shear, 1 + scale - stretch, 0], [tilt_x, tilt_y, 1]]
    return _Fit(
        lens=replace(fit.lens, k1=fit.lens.k1 + float(k[0]), k2=fit.lens.k2 + float(k[1:].sum())),
        h=fit.h @ np.array(change),
        circles=fit.circles + step[coefficients + HOMOGRAPHY_TERMS :].reshape(-1, 2),
        turn=fit.turn + own_step[:, 2],
        shift=fit.shift + own_step[:, :2],
    )


def _second_is_told(both: _Solution) -> bool:
    lens = both.fit.lens
    told = abs(lens.k2) > TOLD_SIGMAS * math.sqrt(both.covariance[1, 1])
    return told and fold_radius(lens.k1, lens.k2) > 1


def _places(fit: _Fit) -> NDArray[np.intp]:
    """Return for each picture the number of its place; in one place are the poses that put every
    circle within about PLACE_PX."""
    middle_px = to_image_px(fit.h, fit.shift)
    unit_px = math.sqrt(np.square(jacobian_px_per_mm(fit.h, fit.shift[:1])).sum() / 2)
    poses_px = np.column_stack([middle_px, unit_px * fit.turn])
    numbers = np.unique(np.round(poses_px / PLACE_PX), axis=0, return_inverse=True)[1]
    return np.asarray(numbers.reshape(-1), dtype=np.intp)


def _without_outliers(pictures: _Pictures, residuals_px: Floats) -> _Pictures | None:
    """Return the pictures without the circles that are not where the others are, or None if there
    are no such."""
    size = np.hypot(residuals_px[..., 0], residuals_px[..., 1])
    # The median of the length of a normal error in two dimensions is 1.177 standard deviations.
    limit = OUTLIER_SIGMAS * max(float(np.median(size[pictures.good])) / 1.177, LEAST_NOISE_PX)
    good = pictures.good & (size <= limit)
    if good.sum() == pictures.good.sum():
        return None
    enough = good.sum(axis=1) >= 3
    if not good[enough].all(axis=1).any():
        raise LensError(_UNFIT)
    return replace(pictures, centres_px=pictures.centres_px[enough], good=good[enough])


def _estimate(pictures: _Pictures, none: Lens, solution: _Solution) -> LensEstimate:
    lens, covariance = solution.fit.lens, solution.covariance
    if fold_radius(lens.k1, lens.k2) <= 1:
        raise LensError(_UNFIT)
    before_mm, residual_before_mm = _motion(pictures, none)
    after_mm, residual_after_mm = _motion(pictures, lens)
    offsets = (pictures.centres_px[pictures.good] - lens.centre_px) / [lens.pixel_aspect, 1.0]
    sigma_corner = math.sqrt(covariance.sum())
    shortfall = ""
    if sigma_corner > LARGEST_SIGMA:
        shortfall = (
            f"the displacement in the picture's corner is known to {100 * sigma_corner:.2g} % of "
            f"its radius, and {100 * LARGEST_SIGMA:g} % is needed; move the marker slowly as far "
            "across the picture as it goes, also up and down"
        )
    return LensEstimate(
        lens=lens,
        sigma_k1=math.sqrt(covariance[0, 0]),
        sigma_k2=math.sqrt(covariance[1, 1]) if len(covariance) > 1 else 0.0,
        sigma_corner=sigma_corner,
        residual_before_mm=residual_before_mm,
        residual_after_mm=residual_after_mm,
        effect_mm=float(np.hypot(*(after_mm - before_mm).T).max()),
        travel_mm=float(np.hypot(*after_mm.T).max()),
        reach=float(np.hypot(*offsets.T).max()) / lens.half_diagonal_px,
        pictures=len(pictures.good),
        places=solution.places,
        shortfall=shortfall,
    )


def _motion(pictures: _Pictures, lens: Lens) -> tuple[Points, float]:
    """Return displacements (n, 2) mm and the rms distance of the circles from the rigid marker, as
    the homography of the first stills gives them."""
    ideal_px = undistort_px(lens, pictures.centres_px)
    whole = ideal_px[pictures.good.all(axis=1)]
    moved_px = np.abs(whole - whole[0]).max(axis=(1, 2))
    still = np.logical_and.accumulate(moved_px < PLACE_PX)
    reference_px = whole[still][:MOST_STILLS].mean(axis=0)
    h = homography_normalised(pictures.circles, reference_px)
    plane = _each(to_marker_mm, h, ideal_px)
    turn, shift = _poses(pictures, plane)
    rigid = pictures.circles @ _rotations(turn).transpose(0, 2, 1) + shift[:, None]
    off = (plane - rigid)[pictures.good]
    return shift * pictures.unit_mm, math.sqrt((off**2).sum(axis=1).mean()) * pictures.unit_mm


def _rotations(turn: Floats) -> Floats:
    c, s = np.cos(turn), np.sin(turn)
    return np.stack([np.stack([c, -s], axis=-1), np.stack([s, c], axis=-1)], axis=-2)


def _each(function: Callable[[Matrix, Points], Floats], h: Matrix, points: Floats) -> Floats:
    """Return a function of a homography at points of any shape (..., 2)."""
    values = function(h, points.reshape(-1, 2))
    return values.reshape(*points.shape[:-1], *values.shape[1:])
