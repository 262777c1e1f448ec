"""The centres of a marker's circles by the weight that passes on the least noise."""

from __future__ import annotations

import math
from math import cos, sin
from typing import NamedTuple

import cv2
import numpy as np

from vdms_rt.measure.edge import spread_table, weight
from vdms_rt.measure.expect import Expected
from vdms_rt.measure.gate import FEW_PIXELS, Gate, Shape, Workspace, fill_boxes
from vdms_rt.model import Luma

EFFICIENCY = 1.03
"""Standard deviation of this centroid over the Cramer-Rao bound, for the whole bench."""
EDGE_REACH_PX = 2.2
"""Of the blurred edge beside its middle, with what the rounding to whole pixels adds."""
RASTER_SHARE = 0.02
"""How far the raster's pull is known."""
MAX_PASSES = 12
REFRESH_PICTURES = 32
"""Every so many pictures one circle's slow figures are measured anew."""
LIGHT_LIMIT = 5.0
"""Standard deviations of the slope of light on a disc beyond which it has changed."""
LEAST_WAY_PX2 = 0.1
"""Squared way in an exposure from which on the widths of the edge are not those of the optics."""
_MEMORY = 1 / 16
_TURN = 2 * math.pi
_new = tuple.__new__


class Slow(NamedTuple):
    """Figures that change slowly, and so are averaged over many pictures."""

    variance_grey2: float
    """Of the noise, its rounding to whole grey levels included."""
    edge_px: tuple[tuple[float, float], ...]
    """Of each circle: widths s_x, s_y of the blurred edge, the pixel's own included."""
    pictures: int = 0


class CircleReading(NamedTuple):
    """One circle in one picture, in pixels of the whole frame."""

    x_px: float
    y_px: float
    area_px: float
    moments_px2: Shape
    disc_grey: float
    ground_grey: float
    light_per_px: tuple[float, float]
    """Slope of the light along x and y, as a part of the disc's level."""
    covariance_px2: Shape
    """Of the centre: xx, xy, yy."""

    @property
    def contrast(self) -> float:
        """Grey levels between disc and ground, negative for a dark disc."""
        return self.disc_grey - self.ground_grey


def first_slow(circles: int) -> Slow:
    """Return a start for the slow figures, good enough to learn the true ones from stills."""
    return Slow(4.0, ((1.0, 1.0),) * circles)


def measure(
    image: Luma, row_offset: int, row_step: int, expected: Expected, slow: Slow, work: Workspace
) -> tuple[list[CircleReading], Slow]:
    """Return a reading of every circle of a marker, in its order, and the next slow figures.

    `image` is a whole frame, or one field of it: its row r is row `row_offset + r * row_step` of
    the frame. Where the circles lie farther from where they were expected than the gate has room,
    the gate follows and the picture is measured again. Nothing is judged here: also a circle that
    is not there has a reading, which `validity` then refuses.
    """
    gate = work.gate(expected.gate, expected.margin_px, row_step)
    half_width, half_height = gate.half_width, gate.half_height
    lefts = [round(x) - half_width for x in expected.x_px]
    tops = [round((y - row_offset) / row_step) - half_height for y in expected.y_px]
    variance = slow.variance_grey2
    for passes_left in range(MAX_PASSES - 1, -1, -1):
        for left, top in zip(lefts, tops, strict=True):
            first = top * row_step + row_offset
            work.read.append(
                (left, first, left + gate.width, first + (gate.height - 1) * row_step + 1)
            )
        moments, levels = _sums(image, gate, lefts, tops, expected.smeared, work)
        readings, escaped, relit = _read(
            moments, levels, lefts, tops, row_offset, row_step, gate, expected, variance
        )
        if not escaped:
            break
        if not passes_left:
            return _without_escaped(readings, lefts, tops, row_offset, row_step, gate), slow
        for k, m in enumerate(moments):
            lefts[k] += round(m[1] / m[0])
            tops[k] += round(m[3] / m[0])
    if relit:
        for k in _changed(levels, expected, gate, variance):
            _divide_light(gate, k, moments, levels, expected, variance)
        readings, _, _ = _read(
            moments, levels, lefts, tops, row_offset, row_step, gate, expected, variance
        )
    if slow.pictures % REFRESH_PICTURES or moves(expected):
        return readings, Slow(variance, slow.edge_px, slow.pictures + 1)
    return readings, _refreshed(slow, gate)


def moves(expected: Expected) -> bool:
    """Return whether the exposure blurs the circles' edges."""
    return max(way_x * way_x + way_y * way_y for way_x, way_y in expected.blur_px) > LEAST_WAY_PX2


def _without_escaped(
    readings: list[CircleReading],
    lefts: list[int],
    tops: list[int],
    row_offset: int,
    row_step: int,
    gate: Gate,
) -> list[CircleReading]:
    """Return the readings with no area for circles whose edge may have left its zone: the gate did
    not catch up with them, and what it shows is not the circle."""
    reach = gate.margin_px - EDGE_REACH_PX
    return [
        r
        if abs(r.x_px - left - gate.half_width) <= reach
        and abs(r.y_px - (top + gate.half_height) * row_step - row_offset) <= reach
        else r._replace(area_px=math.nan)
        for r, left, top in zip(readings, lefts, tops, strict=True)
    ]


def _read(
    moments: list[list[float]],
    levels: list[list[float]],
    lefts: list[int],
    tops: list[int],
    row_offset: int,
    row_step: int,
    gate: Gate,
    expected: Expected,
    variance_grey2: float,
) -> tuple[list[CircleReading], bool, bool]:
    """Return the readings, whether an edge may have left its zone, and whether the light on a disc,
    or on all of them together, has another slope than at rest."""
    noise = LIGHT_LIMIT * math.sqrt(variance_grey2)
    limit_x, limit_y = noise * gate.slope_noise_x, noise * gate.slope_noise_y
    half_width, half_height = gate.half_width, gate.half_height
    reach_x = expected.margin_px - EDGE_REACH_PX
    reach_y = reach_x / row_step
    raster_part = RASTER_SHARE * RASTER_SHARE / 2
    variance_part = EFFICIENCY * EFFICIENCY * variance_grey2
    sum_x = sum_y = 0.0
    escaped = relit = False
    readings = []
    for (
        (area, mx, mxx, my, mxy, _, myy, _, _),
        (ground, disc, slope_x, slope_y),
        left,
        top,
        (light_x, light_y),
        (wave_y, wave_area, wave_yy),
        (sxx, sxy, syy),
    ) in zip(
        moments,
        levels,
        lefts,
        tops,
        expected.light_per_px,
        expected.raster,
        expected.spread_px2,
        strict=True,
    ):
        dx, dy = mx / area, my / area
        if not (-reach_x <= dx <= reach_x and -reach_y <= dy <= reach_y):
            escaped = True
        change_x, change_y = slope_x - light_x * disc, slope_y - light_y * disc
        if not (-limit_x <= change_x <= limit_x and -limit_y <= change_y <= limit_y):
            relit = True
        sum_x += change_x
        sum_y += change_y
        xy = (mxy / area - dx * dy) * row_step
        yy = (myy / area - dy * dy) * row_step * row_step
        phase = _TURN * dy
        wave = wave_y * sin(phase)
        if row_step > 1:
            # The phase is that of the true centre, which for a small disc matters.
            wave = wave_y * sin(phase - _TURN * wave / row_step)
        crest = cos(phase)
        contrast = disc - ground
        # A disc that is quite black has no light to slope.
        full = disc or math.inf
        part = variance_part / (contrast * contrast + 1e-6)
        readings.append(
            _new(
                CircleReading,
                (
                    dx + (left + half_width) - xy / yy * wave,
                    (dy + (top + half_height)) * row_step + row_offset - wave,
                    area * row_step / (1 + wave_area * crest),
                    (mxx / area - dx * dx, xy, yy - wave_yy * crest),
                    disc,
                    ground,
                    (slope_x / full, slope_y / full),
                    (sxx * part, sxy * part, syy * part + raster_part * wave_y * wave_y),
                ),
            )
        )
    n = len(levels)
    if sum_x * sum_x > limit_x * limit_x * n or sum_y * sum_y > limit_y * limit_y * n:
        relit = True
    return readings, escaped, relit


def _sums(
    image: Luma, gate: Gate, lefts: list[int], tops: list[int], smeared: bool, work: Workspace
) -> tuple[list[list[float]], list[list[float]]]:
    """Return each circle's sums of weight times 1, x, x^2, y, yx, yx^2, y^2, ... about the middle
    of its box, in rows of the image, and its levels (see `Gate.flat_weights`)."""
    fill_boxes(gate, image, lefts, tops)
    gate.flat[...] = gate.raw_sparse
    np.dot(gate.flat_of_each, gate.flat_weights, out=gate.levels)
    levels: list[list[float]] = gate.levels.tolist()
    work.set_weights(levels, smeared)
    np.bitwise_or(gate.raw_rows, gate.zones, out=gate.index_rows)
    cv2.LUT(gate.index_rows, work.table, gate.weights_rows)
    np.matmul(gate.rows_of, gate.weights, out=gate.down_columns)
    np.dot(gate.down_columns_rows, gate.columns_of, out=gate.moments)
    moments: list[list[float]] = gate.moments_of_each.tolist()
    for m in moments:
        if not m[0]:
            m[0] = m[2] = m[6] = 1e-9
    return moments, levels


def _changed(
    levels: list[list[float]], expected: Expected, gate: Gate, variance_grey2: float
) -> list[int]:
    """Return the circles on which the light has changed: those beyond their own limit, or all of
    them where only their sum is beyond its."""
    noise = LIGHT_LIMIT * math.sqrt(variance_grey2)
    limits = np.array([noise * gate.slope_noise_x, noise * gate.slope_noise_y])
    table = np.array(levels)
    changes = abs(table[:, 2:] - np.array(expected.light_per_px) * table[:, 1:2])
    alone = np.flatnonzero((changes > limits).any(axis=1))
    return alone.tolist() if len(alone) else list(range(len(levels)))


def _divide_light(
    gate: Gate,
    k: int,
    moments: list[list[float]],
    levels: list[list[float]],
    expected: Expected,
    variance_grey2: float,
) -> None:
    """Measure circle k once more with the change of light since rest divided out of its box.

    Left as it is when no plane fits the disc's inside: then something lies on it.
    """
    box = gate.raw[k].astype(np.float64)
    mean, slope_x, slope_y, rest = gate.plane_on_disc(box)
    if not (rest <= 2 * variance_grey2 + (0.01 * mean) ** 2 and mean >= 1):
        return
    at_rest = expected.light_per_px[k]
    change_x, change_y = slope_x / mean - at_rest[0], slope_y / mean - at_rest[1]
    light = 1 + change_x * gate.x_px + change_y * gate.y_px
    if light.min() < 0.2:
        return
    box /= light
    ground = float(box[gate.on_ground].mean())
    disc = float(box[gate.on_disc].mean())
    if abs(disc - ground) < 1:
        return
    weights = gate.zoned(k, weight((box - ground) / (disc - ground), expected.smeared))
    sums = gate.rows_of.astype(np.float64) @ weights @ gate.columns_of.astype(np.float64)
    moments[k] = sums.ravel().tolist()
    levels[k] = [ground, disc, slope_x, slope_y]


def study(
    image: Luma, row_offset: int, row_step: int, expected: Expected, slow: Slow, work: Workspace
) -> tuple[list[CircleReading], Slow]:
    """Return what `measure` does, but with the slow figures of this picture alone, of all circles:
    for the stills from which `validity.learn` learns."""
    readings, _ = measure(image, row_offset, row_step, expected, slow._replace(pictures=1), work)
    gate = work.gate(expected.gate, expected.margin_px, row_step)
    figures = [_slow_figures(gate, k) for k in range(gate.count)]
    return readings, Slow(
        sum(variance for variance, _, _ in figures) / len(figures),
        tuple((x, y) for _, x, y in figures),
        1,
    )


def _refreshed(slow: Slow, gate: Gate) -> Slow:
    k = slow.pictures // REFRESH_PICTURES % gate.count
    variance, edge_x, edge_y = _slow_figures(gate, k)
    edge = list(slow.edge_px)
    edge[k] = (_drawn(edge[k][0], edge_x, 2.0), _drawn(edge[k][1], edge_y, 2.0))
    return Slow(_drawn(slow.variance_grey2, variance, 4.0), tuple(edge), slow.pictures + 1)


def _drawn(mean: float, value: float, factor: float) -> float:
    """Return a running mean with one more value. A value that is off by more than `factor` counts
    as one off by that: a glare or a wire in one picture must not upset the mean of many."""
    if not mean / factor <= value <= mean * factor:
        value = mean * factor if value > mean else mean / factor
    return mean + (value - mean) * _MEMORY


def _slow_figures(gate: Gate, k: int) -> tuple[float, float, float]:
    """Return the variance of the noise in grey^2 and the widths of the edge along x and y in px, of
    circle k in the picture whose boxes the gate holds."""
    ground, disc, slope_x, slope_y = gate.levels[k].tolist()
    flat = gate.flat_of_each[k].take(gate.disc_pixels)
    flat -= np.float32(disc)
    flat -= np.array([slope_x, slope_y], np.float32) @ gate.disc_plane
    squares, freedom = float(np.dot(flat, flat)), gate.disc_freedom
    if freedom < FEW_PIXELS:
        flat = gate.flat_of_each[k].take(gate.ground_pixels) - np.float32(ground)
        squares, freedom = squares + float(np.dot(flat, flat)), freedom + len(flat) - 1
    variance = squares / freedom
    spread = spread_table(ground, disc).take(gate.raw[k].ravel())
    noise = variance / ((disc - ground) ** 2 + 1e-6)
    x, y = (spread @ gate.edge_weights[k] + noise * gate.edge_offset[k]).tolist()
    return variance, x, y
