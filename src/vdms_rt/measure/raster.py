"""What the raster of the rows does to the figures of a circle."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from vdms_rt.measure.edge import profile, weight
from vdms_rt.measure.gate import Shape


class Raster(NamedTuple):
    """How far the rows' raster pulls a circle's figures, at most: y by `y_px` sin, the area by its
    part `area` cos, and the second moment by `yy_px2` cos of 2 pi (y - y_row) / row_step.

    A sum over rows is the integral plus its aliases at the rows' own frequency (Poisson). For whole
    pictures that is some thousandths of a pixel at most; for a field, some hundredths.
    """

    y_px: float
    area: float
    yy_px2: float


NO_RASTER = Raster(0.0, 0.0, 0.0)


def raster_pair(
    shape: Shape, edge_px: tuple[float, float], row_step: int, smeared: bool
) -> tuple[Raster, Raster]:
    """Return what the raster does to a circle as it is, and to one that is higher by a quarter of
    the rows' period: the two between which it goes round with the height."""
    xx, xy, yy = shape
    higher = (math.sqrt(yy) + row_step / 8) ** 2
    return raster(shape, edge_px, row_step, smeared), raster(
        (xx, xy, higher), edge_px, row_step, smeared
    )


def raster(
    shape: Shape, edge_px: tuple[float, float], row_step: int, smeared: bool = False
) -> Raster:
    """Return what the rows' raster does to a circle of which every `row_step`-th row is seen.

    The edge's profile is known, so this sums the weights (the usual ones, or those for `smeared`
    edges) of such a disc for every position between two rows.
    """
    fine = 16
    width_x, width_y = edge_px
    # The weighed edge has half the variance, and a round edge bends its middle inwards.
    bend = (width_x * width_x + width_y * width_y) / 16
    yy = max(shape[2] - width_y * width_y / 2 + bend, 1e-3)
    xx = max(shape[0] - width_x * width_x / 2 + bend, 1e-3)
    half_height, lean = 2 * math.sqrt(yy), shape[1] / yy
    half_chord = 2 * math.sqrt(max(xx - shape[1] ** 2 / yy, 1e-3))
    period = fine * row_step
    reach = math.ceil((half_height + 5 * width_y + 1) / row_step) * period
    y = np.arange(-reach, reach) / fine
    side = math.ceil(half_chord + abs(lean) * half_height + 5 * width_x)
    x = np.arange(-side, side + 1) - lean * y[:, None]
    half = half_chord * np.sqrt(np.clip(1 - (y / half_height) ** 2, 0, None))[:, None]
    sharp = np.where(half > 0, profile((x + half) / width_x) - profile((x - half) / width_x), 0)
    f = np.fft.rfftfreq(len(y), 1 / fine)[:, None]
    blur = np.exp(-2 * (math.pi * width_y * f) ** 2)
    part = np.fft.irfft(np.fft.rfft(sharp, axis=0) * blur, len(y), axis=0)
    along = weight(part, smeared).sum(axis=1).reshape(-1, period)
    rows = y.reshape(-1, period)
    area = along.sum(axis=0)
    mean = (along * rows).sum(axis=0) / area
    square = (along * rows * rows).sum(axis=0) / area - mean * mean
    # The first of these phases has a row at the centre; later ones have it below.
    turn = -2 * math.pi * np.arange(period) / period
    wave = 2 / period * np.cos(turn)
    return Raster(
        y_px=float(mean @ np.sin(turn)) * 2 / period,
        area=float(area @ wave / area.mean()),
        yy_px2=float(square @ wave),
    )
