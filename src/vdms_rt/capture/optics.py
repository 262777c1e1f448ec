"""The virtual camera: from the marker plane to pixels, and what a pixel sees of a sharp outline."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from vdms_rt.config import Table

Floats: TypeAlias = NDArray[np.float64]

PHASES = 512
"""Sub-pixel positions for which the blur is tabulated, linear between them: right to 2e-5."""
TAIL_SIGMAS = 3.7
TURNING = 0.147
"""Just below 4/27, where r (1 - a r^2) has no larger value."""
SHARP_PX = 0.3
"""Below this blur an outline is cut into short chords; above, quadrature needs few points."""


class Camera:
    """A pinhole that looks at the zero of the marker plane from `distance_m`, with a lens.

    The picture plane is measured in rows from the picture's centre, x right, y down ("ideal"),
    until the lens distorts it and the pixels' aspect stretches x. With a positive angle the right
    side of the sheet is the farther one; with a positive roll the picture is turned
    counter-clockwise.

    The lens follows Brown (1966): ideal radius = r (1 - distortion (r / R)^2) for the radius r in
    the picture and R in its corner, so the displacement in the corner is `distortion` times R, and
    every pixel has its ray.
    """

    def __init__(self, table: Table, sheet_height_mm: float) -> None:
        self._distance_mm = 1000 * table.distance_m
        self.scale = table.fill * table.height_px / sheet_height_mm
        """Rows for each millimetre at the zero of the plane."""
        self._aspect = table.pixel_aspect
        self._centre_px = np.array([(table.width_px - 1) / 2, (table.height_px - 1) / 2])
        self._corner = math.hypot(table.width_px / 2 / self._aspect, table.height_px / 2)
        self._distortion = table.distortion
        angle, roll = math.radians(table.angle_deg), math.radians(table.roll_deg)
        self._stand = np.array(
            [
                [math.cos(angle), 0.0, 0.0],
                [0.0, 1.0, 0.0],
                [math.sin(angle), 0.0, self._distance_mm],
            ]
        )
        focal = self.scale * self._distance_mm
        turn = np.array(
            [
                [math.cos(roll), math.sin(roll), 0.0],
                [-math.sin(roll), math.cos(roll), 0.0],
                [0.0, 0.0, 1.0],
            ]
        )
        self._lens = turn @ np.diag([focal, -focal, 1.0])

    def homography(self, shake_mm: tuple[float, float]) -> Floats:
        """Return the (3, 3) map from the plane's millimetres to the ideal picture while the camera
        is turned so that the plane's zero seems to be at `shake_mm`."""
        pan, tilt = (math.atan2(mm, self._distance_mm) for mm in shake_mm)
        panned = np.array(
            [[math.cos(pan), 0.0, math.sin(pan)], [0, 1, 0], [-math.sin(pan), 0.0, math.cos(pan)]]
        )
        tilted = np.array(
            [
                [1, 0, 0],
                [0.0, math.cos(tilt), math.sin(tilt)],
                [0.0, -math.sin(tilt), math.cos(tilt)],
            ]
        )
        return np.asarray(self._lens @ tilted @ panned @ self._stand)

    def project(self, homography: Floats, points_mm: Floats) -> Floats:
        """Return where points of the plane, (n, 2) mm, are in the picture, (n, 2) px."""
        return self.trace(homography, points_mm, np.zeros_like(points_mm))[0]

    def trace(
        self, homography: Floats, points_mm: Floats, steps_mm: Floats
    ) -> tuple[Floats, Floats]:
        """Return points of an outline and their steps along it, both (n, 2), in the picture."""
        ahead = points_mm @ homography[:, :2].T + homography[:, 2]
        along = steps_mm @ homography[:, :2].T
        ideal = ahead[:, :2] / ahead[:, 2:]
        steps = (along[:, :2] - ideal * along[:, 2:]) / ahead[:, 2:]
        if self._distortion:
            ideal, steps = self._bend(ideal, steps)
        stretch = np.array([self._aspect, 1.0])
        return self._centre_px + stretch * ideal, stretch * steps

    def depth_mm(self, points_mm: Floats) -> Floats:
        """Return how far points of the plane, (n, 2) mm, lie before the camera, (n,)."""
        return np.asarray(points_mm @ self._stand[2, :2] + self._distance_mm)

    def _bend(self, ideal: Floats, steps: Floats) -> tuple[Floats, Floats]:
        """Return ideal points and steps as the lens moves them.

        With s = r' / r and a = distortion (r / R)^2 for the ideal radius r, s solves
        s - a s^3 = 1. Beyond the turning point of a pincushion, outside the picture, s is held.
        """
        square = (ideal**2).sum(axis=1) / self._corner**2
        a = np.minimum(self._distortion * square, TURNING)
        s = np.ones_like(a)
        for _ in range(12):
            change = (s - a * s**3 - 1) / (1 - 3 * a * s**2)
            s -= change
            if np.abs(change).max(initial=0.0) < 1e-12:
                break
        radial = (ideal * steps).sum(axis=1) / self._corner**2
        stretch = 2 * self._distortion * radial * s**3 / (1 - 3 * a * s**2) * (a < TURNING)
        return ideal * s[:, None], steps * s[:, None] + ideal * stretch[:, None]


class Taps:
    """A tabulated response of pixels to a point of an outline, by their distance behind it."""

    def __init__(
        self, response: Callable[[Floats], Floats], nearest_px: float, farthest_px: float, step: int
    ) -> None:
        """Take a response that is zero outside of nearest_px..farthest_px; `step` is the distance
        from one pixel to the next, in px."""
        self._nearest = nearest_px / step
        count = 1 + math.floor((farthest_px - nearest_px) / step)
        phases = np.arange(PHASES + 1) / PHASES
        self._table = response(nearest_px + step * (phases[:, None] + np.arange(count)))
        self._slope = np.diff(self._table, axis=0)

    def at(self, places: Floats) -> tuple[NDArray[np.intp], Floats]:
        """Return, for places (n,) in steps, the first pixel that responds and the responses of it
        and its followers, (n, count)."""
        begin = places + self._nearest
        first = np.ceil(begin)
        phase = (first - begin) * PHASES
        index = np.minimum(phase.astype(np.intp), PHASES - 1)
        part = (phase - index)[:, None]
        return first.astype(np.intp), self._table[index] + part * self._slope[index]


def _normal_cdf(x: Floats) -> Floats:
    return np.array([0.5 * math.erfc(-v / math.sqrt(2)) for v in x.ravel()]).reshape(x.shape)


def edge_response(blur_px: float) -> Callable[[Floats], Floats]:
    """Return what part of a pixel's light comes from beyond an edge, by the pixel's distance in px
    behind the edge: a pixel's width blurred by a Gaussian of standard deviation `blur_px`,
    integrated. It is exactly 0 and 1 from TAIL_SIGMAS of the blur on."""
    reach_px = 0.5 + TAIL_SIGMAS * blur_px
    grid_px = np.linspace(-reach_px, reach_px, 8 * PHASES + 1)
    if blur_px > 0:
        low, high = (grid_px - 0.5) / blur_px, (grid_px + 0.5) / blur_px
        values = blur_px * (_ramp(high) - _ramp(low))
        values[0], values[-1] = 0.0, 1.0
    else:
        values = grid_px + 0.5
    return lambda d: np.interp(d, grid_px, values)


def _ramp(z: Floats) -> Floats:
    """The integral of the normal distribution function."""
    return np.asarray(z * _normal_cdf(z) + np.exp(-(z**2) / 2) / math.sqrt(2 * math.pi))


def line_response(blur_px: float) -> Callable[[Floats], Floats]:
    """Return the derivative of `edge_response`: a pixel's light from a thin line."""
    if blur_px == 0:
        return lambda d: (np.abs(d) < 0.5).astype(np.float64)
    return lambda d: _normal_cdf((d + 0.5) / blur_px) - _normal_cdf((d - 0.5) / blur_px)
