"""The lit and cluttered room behind the virtual sheets: a finder needs something to refuse."""

from __future__ import annotations

import math
from typing import Any, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from vdms_rt.config import Table

Reflectance: TypeAlias = NDArray[np.float32]
"""0 is the black of a sheet, 1 its white; lamps are brighter. Shape (height, width)."""
Place: TypeAlias = tuple[float, float]
"""x right, y down, from the picture's middle, in picture heights."""

FINE = 4
"""Drawn rows for each row of the picture."""
COARSE = 16
_SUBPIXEL_BITS = 6
WALL = 0.55


def laboratory_grey(table: Table, margin_px: int) -> Reflectance:
    """Return the room in grey levels of an even light, as blurred by the camera, float32, with
    `margin_px` more on each side than the picture has. The same seed gives the same room."""
    height_px, width_px = table.height_px + 2 * margin_px, table.width_px + 2 * margin_px
    contrast = table.white_grey - table.black_grey
    if not table.clutter:
        return np.full((height_px, width_px), table.black_grey + WALL * contrast, np.float32)
    fine_width_px = round(width_px * FINE / table.pixel_aspect)
    brush = _Brush(fine_width_px, height_px * FINE, table.height_px * FINE)
    _furnish(brush, np.random.default_rng(np.random.SeedSequence(table.seed, spawn_key=(2,))))
    room: NDArray[Any] = brush.finish()
    blur_x_px = table.blur_x_px * fine_width_px / width_px
    if table.blur_x_px > 0 and table.blur_y_px > 0:
        room = cv2.GaussianBlur(room, (0, 0), blur_x_px, sigmaY=table.blur_y_px * FINE)
    room = cv2.resize(room, (width_px, height_px), interpolation=cv2.INTER_AREA)
    return np.asarray(table.black_grey + contrast * room, dtype=np.float32)


class _Brush:
    """Draws with sub-pixel places; everything it draws is opaque, except glow and shade."""

    def __init__(self, width: int, height: int, unit: int) -> None:
        self._room: Reflectance = np.full((height, width), WALL, np.float32)
        self._glow: Reflectance = np.zeros((height // COARSE + 1, width // COARSE + 1), np.float32)
        self._unit = unit
        self._middle = np.array([(width - 1) / 2, (height - 1) / 2])

    def _fixed(self, places: NDArray[np.float64]) -> NDArray[np.int32]:
        fixed = np.round((self._middle + places * self._unit) * 2**_SUBPIXEL_BITS)
        return np.asarray(fixed, dtype=np.int32)

    def area(self, places: list[Place], grey: float) -> None:
        cv2.fillPoly(self._room, [self._fixed(np.array(places))], grey, cv2.LINE_AA, _SUBPIXEL_BITS)

    def box(self, left: float, top: float, right: float, bottom: float, grey: float) -> None:
        self.area([(left, top), (right, top), (right, bottom), (left, bottom)], grey)

    def line(self, places: list[Place], width: float, grey: float) -> None:
        cv2.polylines(
            self._room,
            [self._fixed(np.array(places))],
            False,
            grey,
            max(1, round(width * self._unit)),
            cv2.LINE_AA,
            _SUBPIXEL_BITS,
        )

    def disc(self, at: Place, radius: float, grey: float, squash: float = 1.0) -> None:
        t = np.linspace(0, 2 * np.pi, 97)[:-1]
        rim = np.stack([squash * np.cos(t), np.sin(t)], axis=1)
        self.area([(at[0] + radius * x, at[1] + radius * y) for x, y in rim], grey)

    def cable(self, begin: Place, end: Place, sag: float, width: float, grey: float) -> None:
        t = np.linspace(0, 1, 60)
        x = begin[0] + (end[0] - begin[0]) * t
        y = begin[1] + (end[1] - begin[1]) * t + 4 * sag * t * (1 - t)
        places = list(zip(x.tolist(), y.tolist(), strict=True))
        self.line(places, width, grey)
        self.line([(x, y - width / 5) for x, y in places], width / 5, grey + 0.15)

    def glow(self, at: Place, radius: float, strength: float) -> None:
        """Add light around a lamp, as scattered in the lens and on the wall."""
        x, y = (self._middle + np.array(at) * self._unit) / COARSE
        rows, columns = np.ogrid[: self._glow.shape[0], : self._glow.shape[1]]
        distance2 = ((rows - y) ** 2 + (columns - x) ** 2) * (COARSE / (radius * self._unit)) ** 2
        self._glow += (strength / (1 + distance2) ** 1.5).astype(np.float32)

    def grain(self, rng: np.random.Generator) -> None:
        """Give every surface some unevenness: paint, plaster, dust, marks."""
        height, width = self._room.shape
        for size, depth in ((self._unit // 4, 0.06), (self._unit // 30, 0.025), (4, 0.02)):
            coarse = rng.standard_normal((height // size + 3, width // size + 3), np.float32)
            even = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
            self._room *= 1 + np.float32(depth) * even

    def finish(self) -> Reflectance:
        height, width = self._room.shape
        size = (self._glow.shape[1] * COARSE, self._glow.shape[0] * COARSE)
        return self._room + cv2.resize(self._glow, size)[:height, :width]


def _near(rng: np.random.Generator, value: float, part: float = 0.1) -> float:
    return float(value * (1 + part * rng.uniform(-1, 1)))


def _furnish(brush: _Brush, rng: np.random.Generator) -> None:
    side = 1.0 if rng.random() < 0.5 else -1.0
    _walls(brush)
    _shelf(brush, rng, -side)
    _rack(brush, rng, side * 0.33)
    _column(brush, rng, side * 0.62)
    _bench(brush, rng)
    brush.grain(rng)
    for n in range(6):
        x = -0.75 + 0.27 * n + rng.uniform(-0.1, 0.1)
        end = (x + rng.uniform(-0.5, 0.5), rng.uniform(0.1, 0.5))
        grey = rng.choice([0.08, 0.12, 0.25, 0.75])
        brush.cable((x, -0.55), end, rng.uniform(-0.05, 0.25), _near(rng, 0.009, 0.5), grey)
    _clock(brush, (-side * _near(rng, 0.6), _near(rng, -0.4, 0.05)), _near(rng, 0.075))
    _lamps(brush, rng, side)
    _tape(brush, (-side * _near(rng, 0.15, 0.3), _near(rng, -0.43, 0.03)), _near(rng, 0.05))


def _walls(brush: _Brush) -> None:
    brush.box(-2, -1, 2, 0.33, WALL)
    for x in (-0.62, -0.2, 0.22, 0.64):
        brush.line([(x, -1), (x, 0.33)], 0.004, 0.38)
    brush.line([(-2, -0.27), (2, -0.27)], 0.004, 0.38)
    brush.box(-2, 0.33, 2, 1, 0.27)
    brush.box(-2, 0.315, 2, 0.34, 0.17)


def _bolt(brush: _Brush, at: Place, radius: float) -> None:
    x, y = at
    brush.disc((x + 0.25 * radius, y + 0.3 * radius), 1.25 * radius, 0.2)
    brush.disc(at, radius, 0.62)
    turns = [math.pi / 3 * k + x + y for k in range(6)]
    brush.area(
        [(x + 0.7 * radius * math.cos(t), y + 0.7 * radius * math.sin(t)) for t in turns], 0.8
    )
    brush.disc((x - 0.25 * radius, y - 0.25 * radius), 0.2 * radius, 1.1)


def _column(brush: _Brush, rng: np.random.Generator, x: float) -> None:
    """A steel column of the test frame, its bolts and a beam with a row of larger ones."""
    half = _near(rng, 0.055)
    brush.box(x - half - 0.02, -0.7, x + half + 0.03, 0.7, 0.3)
    brush.box(x - half, -0.7, x + half, 0.7, 0.56)
    brush.box(x - half, -0.7, x - 0.75 * half, 0.7, 0.7)
    brush.box(x + 0.75 * half, -0.7, x + half, 0.7, 0.4)
    for n in range(14):
        _bolt(brush, (x - 0.35 * half, -0.5 + 0.075 * n), 0.009)
        _bolt(brush, (x + 0.4 * half, -0.5 + 0.075 * n), 0.009)
    y = _near(rng, 0.23)
    brush.box(x - 0.2, y - 0.05, x + 0.2, y + 0.05, 0.48)
    brush.box(x - 0.2, y - 0.05, x + 0.2, y - 0.04, 0.66)
    for n in range(5):
        _bolt(brush, (x - 0.16 + 0.08 * n, y), 0.02)


def _shelf(brush: _Brush, rng: np.random.Generator, side: float) -> None:
    """Three boards with boxes, books and bottles."""
    inner, outer = 0.3 * side, 0.9 * side
    left, right = min(inner, outer), max(inner, outer)
    for y in (-0.22, 0.02, 0.26):
        brush.box(left, y, right, y + 0.02, 0.72)
        brush.box(left, y + 0.02, right, y + 0.03, 0.2)
        x = left + 0.01
        while x < right - 0.05:
            width, height = rng.uniform(0.03, 0.14), rng.uniform(0.07, 0.19)
            grey = float(rng.choice([0.05, 0.15, 0.35, 0.6, 0.85, 0.95]))
            end = min(x + width, right)
            brush.box(x + 0.012, y - height + 0.015, end + 0.014, y, 0.25)
            brush.box(x, y - height, end, y, grey)
            brush.box(x, y - height, x + 0.15 * (end - x), y, grey + 0.08)
            kind = rng.integers(4)
            if kind == 0:
                _label(brush, rng, x + 0.2 * width, y - 0.7 * height, 0.6 * width, 0.35 * height)
            elif kind == 1:
                brush.line([(x, y - 0.55 * height), (end, y - 0.55 * height)], 0.012, 0.75)
            elif kind == 2:
                middle = (x + width / 2, y - height / 2)
                brush.disc(middle, min(width, height) / 3, 0.9 if grey < 0.5 else 0.1)
            x = end + rng.uniform(0.004, 0.04)


def _label(
    brush: _Brush, rng: np.random.Generator, x: float, y: float, width: float, height: float
) -> None:
    brush.box(x, y, x + width, y + height, 1.0)
    for n in range(3):
        row = y + height * (0.25 + 0.25 * n)
        brush.line([(x + 0.1 * width, row), (x + rng.uniform(0.5, 0.9) * width, row)], 0.004, 0.1)


def _rack(brush: _Brush, rng: np.random.Generator, x: float) -> None:
    """Instruments in a rack: dials, round holes, lights, a bright screen."""
    left, right = x - 0.17, x + 0.17
    brush.box(left - 0.015, -0.37, right + 0.015, 0.36, 0.13)
    for n in range(5):
        top = -0.35 + 0.14 * n
        brush.box(left, top, right, top + 0.125, _near(rng, 0.4, 0.4))
        for end in (left + 0.012, right - 0.012):
            _bolt(brush, (end, top + 0.02), 0.007)
            _bolt(brush, (end, top + 0.105), 0.007)
        match n % 3:
            case 0:
                for k in range(3):
                    at = (left + 0.07 + 0.1 * k, top + 0.063)
                    brush.disc(at, 0.04, 0.08)
                    brush.disc(at, 0.034, 0.95)
                    turn = rng.uniform(0, 2 * math.pi)
                    tip = (at[0] + 0.03 * math.cos(turn), at[1] + 0.03 * math.sin(turn))
                    brush.line([at, tip], 0.004, 0.1)
            case 1:
                for k in range(40):
                    at = (left + 0.045 + 0.017 * (k % 10), top + 0.03 + 0.02 * (k // 10))
                    brush.disc(at, 0.006, 0.05)
                for k in range(4):
                    brush.disc((right - 0.08 + 0.018 * k, top + 0.05), 0.006, 1.4)
            case _:
                brush.box(left + 0.03, top + 0.015, left + 0.18, top + 0.11, 0.85)
                wave = [
                    (left + 0.035 + 0.14 * k / 60, top + 0.06 + 0.03 * math.sin(k / 4))
                    for k in range(61)
                ]
                brush.line(wave, 0.004, 0.15)
                for k in range(3):
                    brush.disc((left + 0.21 + 0.045 * k, top + 0.06), 0.017, 0.75)
                    brush.disc((left + 0.21 + 0.045 * k, top + 0.06), 0.012, 0.2)


def _bench(brush: _Brush, rng: np.random.Generator) -> None:
    """The table's machinery and a bench in front of the wall, with tools and a coil of cable."""
    brush.box(-0.32, 0.38, 0.32, 0.7, 0.42)
    brush.box(-0.34, 0.365, 0.34, 0.39, 0.68)
    for n in range(9):
        _bolt(brush, (-0.3 + 0.075 * n, 0.43), 0.012)
    brush.box(0.36, 0.4, 0.6, 0.47, 0.3)
    brush.box(0.3, 0.42, 0.42, 0.45, 0.85)
    at = (_near(rng, -0.55), 0.43)
    for n in range(5):
        ring = np.linspace(0, 2 * np.pi, 50)
        radius = 0.055 + 0.008 * n
        brush.line(
            [(at[0] + radius * math.cos(t), at[1] + 0.5 * radius * math.sin(t)) for t in ring],
            0.006,
            0.1 + 0.05 * (n % 2),
        )


def _clock(brush: _Brush, at: Place, radius: float) -> None:
    brush.disc(at, 1.12 * radius, 0.1)
    brush.disc(at, radius, 0.98)
    for n in range(12):
        x, y = math.cos(math.pi / 6 * n), math.sin(math.pi / 6 * n)
        ends = [(at[0] + r * radius * x, at[1] + r * radius * y) for r in (0.8, 0.93)]
        brush.line(ends, 0.004, 0.1)
    for turn, length, width in ((0.7, 0.5, 0.008), (3.9, 0.75, 0.005)):
        tip = (at[0] + length * radius * math.cos(turn), at[1] + length * radius * math.sin(turn))
        brush.line([at, tip], width, 0.1)


def _lamps(brush: _Brush, rng: np.random.Generator, side: float) -> None:
    """A tube under the ceiling, a work light of two round lamps, and one alone."""
    brush.box(-0.36, -0.49, 0.3, -0.465, 1.7)
    brush.glow((0.0, -0.48), 0.25, 0.15)
    radius = _near(rng, 0.06)
    for x, y in ((0.47, -0.40), (0.62, -0.41)):
        at = (side * x, y)
        brush.disc(at, 1.25 * radius, 0.15)
        brush.disc(at, radius, 1.6)
        brush.glow(at, radius, 0.2)
    at = (-side * _near(rng, 0.5), _near(rng, 0.4, 0.04))
    brush.disc(at, 1.3 * radius, 0.08)
    brush.disc(at, 1.05 * radius, 1.05)
    brush.glow(at, radius, 0.05)


def _tape(brush: _Brush, at: Place, radius: float) -> None:
    """A roll of white tape on a nail."""
    brush.disc((at[0] + 0.2 * radius, at[1] + 0.2 * radius), radius, 0.3)
    brush.disc(at, radius, 0.92)
    brush.disc(at, 0.55 * radius, 0.45)
