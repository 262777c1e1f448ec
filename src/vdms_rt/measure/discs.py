"""Everything in a picture that looks like a bright disc on an even ground."""

from __future__ import annotations

import math
from typing import NamedTuple, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from vdms_rt.model import Luma, Points

Floats: TypeAlias = NDArray[np.float64]
Squares: TypeAlias = NDArray[np.float32]
Mask: TypeAlias = NDArray[np.bool_]

MIN_CONTRAST_GREY = 15.0
MIN_AREA_PX = 30.0
MAX_SIDE_PART = 0.45
"""Of the picture's height or width: four discs and the gaps between them have to fit."""
LEVELS = 20
MIN_STEP_GREY = 6.0
MAX_UNEVEN = 0.15
"""Spread of the greys inside the disc and around it, as a part of its contrast."""
MAX_OUTLINE_PART = 0.06
"""Pixels on the wrong side of the ellipse, as a part of the area; and as a part of the outline: """
MAX_OUTLINE_PX = 0.35
CORE = 0.75
"""Of the semi-axes: the part of the disc that counts as its inside."""
MAX_BLOBS = 1000
"""Bounds the time that a wall full of holes costs."""


class Discs(NamedTuple):
    """Arrays over n discs; an outline is all d with d^T inv(shape) d = 1."""

    centres_px: Points
    shapes_px2: Floats
    """(n, 2, 2)"""
    inside_grey: Floats
    ground_grey: Floats

    @property
    def contrast_grey(self) -> Floats:
        return self.inside_grey - self.ground_grey


class _Blob(NamedTuple):
    left: int
    top: int
    width: int
    height: int
    level: float


class _Disc(NamedTuple):
    x: float
    y: float
    xx: float
    xy: float
    yy: float
    inside_grey: float
    ground_grey: float
    uneven: float


def find_discs(image: Luma) -> Discs:
    """Return the bright discs of a picture, in its own pixels.

    A disc is a connected part brighter than some grey level that hardly changes with that level,
    whose outline is an ellipse, and that is even inside and in a narrow band around it.
    """
    smooth = np.asarray(cv2.GaussianBlur(image, (3, 3), 0), dtype=np.uint8)
    discs: list[_Disc] = []
    for blob in _stable_blobs(smooth):
        disc = _fit(smooth, blob)
        if disc is not None:
            discs.append(disc)
    discs.sort(key=lambda d: d.uneven)
    kept: list[_Disc] = []
    for disc in discs:
        if all(
            (disc.x - k.x) ** 2 + (disc.y - k.y) ** 2 > 0.25 * min(k.xx + k.yy, disc.xx + disc.yy)
            for k in kept
        ):
            kept.append(disc)
    table = np.array([d[:7] for d in kept], dtype=np.float64).reshape(-1, 7)
    return Discs(table[:, :2], table[:, [2, 3, 3, 4]].reshape(-1, 2, 2), table[:, 5], table[:, 6])


def _stable_blobs(image: Luma) -> list[_Blob]:
    """Return the parts that stay alike over two or more of the grey levels tried, each at the
    middle one of them."""
    darkest, brightest = (float(v) for v in cv2.minMaxLoc(image)[:2])
    step = max((brightest - darkest) / LEVELS, MIN_STEP_GREY)
    chains: list[list[_Blob]] = []
    open_chains: list[int] = []
    before = np.empty((0, 5))
    for level in np.arange(darkest + step / 2, brightest, step):
        now = _blobs(image, float(level))
        chain_of = _same_as_before(now, before)
        chosen = []
        for row, parent in zip(now, chain_of, strict=True):
            left, top, width, height = (int(v) for v in row[:4])
            blob = _Blob(left, top, width, height, float(level))
            if parent >= 0:
                chosen.append(open_chains[parent])
                chains[chosen[-1]].append(blob)
            else:
                chosen.append(len(chains))
                chains.append([blob])
        open_chains, before = chosen, now
    chains.sort(key=len, reverse=True)
    return [chain[len(chain) // 2] for chain in chains[:MAX_BLOBS] if len(chain) > 1]


def _blobs(image: Luma, level: float) -> Floats:
    """Return left, top, width, height, area of the parts that may be ellipses, (n, 5)."""
    mask = cv2.threshold(image, level, 255, cv2.THRESH_BINARY)[1]
    stats = cv2.connectedComponentsWithStats(mask, connectivity=8)[2][1:].astype(np.float64)
    height, width = image.shape
    left, top, w, h, area = stats.T
    box = area / (w * h)
    plausible = (
        (area >= MIN_AREA_PX)
        & (np.minimum(w, h) >= 4)
        & (w < MAX_SIDE_PART * width)
        & (h < MAX_SIDE_PART * height)
        & (w < 4 * h)
        & (h < 4 * w)
        & (box > 0.45)
        & (box < 0.9)
        & (left > 0)
        & (top > 0)
        & (left + w < width)
        & (top + h < height)
    )
    return np.asarray(stats[plausible], dtype=np.float64)


def _same_as_before(now: Floats, before: Floats) -> NDArray[np.intp]:
    """Return for each part the row of its like at the level before, -1 where there is none."""
    if len(now) == 0 or len(before) == 0:
        return np.full(len(now), -1)
    centre_now, centre_before = (b[:, :2] + b[:, 2:4] / 2 for b in (now, before))
    apart = np.maximum(
        *(np.abs(centre_now[:, None, k] - centre_before[None, :, k]) for k in (0, 1))
    )
    alike = apart <= 1 + 0.1 * now[:, 2:4].min(axis=1)[:, None]
    area_now, area_before = now[:, None, 4], before[None, :, 4]
    alike &= (area_now <= area_before) & (area_before <= 1.4 * area_now + 8)
    apart[~alike] = math.inf
    nearest = apart.argmin(axis=1)
    return np.where(alike.any(axis=1), nearest, -1)


def _fit(image: Luma, blob: _Blob) -> _Disc | None:
    """Return the disc that a part of the picture is, or None if it is something else."""
    level = blob.level
    for _ in range(2):
        disc = _at_level(image, blob, level)
        if disc is None:
            return None
        middle = (disc.inside_grey + disc.ground_grey) / 2
        if abs(middle - level) < 0.08 * (disc.inside_grey - disc.ground_grey):
            break
        level = middle
    return disc


def _at_level(image: Luma, blob: _Blob, level: float) -> _Disc | None:
    around = max(5, max(blob.width, blob.height) // 3)
    left, top = max(blob.left - around, 0), max(blob.top - around, 0)
    view = image[top : blob.top + blob.height + around, left : blob.left + blob.width + around]
    mask = cv2.threshold(view, level, 255, cv2.THRESH_BINARY)[1]
    labels = cv2.connectedComponents(mask, connectivity=8, ltype=cv2.CV_16U)[1]
    seed = labels[blob.top + blob.height // 2 - top, blob.left + blob.width // 2 - left]
    if seed == 0:
        return None
    part = labels == seed
    m = cv2.moments(part.view(np.uint8), binaryImage=True)
    area = m["m00"]
    x, y = m["m10"] / area, m["m01"] / area
    xx, xy, yy = (4 * m[k] / area for k in ("mu20", "mu11", "mu02"))
    long, short, turn = _axes(xx, xy, yy)
    if short < 2 or long > 5 * short:
        return None
    columns, rows = (np.arange(n, dtype=np.float64) for n in view.shape[::-1])
    along, across = _along_axes(columns - x, rows - y, turn)
    wrong = np.count_nonzero(_within(along, across, long, short) != part)
    if wrong > MAX_OUTLINE_PART * area + MAX_OUTLINE_PX * math.pi * (long + short):
        return None
    core = view[_within(along, across, CORE * long, CORE * short)]
    ground = view[_band(along, across, long, short)]
    if len(core) < 5 or len(ground) < 12:
        return None
    (inside_grey, core_spread), (ground_grey, ground_spread) = _typical(core), _typical(ground)
    contrast, uneven = inside_grey - ground_grey, max(core_spread, ground_spread)
    if contrast < MIN_CONTRAST_GREY or uneven > MAX_UNEVEN * contrast:
        return None
    return _Disc(left + x, top + y, xx, xy, yy, inside_grey, ground_grey, uneven / contrast)


def _within(along: Squares, across: Squares, long: float, short: float) -> Mask:
    return along * np.float32(1 / long**2) + across * np.float32(1 / short**2) <= 1


def _band(along: Squares, across: Squares, long: float, short: float) -> Mask:
    """Return the pixels just outside the blurred edge of an ellipse."""
    outer = _within(along, across, *(s + max(0.45 * s, 2.8) for s in (long, short)))
    return outer & ~_within(along, across, long + 1.6, short + 1.6)


def _typical(greys: Luma) -> tuple[float, float]:
    """Return the median grey, and how far the nearest 70 % of the pixels reach from it: a standard
    deviation that a wire across or the edge of the sheet does not spoil."""
    level = float(np.median(greys))
    off = np.abs(greys.astype(np.float32) - np.float32(level))
    return level, float(np.partition(off, int(0.7 * len(off)))[int(0.7 * len(off))])


def _axes(xx: float, xy: float, yy: float) -> tuple[float, float, float]:
    """Return the semi-axes and the angle (radians) of the longer one."""
    mean, half = (xx + yy) / 2, math.hypot((xx - yy) / 2, xy)
    return (
        math.sqrt(mean + half),
        math.sqrt(max(mean - half, 0.0)),
        0.5 * math.atan2(2 * xy, xx - yy),
    )


def _along_axes(dx: Floats, dy: Floats, turn: float) -> tuple[Squares, Squares]:
    """Return the squares of each pixel's coordinates along the axes of an ellipse, from the
    coordinates of the columns and the rows."""
    columns, rows = dx.astype(np.float32)[None], dy.astype(np.float32)[:, None]
    cos, sin = np.float32(math.cos(turn)), np.float32(math.sin(turn))
    return np.square(cos * columns + sin * rows), np.square(cos * rows - sin * columns)


def refine(image: Luma, row_offset: int, row_step: int, disc: Discs) -> Discs | None:
    """Return one disc measured anew in the greys of some rows of a frame, or None if it is gone.

    `disc` holds one disc, in pixels of the frame, and so does the result; row r of `image` is row
    `row_offset + r * row_step` of the frame. The outline is that of a grey level half way between
    the disc and its ground, softened over half of the contrast, so that a pixel's part counts.
    """
    x, y = disc.centres_px[0]
    shape, inside_grey, ground_grey = disc.shapes_px2[0], disc.inside_grey[0], disc.ground_grey[0]
    for _ in range(3):
        xx, xy, yy = shape[0, 0], shape[0, 1], shape[1, 1]
        long, short, turn = _axes(xx, xy, yy)
        reach_x = 1.6 * math.sqrt(xx) + 4
        reach_y = 1.6 * math.sqrt(yy) + 4
        left, right = max(math.floor(x - reach_x), 0), math.ceil(x + reach_x) + 1
        top = max(math.floor((y - reach_y - row_offset) / row_step), 0)
        bottom = math.ceil((y + reach_y - row_offset) / row_step) + 1
        view = image[top:bottom, left:right].astype(np.float32)
        if min(view.shape) < 3:
            return None
        columns = np.arange(left, left + view.shape[1], dtype=np.float64)
        rows = row_offset + row_step * np.arange(top, top + view.shape[0], dtype=np.float64)
        along, across = _along_axes(columns - x, rows - y, turn)
        core = view[_within(along, across, CORE * long, CORE * short)]
        ground = view[_band(along, across, long, short)]
        if len(core) < 4 or len(ground) < 8:
            return None
        inside_grey, ground_grey = float(np.median(core)), float(np.median(ground))
        contrast = inside_grey - ground_grey
        if contrast < MIN_CONTRAST_GREY:
            return None
        weight = np.clip(2 * (view - ground_grey) / contrast - 0.5, 0, 1)
        weight[~_within(along, across, *(s + max(0.25 * s, 1.6) for s in (long, short)))] = 0
        weight = weight.astype(np.float64)
        by_column, by_row = weight.sum(axis=0), weight.sum(axis=1)
        total = by_column.sum()
        if total * row_step < MIN_AREA_PX / 2:
            return None
        x, y = float(by_column @ columns / total), float(by_row @ rows / total)
        dx, dy = columns - x, rows - y
        xx, yy = (float(4 * (w @ d**2) / total) for w, d in ((by_column, dx), (by_row, dy)))
        shape = np.array([[xx, xy := float(4 * (dy @ weight @ dx) / total)], [xy, yy]])
    moved = np.abs(np.array([x, y]) - disc.centres_px[0])
    if (moved > 0.5 * np.sqrt(np.diag(disc.shapes_px2[0]))).any():
        return None
    return Discs(np.array([[x, y]]), shape[None], np.array([inside_grey]), np.array([ground_grey]))
