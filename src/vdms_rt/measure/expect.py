"""What a marker's circles should look like in the next picture, from how they looked at rest."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from vdms_rt.measure.edge import profile, weight
from vdms_rt.measure.gate import Shape, outline
from vdms_rt.measure.homography import Matrix, jacobian_px_per_mm, to_marker_mm

MARGIN_PX = 4.0
"""The blurred edge takes two pixels on each side and rounding to whole pixels half a one."""
EDGE_PX = 2.0
MAX_MARGIN_PX = 24
BLUR_MOMENT = 1 / 22
"""Of the square of the way that a circle goes in an exposure: what the second moment gains. Light
alone would gain 1/12; the weight is steeper, 1/24 on a short way and 1/20 on a long one."""


class Raster(NamedTuple):
    """How far the rows' raster pulls a circle's figures, at most: y by `y_px` sin, the area by its
    part `area` cos, and the second moment by `yy_px2` cos of 2 pi (y - y_row) / row_step.

    A sum over rows is the integral plus its aliases at the rows' own frequency (Poisson). For whole
    pictures that is some thousandths of a pixel at most; for a field, some hundredths.
    """

    y_px: float
    area: float
    yy_px2: float


NO_RASTER = Raster(0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class Appearance:
    """How a marker's circles look at rest in one kind of picture (whole, or one field): plain
    numbers, tuples over the circles, in pixels of the whole frame. Part of the set-up."""

    row_step: int
    x_px: tuple[float, ...]
    y_px: tuple[float, ...]
    area_px: tuple[float, ...]
    moments_px2: tuple[Shape, ...]
    """Second central moments xx, xy, yy."""
    disc_grey: tuple[float, ...]
    ground_grey: tuple[float, ...]
    light_per_px: tuple[tuple[float, float], ...]
    """Slope of the light on the disc along x and y, as a part of the disc's level."""
    variance_grey2: float
    """Of the noise, its rounding to whole grey levels included."""
    edge_px: tuple[tuple[float, float], ...]
    """Widths (standard deviations) of the blurred edge along x and y, the pixel's own included."""


class Expected(NamedTuple):
    """A marker's circles as they should be in one picture, in pixels of the whole frame."""

    x_px: tuple[float, ...]
    y_px: tuple[float, ...]
    gate: tuple[Shape, ...]
    """Shapes that the gates are made for: the reference's, the same in every picture."""
    margin_px: int
    """How far from the gate's edge the circle's edge may lie, blur included."""
    area_px: tuple[float, ...]
    moments_px2: tuple[Shape, ...]
    light_per_px: tuple[tuple[float, float], ...]
    raster: tuple[Raster, ...]
    spread_px2: tuple[Shape, ...]
    """Covariance xx, xy, yy of the centres for noise as large as the contrast."""
    blur_px: tuple[tuple[float, float], ...]
    """The way that each circle goes in an exposure."""
    travel_px: tuple[float, ...]
    """How far each circle is from its place at rest."""
    reach_px: tuple[tuple[float, float], ...]
    """Half of each circle's bounding box, and the blurred edge."""


class Forecast:
    """Tells how the circles of one marker look at any place, by its map and its appearance at rest.

    Neither the picture nor earlier calls change it.
    """

    def __init__(self, appearance: Appearance, h: Matrix, exposure_s: float) -> None:
        self._appearance = appearance
        self._exposure_s = exposure_s
        self._h = [[float(v) for v in row] for row in h / h[2, 2]]
        at_px = np.column_stack((appearance.x_px, appearance.y_px))
        at_mm = to_marker_mm(h, at_px)
        self.reference_mm = at_mm
        """The circles in the marker plane at rest, (n, 2)."""
        centre = at_mm.mean(axis=0)
        self._centre = (float(centre[0]), float(centre[1]))
        self._arms = [(float(x), float(y)) for x, y in at_mm - centre]
        back = np.linalg.inv(jacobian_px_per_mm(h, at_mm))
        self._back = [tuple(float(v) for v in m.ravel()) for m in back]
        self._raster = tuple(
            raster(shape, edge, appearance.row_step)
            for shape, edge in zip(appearance.moments_px2, appearance.edge_px, strict=True)
        )
        self._spread = tuple(
            spread_px2(shape, edge, appearance.row_step)
            for shape, edge in zip(appearance.moments_px2, appearance.edge_px, strict=True)
        )

    def at(
        self,
        pose: tuple[float, float, float],
        velocity: tuple[float, float, float] = (0.0, 0.0, 0.0),
        slack_px: float = 0.0,
    ) -> Expected:
        """Return what to expect of the marker at a pose.

        `pose` is x_mm, y_mm and rotation_mrad from rest, `velocity` the same per second; `slack_px`
        is how far off the pose may be.
        """
        seen = self._appearance
        c, s = math.cos(pose[2] / 1000), math.sin(pose[2] / 1000)
        turn = velocity[2] / 1000
        (h00, h01, h02), (h10, h11, h12), (h20, h21, _) = self._h
        xs, ys, areas, shapes, rasters, spreads, blurs = [], [], [], [], [], [], []
        travels, reaches = [], []
        room = 0.0
        for k, ((ax, ay), (b00, b01, b10, b11)) in enumerate(
            zip(self._arms, self._back, strict=True)
        ):
            arm_x, arm_y = c * ax - s * ay, s * ax + c * ay
            x, y = self._centre[0] + arm_x + pose[0], self._centre[1] + arm_y + pose[1]
            depth = h20 * x + h21 * y + 1.0
            u, v = (h00 * x + h01 * y + h02) / depth, (h10 * x + h11 * y + h12) / depth
            j00, j01 = (h00 - u * h20) / depth, (h01 - u * h21) / depth
            j10, j11 = (h10 - v * h20) / depth, (h11 - v * h21) / depth
            # Pixels at rest -> marker plane, turned -> pixels here.
            r00, r01 = c * b00 - s * b10, c * b01 - s * b11
            r10, r11 = s * b00 + c * b10, s * b01 + c * b11
            a00, a01 = j00 * r00 + j01 * r10, j00 * r01 + j01 * r11
            a10, a11 = j10 * r00 + j11 * r10, j10 * r01 + j11 * r11
            speed_x = velocity[0] - turn * arm_y
            speed_y = velocity[1] + turn * arm_x
            way_x = (j00 * speed_x + j01 * speed_y) * self._exposure_s
            way_y = (j10 * speed_x + j11 * speed_y) * self._exposure_s
            edge_x, edge_y = seen.edge_px[k]
            wx, wy = edge_x * edge_x / 2, edge_y * edge_y / 2
            xx, xy, yy = seen.moments_px2[k]
            xx, yy = xx - wx, yy - wy
            xs.append(u)
            ys.append(v)
            areas.append(seen.area_px[k] * (a00 * a11 - a01 * a10))
            shapes.append(
                (
                    a00 * a00 * xx
                    + 2 * a00 * a01 * xy
                    + a01 * a01 * yy
                    + wx
                    + BLUR_MOMENT * way_x * way_x,
                    a00 * a10 * xx
                    + (a00 * a11 + a01 * a10) * xy
                    + a01 * a11 * yy
                    + BLUR_MOMENT * way_x * way_y,
                    a10 * a10 * xx
                    + 2 * a10 * a11 * xy
                    + a11 * a11 * yy
                    + wy
                    + BLUR_MOMENT * way_y * way_y,
                )
            )
            flat = math.exp(-((math.pi * way_y / seen.row_step) ** 2) / 12)
            y_px, area, yy_px2 = self._raster[k]
            rasters.append(Raster(y_px * flat, area * flat, yy_px2 * flat))
            gx = math.sqrt(1 + way_x * way_x / (12 * edge_x * edge_x))
            gy = math.sqrt(1 + way_y * way_y / (12 * edge_y * edge_y))
            sxx, sxy, syy = self._spread[k]
            spreads.append((sxx * gx, sxy * math.sqrt(gx * gy), syy * gy))
            blurs.append((way_x, way_y))
            travels.append(math.hypot(u - seen.x_px[k], v - seen.y_px[k]))
            reach_x, reach_y = 2 * math.sqrt(xx), 2 * math.sqrt(yy)
            reaches.append(
                (a00 * reach_x + EDGE_PX + abs(way_x) / 2, a11 * reach_y + EDGE_PX + abs(way_y) / 2)
            )
            room = max(
                room,
                math.hypot(way_x, way_y) / 2
                + max(
                    abs(a00 - 1) * reach_x + abs(a01) * reach_y,
                    abs(a10) * reach_x + abs(a11 - 1) * reach_y,
                ),
            )
        return Expected(
            tuple(xs),
            tuple(ys),
            seen.moments_px2,
            min(math.ceil(MARGIN_PX + room + slack_px), MAX_MARGIN_PX),
            tuple(areas),
            tuple(shapes),
            seen.light_per_px,
            tuple(rasters),
            tuple(spreads),
            tuple(blurs),
            tuple(travels),
            tuple(reaches),
        )


def first_look(
    centres_px: tuple[tuple[float, float], ...],
    semi_axes_px: tuple[tuple[float, float], ...],
    slack_px: float = 2.0,
) -> Expected:
    """Return what to expect of circles that were only just found: their places and sizes.

    `semi_axes_px` is half of each circle's bounding box, as `FoundMarker` has it. Nothing is known
    of the edge or the raster yet, so the centres' covariance is that of an edge of one pixel.
    """
    shapes = tuple((a * a / 4, 0.0, b * b / 4) for a, b in semi_axes_px)
    n = len(shapes)
    return Expected(
        tuple(x for x, _ in centres_px),
        tuple(y for _, y in centres_px),
        shapes,
        math.ceil(MARGIN_PX + slack_px),
        tuple(math.pi * a * b for a, b in semi_axes_px),
        shapes,
        ((0.0, 0.0),) * n,
        (NO_RASTER,) * n,
        tuple(spread_px2(shape, (1.0, 1.0), 1) for shape in shapes),
        ((0.0, 0.0),) * n,
        (0.0,) * n,
        tuple((a + EDGE_PX, b + EDGE_PX) for a, b in semi_axes_px),
    )


def raster(shape: Shape, edge_px: tuple[float, float], row_step: int) -> Raster:
    """Return what the rows' raster does to a circle of which every `row_step`-th row is seen.

    The edge's profile is known, so this sums the weights of such a disc for every position between
    two rows.
    """
    fine = 16
    width_x, width_y = edge_px
    # The weighed edge has half the variance, and a round edge bends its middle inwards.
    bend = (width_x * width_x + width_y * width_y) / 16
    yy = max(shape[2] - width_y * width_y / 2 + bend, 1e-3)
    xx = max(shape[0] - width_x * width_x / 2 + bend, 1e-3)
    half_height, lean = 2 * math.sqrt(yy), shape[1] / yy
    half_chord = 2 * math.sqrt(max(xx - shape[1] ** 2 / yy, 1e-3))
    period = fine * row_step
    reach = math.ceil((half_height + 5 * width_y + 1) / row_step) * period
    y = np.arange(-reach, reach) / fine
    side = math.ceil(half_chord + abs(lean) * half_height + 5 * width_x)
    x = np.arange(-side, side + 1) - lean * y[:, None]
    half = half_chord * np.sqrt(np.clip(1 - (y / half_height) ** 2, 0, None))[:, None]
    sharp = np.where(half > 0, profile((x + half) / width_x) - profile((x - half) / width_x), 0)
    f = np.fft.rfftfreq(len(y), 1 / fine)[:, None]
    blur = np.exp(-2 * (math.pi * width_y * f) ** 2)
    part = np.fft.irfft(np.fft.rfft(sharp, axis=0) * blur, len(y), axis=0)
    along = weight(part).sum(axis=1).reshape(-1, period)
    rows = y.reshape(-1, period)
    area = along.sum(axis=0)
    mean = (along * rows).sum(axis=0) / area
    square = (along * rows * rows).sum(axis=0) / area - mean * mean
    # The first of these phases has a row at the centre; later ones have it below.
    turn = -2 * math.pi * np.arange(period) / period
    wave = 2 / period * np.cos(turn)
    return Raster(
        y_px=float(mean @ np.sin(turn)) * 2 / period,
        area=float(area @ wave / area.mean()),
        yy_px2=float(square @ wave),
    )


def spread_px2(shape: Shape, edge_px: tuple[float, float], row_step: int) -> Shape:
    """Return the covariance xx, xy, yy of a centre for white noise as large as the contrast.

    The Cramer-Rao bound of a Gaussian edge of widths s_x, s_y: the inverse of the sum over the
    outline of n n' / (2 sqrt(pi) s).
    """
    normal, length = outline(shape)
    width = np.hypot(normal[:, 0] * edge_px[0], normal[:, 1] * edge_px[1])
    share = length / (2 * math.sqrt(math.pi) * width) / row_step
    xx, xy, yy = (
        float(share @ (normal[:, 0] ** 2)),
        float(share @ (normal[:, 0] * normal[:, 1])),
        float(share @ (normal[:, 1] ** 2)),
    )
    det = xx * yy - xy * xy
    return yy / det, -xy / det, xx / det
