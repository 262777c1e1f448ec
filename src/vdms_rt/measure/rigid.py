"""The rigid motion of a marker in its own plane, from as many circles as are good."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vdms_rt.model import Points

LEAST_CIRCLES = 3
"""Two circles fix x, y and rotation, and would hide a wrong one; the third can contradict."""

Covariances = NDArray[np.float64]
"""One 2 x 2 covariance for each point, (n, 2, 2), float64."""


@dataclass(frozen=True, slots=True)
class Motion:
    """Where a marker is, and how well that is known."""

    x_mm: float
    y_mm: float
    rotation_mrad: float
    residual_mm: float
    """Root mean square distance of the circles that were used from the rigid marker."""
    covariance: NDArray[np.float64]
    """Of (x mm, y mm, rotation rad), (3, 3), from the errors of the circles of this picture."""
    misfit: tuple[float, ...]
    """Of every circle, used or not: its distance from where the *other* used circles say it is, in
    standard deviations of that distance (Baarda 1968); for a good one its square is chi-square
    with 2 degrees of freedom."""
    used: tuple[bool, ...]


def rigid_motion(
    reference_mm: Points,
    now_mm: Points,
    covariance_mm2: Covariances,
    good: NDArray[np.bool_],
    tolerance_mm: float = 0.0,
) -> Motion | None:
    """Return the rotation about the mean of all `reference_mm` and the shift of that mean which
    best carry the good circles' reference to `now_mm`; None with fewer than three good ones.

    Weighted least squares over the circles' covariances (n, 2, 2). `tolerance_mm` is how far a
    circle may be off for other reasons than its own noise (what the lens bends); it weakens the
    misfit, and nothing else.
    """
    if np.count_nonzero(good) < LEAST_CIRCLES:
        return None
    arms = reference_mm - reference_mm.mean(axis=0)
    changes = now_mm - reference_mm
    weights = np.linalg.inv(covariance_mm2[good])
    angle = _turn(arms[good], now_mm[good])
    shift = np.zeros(2)
    for _ in range(4):
        c, s = math.cos(angle), math.sin(angle)
        turned = arms @ np.array([[c, s], [-s, c]])
        residuals = changes + arms - turned - shift
        slopes = np.zeros((len(arms), 2, 3))
        slopes[:, 0, 0] = slopes[:, 1, 1] = 1.0
        slopes[:, 0, 2] = -turned[:, 1]
        slopes[:, 1, 2] = turned[:, 0]
        weighed = slopes[good].transpose(0, 2, 1) @ weights
        covariance = np.linalg.inv((weighed @ slopes[good]).sum(axis=0))
        step = covariance @ (weighed @ residuals[good][:, :, None]).sum(axis=0)[:, 0]
        shift += step[:2]
        angle += step[2]
        # What a step leaves is its square's half of the arms: below a nanometre.
        if abs(step[2]) < 1e-5:
            break
    residuals = residuals - slopes @ step
    # A used circle has pulled the fit towards itself, so its residual is smaller than its error.
    pull = slopes @ covariance @ slopes.transpose(0, 2, 1)
    own = covariance_mm2 + np.where(good, -1.0, 1.0)[:, None, None] * pull
    own = own + tolerance_mm**2 * np.eye(2)
    misfit = np.sqrt((residuals * np.linalg.solve(own, residuals[:, :, None])[:, :, 0]).sum(axis=1))
    return Motion(
        x_mm=float(shift[0]),
        y_mm=float(shift[1]),
        rotation_mrad=1000 * angle,
        residual_mm=math.sqrt(float((residuals[good] ** 2).sum(axis=1).mean())),
        covariance=covariance,
        misfit=tuple(misfit.tolist()),
        used=tuple(good.tolist()),
    )


def _turn(arms_mm: Points, now_mm: Points) -> float:
    """Return the angle in radians by which unweighed arms have turned."""
    a, b = arms_mm - arms_mm.mean(axis=0), now_mm - now_mm.mean(axis=0)
    return math.atan2(
        float(a[:, 0] @ b[:, 1] - a[:, 1] @ b[:, 0]), float(a[:, 0] @ b[:, 0] + a[:, 1] @ b[:, 1])
    )


def agreeing_motion(
    reference_mm: Points,
    now_mm: Points,
    covariance_mm2: Covariances,
    good: NDArray[np.bool_],
    limit: float,
    tolerance_mm: float = 0.0,
) -> tuple[Motion | None, bool]:
    """Return the motion from the good circles that agree with each other, and whether they do.

    While the worst misfit is above `limit`, that circle is left out, as long as three remain. With
    three left that still contradict each other nobody can say which is wrong: the answer is False.
    """
    good = good.copy()
    while True:
        motion = rigid_motion(reference_mm, now_mm, covariance_mm2, good, tolerance_mm)
        if motion is None:
            return None, True
        misfit = np.where(good, motion.misfit, 0.0)
        worst = int(misfit.argmax())
        if misfit[worst] <= limit:
            return motion, True
        if np.count_nonzero(good) == LEAST_CIRCLES:
            return motion, False
        good[worst] = False


def position_covariance(
    motion: Motion, reference_mm: Points, reference_covariance_mm2: Covariances
) -> NDArray[np.float64]:
    """Return the covariance of (x_mm, y_mm), (2, 2), the reference's own share included.

    `reference_covariance_mm2` (n, 2, 2) is that of the circles' reference positions as the current
    picture sees them: their errors carry over to every later sample just as a picture's own do.
    """
    used = np.array(motion.used)
    arms = (reference_mm - reference_mm.mean(axis=0))[used]
    slopes = np.zeros((len(arms), 2, 3))
    slopes[:, 0, 0] = slopes[:, 1, 1] = 1.0
    slopes[:, 0, 2] = -arms[:, 1]
    slopes[:, 1, 2] = arms[:, 0]
    weights = np.linalg.inv(reference_covariance_mm2[used])
    information = (slopes.transpose(0, 2, 1) @ weights @ slopes).sum(axis=0)
    total: NDArray[np.float64] = (motion.covariance + np.linalg.inv(information))[:2, :2]
    return total
