"""The picture that the virtual camera takes: sheets in their outlines, before a laboratory."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

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

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(8)


class Pose(NamedTuple):
    """Where things are at one moment of an exposure, in millimetres of the marker plane."""

    weight: float
    """The moment's part of the exposure; those of one exposure sum to 1."""
    table_mm: tuple[float, float]
    shake_mm: tuple[float, float]


class Sheet(NamedTuple):
    """One sheet as outlines: points and the steps along them, (n, 2) mm, its edge first."""

    points_mm: Floats
    steps_mm: Floats
    edge_points: int
    ground_grey: float
    ink_grey: float
    moves: bool


class Scene:
    """Renders into `picture`, (height_px, width_px) float32 grey levels before noise.

    The light that a pixel gets from a shape is the shape's area under the pixel, blurred by the
    Gaussian of camera and bandwidth. By Green's theorem this is an integral along the shape's
    outline alone; the trapezoidal rule (smooth and closed) and Gauss-Legendre panels (straight)
    give it to a few thousandths of a grey level with a point for each 0.6 px. Where a sheet's edge
    crosses the laboratory, the laboratory counts as even within a pixel's blur.
    """

    def __init__(self, table: Table, shapes: Sequence[MarkerShape], reach_mm: float) -> None:
        """Raises SourceError when a sheet would touch the camera."""
        named = {shape.name: shape for shape in shapes}
        hung = [(sheet, named[sheet.marker]) for sheet in table.sheet]
        _, bottom, _, top = sheet_mm(hung[0][1])
        self.camera = Camera(table, top - bottom)
        self.blur_px = math.sqrt(min(table.blur_x_px, table.blur_y_px) ** 2 + 1 / 12)
        self._blur_px = (table.blur_x_px, table.blur_y_px)
        self._sharp = min(self._blur_px) < SHARP_PX
        self._spacing_px = 0.1 if self._sharp else min(self._blur_px)
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
        wall = table.black_grey + 0.5 * (table.white_grey - table.black_grey)
        still = [s for s in self._sheets if not s.moves]
        self._moving = [s for s in self._sheets if s.moves]
        self._base: Greys = np.full((table.height_px, table.width_px), wall, np.float32)
        self._base *= self._light
        rest = [Pose(1.0, (0.0, 0.0), (0.0, 0.0))]
        for sheet in still:
            self._paint(self._base, sheet, rest, 0, 1)
        self.picture: Greys = self._base.copy()
        self._last: dict[int, Sequence[Pose]] = {}

    def render(self, poses: Sequence[Pose], first_row: int, row_step: int) -> None:
        """Bring the rows first_row, first_row + row_step, ... of `picture` to an exposure."""
        if self._last.get(first_row) == poses:
            return
        self._last[first_row] = poses
        view = self.picture[first_row::row_step]
        view[:] = self._base[first_row::row_step]
        for sheet in self._moving:
            self._paint(view, sheet, poses, first_row, row_step)

    def _hang(self, table: Table, shape: MarkerShape, at_mm: Floats, moves: bool) -> Sheet:
        left, bottom, right, top = sheet_mm(shape)
        corners = np.array([[left, bottom], [right, bottom], [right, top], [left, top]]) + at_mm
        points, steps = [], []
        for begin, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            p, s = self._straight(begin, end)
            points.append(p)
            steps.append(s)
        edge_points = sum(map(len, points))
        for centre in np.array(shape.circles_mm) + at_mm:
            p, s = self._circle(centre, shape.diameter_mm / 2)
            points.append(p)
            steps.append(s)
        ground, ink = table.black_grey, table.white_grey
        if not shape.white_on_black:
            ground, ink = ink, ground
        return Sheet(np.concatenate(points), np.concatenate(steps), edge_points, ground, ink, moves)

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
        def points(panels: int) -> tuple[Floats, Floats]:
            if self._sharp:
                t = (np.arange(panels) + 0.5) / panels
                weights = np.full(panels, 1 / panels)
            else:
                t = ((np.arange(panels)[:, None] + 0.5 + _NODES / 2) / panels).ravel()
                weights = np.tile(_WEIGHTS / 2 / panels, panels)
            return begin_mm + t[:, None] * (end_mm - begin_mm), weights[:, None] * (
                end_mm - begin_mm
            )

        whole_px = 64 * self._length_px(
            begin_mm + np.linspace(0, 1, 64)[:, None] * (end_mm - begin_mm),
            np.tile((end_mm - begin_mm) / 64, (64, 1)),
        )
        return points(math.ceil(whole_px / (self._spacing_px * (1 if self._sharp else 6))))

    def _paint(
        self, view: Greys, sheet: Sheet, poses: Sequence[Pose], first_row: int, row_step: int
    ) -> None:
        traced = [self._trace(sheet, pose) for pose in poses]
        points = np.concatenate([p for p, _ in traced])
        y_steps = np.concatenate([s for _, s in traced])
        inked = np.tile(np.arange(len(sheet.points_mm)) >= sheet.edge_points, len(poses))
        left, across = self._columns.at(points[:, 0])
        if self._sharp:
            top, down = self._chords(points[:, 1], y_steps, first_row, row_step)
        else:
            top, down = self._rows[row_step].at((points[:, 1] - first_row) / row_step)
            down *= y_steps[:, None]
        rows = slice(*_clip(top, down.shape[1], view.shape[0]))
        columns = slice(*_clip(left, across.shape[1], view.shape[1]))
        height, width = rows.stop - rows.start, columns.stop - columns.start
        if height <= 0 or width <= 0:
            return
        row = top[:, None] + np.arange(down.shape[1]) - rows.start
        row[(row < 0) | (row >= height)] = height
        row += (inked * (height + 1))[:, None]
        column = np.clip(left[:, None] + np.arange(across.shape[1]) - columns.start, 0, width)
        where = row[:, :, None] * (width + 1) + column[:, None, :]
        light = down[:, :, None] * across[:, None, :]
        rises = np.bincount(where.ravel(), light.ravel(), 2 * (height + 1) * (width + 1))
        rises = rises.reshape(2, height + 1, width + 1)[:, :height, :width]
        ground, ink = np.cumsum(rises, axis=2).astype(np.float32)
        behind = view[rows, columns]
        front = sheet.ground_grey * ground + (sheet.ink_grey - sheet.ground_grey) * ink
        behind += self._light[columns] * front - behind * ground

    def _trace(self, sheet: Sheet, pose: Pose) -> tuple[Floats, Floats]:
        homography = self.camera.homography(pose.shake_mm)
        points_mm = sheet.points_mm + (pose.table_mm if sheet.moves else (0.0, 0.0))
        points, steps = self.camera.trace(homography, points_mm, sheet.steps_mm)
        return points, pose.weight * steps[:, 1]

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


def _clip(first: NDArray[np.intp], count: int, size: int) -> tuple[int, int]:
    return max(0, int(first.min())), min(size, int(first.max()) + count)
