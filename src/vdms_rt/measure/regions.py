"""The regions in which circles are measured."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from vdms_rt.measure.homography import Matrix, homography_normalised, to_marker_mm
from vdms_rt.model import Circle, FoundMarker, MarkerShape, Points, Region

SHEET_MARGIN = 0.5
"""Background of the printed sheet beyond its outermost circles, in circle diameters."""
MIN_SIDE_PX = 8
MIN_REACH_PX = 2.0
MAX_REACH = 8.0
"""Of a region beyond its circle, in semi-axes: past that it only brings in more noise."""
MAX_OVERLAP = 0.25
"""Of the smaller of two regions: as much as one covers whose corner is at the other's centre."""


def regions_around(
    found: FoundMarker,
    shape: MarkerShape,
    width_px: int,
    height_px: int,
    margin: float = SHEET_MARGIN,
) -> tuple[Region, ...]:
    """Return a region for each circle of a found marker, in its order, cut to the picture.

    A region reaches half way to the next circle, and half way to the edge of the sheet, which is
    the rectangle around the shape's circles and `margin` diameters more on each side. Half way,
    because the circle moves out of its region just when the next thing moves in. Regions of
    one marker do not overlap.
    """
    centres = np.array(found.centres_px)
    semi_axes = np.array(found.semi_axes_px)
    h = homography_normalised(np.array(shape.circles_mm), centres)
    sheet = _sheet_mm(shape, margin)
    regions = []
    for i, (centre, semi) in enumerate(zip(centres, semi_axes, strict=True)):
        reach = _reach(h, sheet, centre, semi)
        low, high = centre - semi - reach[0], centre + semi + reach[1]
        for j in range(len(centres)):
            if j != i:
                _stay_apart(low, high, centre, semi, centres[j], semi_axes[j])
        left, top = (max(math.ceil(v), 0) for v in low)
        right = min(math.floor(high[0]), width_px - 1)
        bottom = min(math.floor(high[1]), height_px - 1)
        regions.append(Region(left, top, max(right - left + 1, 0), max(bottom - top + 1, 0)))
    return tuple(regions)


def with_read(
    regions: Sequence[Sequence[Region]], read: Sequence[tuple[int, int, int, int]]
) -> tuple[tuple[Region, ...], ...]:
    """Return the regions, each grown over what was read nearest to it, so that measuring finds
    every pixel again. `read` are left, top, right and bottom, the last two exclusive."""
    boxes = [
        [[r.x_px, r.y_px, r.x_px + r.width_px, r.y_px + r.height_px] for r in circles]
        for circles in regions
    ]
    every = [box for circles in boxes for box in circles]
    middles = [(left + right, top + bottom) for left, top, right, bottom in every]
    for n, (left, top, right, bottom) in enumerate(read if every else ()):
        # What was read comes in the order of the circles, and mostly lies in its region.
        own = every[n % len(every)]
        if own[0] <= left and own[1] <= top and right <= own[2] and bottom <= own[3]:
            continue
        x, y = left + right, top + bottom
        away = [abs(x - mx) + abs(y - my) for mx, my in middles]
        box = every[away.index(min(away))]
        box[:] = min(box[0], left), min(box[1], top), max(box[2], right), max(box[3], bottom)
    return tuple(tuple(Region(a, b, c - a, d - b) for a, b, c, d in circles) for circles in boxes)


def check_regions(regions: Sequence[Region], width_px: int, height_px: int) -> list[str]:
    """Return a sentence for each thing that is wrong with regions set by hand; empty if none."""
    faults = []
    for i, r in enumerate(regions, 1):
        named = f"region {i} ({r.x_px}, {r.y_px}, {r.width_px} x {r.height_px})"
        if r.width_px < MIN_SIDE_PX or r.height_px < MIN_SIDE_PX:
            faults.append(
                f"{named} is too small for a circle; "
                f"make it at least {MIN_SIDE_PX} x {MIN_SIDE_PX} pixels"
            )
        if (
            r.x_px < 0
            or r.y_px < 0
            or r.x_px + r.width_px > width_px
            or r.y_px + r.height_px > height_px
        ):
            faults.append(
                f"{named} reaches outside the picture of {width_px} x {height_px} pixels; "
                "move it or make it smaller"
            )
        for j, other in enumerate(regions[: i - 1], 1):
            smaller = min(r.width_px * r.height_px, other.width_px * other.height_px)
            part = _overlap(r, other) / smaller if smaller > 0 else 0.0
            if part > MAX_OVERLAP:
                faults.append(
                    f"regions {j} and {i} share {part:.0%} of the smaller one; "
                    "give each circle a region of its own"
                )
    return faults


def check_circles(circles: Sequence[Circle]) -> list[str]:
    """Return a sentence for each two regions in which the same circle was measured."""
    faults = []
    for i, a in enumerate(circles, 1):
        for j, b in enumerate(circles[: i - 1], 1):
            radius_px = math.sqrt(min(a.area_px, b.area_px) / math.pi)
            if math.hypot(a.x_px - b.x_px, a.y_px - b.y_px) < radius_px:
                faults.append(
                    f"regions {j} and {i} lie over the same circle at "
                    f"({a.x_px:.0f}, {a.y_px:.0f}); give each circle a region of its own"
                )
    return faults


def _sheet_mm(shape: MarkerShape, margin: float) -> tuple[Points, Points]:
    circles = np.array(shape.circles_mm)
    beyond = (0.5 + margin) * shape.diameter_mm
    return circles.min(axis=0) - beyond, circles.max(axis=0) + beyond


def _reach(h: Matrix, sheet: tuple[Points, Points], centre: Points, semi: Points) -> Points:
    """Return how far the region goes beyond the circle's box, (2, 2): left and top, right and
    bottom. Pushed towards any side by what it reaches beyond the circle there, it still lies on the
    sheet."""

    def on_sheet(reach: Points) -> bool:
        left, top = centre - semi - reach[0]
        right, bottom = centre + semi + reach[1]
        corners = np.array([(left, top), (right, top), (right, bottom), (left, bottom)])
        pushes = np.array(
            [(-reach[0, 0], 0), (0, -reach[0, 1]), (reach[1, 0], 0), (0, reach[1, 1])]
        )
        mm = to_marker_mm(h, (corners[:, None] + pushes).reshape(-1, 2))
        return bool((mm >= sheet[0]).all() and (mm <= sheet[1]).all())

    def grown(reach: Points, sides: Points) -> Points:
        low, high = 0.0, MAX_REACH
        while high - low > 0.01:
            middle = (low + high) / 2
            low, high = (middle, high) if on_sheet(reach + sides * middle) else (low, middle)
        return reach + sides * low

    all_sides = np.array([semi, semi])
    reach = grown(np.zeros((2, 2)), all_sides)
    for side in np.ndindex(2, 2):
        one = np.zeros((2, 2))
        one[side] = all_sides[side]
        reach = grown(reach, one)
    return np.maximum(reach, MIN_REACH_PX)


def _stay_apart(
    low: Points, high: Points, centre: Points, semi: Points, other: Points, other_semi: Points
) -> None:
    """Move a border of the region to half way between the circle and another one."""
    gap = np.abs(other - centre) - semi - other_semi
    axis = int(np.argmax(gap / semi))
    half_way = semi[axis] + gap[axis] / 2
    if other[axis] > centre[axis]:
        high[axis] = min(high[axis], centre[axis] + half_way - 0.5)
    else:
        low[axis] = max(low[axis], centre[axis] - half_way + 0.5)


def _overlap(a: Region, b: Region) -> int:
    width = min(a.x_px + a.width_px, b.x_px + b.width_px) - max(a.x_px, b.x_px)
    height = min(a.y_px + a.height_px, b.y_px + b.height_px) - max(a.y_px, b.y_px)
    return max(width, 0) * max(height, 0)
