"""What can be told of a marker from a picture alone: its layout, but not its size."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vdms_rt.model import MarkerShape, Points

CLEAR_RADII = 1.4
"""A place so far from every circle's centre shows the bare sheet, blur included."""


@dataclass(frozen=True, slots=True, eq=False)
class Layout:
    """Markers of equal shape, with their circles in one order, whatever their own is."""

    circles_mm: Points
    radius_mm: float
    members: tuple[int, ...]
    """Numbers of the shapes."""
    orders: tuple[tuple[int, ...], ...]
    """For each member, which of its own circles is the layout's first, second, ..."""
    ways_mm: Points
    """Places between the circles, well clear of all of them, where the bare sheet should show."""
    ends: NDArray[np.intp]
    """The two circles that each of these places lies between, (n, 2)."""


def layouts_of(shapes: Sequence[MarkerShape], white: bool) -> list[Layout]:
    """Return the layouts of the white or of the black markers; shapes that differ in size, place or
    the order of their circles alone share one."""
    alike: dict[tuple[tuple[float, float], ...], list[tuple[int, tuple[int, ...]]]] = {}
    for number, shape in enumerate(shapes):
        if shape.white_on_black != white:
            continue
        circles = np.array(shape.circles_mm)
        # In diameters from the centroid, coarse enough for rounding in somebody's list.
        places = np.round((circles - circles.mean(axis=0)) / shape.diameter_mm, 3) + 0.0
        order = tuple(int(i) for i in np.lexsort(places.T))
        key = tuple((float(places[i, 0]), float(places[i, 1])) for i in order)
        alike.setdefault(key, []).append((number, order))
    layouts = []
    for group in alike.values():
        first, order = group[0]
        circles = np.array(shapes[first].circles_mm)[list(order)]
        radius = shapes[first].diameter_mm / 2
        ways, ends = _ways(circles, radius)
        members, orders = zip(*group, strict=True)
        layouts.append(Layout(circles, radius, members, orders, ways, ends))
    return layouts


def _ways(circles_mm: Points, radius_mm: float) -> tuple[Points, NDArray[np.intp]]:
    """Return places along the lines between the circles, and which circles they lie between."""
    pairs = np.array(list(itertools.combinations(range(len(circles_mm)), 2)))
    part = np.linspace(0, 1, 33)[1:-1, None]
    begin, end = circles_mm[pairs[:, 0], None], circles_mm[pairs[:, 1], None]
    ways = (begin + part * (end - begin)).reshape(-1, 2)
    clear = (
        np.linalg.norm(ways[:, None] - circles_mm[None], axis=2).min(axis=1)
        > CLEAR_RADII * radius_mm
    )
    return ways[clear], np.repeat(pairs, len(part), axis=0)[clear]
