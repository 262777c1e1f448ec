"""Telling a marker at rest from one that moves, out of its circles' last centres."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

NEUMANN_RATIO = 0.35
"""Least ratio of half the mean square successive difference to the variance. It is 1 +- 0.18 for 30
pictures of white noise (von Neumann et al., "The mean square successive difference", 1941), and
near 0 for motion."""
QUANTISATION_PX = 0.01
"""Movement below this cannot be told from the rounding of a thresholded centroid."""


def noise_px(centres_px: NDArray[np.float64]) -> float:
    """Return the standard deviation of one coordinate of one centre, from successive differences.

    centres_px is (pictures, circles, 2). Slow motion hardly enters; NaN for a single picture.
    """
    if len(centres_px) < 2:
        return float("nan")
    return float(np.sqrt(np.mean(np.diff(centres_px, axis=0) ** 2) / 2))


def is_still(centres_px: NDArray[np.float64], still_px: float) -> bool:
    """Return whether the centres, (pictures, circles, 2), show a marker at rest.

    No circle may have moved by more than `still_px`, peak to peak, and the circles' mean may not
    vary more than its noise from picture to picture explains. A single picture counts as still.
    """
    if np.ptp(centres_px, axis=0).max() > still_px:
        return False
    if len(centres_px) < 4:
        return True
    common = centres_px.mean(axis=1)
    noise_variance = np.mean(np.diff(common, axis=0) ** 2, axis=0) / 2
    limit = noise_variance / NEUMANN_RATIO + QUANTISATION_PX**2
    return bool((common.var(axis=0, ddof=1) <= limit).all())
