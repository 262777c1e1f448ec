"""Finding markers by themselves in a whole picture."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np

from vdms_rt.measure.discs import Discs, Floats, Mask, find_discs, refine
from vdms_rt.measure.homography import (
    GeometryError,
    Matrix,
    homography_normalised,
    jacobian_px_per_mm,
    roll_deg,
    to_image_px,
    to_marker_mm,
)
from vdms_rt.measure.layout import Layout, layouts_of
from vdms_rt.model import FoundMarker, Luma, MarkerShape, Points, Scan

SEARCH_PIXELS = 500_000
"""Larger pictures are searched at a smaller scale; centres are then refined at the full one."""
PIXEL_ASPECT = 1.05
"""Middle of the 0.9 to 1.2 that video has; it enters only where 15 % do not matter."""
MAX_ROLL_DEG = 45.0
MIN_FORESHORTENING = 0.3
PAIR_AREA = 2.0
"""Greatest ratio of two discs' areas, from perspective."""
PAIR_DISTANCE = 1.3
"""Greatest ratio of two discs' distance to what their sizes and the marker say."""
SEARCH_RADII = 0.6
"""A disc is looked for this far from where two others put it, in its own semi-axes."""
DIAMETER_SCALE = 1.12
"""Greatest ratio of the discs' diameter to the marker's: ink, glare and blur."""
MAX_DEPTH_RATIO = 1.5
"""Of the farthest to the nearest circle. A marker that looks small is far for its size, so its
depth varies by no more than a wide lens (60 degrees across the picture) and a steep view allow: """
DEPTH_PER_WIDTH = 2.0
"""of the marker's extent as a part of the picture's width, and """
DEPTH_NOISE = 0.06
"""for the errors of small discs."""
MISFIT_PX = 0.35
MISFIT_PART = 0.03
"""Greatest root mean square distance of the outlines from the marker's, in pixels and as a part of
the discs' mean semi-axis, added."""
REFINED_MISFIT_PX = 0.15
"""The same once the discs are measured in the full picture."""
PAIR_CONTRAST = 2.5
PAIR_GROUND_PART = 0.4
"""How far the greys around two discs may be apart, of their contrast."""
SHEET_GREY_PART = 0.3
SHEET_EVEN_PART = 0.8
"""So much of the way between the discs must be as dark as the ground around them, within so much of
their contrast."""

_DIRECTIONS = np.arange(16) * math.pi / 8
_NORMALS = np.column_stack((np.cos(_DIRECTIONS), np.sin(_DIRECTIONS)))


class Rows(NamedTuple):
    """Some rows of a frame: row r of `image` is row `offset + step * r` of it."""

    image: Luma
    offset: int
    step: int


@dataclass(frozen=True, slots=True, eq=False)
class Sight:
    """A set of discs that a layout explains, in the layout's order."""

    layout: Layout
    discs: tuple[int, ...]
    centre_px: tuple[float, float]
    size_px: float
    """Mean semi-axis of the discs."""
    misfit_px: float
    strict_misfit: float
    """The misfit if the diameter is exactly the shape's, as a part of `size_px`: it tells layouts
    apart that differ in the ratio of diameter to spacing alone."""


def find_markers(image: Luma, shapes: Sequence[MarkerShape], scan: Scan) -> list[FoundMarker]:
    """Return those of the markers that are seen in a picture, in the order of `shapes`.

    `image` is a whole frame, or one field where `scan` says so; results are in pixels of the whole
    frame, in an interlaced one for the mean of both fields. A marker is found as a whole or not at
    all, turned by less than 45 degrees, at viewing angles up to about 65 degrees, with discs of at
    least 10 pixels. Its layout and the ratio of its diameter to its spacing tell which it is.
    Markers of equal shape are taken from left to right, then from top to bottom. When fewer of them
    are seen than there are, none of them is returned, because nothing tells which one is missing;
    when more are seen, the largest are taken.
    """
    found: dict[int, FoundMarker] = {}
    for white in {shape.white_on_black for shape in shapes}:
        positive = image if white else np.bitwise_not(image)
        fields = _fields(positive, scan)
        seen = _discs(fields[0])
        layouts = layouts_of(shapes, white)
        candidates = [s for layout in layouts for s in _sights(fields[0], seen, layout)]
        for layout, sights in _shared_out(layouts, candidates):
            for number, order, sight in zip(layout.members, layout.orders, sights, strict=True):
                marker = _marker(fields, seen, sight, order, shapes[number].name)
                if marker is not None:
                    found[number] = marker
    return [found[number] for number in sorted(found)]


def _fields(image: Luma, scan: Scan) -> list[Rows]:
    if scan.interlaced:
        return [Rows(image[0::2], 0, 2), Rows(image[1::2], 1, 2)]
    if scan is Scan.PROGRESSIVE:
        return [Rows(image, 0, 1)]
    return [Rows(image, 0 if scan is Scan.TOP else 1, 2)]


def _discs(rows: Rows) -> Discs:
    """Return the discs in some rows of a frame, in pixels of the frame."""
    height, width = rows.image.shape
    shrink = max(1, math.ceil(math.sqrt(height * rows.step * width / SEARCH_PIXELS)))
    size = (width // shrink, height * rows.step // shrink)
    image = rows.image
    if size != (width, height):
        how = cv2.INTER_AREA if size[1] <= height else cv2.INTER_LINEAR
        image = np.asarray(cv2.resize(image, size, interpolation=how), dtype=np.uint8)
    seen = find_discs(image)
    scale = np.array([width / size[0], rows.step * height / size[1]])
    # Pixel edges map to pixel edges, so centres shift by half of what a pixel grows.
    shift = (scale - np.array([1, rows.step])) / 2 + np.array([0, rows.offset])
    return seen._replace(
        centres_px=seen.centres_px * scale + shift,
        shapes_px2=seen.shapes_px2 * np.outer(scale, scale),
    )


def _sights(rows: Rows, seen: Discs, layout: Layout) -> list[Sight]:
    """Return every set of discs that the layout explains."""
    alike = _alike(seen)
    sights = (_explained(rows, seen, alike, layout, discs) for discs in _sets(seen, alike, layout))
    return [sight for sight in sights if sight is not None]


def _sets(seen: Discs, alike: Mask, layout: Layout) -> list[tuple[int, ...]]:
    """Return the sets of discs that may be the layout's circles, in its order.

    Two discs taken for the layout's farthest two fix an affine map: their mean outline tells it but
    for a rotation, which the way from one to the other tells. The other circles must then be there.
    """
    circles, radius = layout.circles_mm, layout.radius_mm
    if len(seen.centres_px) < len(circles):
        return []
    apart = np.linalg.norm(circles[:, None] - circles[None], axis=2)
    i, j = np.unravel_index(int(apart.argmax()), apart.shape)

    up = np.array([1.0, -1.0])
    centres, shapes = seen.centres_px * up, seen.shapes_px2 * np.outer(up, up)
    due = circles[j] - circles[i]
    due_radii = float(np.linalg.norm(due)) / radius
    long, short = np.sqrt(np.linalg.eigvalsh(shapes)[:, ::-1]).T
    apart_px = np.hypot(*(centres[:, None, k] - centres[None, :, k] for k in (0, 1)))
    near = apart_px < PAIR_DISTANCE * due_radii * np.maximum(long[:, None], long[None])
    near &= apart_px * PAIR_DISTANCE > due_radii * np.minimum(short[:, None], short[None])
    a, b = np.nonzero(alike & near)
    mean = (shapes[a] + shapes[b]) / 2
    root = np.sqrt(np.linalg.det(mean))
    stretch = mean + root[:, None, None] * np.eye(2)
    stretch /= (radius * np.sqrt(np.trace(mean, axis1=1, axis2=2) + 2 * root))[:, None, None]
    shrink = np.linalg.inv(stretch)
    way = np.einsum("pij,pj->pi", shrink, centres[b] - centres[a])
    turn = np.arctan2(way[:, 1], way[:, 0]) - math.atan2(due[1], due[0])
    turn = (turn + math.pi) % (2 * math.pi) - math.pi
    ratio = np.linalg.norm(way, axis=1) / (due_radii * radius)
    fits = (np.abs(turn) < math.radians(MAX_ROLL_DEG + 5)) & (
        np.abs(np.log(ratio)) < math.log(PAIR_DISTANCE)
    )
    a, b, turn, ratio, shrink = a[fits], b[fits], turn[fits], ratio[fits], shrink[fits]
    cos, sin = ratio * np.cos(turn), ratio * np.sin(turn)
    rotation = np.stack((np.stack((cos, -sin), 1), np.stack((sin, cos), 1)), 1)
    affine = stretch[fits] @ rotation
    origin = (centres[a] + centres[b]) / 2

    chosen = np.empty((len(a), len(circles)), dtype=np.intp)
    alive = np.arange(len(a))
    for k in range(len(circles)):
        due_px = origin[alive] + affine[alive] @ (circles[k] - (circles[i] + circles[j]) / 2)
        off = np.einsum("pij,pnj->pni", shrink[alive], centres[None] - due_px[:, None])
        off_radii = np.linalg.norm(off, axis=2) / radius
        chosen[alive, k] = off_radii.argmin(axis=1)
        alive = alive[off_radii.min(axis=1) < SEARCH_RADII]
    sets = {tuple(int(d) for d in chosen[p]) for p in alive}
    return sorted(s for s in sets if len(set(s)) == len(s))


def _alike(seen: Discs) -> Mask:
    """Return which pairs of discs may belong to one marker, (n, n), never a disc with itself."""
    area = np.sqrt(np.linalg.det(seen.shapes_px2))
    contrast = seen.contrast_grey
    least = np.minimum(contrast[:, None], contrast[None])
    alike: Mask = np.abs(np.log(area[:, None] / area[None])) < math.log(PAIR_AREA)
    alike &= np.abs(np.log(contrast[:, None] / contrast[None])) < math.log(PAIR_CONTRAST)
    alike &= np.abs(seen.ground_grey[:, None] - seen.ground_grey[None]) < PAIR_GROUND_PART * least
    np.fill_diagonal(alike, val=False)
    return alike


def _explained(
    rows: Rows, seen: Discs, alike: Mask, layout: Layout, discs: tuple[int, ...]
) -> Sight | None:
    """Return the sight if the discs are a view of the layout, else None."""
    chosen = list(discs)
    if np.count_nonzero(alike[np.ix_(chosen, chosen)]) < len(chosen) * (len(chosen) - 1):
        return None
    centres, shapes = seen.centres_px[chosen], seen.shapes_px2[chosen]
    try:
        h = homography_normalised(layout.circles_mm, centres)
    except GeometryError:
        return None
    if not _plausible(h, layout, float(np.ptp(centres, axis=0).max()) / rows.image.shape[1]):
        return None
    size = float(np.sqrt(np.sqrt(np.linalg.det(shapes))).mean())
    misfit, scale = outline_misfit(h, layout, centres, shapes, None)
    if abs(math.log(scale)) > math.log(DIAMETER_SCALE):
        return None
    if misfit > MISFIT_PX + MISFIT_PART * size:
        return None
    others = seen.centres_px[alike[chosen].all(axis=0)]
    if _any_between(h, layout, others) or not _on_one_sheet(rows, seen, layout, chosen, h):
        return None
    strict, _ = outline_misfit(h, layout, centres, shapes, 1.0)
    middle = centres.mean(axis=0)
    return Sight(layout, discs, (float(middle[0]), float(middle[1])), size, misfit, strict / size)


def _plausible(h: Matrix, layout: Layout, extent: float) -> bool:
    """Return whether a camera before the sheet can see it so; `extent` is the largest distance of
    two discs' rows or columns, as a part of the picture's width."""
    middle = layout.circles_mm.mean(axis=0)
    depth = layout.circles_mm @ h[2, :2] + h[2, 2]
    most = min(1 + DEPTH_NOISE + DEPTH_PER_WIDTH * extent, MAX_DEPTH_RATIO)
    if depth.max() > most * depth.min():
        return False
    square = jacobian_px_per_mm(h, middle[None])[0] / [[PIXEL_ASPECT], [-1.0]]
    long, short = np.linalg.svd(square, compute_uv=False)
    if short < MIN_FORESHORTENING * long:
        return False
    return abs(roll_deg(h, PIXEL_ASPECT, (middle[0], middle[1]))) < MAX_ROLL_DEG


def outline_misfit(
    h: Matrix, layout: Layout, centres_px: Points, shapes_px2: Floats, scale: float | None
) -> tuple[float, float]:
    """Return the root mean square distance, in pixels, of the discs' outlines from those of the
    layout's circles, and the scale of the circles' diameter: as given, or the one that fits."""
    j = jacobian_px_per_mm(h, layout.circles_mm) * layout.radius_mm
    due = j @ j.transpose(0, 2, 1)
    if scale is None:
        areas = np.linalg.det(shapes_px2) / np.linalg.det(due)
        scale = float(np.median(areas)) ** 0.25
    off = (centres_px - to_image_px(h, layout.circles_mm)) @ _NORMALS.T
    off += _supports(shapes_px2) - scale * _supports(due)
    return math.sqrt(float(np.square(off).mean())), scale


def _supports(shapes_px2: Floats) -> Floats:
    """Return how far each ellipse reaches from its centre in each direction, (n, 16)."""
    supports: Floats = np.sqrt(np.einsum("ki,nij,kj->nk", _NORMALS, shapes_px2, _NORMALS))
    return supports


def _any_between(h: Matrix, layout: Layout, others_px: Points) -> bool:
    """Return whether one more disc lies within the rectangle of the layout's circles."""
    mm = to_marker_mm(h, others_px)
    low, high = layout.circles_mm.min(axis=0), layout.circles_mm.max(axis=0)
    return bool(((mm > low) & (mm < high)).all(axis=1).any())


def _on_one_sheet(rows: Rows, seen: Discs, layout: Layout, chosen: list[int], h: Matrix) -> bool:
    """Return whether the picture between the discs looks like the ground around them."""
    way_px = to_image_px(h, layout.ways_mm)
    height, width = rows.image.shape
    column = np.clip(np.rint(way_px[:, 0]).astype(np.intp), 0, width - 1)
    row = np.rint((way_px[:, 1] - rows.offset) / rows.step).astype(np.intp)
    grey = rows.image[np.clip(row, 0, height - 1), column]
    ends = np.array(chosen)[layout.ends]
    off = np.abs(grey - seen.ground_grey[ends].mean(axis=1))
    even = off < SHEET_GREY_PART * seen.contrast_grey[ends].mean(axis=1)
    return bool(even.mean() >= SHEET_EVEN_PART)


def _shared_out(
    layouts: Sequence[Layout], sights: Sequence[Sight]
) -> list[tuple[Layout, list[Sight]]]:
    """Return each layout with the sights of its members, in their order.

    No disc serves twice: sights of many discs go first, then those that fit best. Where a layout
    could as well be some of the same discs and others, it is a pattern of discs and no marker.
    """
    kept: list[Sight] = []
    for sight in sorted(sights, key=lambda s: (-len(s.discs), s.strict_misfit)):
        if all(set(k.discs).isdisjoint(sight.discs) for k in kept):
            kept.append(sight)
    vague: set[Sight] = set()
    for sight in sights:
        owners = [k for k in kept if not set(k.discs).isdisjoint(sight.discs)]
        if all(len(k.discs) == len(sight.discs) for k in owners):
            vague.update(
                k for k in owners if k.layout is sight.layout and set(k.discs) != set(sight.discs)
            )
    kept = [k for k in kept if k not in vague]
    result = []
    for layout in layouts:
        own = sorted((s for s in kept if s.layout is layout), key=lambda s: -s.size_px)
        count = len(layout.members)
        if len(own) >= count:
            result.append((layout, _in_reading_order(own[:count])))
    return result


def _in_reading_order(sights: Sequence[Sight]) -> list[Sight]:
    """Return sights column by column, from left to right, each from top to bottom."""
    result: list[Sight] = []
    column: list[Sight] = []
    for sight in sorted(sights, key=lambda s: s.centre_px[0]):
        if column and sight.centre_px[0] - column[0].centre_px[0] > 2 * sight.size_px:
            result += sorted(column, key=lambda s: s.centre_px[1])
            column = []
        column.append(sight)
    return result + sorted(column, key=lambda s: s.centre_px[1])


def _marker(
    fields: Sequence[Rows], seen: Discs, sight: Sight, order: tuple[int, ...], name: str
) -> FoundMarker | None:
    """Return the marker with its discs measured anew in every field, in its own order."""
    centres, shapes, low, high, contrast = [], [], [], [], []
    for disc in sight.discs:
        guess = Discs(*(values[disc : disc + 1] for values in seen))
        measured = [refine(rows.image, rows.offset, rows.step, guess) for rows in fields]
        fit = [m for m in measured if m is not None]
        if len(fit) < len(fields):
            return None
        each = np.array([m.centres_px[0] for m in fit])
        semi = np.array([np.sqrt(np.diag(m.shapes_px2[0])) for m in fit])
        centres.append(each.mean(axis=0))
        shapes.append(np.mean([m.shapes_px2[0] for m in fit], axis=0))
        low.append((each - semi).min(axis=0))
        high.append((each + semi).max(axis=0))
        contrast.append(np.mean([m.contrast_grey[0] for m in fit]))
    h = homography_normalised(sight.layout.circles_mm, np.array(centres))
    misfit, _ = outline_misfit(h, sight.layout, np.array(centres), np.array(shapes), None)
    if misfit > REFINED_MISFIT_PX + MISFIT_PART * sight.size_px:
        return None
    back = np.argsort(order)
    semi_axes = (np.array(high) - np.array(low)) / 2
    return FoundMarker(
        name=name,
        centres_px=tuple((float(x), float(y)) for x, y in np.array(centres)[back]),
        semi_axes_px=tuple((float(x), float(y)) for x, y in semi_axes[back]),
        contrast=float(np.mean(contrast)),
        score=misfit,
    )
