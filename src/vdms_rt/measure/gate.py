"""The window through which a marker's circles are measured, and the buffers that it needs.

A box of fixed size rides on each circle's expected centre, in whole pixels. In it three zones are
told apart by their distance from the expected edge: beyond the margin outside everything is
ground, beyond it inside everything is disc, and only the pixels between the two are looked at one
by one. The flat zones give the two grey levels and the plane of light, by a weighted sum each.
"""

from __future__ import annotations

import math
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from vdms_rt.measure.edge import STEPS, weight_table
from vdms_rt.model import Luma

Shape = tuple[float, float, float]
"""Second central moments xx, xy, yy of a circle's picture, in whole-frame px^2. The picture is an
ellipse: all points q with q' C^-1 q = 4 for the matrix C of these."""

FEW_PIXELS = 100
FLAT_PIXELS = 600
"""Enough of a disc's flat pixels for its levels; of larger discs not every row is used."""
DEEP_PX = 2.8
"""So far inside its edge a disc is flat, also half a pixel off the middle of its box."""
_MAX_GATES = 64

GROUND, DISC, EDGE = 0, 1, 2
"""Blocks of 256 in the table of weights: all 0, all 1, and from the third on one of each circle."""


class Gate:
    """Zones, weights and scratch for circles of these shapes.

    Distances are in pixels of the whole frame; a row of the image is `row_step` of them high.
    """

    def __init__(self, shapes: tuple[Shape, ...], margin_px: int, row_step: int) -> None:
        n = self.count = len(shapes)
        self.margin_px = margin_px
        self.half_width = math.ceil(2 * math.sqrt(max(s[0] for s in shapes)) + margin_px)
        reach_y = 2 * math.sqrt(max(s[2] for s in shapes)) + margin_px
        self.half_height = math.ceil(reach_y / row_step)
        self.width, self.height = 2 * self.half_width + 1, 2 * self.half_height + 1

        x = np.arange(-self.half_width, self.half_width + 1, dtype=np.float64)
        y = np.arange(-self.half_height, self.half_height + 1, dtype=np.float64)[:, None] * row_step
        fields = [distance_px(s, x, y) for s in shapes]
        distance = np.array([f[0] for f in fields])
        zone = np.where(distance < -margin_px, DISC, np.where(distance < margin_px, EDGE, GROUND))
        zone[zone == EDGE] += np.broadcast_to(np.arange(n)[:, None, None], zone.shape)[zone == EDGE]
        self.zones = (256 * zone).astype(np.uint16).reshape(-1, self.width)
        """Where in the table of weights a pixel's block begins."""

        self.raw = np.zeros((n, self.height, self.width), np.uint16)
        """The boxes' grey levels."""
        self.boxes = list(self.raw)
        self.raw_rows = self.raw.reshape(-1, self.width)
        self.index_rows = np.empty_like(self.raw_rows)
        self.weights = np.empty(self.raw.shape, np.float32)
        self.weights_rows = self.weights.reshape(-1, self.width)

        rows = y[:, 0] / row_step
        self.columns_of = np.stack([np.ones_like(x), x, x * x], axis=1).astype(np.float32)
        self.rows_of = np.stack([np.ones_like(rows), rows, rows * rows]).astype(np.float32)
        self.down_columns = np.empty((n, 3, self.width), np.float32)
        self.down_columns_rows = self.down_columns.reshape(-1, self.width)
        self.moments = np.empty((3 * n, 3), np.float32)
        self.moments_of_each = self.moments.reshape(n, 9)

        self.x_px, self.y_px = x, y
        """Pixels of the whole frame from the middle of a box, (width,) and (height, 1)."""
        self._flats(shapes, distance, x, y, margin_px)
        self._edges(shapes, fields, margin_px, row_step)

    def _flats(
        self,
        shapes: tuple[Shape, ...],
        distance: NDArray[np.float64],
        x: NDArray[np.float64],
        y: NDArray[np.float64],
        margin_px: int,
    ) -> None:
        smallest = min(
            2 * math.sqrt(np.linalg.eigvalsh([[xx, xy], [xy, yy]])[0]) for xx, xy, yy in shapes
        )
        depth = min(margin_px, max(0.5 * smallest, min(DEEP_PX, 0.85 * smallest)))
        disc = np.all(distance < -depth, axis=0)
        ground = np.all(distance > margin_px + 0.5, axis=0)
        if not ground.any():
            nearest = distance.min(axis=0)
            ground = nearest >= nearest.max() - 1
        self.on_disc: NDArray[np.bool_] = disc
        self.on_ground: NDArray[np.bool_] = ground
        """The zones that are flat in every box, (height, width)."""
        self.every = max(1, min(4, int(disc.sum()) // FLAT_PIXELS))
        first = self.half_height % self.every
        self.raw_sparse = self.raw[:, first :: self.every]
        self.flat = np.empty(self.raw_sparse.shape, np.float32)
        self.flat_of_each = self.flat.reshape(self.count, -1)
        disc, ground = self.on_disc[first :: self.every], self.on_ground[first :: self.every]
        yy, xx = np.broadcast_arrays(y[first :: self.every], x)
        plane = np.column_stack([np.ones(disc.sum()), xx[disc], yy[disc]])
        self.flat_weights = np.zeros((4, disc.size), np.float32).T
        """Columns: mean of the ground; mean of the disc, its slope along x and along y per px."""
        self.flat_weights[ground.ravel(), 0] = 1 / ground.sum()
        self.flat_weights[disc.ravel(), 1:] = np.linalg.pinv(plane).T
        self.levels = np.empty((self.count, 4), np.float32)
        self.disc_pixels = np.flatnonzero(disc.ravel())
        self.disc_plane = plane[:, 1:].T.astype(np.float32)
        self.disc_freedom = len(plane) - 3
        self.ground_pixels = np.flatnonzero(ground.ravel())
        noise = np.linalg.norm(self.flat_weights, axis=0).tolist()
        self.slope_noise_x, self.slope_noise_y = noise[2], noise[3]
        """Standard deviation of the slopes for noise of 1."""

    def _edges(
        self,
        shapes: tuple[Shape, ...],
        fields: list[tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]],
        margin_px: int,
        row_step: int,
    ) -> None:
        """Prepare the sums over p (1 - p) near the edge that give its width along x and along y.

        The width is taken as s = s_x n_x^2 + s_y n_y^2 for an edge of normal n; two sums over the
        edge, weighed by n_x^2 and n_y^2, then fix s_x and s_y.
        """
        self.edge_weights = []
        self.edge_offset = []
        for shape, (distance, nx, ny) in zip(shapes, fields, strict=True):
            near = abs(distance) < margin_px
            sums = np.stack([(near * nx * nx).ravel(), (near * ny * ny).ravel()], axis=1) * row_step
            normal, length = outline(shape)
            square = normal**2
            turns = (square * length[:, None]).T @ square / math.sqrt(math.pi)
            solved = sums @ np.linalg.inv(turns)
            self.edge_weights.append(solved.astype(np.float32))
            self.edge_offset.append(solved.sum(axis=0))

    def zoned(self, k: int, weights: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return weights of circle k's box with 0 and 1 in its flat zones."""
        zones = self.zones.reshape(self.raw.shape)[k]
        return np.where(zones >= 256 * EDGE, weights, np.where(zones == 256 * DISC, 1.0, 0.0))

    def plane_on_disc(self, box: NDArray[np.float64]) -> tuple[float, float, float, float]:
        """Return mean, slope along x and along y, and mean square rest of a plane through the
        disc's flat pixels."""
        values = box[self.on_disc]
        mean, slope_x, slope_y = (self._plane_solver @ values).tolist()
        yy, xx = np.broadcast_arrays(self.y_px, self.x_px)
        rest = values - mean - slope_x * xx[self.on_disc] - slope_y * yy[self.on_disc]
        return mean, slope_x, slope_y, float(rest @ rest) / max(1, len(rest) - 3)

    @cached_property
    def _plane_solver(self) -> NDArray[np.float64]:
        yy, xx = np.broadcast_arrays(self.y_px, self.x_px)
        on = self.on_disc
        return np.linalg.pinv(np.column_stack([np.ones(on.sum()), xx[on], yy[on]]))


class Workspace:
    """Gates that are ready for use. Scratch only: no result depends on what it was used for."""

    def __init__(self) -> None:
        self._gates: dict[tuple[tuple[Shape, ...], int, int], Gate] = {}
        self.table = np.zeros(65536, np.float32)
        """Weights, a block of 256 for each zone."""
        self.table[256 * DISC : 256 * EDGE] = 1
        self.read: list[tuple[int, int, int, int]] = []
        """Rectangles of the frame that were looked at since this was last cleared: left, top, right
        and bottom in pixels, the last two exclusive. What records pixels keeps these too."""
        self._blocks: list[tuple[int, int, bool] | None] = [None] * (256 - EDGE)

    def gate(self, shapes: tuple[Shape, ...], margin_px: int, row_step: int) -> Gate:
        key = (shapes, margin_px, row_step)
        gate = self._gates.get(key)
        if gate is None:
            if len(self._gates) >= _MAX_GATES:
                self._gates.clear()
            gate = self._gates[key] = Gate(*key)
        return gate

    def set_weights(self, levels: list[list[float]], smeared: bool) -> None:
        """Write each circle's block of the table; levels begin with ground and disc, in grey."""
        blocks = self._blocks
        for k, (ground, disc, _, _) in enumerate(levels):
            block = (round(STEPS * ground), round(STEPS * (disc - ground)), smeared)
            if block != blocks[k]:
                start = 256 * (EDGE + k)
                self.table[start : start + 256] = weight_table(*block)
                blocks[k] = block


def fill_boxes(gate: Gate, image: Luma, lefts: list[int], tops: list[int]) -> None:
    """Copy each circle's box out of the image into `gate.raw`; what lies beyond the picture's
    border repeats the border."""
    rows, columns = image.shape
    height, width = gate.height, gate.width
    if (
        min(lefts) >= 0
        and min(tops) >= 0
        and max(lefts) + width <= columns
        and max(tops) + height <= rows
    ):
        for box, left, top in zip(gate.boxes, lefts, tops, strict=True):
            box[...] = image[top : top + height, left : left + width]
        return
    for box, left, top in zip(gate.boxes, lefts, tops, strict=True):
        y = np.clip(np.arange(top, top + height), 0, rows - 1)
        x = np.clip(np.arange(left, left + width), 0, columns - 1)
        box[...] = image[y[:, None], x]


def outline(shape: Shape, points: int = 720) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the outward unit normals (points, 2) of the ellipse and the length in pixels of the
    piece of its outline that has each, (points,)."""
    half = 2 * np.linalg.cholesky(np.array([[shape[0], shape[1]], [shape[1], shape[2]]]))
    t = 2 * math.pi * np.arange(points) / points
    along = np.stack([-np.sin(t), np.cos(t)], axis=1) @ half.T
    speed = np.hypot(along[:, 0], along[:, 1])
    normal = np.stack([along[:, 1], -along[:, 0]], axis=1) / speed[:, None]
    return normal, speed * (2 * math.pi / points)


def distance_px(
    shape: Shape, x: NDArray[np.float64], y: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return the distance of each pixel from the ellipse's edge, positive outside, and the outward
    normal there; exact at the edge, and to first order beside it."""
    xx, xy, yy = shape
    det = xx * yy - xy * xy
    ax, ay = (yy * x - xy * y) / det, (xx * y - xy * x) / det
    radius = np.maximum(np.sqrt(ax * x + ay * y) / 2, 1e-6)
    # At the centre itself any direction would do; this one leads along the longest half.
    slope = np.maximum(np.hypot(ax, ay) / (4 * radius), 0.5 / math.sqrt(xx + yy))
    return (radius - 1) / slope, ax / (4 * radius * slope), ay / (4 * radius * slope)
