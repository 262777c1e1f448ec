"""Where a reference's clock stands against the camera's: offset, rate, sign and axis."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy import fft, signal

from vdms_replay.series import Series

Floats: TypeAlias = NDArray[np.float64]

LEAST_SAMPLES = 20
LEAST_OVERLAP = 0.5
"""Of the shorter of the two series."""
LEAST_MOTION = 0.1
"""Of the variance of a whole series that its part in the overlap must have."""
CANDIDATES = 32
MOST_RESIDUAL = 1.0
"""Beyond which most of what the camera saw is not in the reference."""
SAME = 1.5
"""Places whose residuals differ by less than this factor fit equally well."""
LIKELY = 3.0
"""A place whose residual is larger by more than this is out of the question."""
_STEPS = 30
_SETTLED_S = 1e-10


class AlignError(ValueError):
    """The two series cannot be brought together; a phrase says why."""


@dataclass(frozen=True, slots=True)
class Camera:
    """One marker's valid samples, in the order of time."""

    time_s: Floats
    """Middle of the exposure, on the recording's clock."""
    x_mm: Floats
    y_mm: Floats
    exposure_s: float = 0.0
    """Of each field, or of the frame."""
    fields_s: tuple[float, ...] = (0.0,)
    """When the exposures of one sample are, from its time: two for a whole interlaced frame."""

    def along(self, axis_deg: float) -> Floats:
        """Return the displacement along an axis, from x towards y."""
        angle = math.radians(axis_deg)
        if axis_deg == 0:
            return self.x_mm
        return math.cos(angle) * self.x_mm + math.sin(angle) * self.y_mm


@dataclass(frozen=True, slots=True)
class Wanted:
    """What is looked for besides the offset, and where."""

    clock_rate: bool = False
    sign: bool = False
    axis: bool = False
    axis_deg: float = 0.0
    offset_s: float | None = None
    """Where the offset is looked for; None: everywhere."""
    within_s: float = 0.5
    """How far from `offset_s`; 0 takes it as it is."""


@dataclass(frozen=True, slots=True)
class Alignment:
    """How the reference fits: at the recording's time t its clock shows offset + (1 + rate) t."""

    offset_s: float
    sigma_offset_s: float
    rate: float
    sigma_rate: float
    sign: int
    """-1: the reference counts the other way."""
    axis_deg: float
    """Of the reference's axis in the marker plane, from x towards y."""
    residual: float
    """Standard deviation of what a fit with gain leaves, over that of the reference."""
    overlap: int
    """Samples of the camera that the reference covers."""
    other_offset_s: float = math.nan
    """The next best place that fits almost as well; NaN without one."""
    other_residual: float = math.nan
    gain_of_rate: float = 1.0
    """By how much the residual would shrink with the clock rate found; 1 where it was."""
    rate_if_found: float = 0.0
    mirrored: bool = False
    """The sign was not asked for, and is wrong."""

    def clock(self, time_s: Floats) -> Floats:
        """Return the reference's clock at the recording's times."""
        return self.offset_s + (1 + self.rate) * time_s


def reference_at(camera: Camera, series: Series, alignment: Alignment) -> Floats:
    """Return what the camera would see of the reference in each sample, in its sign: the mean over
    each exposure (and over the two of a whole interlaced frame); NaN where it does not reach."""
    return alignment.sign * _seen(camera, series, alignment.offset_s, alignment.rate)


def _seen(camera: Camera, series: Series, offset_s: float, rate: float) -> Floats:
    parts = [
        series.mean_about(
            offset_s + (1 + rate) * (camera.time_s + shift_s), camera.exposure_s * (1 + rate)
        )
        for shift_s in camera.fields_s
    ]
    return np.asarray(sum(parts) / len(parts))


def align(camera: Camera, series: Series, wanted: Wanted) -> Alignment:
    """Return how the reference fits the camera's samples best.

    The offset is sought by the correlation of all that overlaps, then refined with the samples
    themselves. Raises AlignError.
    """
    if len(camera.time_s) < LEAST_SAMPLES:
        raise AlignError(
            f"{len(camera.time_s)} valid samples are too few; {LEAST_SAMPLES} or more are needed"
        )
    seen_mm = _moved_most(camera) if wanted.axis else camera.along(wanted.axis_deg)
    if wanted.offset_s is not None and wanted.within_s == 0:
        places = [wanted.offset_s]
    else:
        places = _places(camera.time_s, seen_mm, series, wanted)
    found = [
        one for place in places if (one := _refined(camera, series, place, wanted)) is not None
    ]
    least = min((one.residual for one in found), default=math.inf)
    if least > MOST_RESIDUAL:
        raise AlignError(_nowhere(camera, series, wanted))
    upright = [one for one in found if not one.mirrored] or found
    least_upright = min(one.residual for one in upright)
    best = max(
        (one for one in upright if one.residual <= SAME * least_upright),
        key=lambda one: (one.overlap, -one.residual),
    )
    best = _with_others(best, upright)
    if 2 * least < best.residual:
        best = replace(best, mirrored=True)
    return _with_hints(best, camera, series, wanted)


def _moved_most(camera: Camera) -> Floats:
    """Return the displacement along the direction of the most motion."""
    both = np.stack([camera.x_mm - camera.x_mm.mean(), camera.y_mm - camera.y_mm.mean()])
    _, axes = np.linalg.eigh(both @ both.T)
    return np.asarray(axes[:, -1] @ both)


def _places(time_s: Floats, seen_mm: Floats, series: Series, wanted: Wanted) -> list[float]:
    """Return offsets near which the two series correlate best, the best first.

    Both are taken to one grid of half the camera's step; the correlation is that of the part that
    both cover (Padfield 2012, Masked Object Registration in the Fourier Domain).
    """
    step_s = max(float(np.median(np.diff(time_s))) / 2, series.step_s)
    begin_s = float(time_s[0])
    grid_s = np.arange(begin_s, float(time_s[-1]) + step_s / 2, step_s)
    near = np.clip(np.searchsorted(time_s, grid_s), 1, len(time_s) - 1)
    covered = time_s[near] - time_s[near - 1] < 5 * step_s
    a = np.interp(grid_s, time_s, seen_mm - seen_mm.mean())
    there_s = np.arange(
        series.start_s + 2 * step_s + 2 * series.step_s, series.end_s - 2 * series.step_s, step_s
    )
    b = series.mean_about(there_s, step_s)
    has = np.isfinite(b)
    if covered.sum() < LEAST_SAMPLES or has.sum() < LEAST_SAMPLES:
        return []
    b = np.where(has, b - b[has].mean(), 0.0)
    quality, count = _correlation(a * covered, covered, b, has)
    offsets_s = there_s[0] - begin_s + (np.arange(len(quality)) - (len(grid_s) - 1)) * step_s
    quality[count < LEAST_OVERLAP * min(covered.sum(), has.sum())] = 0
    if wanted.offset_s is not None:
        quality[np.abs(offsets_s - wanted.offset_s) > wanted.within_s] = 0
    height = np.abs(quality)
    tops = np.unique(np.append(signal.find_peaks(height)[0], int(np.argmax(height))))
    tops = tops[height[tops] > 0]
    if not len(tops):
        return []
    rest = 1 - height[tops] ** 2
    tops = tops[rest <= 4 * rest.min() + 0.02]
    best = tops[np.argsort(-height[tops], kind="stable")][:CANDIDATES]
    return [float(offset_s) for offset_s in offsets_s[best]]


def _correlation(
    a: Floats, has_a: NDArray[np.bool_], b: Floats, has_b: NDArray[np.bool_]
) -> tuple[Floats, Floats]:
    """Return the correlation of `a` with `b` at every shift, and on how many values it rests.

    Both are zero where they are unknown. Value n is of a[i] with b[i + n - (len(a) - 1)].
    """
    total = len(a) + len(b) - 1
    size = fft.next_fast_len(total, real=True)
    forward = [fft.rfft(v, size) for v in (has_b.astype(float), b, b * b)]
    back = [fft.rfft(v[::-1], size) for v in (has_a.astype(float), a, a * a)]

    def of(i: int, j: int) -> Floats:
        return np.asarray(fft.irfft(back[i] * forward[j], size)[:total])

    count = np.maximum(np.rint(of(0, 0)), 1.0)
    mean_a, mean_b = of(1, 0) / count, of(0, 1) / count
    var_a = of(2, 0) / count - mean_a**2
    var_b = of(0, 2) / count - mean_b**2
    moving = (var_a > LEAST_MOTION * (a @ a) / has_a.sum()) & (
        var_b > LEAST_MOTION * (b @ b) / has_b.sum()
    )
    both = of(1, 1) / count - mean_a * mean_b
    scale = np.sqrt(np.where(moving, var_a * var_b, 1.0))
    return np.where(moving, both / scale, 0.0), count


def _refined(camera: Camera, series: Series, offset_s: float, wanted: Wanted) -> Alignment | None:
    """Return the best fit near an offset, None if too little overlaps there.

    Gauss-Newton for the times; gain and zero are free, so that a wrong scale bends no time.
    """
    fixed = wanted.offset_s is not None and wanted.within_s == 0
    rate = 0.0
    sigma_offset_s = sigma_rate = 0.0
    reach_s = float(np.median(np.diff(camera.time_s)))
    for _ in range(_STEPS):
        r = _seen(camera, series, offset_s, rate)
        nudge_s = max(series.step_s, 1e-4)
        ahead = _seen(camera, series, offset_s + nudge_s, rate)
        slope = (ahead - _seen(camera, series, offset_s - nudge_s, rate)) / (2 * nudge_s)
        on = np.isfinite(r) & np.isfinite(slope)
        if on.sum() < LEAST_SAMPLES or float(np.std(r[on])) == 0:
            return None
        t, r, slope = camera.time_s[on], r[on], slope[on]
        columns = [] if fixed else [slope]
        if wanted.clock_rate:
            columns.append(slope * (t - (0.0 if fixed else t.mean())))
        left = _target(camera, on, r, wanted)
        design = np.column_stack([r - r.mean(), np.ones_like(r), *columns])
        solved, *_ = np.linalg.lstsq(design, left, rcond=None)
        rest = left - design @ solved
        gain = float(solved[0])
        if not columns or gain == 0:
            break
        moves = solved[2:] / gain
        variance = float(rest @ rest) / max(1, len(rest) - design.shape[1])
        spread = np.linalg.pinv(design.T @ design)[2:, 2:] * variance / gain**2
        turn = float(moves[-1]) if wanted.clock_rate else 0.0
        shift_s = 0.0 if fixed else float(np.clip(moves[0], -reach_s, reach_s))
        pivot_s = 0.0 if fixed else float(t.mean())
        offset_s += shift_s - turn * pivot_s
        rate += turn
        sigma_rate = math.sqrt(spread[-1, -1]) if wanted.clock_rate else 0.0
        if not fixed:
            sigma_offset_s = math.hypot(math.sqrt(spread[0, 0]), sigma_rate * pivot_s)
        if abs(shift_s) < _SETTLED_S and abs(turn) * float(np.ptp(t)) < _SETTLED_S:
            break
    sign, axis_deg = _direction(camera, on, r, wanted)
    return Alignment(
        offset_s=offset_s,
        sigma_offset_s=sigma_offset_s,
        rate=rate,
        sigma_rate=sigma_rate,
        sign=sign,
        axis_deg=axis_deg,
        residual=float(np.std(rest) / np.std(r)) / max(abs(gain), 1e-12),
        overlap=int(on.sum()),
        mirrored=gain < 0 and not wanted.sign and not wanted.axis,
    )


def _target(camera: Camera, on: NDArray[np.bool_], r: Floats, wanted: Wanted) -> Floats:
    if not wanted.axis:
        return camera.along(wanted.axis_deg)[on]
    return camera.along(_axis_deg(camera, on, r))[on]


def _axis_deg(camera: Camera, on: NDArray[np.bool_], r: Floats) -> float:
    """Return the direction in which the camera sees what the reference does."""
    flat = r - r.mean()
    return math.degrees(math.atan2(float(camera.y_mm[on] @ flat), float(camera.x_mm[on] @ flat)))


def _direction(
    camera: Camera, on: NDArray[np.bool_], r: Floats, wanted: Wanted
) -> tuple[int, float]:
    axis_deg = wanted.axis_deg
    if wanted.axis:
        axis_deg = _axis_deg(camera, on, r)
        # Without the sign asked for, the axis alone tells the direction.
        if not wanted.sign:
            return 1, axis_deg
        if not -90 < axis_deg <= 90:
            return -1, axis_deg - math.copysign(180, axis_deg)
        return 1, axis_deg
    if not wanted.sign:
        return 1, axis_deg
    seen = camera.along(axis_deg)[on]
    return (-1 if float(seen @ (r - r.mean())) < 0 else 1), axis_deg


def _with_others(best: Alignment, found: list[Alignment]) -> Alignment:
    """Return the best fit with the next best place, if it is one that cannot be ruled out."""
    others = [
        one
        for one in found
        if abs(one.offset_s - best.offset_s) > 1e-3 and one.residual <= LIKELY * best.residual
    ]
    if not others:
        return best
    other = min(others, key=lambda one: one.residual)
    return replace(best, other_offset_s=other.offset_s, other_residual=other.residual)


def _with_hints(best: Alignment, camera: Camera, series: Series, wanted: Wanted) -> Alignment:
    """Return the best fit with what a found clock rate would have gained."""
    if wanted.clock_rate:
        return best
    near = replace(wanted, clock_rate=True, offset_s=best.offset_s, within_s=1.0)
    if wanted.offset_s is not None and wanted.within_s == 0:
        near = replace(near, within_s=0.0)
    turned = _refined(camera, series, best.offset_s, near)
    if turned is None or turned.residual >= best.residual:
        return best
    if abs(turned.rate) < 5 * turned.sigma_rate:
        return best
    return replace(best, gain_of_rate=turned.residual / best.residual, rate_if_found=turned.rate)


def _nowhere(camera: Camera, series: Series, wanted: Wanted) -> str:
    length_s = float(camera.time_s[-1] - camera.time_s[0])
    own_s = series.end_s - series.start_s
    where = ""
    if wanted.offset_s is not None:
        where = f" within {wanted.within_s:g} s of the offset {wanted.offset_s:g} s"
    return (
        f"the reference ({own_s:.1f} s) and the recording ({length_s:.1f} s) show no common "
        f"motion{where}; do they belong together, and is it the right column and axis?"
    )
