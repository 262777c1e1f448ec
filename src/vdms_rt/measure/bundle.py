"""A marker in many pictures at once: its rigid poses, the homography and the lens that fit best."""

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
from vdms_rt.measure.lens import Lens, undistort_jacobian, undistort_px
from vdms_rt.model import MarkerShape, Points, VdmsError

Floats = NDArray[np.float64]
Seen = NDArray[np.bool_]

PRINT_MM = 0.1
"""Standard deviation of a printed circle's place from where the sheet's design has it."""
CENTRE_PART = 0.1
"""Standard deviation of the lens's centre from the picture's, as a part of half its diagonal."""
MOST_PICTURES = 3000
LEAST_PLACES = 30
"""Fewer cannot tell their own scatter."""
PLACE_PX = 2.0
"""Pictures of a marker that stands within this share their errors: pixels, light, print."""
OUTLIER_SIGMAS = 6.0
LEAST_NOISE_PX = 1e-3
MAX_STEPS = 40
STEP = 1e-4
"""Of a lens term, to take its slope by."""
HOMOGRAPHY_TERMS = 5
"""Scale, stretch, shear and two of perspective: its shift and turn are those of all poses."""
UNFIT = (
    "the circles fit no rigid marker before a camera that stands still; move the marker in its own "
    "plane, and nothing else"
)


class LensError(VdmsError):
    """The pictures hold no estimate of the lens."""


@dataclass(frozen=True, slots=True)
class Pictures:
    """All that is known. The marker's plane has its zero in the middle of the circles, and their
    mean distance from there as its unit."""

    centres_px: Floats
    """Seen, (pictures, circles, 2); a circle that is not good stands in the middle of the good."""
    good: Seen
    circles: Points
    radius: float
    unit_mm: float
    lens: Lens
    """Without distortion: where its centre is by default, and the picture's size."""


@dataclass(frozen=True, slots=True)
class Fit:
    """All that is sought."""

    lens: Lens
    h: Matrix
    circles: Points
    turn: Floats
    """Of each picture's pose, rad."""
    shift: Points


@dataclass(frozen=True, slots=True)
class Solution:
    fit: Fit
    terms: tuple[str, ...]
    residuals_px: Floats
    """In the picture as it is seen, (pictures, circles, 2)."""
    covariance: Floats
    """Of the terms; the centre in halves of the picture's diagonal."""
    places: int

    def sigma(self, term: str) -> float:
        """Return a term's standard error, 0 for one that was not sought."""
        if term not in self.terms:
            return 0.0
        n = self.terms.index(term)
        return math.sqrt(self.covariance[n, n])


def pictures_of(shape: MarkerShape, centres_px: Floats, lens: Lens) -> Pictures:
    """Return the pictures with three circles or more, at most MOST_PICTURES evenly spread, of seen
    centres (pictures, circles, 2) that are NaN where a circle is not good.

    `lens` has no distortion. Raises LensError if no picture shows all circles.
    """
    good = np.asarray(np.isfinite(centres_px).all(axis=2))
    chosen = np.flatnonzero(good.sum(axis=1) >= 3)
    if not good.all(axis=1).any():
        raise LensError("no picture shows all circles of the marker")
    if len(chosen) > MOST_PICTURES:
        chosen = chosen[np.linspace(0, len(chosen) - 1, MOST_PICTURES).round().astype(np.intp)]
    circles_mm = np.array(shape.circles_mm)
    circles_mm = circles_mm - circles_mm.mean(axis=0)
    unit_mm = float(np.hypot(*circles_mm.T).mean())
    return Pictures(
        centres_px=np.where(
            good[chosen][..., None],
            centres_px[chosen],
            np.nanmean(centres_px[chosen], axis=1, keepdims=True),
        ),
        good=good[chosen],
        circles=circles_mm / unit_mm,
        radius=shape.diameter_mm / 2 / unit_mm,
        unit_mm=unit_mm,
        lens=lens,
    )


def begin(pictures: Pictures) -> Fit:
    """Return the fit that needs no search: without a lens, by the first whole picture."""
    first = int(np.flatnonzero(pictures.good.all(axis=1))[0])
    h = homography_normalised(pictures.circles, pictures.centres_px[first])
    turn, shift = poses(pictures, each(to_marker_mm, h, pictures.centres_px))
    return Fit(pictures.lens, h, pictures.circles, turn, shift)


def poses(pictures: Pictures, plane: Floats) -> tuple[Floats, Points]:
    """Return the turn of each picture's marker and the shift of its middle, by least squares over
    the good circles (Schoenemann 1966)."""
    weight = pictures.good[..., None] / pictures.good.sum(axis=1)[:, None, None]
    then = (weight * pictures.circles).sum(axis=1)
    now = (weight * plane).sum(axis=1)
    a, b = weight * (pictures.circles - then[:, None]), plane - now[:, None]
    cross = (a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]).sum(axis=1)
    turn = np.arctan2(cross, (a * b).sum(axis=(1, 2)))
    return turn, now - (rotations(turn) @ then[..., None])[..., 0]


def solve(pictures: Pictures, fit: Fit, terms: tuple[str, ...]) -> Solution:
    """Return the least squares over the lens's `terms` (of "k1", "k2", "x", "y") and all the rest.

    Gauss-Newton, the poses eliminated; the circles' places on the print are held by PRINT_MM, the
    lens's centre by CENTRE_PART. The covariance is by the residuals' scatter, or by the sandwich
    over places (Liang and Zeger 1986) if that gives the first term more: errors of pictures in one
    place are not independent. Raises LensError if nothing fits or the places are too few.
    """
    try:
        with np.errstate(all="ignore"):
            return _solve(pictures, fit, terms)
    except np.linalg.LinAlgError:
        raise LensError(UNFIT) from None


def _solve(pictures: Pictures, fit: Fit, terms: tuple[str, ...]) -> Solution:
    lengths = pictures.circles.size
    count = len(terms) + HOMOGRAPHY_TERMS + lengths
    freedom = max(2 * int(pictures.good.sum()) - 3 * len(pictures.good) - count + lengths, 1)
    default = _numbers(pictures.lens)
    for _ in range(MAX_STEPS):
        residuals, shared, own = _equations(pictures, fit, terms)
        across = own.transpose(0, 2, 1)
        with_residuals = np.concatenate([shared, residuals[..., None]], axis=2)
        solved = np.linalg.solve(across @ own, across @ with_residuals)
        left = with_residuals - own @ solved
        pulls = (shared.transpose(0, 2, 1) @ left[..., -1:])[..., 0]
        noise_px = max(math.sqrt(float((residuals**2).sum()) / freedom), LEAST_NOISE_PX)
        hold, away = np.zeros(count), np.zeros(count)
        hold[-lengths:] = (noise_px * pictures.unit_mm / PRINT_MM) ** 2
        away[-lengths:] = (fit.circles - pictures.circles).ravel()
        for n, term in enumerate(terms):
            if term in ("x", "y"):
                hold[n] = (noise_px / CENTRE_PART) ** 2
                away[n] = _numbers(fit.lens)[term] - default[term]
        normal = np.einsum("pij,pik->jk", shared, left[..., :-1]) + np.diag(hold)
        step = -np.linalg.solve(normal, pulls.sum(axis=0) + hold * away)
        own_step = -(solved[..., -1] + solved[..., :-1] @ step)
        fit = _stepped(fit, step, own_step, terms)
        if max(np.abs(step).max(), np.abs(own_step).max()) < 1e-8:
            break
    else:
        raise LensError(UNFIT)
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
    inverse_normal = np.linalg.inv(normal)
    sandwich = (inverse_normal @ meat @ inverse_normal)[: len(terms), : len(terms)]
    plain = (noise_px**2 * inverse_normal)[: len(terms), : len(terms)]
    return Solution(
        fit=fit,
        terms=terms,
        residuals_px=residuals.reshape(pictures.centres_px.shape),
        covariance=plain if plain[0, 0] > sandwich[0, 0] else sandwich,
        places=places,
    )


def _equations(
    pictures: Pictures, fit: Fit, terms: tuple[str, ...]
) -> tuple[Floats, Floats, Floats]:
    """Return residuals in the seen picture, and their slopes along what all pictures share (lens,
    homography, print) and along each one's own pose."""
    count, circles = pictures.good.shape
    rotated = rotations(fit.turn)
    arms = fit.circles @ rotated.transpose(0, 2, 1)
    plane = arms + fit.shift[:, None]
    to_ideal = each(jacobian_px_per_mm, fit.h, plane)
    to_seen = np.linalg.inv(undistort_jacobian(fit.lens, pictures.centres_px))
    slopes = to_seen @ to_ideal
    spread_px2 = (pictures.radius / 2) ** 2 * (slopes @ slopes.transpose(0, 1, 3, 2))
    ideal = undistort_px(fit.lens, pictures.centres_px, spread_px2)
    residuals = (to_seen @ (ideal - each(to_image_px, fit.h, plane))[..., None])[..., 0]

    first = len(terms)
    shared = np.zeros((count, circles, 2, first + HOMOGRAPHY_TERMS + 2 * circles))
    for n, term in enumerate(terms):
        more = undistort_px(_changed(fit.lens, {term: STEP}), pictures.centres_px, spread_px2)
        shared[..., n] = (to_seen @ ((more - ideal) / STEP)[..., None])[..., 0]
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
    shared[..., first : first + HOMOGRAPHY_TERMS] = -slopes @ ways
    for n in range(circles):
        at = first + HOMOGRAPHY_TERMS + 2 * n
        shared[:, n, :, at : at + 2] = -slopes[:, n] @ rotated
    turned = np.stack([-arms[..., 1], arms[..., 0]], axis=-1)
    own = -np.concatenate([slopes, slopes @ turned[..., None]], axis=-1)

    weight = pictures.good.astype(np.float64)[..., None]
    return (
        (weight * residuals).reshape(count, 2 * circles),
        (weight[..., None] * shared).reshape(count, 2 * circles, -1),
        (weight[..., None] * own).reshape(count, 2 * circles, 3),
    )


def _stepped(fit: Fit, step: Floats, own_step: Floats, terms: tuple[str, ...]) -> Fit:
    first = len(terms)
    scale, stretch, shear, tilt_x, tilt_y = step[first : first + HOMOGRAPHY_TERMS]
    change = [[1 + scale + stretch, shear, 0], [shear, 1 + scale - stretch, 0], [tilt_x, tilt_y, 1]]
    return Fit(
        lens=_changed(fit.lens, dict(zip(terms, step.tolist(), strict=False))),
        h=fit.h @ np.array(change),
        circles=fit.circles + step[first + HOMOGRAPHY_TERMS :].reshape(-1, 2),
        turn=fit.turn + own_step[:, 2],
        shift=fit.shift + own_step[:, :2],
    )


def _numbers(lens: Lens) -> dict[str, float]:
    """Return the lens's terms, the centre in halves of the picture's diagonal."""
    x_px, y_px = lens.centre_px
    unit_px = lens.half_diagonal_px
    return {"k1": lens.k1, "k2": lens.k2, "x": x_px / unit_px, "y": y_px / unit_px}


def _changed(lens: Lens, changes: dict[str, float]) -> Lens:
    new = {term: value + changes.get(term, 0.0) for term, value in _numbers(lens).items()}
    centre_px = (new["x"] * lens.half_diagonal_px, new["y"] * lens.half_diagonal_px)
    return replace(lens, k1=new["k1"], k2=new["k2"], centre_px=centre_px)


def _places(fit: Fit) -> NDArray[np.intp]:
    """Return for each picture the number of its place; in one place are the poses that put every
    circle within about PLACE_PX."""
    middle_px = to_image_px(fit.h, fit.shift)
    unit_px = math.sqrt(np.square(jacobian_px_per_mm(fit.h, fit.shift[:1])).sum() / 2)
    poses_px = np.column_stack([middle_px, unit_px * fit.turn])
    numbers = np.unique(np.round(poses_px / PLACE_PX), axis=0, return_inverse=True)[1]
    return np.asarray(numbers.reshape(-1), dtype=np.intp)


def without_outliers(pictures: Pictures, residuals_px: Floats) -> Pictures | None:
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
        raise LensError(UNFIT)
    return replace(pictures, centres_px=pictures.centres_px[enough], good=good[enough])


def rotations(turn: Floats) -> Floats:
    c, s = np.cos(turn), np.sin(turn)
    return np.stack([np.stack([c, -s], axis=-1), np.stack([s, c], axis=-1)], axis=-2)


def each(function: Callable[[Matrix, Points], Floats], h: Matrix, points: Floats) -> Floats:
    """Return a function of a homography at points of any shape (..., 2)."""
    values = function(h, points.reshape(-1, 2))
    return values.reshape(*points.shape[:-1], *values.shape[1:])
