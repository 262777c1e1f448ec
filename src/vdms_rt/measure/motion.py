"""From circle centres to the marker's displacement."""

from __future__ import annotations

import math

import numpy as np

from vdms_rt.measure.homography import Matrix, to_marker_mm
from vdms_rt.model import Points


def mean_displacement(
    h: Matrix, centres_px: Points, reference_mm: Points
) -> tuple[float, float, float]:
    """Return x_mm, y_mm and residual_mm: the mean of the circles' changes in the marker plane, and
    the root mean square distance of the single changes from it.

    `centres_px` and `reference_mm` are (n, 2), circle by circle, n >= 1. Lee, Cho and Sim (2015):
    centres through the inverse homography, less their reference, averaged over the circles.
    """
    changes = to_marker_mm(h, centres_px) - reference_mm
    mean = changes.mean(axis=0)
    residual = math.sqrt(float(np.square(changes - mean).sum(axis=1).mean()))
    return float(mean[0]), float(mean[1]), residual


def mean_rotation_mrad(h: Matrix, centres_px: Points, reference_mm: Points) -> float:
    """Return the marker's rotation in its plane, counter-clockwise positive, by least squares.

    `centres_px` and `reference_mm` are (n, 2), circle by circle, n >= 2. Schoenemann's orthogonal
    Procrustes problem in two dimensions.
    """
    now = to_marker_mm(h, centres_px)
    now = now - now.mean(axis=0)
    then = reference_mm - reference_mm.mean(axis=0)
    cross = float((then[:, 0] * now[:, 1] - then[:, 1] * now[:, 0]).sum())
    return 1000 * math.atan2(cross, float((then * now).sum()))
