"""What the lens bends, from a marker that moved across the picture: a rigid sheet stays rigid."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from vdms_rt.measure.bundle import (
    PLACE_PX,
    UNFIT,
    Floats,
    LensError,
    Pictures,
    Solution,
    begin,
    each,
    pictures_of,
    poses,
    rotations,
    solve,
    without_outliers,
)
from vdms_rt.measure.homography import homography_normalised, to_marker_mm
from vdms_rt.measure.lens import Lens, fold_radius, undistort_px
from vdms_rt.model import MarkerShape, Points

LARGEST_SIGMA = 0.005
"""Of the displacement in the corner, as a part of its radius: it falsifies a displacement of 10 mm
by about 0.04 %."""
LARGEST_RESIDUAL_PX = 0.15
"""Root mean square of a coordinate: several times what the coarsest centroid errs."""
TOLD_SIGMAS = 4.0
"""From which on a term is told from none."""
MAX_ROUNDS = 3
MOST_STILLS = 30


@dataclass(frozen=True, slots=True)
class LensEstimate:
    """A lens, how sure it is, and what it does in the pictures that it was found from."""

    lens: Lens
    sigma_k1: float
    sigma_k2: float
    """0 where k2 is 0, because it was not told from that."""
    sigma_centre_px: float
    """Of each coordinate of the centre; 0 where it was not told from the picture's middle."""
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


def estimate_lens(
    shape: MarkerShape,
    centres_px: Floats,
    width_px: int,
    height_px: int,
    pixel_aspect: float,
) -> LensEstimate:
    """Return the radial distortion with which the marker stays rigid in all pictures.

    `centres_px` is (pictures, circles, 2), seen centres in whole-frame pixels, NaN for a circle
    that was not good, in the order of time; the camera stands still and the marker moves in its own
    plane.

    Least squares in the picture (`bundle.solve`) over k1, one homography, a rigid pose for each
    picture, and the circles' places on the print; over the lens's centre and k2 too where they are
    told from the picture's middle and from 0. A wrong `pixel_aspect` is not noticed.

    Raises LensError where the pictures hold no estimate.
    """
    middle_px = ((width_px - 1) / 2, (height_px - 1) / 2)
    half_diagonal_px = math.hypot(width_px / 2 / pixel_aspect, height_px / 2)
    none = Lens(0.0, 0.0, middle_px, half_diagonal_px, pixel_aspect)
    pictures = pictures_of(shape, centres_px, none)
    solution = _best(pictures)
    for _ in range(MAX_ROUNDS):
        steady = without_outliers(pictures, solution.residuals_px)
        if steady is None:
            break
        pictures = steady
        solution = _best(pictures)
    return _estimate(pictures, solution)


def _best(pictures: Pictures) -> Solution:
    """Return the solution with no more terms than are told."""
    best = solve(pictures, begin(pictures), ("k1",))
    if abs(best.fit.lens.k1) <= TOLD_SIGMAS * best.sigma("k1"):
        return best
    for more in (("x", "y"), ("k2",)):
        try:
            longer = solve(pictures, best.fit, best.terms + more)
        except LensError:
            continue
        if _told(longer, more, pictures.lens):
            best = longer
    return best


def _told(solution: Solution, terms: tuple[str, ...], default: Lens) -> bool:
    lens = solution.fit.lens
    if fold_radius(lens.k1, lens.k2) <= 1:
        return False
    size_px = lens.half_diagonal_px
    away = {
        "k2": lens.k2,
        "x": (lens.centre_px[0] - default.centre_px[0]) / size_px,
        "y": (lens.centre_px[1] - default.centre_px[1]) / size_px,
    }
    return any(abs(away[term]) > TOLD_SIGMAS * solution.sigma(term) for term in terms)


def _estimate(pictures: Pictures, solution: Solution) -> LensEstimate:
    lens = solution.fit.lens
    residual_px = math.sqrt(float((solution.residuals_px[pictures.good] ** 2).mean()))
    if residual_px > LARGEST_RESIDUAL_PX or fold_radius(lens.k1, lens.k2) <= 1:
        raise LensError(UNFIT)
    before_mm, residual_before_mm = _motion(pictures, pictures.lens)
    after_mm, residual_after_mm = _motion(pictures, lens)
    offsets = (pictures.centres_px[pictures.good] - lens.centre_px) / [lens.pixel_aspect, 1.0]
    bending = [n for n, term in enumerate(solution.terms) if term in ("k1", "k2")]
    sigma_corner = math.sqrt(solution.covariance[np.ix_(bending, bending)].sum())
    shortfall = ""
    if sigma_corner > LARGEST_SIGMA:
        shortfall = (
            f"the displacement in the picture's corner is known to {100 * sigma_corner:.2g} % of "
            f"its radius, and {100 * LARGEST_SIGMA:g} % is needed; move the marker slowly as far "
            "across the picture as it goes, also up and down"
        )
    return LensEstimate(
        lens=lens,
        sigma_k1=solution.sigma("k1"),
        sigma_k2=solution.sigma("k2"),
        sigma_centre_px=lens.half_diagonal_px * max(solution.sigma("x"), solution.sigma("y")),
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


def _motion(pictures: Pictures, lens: Lens) -> tuple[Points, float]:
    """Return displacements (n, 2) mm and the rms distance of the circles from the rigid marker, as
    the homography of the first stills gives them."""
    ideal_px = undistort_px(lens, pictures.centres_px)
    whole = ideal_px[pictures.good.all(axis=1)]
    moved_px = np.abs(whole - whole[0]).max(axis=(1, 2))
    still = np.logical_and.accumulate(moved_px < PLACE_PX)
    reference_px = whole[still][:MOST_STILLS].mean(axis=0)
    h = homography_normalised(pictures.circles, reference_px)
    plane = each(to_marker_mm, h, ideal_px)
    turn, shift = poses(pictures, plane)
    rigid = pictures.circles @ rotations(turn).transpose(0, 2, 1) + shift[:, None]
    off = (plane - rigid)[pictures.good]
    return shift * pictures.unit_mm, math.sqrt((off**2).sum(axis=1).mean()) * pictures.unit_mm
