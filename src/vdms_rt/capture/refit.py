"""The times of a whole record once more, from the stamps before and after each."""

from __future__ import annotations

from fractions import Fraction
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vdms_rt.capture.envelope import (
    SOFT,
    UNSEEN,
    Fit,
    Floats,
    Lateness,
    Prior,
    fits,
    lateness,
    lower_edge,
)
from vdms_rt.capture.line import WINDOW

Times: TypeAlias = NDArray[np.int64]

_RATE_SIGMA = 1e-3


def refit(
    stamps_ns: ArrayLike,
    indices: ArrayLike,
    period_s: Fraction,
    offset_ns: int = 0,
    segments: ArrayLike | None = None,
) -> Times:
    """Return the time of each stamp in nanoseconds, int64, in the order given: the line under the
    stamps of two minutes around it, plus `offset_ns`.

    `stamps_ns` and `indices` (n,) are a record's driver stamps and frame indices, ascending,
    `period_s` the nominal time from index to index, `offset_ns` what `clock.mid_exposure_ns` says
    (0 gives the undelayed stamps). Where `segments` (n,) changes the line begins anew. Where the
    stamps' noise has no sharp lower edge a constant delay remains, one for each segment.

    Raises ValueError if the lengths differ, or indices do not ascend within a segment.
    """
    stamps = np.asarray(stamps_ns, dtype=np.int64)
    places = np.asarray(indices, dtype=np.int64)
    parts = np.zeros_like(places) if segments is None else np.asarray(segments, dtype=np.int64)
    if not len(stamps) == len(places) == len(parts):
        raise ValueError(
            f"{len(stamps)} stamps, {len(places)} indices and {len(parts)} segments do not belong "
            "together; give one of each for every frame"
        )
    times = np.empty_like(stamps)
    ends = np.flatnonzero(np.diff(parts)) + 1
    for part in np.split(np.arange(len(stamps)), ends):
        if len(part):
            times[part] = _times(stamps[part], places[part], period_s * 10**9) + offset_ns
    return times


def _times(stamps: Times, places: Times, period_ns: Fraction) -> Times:
    if (np.diff(places) <= 0).any():
        raise ValueError(
            "indices must ascend within a segment; give the segments, and one field of each frame"
        )
    grid = stamps[0] + (places - places[0]) * period_ns.numerator // period_ns.denominator
    y = (stamps - grid).astype(np.float64)
    windows = _windows(len(y))
    prior = Prior(0.0, _RATE_SIGMA * float(period_ns))
    middles = np.array([float(places[w.start] + places[w.stop - 1]) / 2 for w in windows])
    parts = [(places[w] - middle, y[w]) for w, middle in zip(windows, middles, strict=True)]
    lines = [lower_edge(*part, UNSEEN.width_ns, (UNSEEN.width_ns, 1.0), prior)[0] for part in parts]
    soft = [_about(*part, line).softness for part, line in zip(parts, lines, strict=True)]
    depth_ns = 0.0
    if np.median(soft) > SOFT:
        fitted = [_lines(*part, prior) for part in parts]
        clip = _best_clip(fitted, windows)
        lines = [found[clip] for found in fitted]
        shapes = [_about(*part, line) for part, line in zip(parts, lines, strict=True)]
        depth_ns = float(np.median([shape.edge_ns for shape in shapes]))
    levels = np.array([line.level for line in lines]) + depth_ns
    slopes = np.array([line.slope for line in lines])
    residual = _blend(places.astype(np.float64), middles, levels, slopes)
    result: Times = grid + np.rint(residual).astype(np.int64)
    return result


def _windows(n: int) -> list[slice]:
    if n <= WINDOW:
        return [slice(0, n)]
    starts = [*range(0, n - WINDOW, WINDOW // 2), n - WINDOW]
    return [slice(start, start + WINDOW) for start in starts]


def _about(x: Floats, y: Floats, line: Fit) -> Lateness:
    return lateness(y - line.level - line.slope * x, UNSEEN, 1.0)


def _lines(x: Floats, y: Floats, prior: Prior) -> dict[int, Fit]:
    """Return the lines of all clips that a window can carry."""
    third = max(1, len(x) // 3)
    rise = float(np.median(y[-third:]) - np.median(y[:third]))
    run = float(np.median(x[-third:]) - np.median(x[:third]))
    slope = rise / run if run else 0.0
    level = float(np.median(y - slope * x))
    scale_ns = lateness(y - level - slope * x, UNSEEN, 1.0).scale_ns
    widest = fits(x, y, range(1), scale_ns, (level, slope), prior)[0]
    return fits(x, y, None, _about(x, y, widest).scale_ns, (widest.level, widest.slope), prior)


def _best_clip(fitted: list[dict[int, Fit]], windows: list[slice]) -> int:
    """Return the clip whose lines vary least over all windows."""
    common = set.intersection(*(set(found) for found in fitted))

    def spread(clip: int) -> float:
        total = 0.0
        for found, window in zip(fitted, windows, strict=True):
            width = float(window.stop - window.start)
            total += found[clip].var_level + found[clip].var_slope * width * width / 12
        return total

    return min(common, key=spread)


def _blend(x: Floats, middles: Floats, levels: Floats, slopes: Floats) -> Floats:
    """Return the lines at x: between two windows' middles the weight passes from one to the
    other."""
    right = np.clip(np.searchsorted(middles, x), 1, max(1, len(middles) - 1))
    if len(middles) == 1:
        return np.asarray(levels[0] + slopes[0] * (x - middles[0]))
    left = right - 1
    weight = np.clip((x - middles[left]) / (middles[right] - middles[left]), 0.0, 1.0)
    first = levels[left] + slopes[left] * (x - middles[left])
    second = levels[right] + slopes[right] * (x - middles[right])
    return np.asarray((1 - weight) * first + weight * second)
