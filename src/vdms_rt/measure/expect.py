"""What a marker's circles should look like in the next picture, from how they looked at rest."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from vdms_rt.measure.gate import Shape, outline
from vdms_rt.measure.homography import Matrix, to_marker_mm
from vdms_rt.measure.lens import Lens, distort_point, undistort_px
from vdms_rt.measure.raster import NO_RASTER, Raster, raster_pair
from vdms_rt.measure.smear import SMEARED_WAY, smear

Triple = tuple[float, float, float]

MARGIN_PX = 4.0
"""The blurred edge takes two pixels on each side and rounding to whole pixels half a one."""
EDGE_PX = 2.0
MAX_MARGIN_PX = 24
LEAST_WAY = 0.25
"""In edge widths: a shorter way in the exposure does nothing to an edge."""


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
    raster_scale: float = 1.0
    """What the rows' raster does to this picture over what `raster` says of it."""


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
    shift_px: tuple[tuple[float, float], ...]
    """What each centre lacks of the mean over the exposure, by the acceleration."""
    doubt_px: float
    """How far that may be off."""
    smeared: bool
    """The way is so long that the weights for smeared edges serve better."""
    travel_px: tuple[float, ...]
    """How far each circle is from its place at rest."""
    reach_px: tuple[tuple[float, float], ...]
    """Half of each circle's bounding box, and the blurred edge."""


class Forecast:
    """Tells how the circles of one marker look at any place, by its map and its appearance at rest.

    Neither the picture nor earlier calls change it.
    """

    def __init__(
        self,
        appearance: Appearance,
        h: Matrix,
        exposure_s: float,
        lens: Lens | None = None,
        combed: bool = False,
    ) -> None:
        """`h` is to pixels as a lens that bends nothing would show them. `combed` pictures are
        woven of two fields: their blur has two teeth, and a middle that is the mean of both."""
        self._appearance = appearance
        self._exposure_s = exposure_s
        self._lens = lens
        self._mean_s2 = 0.0 if combed else exposure_s**2 / 24
        """The mean of a path over the exposure lies beyond its middle by the acceleration times
        this."""
        self._may_smear = exposure_s > 0 and not combed
        if self._may_smear:
            smear(0.0, smeared=False)
            smear(0.0, smeared=True)
        self._h = [[float(v) for v in row] for row in h / h[2, 2]]
        seen_px = np.column_stack((appearance.x_px, appearance.y_px))
        at_mm = to_marker_mm(h, undistort_px(lens, seen_px))
        self.reference_mm = at_mm
        """The circles in the marker plane at rest, (n, 2)."""
        centre = at_mm.mean(axis=0)
        self._centre = (float(centre[0]), float(centre[1]))
        self._arms = [(float(x), float(y)) for x, y in at_mm - centre]
        maps = [self._map(float(x), float(y))[2:] for x, y in at_mm]
        self._back = [
            tuple(np.linalg.inv(np.reshape(slopes, (2, 2))).ravel().tolist()) for slopes in maps
        ]
        self._px_per_mm = float(np.linalg.norm(np.reshape(maps[0], (2, 2)), 2))
        self._edge_px = float(np.mean(appearance.edge_px))
        self._rasters = [
            tuple(
                raster_pair(shape, edge, appearance.row_step, smeared)
                for shape, edge in zip(appearance.moments_px2, appearance.edge_px, strict=True)
            )
            for smeared in ((False, True) if self._may_smear else (False,))
        ]
        """For the usual weights and for those of smeared edges: at rest, and of an ellipse that is
        higher by a quarter of the rows' period."""
        self._spread = tuple(
            spread_px2(shape, edge, appearance.row_step)
            for shape, edge in zip(appearance.moments_px2, appearance.edge_px, strict=True)
        )

    def _map(self, x_mm: float, y_mm: float) -> tuple[float, float, float, float, float, float]:
        """Return where a point of the marker plane is seen, and d(px)/d(mm), row by row."""
        (h00, h01, h02), (h10, h11, h12), (h20, h21, _) = self._h
        depth = h20 * x_mm + h21 * y_mm + 1.0
        u, v = (h00 * x_mm + h01 * y_mm + h02) / depth, (h10 * x_mm + h11 * y_mm + h12) / depth
        j00, j01 = (h00 - u * h20) / depth, (h01 - u * h21) / depth
        j10, j11 = (h10 - v * h20) / depth, (h11 - v * h21) / depth
        if self._lens is None:
            return u, v, j00, j01, j10, j11
        u, v, d00, d01, d10, d11 = distort_point(self._lens, u, v)
        return (
            u,
            v,
            d00 * j00 + d01 * j10,
            d00 * j01 + d01 * j11,
            d10 * j00 + d11 * j10,
            d10 * j01 + d11 * j11,
        )

    def at(
        self,
        pose: Triple,
        velocity: Triple = (0.0, 0.0, 0.0),
        acceleration: Triple = (0.0, 0.0, 0.0),
        doubt: Triple = (0.0, 0.0, 0.0),
        slack_px: float = 0.0,
        smeared: bool | None = None,
    ) -> Expected:
        """Return what to expect of the marker at a pose.

        `pose` is x_mm, y_mm and rotation_mrad from rest, `velocity` and `acceleration` the same per
        second and second^2, which may be off by `doubt`; `slack_px` is how far off the pose may be.
        `smeared` asks for one or the other weights; None leaves it to the way.
        """
        seen = self._appearance
        h20, h21, _ = self._h[2]
        c, s = math.cos(pose[2] / 1000), math.sin(pose[2] / 1000)
        turn, bend = velocity[2] / 1000, acceleration[2] / 1000
        if smeared is None:
            way_px = math.hypot(velocity[0], velocity[1]) * self._exposure_s * self._px_per_mm
            smeared = self._may_smear and way_px > SMEARED_WAY * self._edge_px
        xs, ys, areas, shapes, rasters, spreads, blurs = [], [], [], [], [], [], []
        shifts, travels, reaches = [], [], []
        room = longest = 0.0
        for k, ((ax, ay), (b00, b01, b10, b11)) in enumerate(
            zip(self._arms, self._back, strict=True)
        ):
            arm_x, arm_y = c * ax - s * ay, s * ax + c * ay
            x_mm = self._centre[0] + arm_x + pose[0]
            y_mm = self._centre[1] + arm_y + pose[1]
            u, v, j00, j01, j10, j11 = self._map(x_mm, y_mm)
            depth = h20 * x_mm + h21 * y_mm + 1.0
            # Pixels at rest -> marker plane, turned -> pixels here.
            r00, r01 = c * b00 - s * b10, c * b01 - s * b11
            r10, r11 = s * b00 + c * b10, s * b01 + c * b11
            a00, a01 = j00 * r00 + j01 * r10, j00 * r01 + j01 * r11
            a10, a11 = j10 * r00 + j11 * r10, j10 * r01 + j11 * r11
            speed_x, speed_y = velocity[0] - turn * arm_y, velocity[1] + turn * arm_x
            way_x = (j00 * speed_x + j01 * speed_y) * self._exposure_s
            way_y = (j10 * speed_x + j11 * speed_y) * self._exposure_s
            mean_x = (acceleration[0] - bend * arm_y - turn * turn * arm_x) * self._mean_s2
            mean_y = (acceleration[1] + bend * arm_x - turn * turn * arm_y) * self._mean_s2
            # On a tilted way the far part of it looks shorter, and the circle smaller there: seen
            # is a mean that is too near, by the covariance of the way times the slope of the
            # depth, once for the place and three times for the area.
            closer = 8 * self._mean_s2 * (h20 * speed_x + h21 * speed_y) / depth
            edge_x, edge_y = seen.edge_px[k]
            wx, wy = edge_x * edge_x / 2, edge_y * edge_y / 2
            xx, xy, yy = seen.moments_px2[k]
            xx, yy = xx - wx, yy - wy
            sharp = (
                a00 * a00 * xx + 2 * a00 * a01 * xy + a01 * a01 * yy,
                a00 * a10 * xx + (a00 * a11 + a01 * a10) * xy + a01 * a11 * yy,
                a10 * a10 * xx + 2 * a10 * a11 * xy + a11 * a11 * yy,
            )
            blur = _blurred(
                (way_x, way_y),
                (j00 * mean_x + j01 * mean_y, j10 * mean_x + j11 * mean_y),
                closer * math.hypot(j00 * speed_x + j01 * speed_y, j10 * speed_x + j11 * speed_y),
                sharp,
                seen.edge_px[k],
                self._spread[k],
                smeared,
            )
            gain_xx, gain_xy, gain_yy = blur.moments_px2
            xs.append(u)
            ys.append(v)
            areas.append(seen.area_px[k] * (a00 * a11 - a01 * a10))
            shapes.append((sharp[0] + wx + gain_xx, sharp[1] + gain_xy, sharp[2] + wy + gain_yy))
            flat = seen.raster_scale * math.exp(-((math.pi * way_y / seen.row_step) ** 2) / 12)
            # The pull goes round with the height of the circle: its upper and its lower edge meet
            # the rows alike or not.
            turn_px = 4 * math.pi * (math.sqrt(sharp[2]) - math.sqrt(yy)) / seen.row_step
            rest, quarter = flat * math.cos(turn_px), flat * math.sin(turn_px)
            (y0, area0, yy0), (y1, area1, yy1) = self._rasters[smeared][k]
            rasters.append(
                Raster(
                    rest * y0 + quarter * y1,
                    rest * area0 + quarter * area1,
                    rest * yy0 + quarter * yy1,
                )
            )
            spreads.append(blur.spread_px2)
            blurs.append((way_x, way_y))
            longest = max(longest, math.hypot(way_x, way_y) / self._edge_px)
            shifts.append(blur.shift_px)
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
        doubt_mm = math.hypot(doubt[0], doubt[1])
        doubt_px = (
            doubt_mm * self._mean_s2 * self._px_per_mm * smear(longest, smeared).missing_along
            if doubt_mm
            else 0.0
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
            tuple(shifts),
            doubt_px,
            smeared,
            tuple(travels),
            tuple(reaches),
        )


class _Blur(NamedTuple):
    moments_px2: Shape
    """What the second moments gain."""
    spread_px2: Shape
    shift_px: tuple[float, float]


def _blurred(
    way_px: tuple[float, float],
    mean_px: tuple[float, float],
    closer_px: float,
    sharp_px2: Shape,
    edge_px: tuple[float, float],
    spread: Shape,
    smeared: bool,
) -> _Blur:
    """Return what an exposure does to a circle of second moments `sharp_px2` that goes `way_px` in
    it, and whose mean place lies `mean_px` beyond that at its middle, but looks `closer_px` short
    of that, along the way."""
    way_x, way_y = way_px
    length = math.hypot(way_x, way_y)
    if length < LEAST_WAY * edge_px[0]:
        return _Blur((0.0, 0.0, 0.0), spread, (0.0, 0.0))
    x, y = way_x / length, way_y / length
    width = math.hypot(x * edge_px[0], y * edge_px[1])
    xx, xy, yy = sharp_px2
    size_along = x * x * xx + 2 * x * y * xy + y * y * yy
    size_across = y * y * xx - 2 * x * y * xy + x * x * yy
    blur = smear(length / width, smeared, math.sqrt(size_across / size_along))
    square = width * width
    along, across = blur.moment_along * square, blur.moment_across * square
    mean_along = mean_px[0] * x + mean_px[1] * y
    # Of what the mean looks too close, the weights let through as much as of the mean itself.
    shift_along = (blur.missing_along - blur.missing_across) * mean_along + (
        1 - blur.missing_along
    ) * closer_px
    # The noise grows by the root of these along the way and across it.
    grow_along, grow_across = math.sqrt(blur.noise_along), math.sqrt(blur.noise_across)
    m00 = grow_along * x * x + grow_across * y * y
    m01 = (grow_along - grow_across) * x * y
    m11 = grow_along * y * y + grow_across * x * x
    sxx, sxy, syy = spread
    return _Blur(
        (
            along * x * x + across * y * y,
            (along - across) * x * y,
            along * y * y + across * x * x,
        ),
        (
            m00 * m00 * sxx + 2 * m00 * m01 * sxy + m01 * m01 * syy,
            m00 * m01 * sxx + (m00 * m11 + m01 * m01) * sxy + m01 * m11 * syy,
            m01 * m01 * sxx + 2 * m01 * m11 * sxy + m11 * m11 * syy,
        ),
        (
            blur.missing_across * mean_px[0] + shift_along * x,
            blur.missing_across * mean_px[1] + shift_along * y,
        ),
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
        ((0.0, 0.0),) * n,
        0.0,
        False,
        (0.0,) * n,
        tuple((a + EDGE_PX, b + EDGE_PX) for a, b in semi_axes_px),
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
