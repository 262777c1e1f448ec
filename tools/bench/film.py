"""The clean picture of a marker at any place of a straight way, out of a table.

A blurred picture is a smooth function of the place, so pictures a quarter of a pixel apart tell
those between them: a polynomial of degree seven through the nearest eight is right to 0.001 grey
levels. The mean over an exposure is a weighed sum of the same pictures. Only windows around the
marker's parts are drawn; beyond them a frame shows the even background, without noise.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from math import ceil, cos, radians, sin
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from tools.bench.picture import Grey, Window

Picture = NDArray[np.float32]
"""The pixels of all windows in a row: those of the top field, window by window, then those of the
bottom field."""

STEP_PX = 0.25
DEGREE = 7
AROUND_PX = 16
"""Of a window beyond what moves in it."""


class Drawn(Protocol):
    """What a film can be made of."""

    @property
    def width_px(self) -> int: ...
    @property
    def height_px(self) -> int: ...
    @property
    def background_grey(self) -> float: ...
    def boxes_px(
        self, x_mm: float, y_mm: float, rotation_mrad: float, z_mm: float
    ) -> NDArray[np.float64]: ...
    def still(
        self, x_mm: float, y_mm: float, rotation_mrad: float, z_mm: float, window: Window
    ) -> Grey: ...


@dataclass(frozen=True)
class Way:
    """A straight line through the place at rest."""

    reach_mm: float
    axis_deg: float = 0.0
    """In the marker's plane, from x towards y."""
    tilt_deg: float = 0.0
    """Out of the marker's plane."""

    def pose(self, place_mm: float) -> tuple[float, float, float, float]:
        """Return x_mm, y_mm, rotation_mrad, z_mm."""
        axis, tilt = radians(self.axis_deg), radians(self.tilt_deg)
        along = place_mm * cos(tilt)
        return along * cos(axis), along * sin(axis), 0.0, place_mm * sin(tilt)


class Film:
    """Pictures of `drawn` along a way."""

    def __init__(self, drawn: Drawn, way: Way) -> None:
        self.background_grey = drawn.background_grey
        self.width_px, self.height_px = drawn.width_px, drawn.height_px
        ends = [drawn.boxes_px(*way.pose(s)) for s in (-way.reach_mm, 0.0, way.reach_mm)]
        low, high = np.min(ends, axis=0)[:, :2], np.max(ends, axis=0)[:, 2:]
        self.extent_px = np.column_stack([low, high])
        """Left, top, right and bottom of where each part of the marker gets to."""
        self.windows = [self._window(*box) for box in self.extent_px]
        small = 0.01
        ahead, behind = (drawn.boxes_px(*way.pose(s)) for s in (small, -small))
        self.px_per_mm = float(abs(ahead - behind).max()) / (2 * small)
        self._step_mm = STEP_PX / self.px_per_mm
        self._middle = ceil(way.reach_mm / self._step_mm) + DEGREE // 2 + 1
        rows_of = [np.arange(w.top, w.top + w.height) for w in self.windows]
        self._parts: list[tuple[tuple[slice, slice], slice, tuple[int, int]]] = []
        """Where in a frame, where in a picture, and the shape there."""
        end = 0
        for parity in (0, 1):
            for window, rows in zip(self.windows, rows_of, strict=True):
                own = rows[rows % 2 == parity]
                shape = len(own), window.width
                begin, end = end, end + shape[0] * shape[1]
                at = slice(own[0], own[-1] + 1, 2), slice(window.left, window.left + window.width)
                self._parts.append((at, slice(begin, end), shape))
            if parity == 0:
                self.top_pixels = end
        self.pixels = end
        self._table = np.empty((2 * self._middle + 1, self.pixels), np.float32)
        for n, picture in enumerate(self._table):
            pose = way.pose((n - self._middle) * self._step_mm)
            self.fill(picture, [drawn.still(*pose, window=w) for w in self.windows])
        self._grey = np.empty((1, self.pixels), np.uint8)

    def _window(self, left: float, top: float, right: float, bottom: float) -> Window:
        x, y = max(0, int(left) - AROUND_PX), max(0, int(top) - AROUND_PX)
        width = min(self.width_px, ceil(right) + AROUND_PX + 1) - x
        return Window(x, y, width, min(self.height_px, ceil(bottom) + AROUND_PX + 1) - y)

    def fill(self, picture: Picture, drawn: list[Grey]) -> None:
        """Write the windows' pictures into `picture`."""
        count = len(self.windows)
        for n, (_, own, _) in enumerate(self._parts):
            window = self.windows[n % count]
            picture[own] = drawn[n % count][(n // count + window.top) % 2 :: 2].ravel()

    def shown(self, picture: Picture) -> list[Grey]:
        """Return the windows' pictures out of `picture`."""
        drawn = [np.empty((w.height, w.width)) for w in self.windows]
        count = len(drawn)
        for n, (_, own, shape) in enumerate(self._parts):
            window = self.windows[n % count]
            rows = drawn[n % count][(n // count + window.top) % 2 :: 2]
            rows[...] = picture[own].reshape(shape)
        return drawn

    def clean(self, fields: list[Grey], shares: Grey) -> Picture:
        """Return the picture of an exposure: the mean of the places `fields[0]` in millimetres with
        weights `shares`; of a whole frame, or first of the top and then of the bottom field."""
        if len(fields) == 1:
            return self._mean(fields[0], shares, slice(None))
        top, bottom = (
            self._mean(places, shares, part)
            for places, part in zip(
                fields, (slice(self.top_pixels), slice(self.top_pixels, None)), strict=True
            )
        )
        return np.concatenate([top, bottom])

    def _mean(self, places_mm: Grey, shares: Grey, part: slice) -> Picture:
        at = places_mm / self._step_mm + self._middle
        first = np.floor(at).astype(np.int64) - DEGREE // 2
        weights = ((at - np.floor(at))[:, None] ** np.arange(DEGREE + 1)) @ _LAGRANGE
        begin = int(first.min())
        index = first[:, None] - begin + np.arange(DEGREE + 1)
        whole = np.bincount(index.ravel(), weights=(shares[:, None] * weights).ravel())
        near = self._table[begin : begin + len(whole), part]
        return np.einsum("k,kp->p", whole.astype(np.float32), near)

    def blank(self) -> NDArray[np.uint8]:
        """Return a frame with nothing but background."""
        return np.full((self.height_px, self.width_px), round(self.background_grey), np.uint8)

    def grab(
        self, frame: NDArray[np.uint8], clean: Picture, unit: Picture, noise_grey: float
    ) -> None:
        """Write `clean` with `noise_grey` times the white noise `unit` into the windows of `frame`,
        rounded to whole grey levels."""
        cv2.addWeighted(
            clean[None], 1.0, unit[None], noise_grey, 0.0, dst=self._grey, dtype=cv2.CV_8U
        )
        for at, own, shape in self._parts:
            frame[at] = self._grey[0, own].reshape(shape)


def _lagrange() -> Grey:
    """Return for the powers 0, 1, ... of the part of a step their share in each node's weight."""
    nodes = np.arange(DEGREE + 1.0) - DEGREE // 2
    return np.linalg.inv(nodes[:, None] ** np.arange(DEGREE + 1))


_LAGRANGE = _lagrange()


@lru_cache(maxsize=1)
def film_of(drawn: Drawn, way: Way) -> Film:
    """Return the film, the last one without drawing it again."""
    return Film(drawn, way)
