"""What the lens bends, from a marker that moved across the picture: a rigid sheet stays rigid."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from vdms_rt.measure.homography import (
    GeometryError,
    Matrix,
    homography_normalised,
    inverse,
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
SHARED = 5
"""Columns of the homography: scale, stretch, shear and two of perspective. Its shift and turn are
those of all poses together."""


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
class _Fit:
    """All that is sought. Lengths are in the marker's own (see `_Pictures`)."""

    lens: Lens
    h: Matrix
    circles: Points
    turn: Floats
    shift: Points


@dataclass(frozen=True, slots=True)
class _Pictures:
    """All that is known. Seen centres (pictures, circles, 2) are in rows of the frame from the
    lens's centre, the marker's plane in multiples of its own size."""

    seen: Floats
    good: Seen
    circles: Points
    size_mm: float


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
    independent. A disc's centroid is bent a little otherwise than a point; to first order that is a
    change of scale, which the homography takes.

    Raises LensError where the pictures hold no estimate.
    """
