"""Which circles to trust: readings against what this picture should show, within learnt limits."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vdms_rt.measure.expect import Appearance, Expected
from vdms_rt.measure.raster import NO_RASTER, Raster, raster
from vdms_rt.measure.smooth import CircleReading, Slow
from vdms_rt.model import CircleFlag

LEAST_CONTRAST = 0.5
"""Of the contrast at rest."""
LOST_CONTRAST = 0.15
FAR_AREA = 0.06
"""By how much all circles together may be larger or smaller than expected: the focus breathes."""
FLOOR = 0.0015
"""Least limit of every ratio: what perspective, pixels and weights leave unexplained."""
PER_PIXEL = 1e-4
"""What a pixel of way from the place at rest adds to a limit: a lens that bends the corner by 1 %
of its radius changes an area by this much."""
RASTER_SHARE = 0.1
"""How far the raster's pull is known from the edge's width alone: by a hundredth of a pixel in that
a field's changes by 6 %."""
DEVIATIONS = 6.0
"""Scatter of the stills that a limit allows."""
BLUR_SHARE = 0.015
"""Of the square of the way in the exposure: how far the moment that motion adds is known, which is
a third of it."""
FULL_GREY = 254.0
LEAST_EDGE_PX = 0.29
"""A pixel's own width, as a standard deviation."""

_FLAGS = tuple(CircleFlag(bits) for bits in range(512))
_LOST, _BORDER, _CONTRAST, _AREA, _FILL, _MOMENT, _SATURATED = (
    int(flag)
    for flag in (
        CircleFlag.LOST,
        CircleFlag.BORDER,
        CircleFlag.CONTRAST,
        CircleFlag.AREA,
        CircleFlag.FILL,
        CircleFlag.MOMENT,
        CircleFlag.SATURATED,
    )
)
_FOUR_PI = 4 * math.pi


@dataclass(frozen=True, slots=True)
class Limits:
    """How far a circle's ratio to what is expected may lie from 1: plain numbers, tuples over the
    circles, learnt from the stills of the reference. Part of the set-up."""

    area: tuple[float, ...]
    """Against the middle of all circles' ratios: focus and light change all of them alike."""
    fill: tuple[float, ...]
    """Area over that of the ellipse with the same second moments."""
    moment: tuple[float, ...]
    """Second moments over the area."""
    contrast_grey: tuple[float, ...]
    """Contrast at rest, negative for a dark disc."""


Still = tuple[Sequence[CircleReading], Slow]
"""What `smooth.study` returned for one picture of the resting marker."""


def learn(
    stills: Mapping[int, Sequence[Still]], row_step: int
) -> dict[int, tuple[Appearance, Limits]]:
    """Return how the circles look at rest and how far that varies, from pictures of a resting
    marker: for each kind of picture, named by its row_offset, and with as many stills.

    Whole pictures have row_step 1 and the one offset 0; fields have row_step 2, and offsets 0 and 1
    if both are seen. The sizes and edges are then the mean of both, in which the raster's first
    alias cancels; each field keeps its own places. The stills must have been studied with no raster
    expected (as by `first_look`): it is worked out here and taken off. Raises ValueError without
    any stills.
    """
    if not stills or not all(stills.values()):
        raise ValueError("no stills: at least one of each field of the resting marker is needed")
    means, scatters = {}, {}
    for offset, kind in stills.items():
        table = np.array([[_figures(r) for r in readings] for readings, _ in kind])
        means[offset] = table.mean(axis=0)
        scatters[offset] = np.zeros_like(means[offset])
        if len(table) > 1:
            # Of successive differences: a slow drift of the light is not noise.
            scatters[offset] = np.sqrt(np.mean(np.diff(table, axis=0) ** 2, axis=0) / 2)
    every = [slow for kind in stills.values() for _, slow in kind]
    widths = np.maximum(np.array([slow.edge_px for slow in every]).mean(axis=0), LEAST_EDGE_PX)
    variance = float(np.mean([slow.variance_grey2 for slow in every]))
    both = np.array(list(means.values())).mean(axis=0)
    scale = _raster_scale(means, scatters, both, widths, row_step, len(every) / len(means))
    learnt = {}
    for offset, mean in means.items():
        places, areas, shapes = [], [], []
        for k, edge in enumerate(widths.tolist()):
            x, seen_y = mean[k, :2].tolist()
            area, xx, xy, yy = both[k, 2:6].tolist()
            y, shape, wave = seen_y, (xx, xy, yy), NO_RASTER
            for _ in range(3):
                wave = Raster(*(scale * v for v in raster(shape, (edge[0], edge[1]), row_step)))
                phase = 2 * math.pi * (y - offset) / row_step
                y = seen_y - wave.y_px * math.sin(phase)
                if len(means) < row_step:
                    shape = (xx, xy, yy - wave.yy_px2 * math.cos(phase))
            places.append((x - xy / yy * (seen_y - y), y))
            areas.append(
                area / (1 + wave.area * math.cos(phase)) if len(means) < row_step else area
            )
            shapes.append(shape)
        scatter = scatters[offset]
        limits = FLOOR + DEVIATIONS * scatter[:, 10:13]
        learnt[offset] = (
            Appearance(
                row_step=row_step,
                x_px=tuple(x for x, _ in places),
                y_px=tuple(y for _, y in places),
                area_px=tuple(areas),
                moments_px2=tuple(shapes),
                disc_grey=tuple(mean[:, 6].tolist()),
                ground_grey=tuple(mean[:, 7].tolist()),
                light_per_px=tuple((a, b) for a, b in mean[:, 8:10].tolist()),
                variance_grey2=variance,
                edge_px=tuple((a, b) for a, b in widths.tolist()),
                raster_scale=scale,
            ),
            Limits(
                area=tuple((FLOOR + DEVIATIONS * scatter[:, 2] / mean[:, 2]).tolist()),
                fill=tuple(limits[:, 0].tolist()),
                moment=tuple(limits[:, 1:].max(axis=1).tolist()),
                contrast_grey=tuple((mean[:, 6] - mean[:, 7]).tolist()),
            ),
        )
    return learnt


def _raster_scale(
    means: Mapping[int, NDArray[np.float64]],
    scatters: Mapping[int, NDArray[np.float64]],
    both: NDArray[np.float64],
    widths: NDArray[np.float64],
    row_step: int,
    stills: float,
) -> float:
    """Return what the raster does over what its model says, from the two fields of one marker:
    it pulls them apart, where their true places are the same. 1 without two fields."""
    if len(means) < 2:
        return 1.0
    (one, one_mean), (two, two_mean) = means.items()
    # As if known beforehand to RASTER_SHARE.
    told, weight = 1 / RASTER_SHARE**2, 1 / RASTER_SHARE**2
    for k, edge in enumerate(widths.tolist()):
        _, y, _, xx, xy, yy = both[k, :6].tolist()
        wave = raster((xx, xy, yy), (edge[0], edge[1]), row_step)
        apart = wave.y_px * (
            math.sin(2 * math.pi * (y - one) / row_step)
            - math.sin(2 * math.pi * (y - two) / row_step)
        )
        noise = (scatters[one][k, 1] ** 2 + scatters[two][k, 1] ** 2) / stills
        share = apart / max(float(noise), 1e-9)
        told += share * float(one_mean[k, 1] - two_mean[k, 1])
        weight += share * apart
    return min(max(told / weight, 0.5), 1.5)


def _figures(r: CircleReading) -> tuple[float, ...]:
    xx, xy, yy = r.moments_px2
    fill = r.area_px / (_FOUR_PI * math.sqrt(max(xx * yy - xy * xy, 1e-9)))
    per_area = _FOUR_PI / r.area_px
    return (
        *(r.x_px, r.y_px, r.area_px),
        *r.moments_px2,
        *(r.disc_grey, r.ground_grey),
        *r.light_per_px,
        *(fill, xx * per_area, yy * per_area),
    )


def judge(
    readings: Sequence[CircleReading],
    expected: Expected,
    limits: Limits,
    noise_grey: float,
    width_px: int,
    height_px: int,
) -> list[CircleFlag]:
    """Return the flags of each circle of a marker in one picture of a frame of that size."""
    ratios = [r[2] / area for r, area in zip(readings, expected.area_px, strict=True)]
    ranked = sorted(ratios)
    middle = (ranked[(len(ranked) - 1) // 2] + ranked[len(ranked) // 2]) / 2
    if not -FAR_AREA < middle - 1 < FAR_AREA:
        middle = 1.0
    full = FULL_GREY - 2 * noise_grey
    last_x, last_y = width_px - 1, height_px - 1
    flags = []
    for (
        (x, y, _, (xx, xy, yy), disc, ground, (light_x, light_y), _),
        ratio,
        (exx, exy, eyy),
        (way_x, way_y),
        travel,
        (reach_x, reach_y),
        area_limit,
        fill_limit,
        moment_limit,
        contrast,
    ) in zip(
        readings,
        ratios,
        expected.moments_px2,
        expected.blur_px,
        expected.travel_px,
        expected.reach_px,
        limits.area,
        limits.fill,
        limits.moment,
        limits.contrast_grey,
        strict=True,
    ):
        bits = 0
        part = (disc - ground) / contrast
        # Asked so that a figure which is not a number is a flag too.
        if not part >= LEAST_CONTRAST:
            bits = _CONTRAST if part > LOST_CONTRAST else _CONTRAST | _LOST
        bent = PER_PIXEL * travel
        blur_x, blur_y = BLUR_SHARE * way_x * way_x, BLUR_SHARE * way_y * way_y
        blur = blur_x + blur_y
        smear = blur / eyy
        if not abs(ratio / middle - 1) <= area_limit + bent + smear:
            bits |= _AREA
        det, edet = xx * yy - xy * xy, exx * eyy - exy * exy
        fill = (ratio * ratio * edet / det - 1) / 2 if det > 0 else 1.0
        if not abs(fill) <= fill_limit + smear:
            bits |= _FILL
        slack = moment_limit + bent
        if not (
            abs(xx / ratio - exx) <= slack * exx + blur_x
            and abs(yy / ratio - eyy) <= slack * eyy + blur_y
            and abs(xy / ratio - exy) <= (slack * (exx + eyy) + blur) / 4
        ):
            bits |= _MOMENT
        brightest = disc + abs(disc) * (abs(light_x * reach_x) + abs(light_y * reach_y))
        if brightest > full or ground > full:
            bits |= _SATURATED
        if not (reach_x <= x <= last_x - reach_x and reach_y <= y <= last_y - reach_y):
            bits |= _BORDER
        flags.append(_FLAGS[bits])
    return flags
