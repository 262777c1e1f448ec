"""The picture that the virtual camera takes: sheets in their outlines, before a laboratory."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from vdms_rt.capture.laboratory import laboratory_grey
from vdms_rt.capture.optics import (
    SHARP_PX,
    TAIL_SIGMAS,
    Camera,
    Taps,
    edge_response,
    line_response,
)
from vdms_rt.config import Table
from vdms_rt.model import MarkerShape, SourceError

Floats: TypeAlias = NDArray[np.float64]
Greys: TypeAlias = NDArray[np.float32]
"""Grey levels before noise and rounding, shape (height, width), dtype float32."""

SPACING_BLURS = 1.5
"""Between the points of an outline, in standard deviations of the blur: the aliasing of the
trapezoidal rule is below exp(-2 pi^2 / 1.5^2) = 2e-4 of the contrast."""
CROWD = 6
"""Points over which the spacing shrinks towards a corner."""


class Pose(NamedTuple):
    """Where things are at one moment of an exposure, in millimetres of the marker plane."""

    weight: float
    """The moment's part of the exposure; those of one exposure sum to 1."""
    table_mm: tuple[float, float]
    shake_mm: tuple[float, float]


class Sheet(NamedTuple):
    """One sheet as outlines, counter-clockwise: points and steps along them, both (n, 2)."""

    points_mm: Floats
    steps_mm: Floats
    edges: tuple[slice, ...]
    """The points of each edge."""
    circles: tuple[slice, ...]
    ground_grey: float
    ink_grey: float
    moves: bool


class Patch(NamedTuple):
    """Light in a part of the picture, from row `top` and column `left` on."""

    top: int
    left: int
    light: Floats


class Scene:
    """Renders into `picture`, (height_px, width_px) float32 grey levels before noise.

    The light that a pixel gets from a shape is the shape's area under the pixel, blurred by the
    Gaussian of camera and bandwidth. By Green's theorem this is an integral along the shape's
    outline alone, which the trapezoidal rule gives to some hundredths of a grey level with a point
    for each 0.9 px (see Trefethen and Weideman, The Exponentially Convergent Trapezoidal Rule,
    2014). Where a sheet's edge crosses the laboratory, the laboratory counts as even within the
    blur. Sheets that move hang in front of those that do not.
    """

    def __init__(self, table: Table, shapes: Sequence[MarkerShape], reach_mm: float) -> None:
        """Raises SourceError when a sheet would touch the camera."""
        named = {shape.name: shape for shape in shapes}
        hung = [(sheet, named[sheet.marker]) for sheet in table.sheet]
        _, bottom, _, top = sheet_mm(hung[0][1] if hung else shapes[0])
        self.camera = Camera(table, top - bottom)
        self._narrowest_px = math.sqrt(min(table.blur_x_px, table.blur_y_px) ** 2 + 1 / 12)
        self._px_per_mm = self.camera.scale * max(1.0, table.pixel_aspect)
        self._blur_px = (table.blur_x_px, table.blur_y_px)
        self._sharp = min(self._blur_px) < SHARP_PX
        self._spacing_px = 0.1 if self._sharp else SPACING_BLURS * min(self._blur_px)
        edge, self._edge_y = (edge_response(blur) for blur in self._blur_px)
        reach_x_px, self._reach_y_px = (0.5 + TAIL_SIGMAS * blur for blur in self._blur_px)
        self._columns = Taps(lambda d: edge(d) - edge(d - 1), -reach_x_px, reach_x_px + 1, 1)
        line = line_response(self._blur_px[1])
        self._rows = {
            step: Taps(line, -self._reach_y_px, self._reach_y_px, step) for step in (1, 2)
        }
        self._sheets = [
            self._hang(table, shape, np.array(sheet.at_mm), sheet.moves) for sheet, shape in hung
        ]
        for sheet, (_, shape) in zip(self._sheets, hung, strict=True):
            nearest_mm = self.camera.depth_mm(sheet.points_mm).min() - reach_mm * sheet.moves
            if nearest_mm < 20 * table.distance_m:
                raise SourceError(
                    f"table: the sheet of marker {shape.name} comes within {nearest_mm:.0f} mm of "
                    f"the camera; raise table.distance_m = {table.distance_m:g}, or turn or move "
                    "it less"
                )
        across = np.arange(table.width_px) / (table.width_px - 1) - 0.5
        self._light = (1 + table.light_gradient * across).astype(np.float32)
        self._ground = np.zeros((table.height_px, table.width_px), np.float32)
        swing_px = table.shake_mm * self._px_per_mm
        self._margin_px = math.ceil(swing_px) + 2 if swing_px else 0
        self._laboratory = laboratory_grey(table, self._margin_px)
        self._shakes = table.shake_mm > 0
        self.picture: Greys = np.zeros((table.height_px, table.width_px), np.float32)
        self._still: Greys = self.picture.copy()
        self._front = sorted(self._sheets, key=lambda sheet: sheet.moves)
        if not self._shakes:
            still = [sheet for sheet in self._sheets if not sheet.moves]
            self._front = [sheet for sheet in self._sheets if sheet.moves]
            self._still[:] = self._laboratory * self._light
            for sheet in still:
                self._paint(self._still, sheet, [Pose(1.0, (0.0, 0.0), (0.0, 0.0))], 0, 1)
        self._last: dict[int, Sequence[Pose]] = {}

    def render(self, poses: Sequence[Pose], first_row: int, row_step: int) -> None:
        """Bring the rows first_row, first_row + row_step, ... of `picture` to an exposure."""
        if self._last.get(first_row) == poses:
            return
        self._last[first_row] = poses
        view = self.picture[first_row::row_step]
        if self._shakes:
            self._look_round(view, poses, first_row, row_step)
        else:
            view[:] = self._still[first_row::row_step]
        for sheet in self._front:
            self._paint(view, sheet, poses, first_row, row_step)

    def moments(self, travel_mm: float) -> int:
        """Return how many moments of an exposure (Gauss-Legendre) stand for a travel, so that
        the smear is right to some hundredths of a grey level."""
        travel_blurs = travel_mm * self._px_per_mm / self._narrowest_px
        return 1 if travel_blurs < 0.1 else 2 + math.floor(0.5 * travel_blurs)

    def _look_round(
        self, view: Greys, poses: Sequence[Pose], first_row: int, row_step: int
    ) -> None:
        """Fill in the laboratory as the shaking camera sees it, moved as a whole."""
        shake_mm = np.array([pose.weight * np.array(pose.shake_mm) for pose in poses]).sum(axis=0)
        homographies = [self.camera.homography(s) for s in ((0.0, 0.0), tuple(shake_mm))]
        rest, now = (self.camera.project(h, np.zeros((1, 2)))[0] for h in homographies)
        x, y = self._margin_px + rest - now
        placed = np.array([[1.0, 0.0, x], [0.0, row_step, first_row + y]])
        seen = cv2.warpAffine(
            self._laboratory,
            placed,
            view.shape[::-1],
            flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP,
        )
        np.multiply(seen, self._light, out=view)

    def _hang(self, table: Table, shape: MarkerShape, at_mm: Floats, moves: bool) -> Sheet:
        left, bottom, right, top = sheet_mm(shape)
        corners = np.array([[left, bottom], [right, bottom], [right, top], [left, top]]) + at_mm
        outlines = [
            self._straight(begin, end)
            for begin, end in zip(corners, np.roll(corners, -1, axis=0), strict=True)
        ]
        outlines += [
            self._circle(centre, shape.diameter_mm / 2)
            for centre in np.array(shape.circles_mm) + at_mm
        ]
        ends = np.cumsum([len(points) for points, _ in outlines])
        parts = [slice(end - len(o[0]), end) for end, o in zip(ends, outlines, strict=True)]
        ground, ink = table.black_grey, table.white_grey
        if not shape.white_on_black:
            ground, ink = ink, ground
        return Sheet(
            points_mm=np.concatenate([points for points, _ in outlines]),
            steps_mm=np.concatenate([steps for _, steps in outlines]),
            edges=tuple(parts[: len(corners)]),
            circles=tuple(parts[len(corners) :]),
            ground_grey=ground,
            ink_grey=ink,
            moves=moves,
        )

    def _length_px(self, points_mm: Floats, steps_mm: Floats) -> float:
        """Return the longest step in the picture, with room for motion towards the camera."""
        homography = self.camera.homography((0.0, 0.0))
        steps = self.camera.trace(homography, points_mm, steps_mm)[1]
        return 1.1 * float(np.hypot(steps[:, 0], steps[:, 1]).max())

    def _circle(self, centre_mm: Floats, radius_mm: float) -> tuple[Floats, Floats]:
        def points(count: int) -> tuple[Floats, Floats]:
            t = 2 * np.pi * (np.arange(count) + 0.5) / count
            spokes = radius_mm * np.stack([np.cos(t), np.sin(t)], axis=1)
            steps = 2 * np.pi / count * np.stack([-spokes[:, 1], spokes[:, 0]], axis=1)
            return centre_mm + spokes, steps

        return points(max(16, math.ceil(64 * self._length_px(*points(64)) / self._spacing_px)))

    def _straight(self, begin_mm: Floats, end_mm: Floats) -> tuple[Floats, Floats]:
        """Return points that crowd towards both ends, so that corners do not spoil the rule."""
        edge_mm = end_mm - begin_mm
        middles = begin_mm + (np.arange(64)[:, None] + 0.5) / 64 * edge_mm
        length_px = 64 * self._length_px(middles, np.tile(edge_mm / 64, (64, 1)))
        count = math.ceil(length_px / self._spacing_px)
        if self._sharp:
            t, density = (np.arange(count) + 0.5) / count, np.full(count, 1 / count)
        else:
            t, density = _graded(count + CROWD)
        return begin_mm + t[:, None] * edge_mm, density[:, None] * edge_mm

    def _paint(
        self, view: Greys, sheet: Sheet, poses: Sequence[Pose], first_row: int, row_step: int
    ) -> None:
        traces = [(*self._trace(sheet, pose), pose.weight) for pose in poses]
        edges, circles = (
            [
                self._lit(points[part], y_steps[part], weight, view.shape, first_row, row_step)
                for points, y_steps, weight in traces
                for part in parts
            ]
            for parts in (sheet.edges, sheet.circles)
        )
        rows = slice(min(p.top for p in edges), max(p.top + p.light.shape[0] for p in edges))
        columns = slice(min(p.left for p in edges), max(p.left + p.light.shape[1] for p in edges))
        ground = self._ground[rows, columns]
        ground[:] = 0
        for top, left, light in edges:
            here = ground[top - rows.start :][: light.shape[0], left - columns.start :]
            here[:, : light.shape[1]] += light
            here[:, light.shape[1] :] += light[:, -1:]
        behind = view[rows, columns]
        behind += ground * (sheet.ground_grey * self._light[columns] - behind)
        for top, left, light in circles:
            height, width = light.shape
            brightness = (sheet.ink_grey - sheet.ground_grey) * self._light[left : left + width]
            view[top : top + height, left : left + width] += light * brightness

    def _lit(
        self,
        points: Floats,
        y_steps: Floats,
        weight: float,
        shape: tuple[int, int],
        first_row: int,
        row_step: int,
    ) -> Patch:
        """Return what part of each pixel's light comes from the right of a piece of outline, if
        the outline goes down there, else less than nothing."""
        left, across = self._columns.at(points[:, 0])
        if self._sharp:
            top, down = self._chords(points[:, 1], y_steps, first_row, row_step)
        else:
            top, down = self._rows[row_step].at((points[:, 1] - first_row) / row_step)
            down *= y_steps[:, None]
        row_0, height = _span(top, down.shape[1], shape[0])
        column_0, width = _span(left, across.shape[1], shape[1])
        row = top[:, None] - row_0 + np.arange(down.shape[1])
        row[(row < 0) | (row >= height)] = height
        column = np.clip(left[:, None] - column_0 + np.arange(across.shape[1]), 0, width)
        pixel = row[:, :, None] * (width + 1) + column[:, None, :]
        rise = np.bincount(
            pixel.ravel(),
            (down[:, :, None] * across[:, None, :]).ravel(),
            (height + 1) * (width + 1),
        ).reshape(height + 1, width + 1)
        light = weight * np.cumsum(rise[:height, :width], axis=1)
        return Patch(row_0, column_0, np.asarray(light, dtype=np.float64))

    def _trace(self, sheet: Sheet, pose: Pose) -> tuple[Floats, Floats]:
        homography = self.camera.homography(pose.shake_mm)
        points_mm = sheet.points_mm + (pose.table_mm if sheet.moves else (0.0, 0.0))
        points, steps = self.camera.trace(homography, points_mm, sheet.steps_mm)
        return points, steps[:, 1]

    def _chords(
        self, y: Floats, y_steps: Floats, first_row: int, row_step: int
    ) -> tuple[NDArray[np.intp], Floats]:
        """Return first rows and weights as `Taps.at` does, for steps that are short chords."""
        reach_px = self._reach_y_px + np.abs(y_steps).max()
        top = np.ceil((y - reach_px - first_row) / row_step).astype(np.intp)
        count = 1 + math.floor(2 * reach_px / row_step)
        d = first_row + row_step * (top[:, None] + np.arange(count)) - y[:, None]
        half = y_steps[:, None] / 2
        return top, self._edge_y(d + half) - self._edge_y(d - half)


def sheet_mm(shape: MarkerShape) -> tuple[float, float, float, float]:
    """Return left, bottom, right and top of a marker's sheet in its own millimetres: half a
    diameter beyond the edges of its circles on every side."""
    circles = np.array(shape.circles_mm)
    left, bottom = circles.min(axis=0) - shape.diameter_mm
    right, top = circles.max(axis=0) + shape.diameter_mm
    return float(left), float(bottom), float(right), float(top)


def _graded(count: int) -> tuple[Floats, Floats]:
    """Return `count` points of 0..1 and their weights in a trapezoidal rule that is exact to high
    order at the ends too: their density rises there from zero with three derivatives."""
    count = max(count, 2 * CROWD)
    z = np.arange(count) + 0.5
    from_end = np.minimum(z, count - z)
    u = np.minimum(from_end / CROWD, 1.0)
    density = u**4 * (35 - 84 * u + 70 * u**2 - 20 * u**3)
    gone = CROWD * u**5 * (7 - 14 * u + 10 * u**2 - 2.5 * u**3) + np.maximum(from_end - CROWD, 0)
    t = gone / (count - CROWD)
    return np.where(z < count / 2, t, 1 - t), density / (count - CROWD)


def _span(first: NDArray[np.intp], count: int, size: int) -> tuple[int, int]:
    """Return the first of `size` pixels that is touched, and how many are, at least one."""
    begin = min(max(int(first.min()), 0), size - 1)
    return begin, max(min(int(first.max()) + count, size) - begin, 1)
