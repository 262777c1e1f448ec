"""The centre of a disturbed circle, from those stretches of its edge that are undisturbed.

The edge is looked at in sectors. In each, the levels of ground and disc are taken beside the edge,
so that a shadow or a glare that covers a sector whole does no harm; the weights of `edge` then tell
how far the edge lies beyond the expected ellipse. Centre and size are fitted to the sectors by
Tukey's biweight, which leaves out those in which the edge is somewhere else: wires, specks, cuts.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vdms_rt.measure.edge import profile, weight
from vdms_rt.measure.gate import Shape, distance_px
from vdms_rt.measure.smooth import CircleReading
from vdms_rt.model import Luma

SECTOR_PX = 5.0
"""Length of edge in a sector: short against what disturbs it."""
FLAT_PX = 4.0
"""How wide the ground and the disc are looked at beside the edge."""
EDGE_PX = 2.6
"""Half the width of the edge's zone, for an edge of 0.9 px."""
LEAST_EDGE = 0.4
"""Part of the outline that has to be undisturbed."""
LEAST_CONTRAST = 0.25
"""Of a sector, as a part of the circle's contrast at rest."""
SIZE_SIGMA_PX = 0.05
"""How well the size of the circle is known beforehand: by the focus, mostly."""
EXCESS = 1.2
"""Of the variance, over that of the matched edge."""
MAX_SIZE_PX = 1.0
_TUKEY = 4.685
"""95 % efficient for normal errors (Holland and Welsch 1977)."""
_PASSES = 8


class _Sectors(NamedTuple):
    beyond_px: NDArray[np.float64]
    """How far the edge lies outside the expected ellipse."""
    normal: NDArray[np.float64]
    """(n, 2)"""
    length_px: NDArray[np.float64]
    noise: NDArray[np.float64]
    """Standard deviation of `beyond_px` for a noise of one grey level."""
    disc_grey: NDArray[np.float64]
    ground_grey: NDArray[np.float64]


def edge_fit(
    image: Luma,
    row_offset: int,
    row_step: int,
    start_px: tuple[float, float],
    shape: Shape,
    edge_px: tuple[float, float],
    contrast_grey: float,
    variance_grey2: float,
    reach_px: float = 1.0,
    read: list[tuple[int, int, int, int]] | None = None,
) -> CircleReading | None:
    """Return a circle's centre from the undisturbed part of its edge; None if that is too little.

    `start_px` may be off by `reach_px`; `shape` are the second moments that the circle should
    have, `edge_px` the widths of its edge, `contrast_grey` that of disc over ground (negative for a
    dark disc). The covariance is that of the edge which was used. The area is that of the fitted
    ellipse; the levels are medians over the sectors. The rectangles that were looked at are added
    to `read`, as to `Workspace.read`.
    """
    x, y = start_px
    size = 0.0
    radius, whole = _outline_of(shape)
    reach = min(reach_px, radius / 4)
    for _ in range(_PASSES):
        if math.hypot(x - start_px[0], y - start_px[1]) > reach_px + MAX_SIZE_PX:
            return None
        box = _box(image, row_offset, row_step, (x, y), _grown(shape, size), reach)
        if box is None:
            return None
        if read is not None:
            left, top, right, bottom = box
            read.append(
                (
                    left,
                    top * row_step + row_offset,
                    right,
                    (bottom - 1) * row_step + row_offset + 1,
                )
            )
        sectors = _sectors(
            image, row_offset, row_step, (x, y), size, shape, edge_px, contrast_grey, reach, box
        )
        if sectors is None:
            return None
        step, weights, covariance = _robust(sectors, math.sqrt(variance_grey2), size)
        x, y, size = x + float(step[0]), y + float(step[1]), size + float(step[2])
        move = math.hypot(step[0], step[1])
        if move < 0.002:
            break
        if move < 0.5:
            reach = 0.0
    else:
        return None
    if float((weights * sectors.length_px).sum()) < LEAST_EDGE * whole or abs(size) > MAX_SIZE_PX:
        return None
    grown = _grown(shape, size)
    disc = float(np.median(sectors.disc_grey[weights > 0]))
    ground = float(np.median(sectors.ground_grey[weights > 0]))
    det = max(grown[0] * grown[2] - grown[1] ** 2, 0.0)
    return CircleReading(
        x,
        y,
        4 * math.pi * math.sqrt(det),
        grown,
        disc,
        ground,
        (0.0, 0.0),
        (float(covariance[0, 0]), float(covariance[0, 1]), float(covariance[1, 1])),
    )


def _sectors(
    image: Luma,
    row_offset: int,
    row_step: int,
    centre: tuple[float, float],
    size: float,
    shape: Shape,
    edge_px: tuple[float, float],
    contrast_grey: float,
    reach: float,
    box: tuple[int, int, int, int],
) -> _Sectors | None:
    """Look at the edge in sectors. `reach` widens the edge's zone, to find an edge far away."""
    grown = _grown(shape, size)
    radius, whole = _outline_of(grown)
    zone = min(EDGE_PX, 0.45 * radius) + reach
    left, top, right, bottom = box
    x = np.arange(left, right, dtype=np.float64) - centre[0]
    y = np.arange(top, bottom, dtype=np.float64)[:, None] * row_step + row_offset - centre[1]
    distance, normal_x, normal_y = distance_px(grown, x, y)
    near = abs(distance) < zone + FLAT_PX
    grey = image[top:bottom, left:right][near].astype(np.float64)
    d, nx, ny = distance[near], normal_x[near], normal_y[near]
    count = int(min(96, max(12, whole // SECTOR_PX)))
    turn = np.arctan2(ny * math.sqrt(shape[2]), nx * math.sqrt(shape[0]))
    sector = ((turn / (2 * math.pi) + 0.5) * count).astype(np.int64) % count

    edge, ground, disc = abs(d) <= zone, d > zone, d < -zone
    if not (edge.any() and ground.any()):
        return None

    def per_sector(values: NDArray[np.float64], at: NDArray[np.bool_]) -> NDArray[np.float64]:
        return np.bincount(sector[at], weights=values[at], minlength=count).astype(np.float64)

    ones = np.ones_like(grey)
    pixels = [per_sector(ones, at) for at in (edge, ground, disc)]
    ground_grey = per_sector(grey, ground) / np.maximum(pixels[1], 1)
    disc_grey = per_sector(grey, disc) / np.maximum(pixels[2], 1)
    if pixels[2].sum() < 6 * count:
        # A small disc has too few flat pixels in a sector.
        disc_grey[:] = grey[disc].mean() if disc.any() else grey[edge].max()
        ground_grey[:] = grey[ground].mean()
        pixels[2][:] = 2
    contrast = disc_grey - ground_grey
    width = np.hypot(nx * edge_px[0], ny * edge_px[1])
    # Of the weighed edge; its slope along the normal integrates to 1.
    slope = np.exp(-((d / width) ** 2)) / (math.sqrt(math.pi) * width)
    length = per_sector(slope, edge) * row_step
    good = (
        (contrast * math.copysign(1, contrast_grey) > LEAST_CONTRAST * abs(contrast_grey))
        & (pixels[1] >= 2)
        & (pixels[2] >= 2)
        & (length > 1)
    )
    if np.count_nonzero(good) < 6:
        return None
    safe = np.where(good, contrast, 1.0)
    part = (grey - ground_grey[sector]) / safe[sector]
    model = weight(profile(-d / width))
    beyond = per_sector(weight(part) - model, edge) * row_step / np.maximum(length, 1e-9)
    normal = np.stack([per_sector(nx * slope, edge), per_sector(ny * slope, edge)], axis=1)
    normal /= np.maximum(length / row_step, 1e-9)[:, None]
    mean_width = per_sector(width * slope, edge) / np.maximum(length / row_step, 1e-9)
    noise = np.sqrt(2 * math.sqrt(math.pi) * mean_width * row_step / np.maximum(length, 1e-9))
    return _Sectors(
        beyond[good],
        normal[good],
        length[good],
        noise[good] / abs(safe[good]),
        disc_grey[good],
        ground_grey[good],
    )


def _box(
    image: Luma,
    row_offset: int,
    row_step: int,
    centre: tuple[float, float],
    shape: Shape,
    reach: float,
) -> tuple[int, int, int, int] | None:
    """Return the columns and the image's rows that hold a circle and its flat ground: left, top,
    right, bottom, the last two exclusive; None where that is outside of the picture."""
    radius, _ = _outline_of(shape)
    side = min(EDGE_PX, 0.45 * radius) + reach + FLAT_PX + 1
    side_x, side_y = 2 * math.sqrt(shape[0]) + side, 2 * math.sqrt(shape[2]) + side
    rows, columns = image.shape
    left = max(0, math.floor(centre[0] - side_x))
    right = min(columns, math.ceil(centre[0] + side_x) + 1)
    top = max(0, math.floor((centre[1] - side_y - row_offset) / row_step))
    bottom = min(rows, math.ceil((centre[1] + side_y - row_offset) / row_step) + 1)
    return None if right - left < 3 or bottom - top < 3 else (left, top, right, bottom)


def _robust(
    sectors: _Sectors, noise_grey: float, size: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return the step of centre and size, each sector's weight, and the centre's covariance."""
    slopes = np.column_stack([sectors.normal, np.ones(len(sectors.beyond_px))])
    sigma = sectors.noise * noise_grey
    weights = np.ones_like(sigma)
    prior = np.array([0.0, 0.0, 1 / SIZE_SIGMA_PX**2])
    for _ in range(20):
        share = weights / sigma**2
        normal = (slopes * share[:, None]).T @ slopes + np.diag(prior)
        step = np.linalg.solve(normal, (share * sectors.beyond_px) @ slopes - prior * size)
        rest = sectors.beyond_px - slopes @ step
        t = rest / sigma
        scale = max(1.0, float(np.median(abs(t))) * 1.4826)
        u = t / (_TUKEY * scale)
        new = np.where(abs(u) < 1, (1 - u * u) ** 2, 0.0)
        done = np.max(abs(new - weights)) < 1e-3
        weights = new
        if done:
            break
    # The zone takes in more noise than the edge needs, and the biweight gives away 5 %.
    covariance = np.linalg.inv(normal)[:2, :2] * (EXCESS * scale**2)
    return step.astype(np.float64), weights, covariance.astype(np.float64)


def _outline_of(shape: Shape) -> tuple[float, float]:
    """Return the mean radius and the length of an ellipse's outline (Ramanujan)."""
    half = np.sqrt(np.linalg.eigvalsh([[shape[0], shape[1]], [shape[1], shape[2]]])) * 2
    b, a = float(half[0]), float(half[1])
    return math.sqrt(a * b), math.pi * (3 * (a + b) - math.sqrt((3 * a + b) * (a + 3 * b)))


def _grown(shape: Shape, size: float) -> Shape:
    """Return the moments of an ellipse whose mean radius is `size` larger."""
    radius, _ = _outline_of(shape)
    factor = ((radius + size) / radius) ** 2
    return shape[0] * factor, shape[1] * factor, shape[2] * factor
