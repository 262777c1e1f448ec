"""Evenly spaced series and what is made of them: resampled, filtered, derived, their modes.

Gaps stay gaps: a series is cut into stretches, and each is treated by itself. All filters are
zero-phase. Times in seconds, frequencies in hertz; values in any unit, shape (n, columns).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy import signal
from scipy.interpolate import CubicSpline

Floats: TypeAlias = NDArray[np.float64]
LEAST = 4
"""Values of a stretch, for a cubic."""
ANTI_ALIAS_ORDER = 8
ANTI_ALIAS = 0.8
"""Of the new Nyquist frequency."""
ACCURATE = 0.01
HALF_POWER = 0.5


class SignalError(ValueError):
    """What was asked for cannot be done with this series; a phrase says why."""


class ShortError(SignalError):
    """A stretch is too short for a filter."""


@dataclass(frozen=True, slots=True)
class Stretch:
    """Evenly spaced values without a gap."""

    start_s: float
    step_s: float
    values: Floats

    def times_s(self) -> Floats:
        """Return the time of each value."""
        return np.asarray(self.start_s + self.step_s * np.arange(len(self.values)), np.float64)


def own_rate_hz(time_s: Floats) -> float:
    """Return the rate of almost evenly spaced times, gaps aside (least squares)."""
    between_s = np.diff(time_s)
    steps = np.maximum(np.rint(between_s / np.median(between_s)), 1)
    place = np.concatenate(([0.0], np.cumsum(steps)))
    return float(1 / np.polyfit(place, time_s, 1)[0])


def evenly(time_s: Floats, values: Floats, rate_hz: float, max_gap_s: float) -> list[Stretch]:
    """Return the values at whole steps of `1 / rate_hz` from the first time on, by cubic splines.

    Times more than `max_gap_s` apart end a stretch; one of fewer than four values is left out. For
    a rate below the times' own the values are low-passed first (Butterworth of order 8, twice, to
    0.8 of the new Nyquist frequency), and stretches too short for that are left out. Raises
    SignalError if nothing is left.
    """
    step_s = 1 / rate_hz
    cuts = np.flatnonzero(np.diff(time_s) > max_gap_s) + 1
    stretches = []
    short = SignalError("no stretch of four valid samples without a gap is in it")
    for times, part in zip(np.split(time_s, cuts), np.split(values, cuts), strict=True):
        if len(times) < LEAST:
            continue
        if rate_hz < 0.9 * own_rate_hz(times):
            try:
                times, part = _low_passed(times, part, rate_hz)  # noqa: PLW2901
            except ShortError as error:
                short = error
                continue
        first = math.ceil((times[0] - time_s[0]) / step_s - 1e-6)
        last = math.floor((times[-1] - time_s[0]) / step_s + 1e-6)
        if last - first + 1 < LEAST:
            continue
        at = np.asarray(time_s[0] + step_s * np.arange(first, last + 1), np.float64)
        stretches.append(Stretch(float(at[0]), step_s, np.asarray(CubicSpline(times, part)(at))))
    if not stretches:
        raise short
    return stretches


def _low_passed(times: Floats, values: Floats, rate_hz: float) -> tuple[Floats, Floats]:
    own_hz = own_rate_hz(times)
    count = math.floor((times[-1] - times[0]) * own_hz + 1e-6) + 1
    at = np.asarray(times[0] + np.arange(count) / own_hz, np.float64)
    even = Stretch(float(at[0]), 1 / own_hz, np.asarray(CubicSpline(times, values)(at)))
    smooth = filtered(even, None, ANTI_ALIAS * rate_hz / 2, ANTI_ALIAS_ORDER)
    return at, smooth.values


def filtered(stretch: Stretch, low_hz: float | None, high_hz: float | None, order: int) -> Stretch:
    """Return the stretch within a band, by a Butterworth filter run forwards and backwards.

    The amplitude at `low_hz` and `high_hz` is one half (-6 dB): each pass takes 3 dB. Raises
    SignalError for an edge beyond the Nyquist frequency, ShortError for a stretch too short to
    filter.
    """
    nyquist_hz = 0.5 / stretch.step_s
    edges = [edge for edge in (low_hz, high_hz) if edge is not None]
    if not all(0 < edge < nyquist_hz for edge in edges) or edges != sorted(set(edges)):
        raise SignalError(
            f"a filter's edges must rise and lie between 0 and {nyquist_hz:.3f} Hz, half the rate"
        )
    if low_hz is not None and high_hz is not None:
        sos = _sections(order, edges, "bandpass", stretch.step_s)
    else:
        sos = _sections(
            order, edges[0], "lowpass" if low_hz is None else "highpass", stretch.step_s
        )
    least = 3 * (2 * len(sos) + 1)
    if len(stretch.values) <= least:
        raise ShortError(
            f"a stretch of {len(stretch.values)} values is too short for this filter, which needs "
            f"{least + 1}; close gaps with --max-gap, or take a lower order"
        )
    # Long enough for the slowest edge to settle; the ends are mirrored for that.
    settling = math.ceil(3 / (min(edges) * stretch.step_s))
    pad = min(max(settling, least), len(stretch.values) - 1)
    values = signal.sosfiltfilt(sos, stretch.values, axis=0, padtype="odd", padlen=pad)
    return Stretch(stretch.start_s, stretch.step_s, np.asarray(values, np.float64))


def filtered_each(
    stretches: list[Stretch], low_hz: float | None, high_hz: float | None, order: int
) -> list[Stretch]:
    """Return the stretches `filtered`, without those too short for it. Raises SignalError, also if
    none is left."""
    kept = []
    short = SignalError("there is nothing to filter")
    for stretch in stretches:
        try:
            kept.append(filtered(stretch, low_hz, high_hz, order))
        except ShortError as error:
            short = error
    if not kept:
        raise short
    return kept


def _sections(
    order: int,
    edges: list[float] | float,
    kind: Literal["bandpass", "lowpass", "highpass"],
    step_s: float,
) -> Floats:
    return signal.butter(order, edges, kind, output="sos", fs=1 / step_s)


def detrended(stretch: Stretch, kind: str) -> Stretch:
    """Return the stretch less its mean ("mean") or its straight line ("line")."""
    values = signal.detrend(stretch.values, axis=0, type="constant" if kind == "mean" else "linear")
    return Stretch(stretch.start_s, stretch.step_s, np.asarray(values, np.float64))


def derived(stretch: Stretch, times: int, window: int, degree: int) -> Floats:
    """Return the first or second derivative in units per second or per second squared.

    The derivative of the polynomial of `degree` that fits the `window` values about each one
    (Savitzky and Golay 1964); at the ends that of the last whole window.
    """
    if len(stretch.values) < window:
        return np.full_like(stretch.values, np.nan)
    found = signal.savgol_filter(
        stretch.values, window, degree, deriv=times, delta=stretch.step_s, axis=0, mode="interp"
    )
    return np.asarray(found, np.float64)


@dataclass(frozen=True, slots=True)
class Response:
    """What a derivative filter does."""

    accurate_hz: float
    """Up to here the amplitude is right within 1 %."""
    cutoff_hz: float
    """Here the amplitude is -3 dB of the true derivative's."""
    noise_gain: float
    """Standard deviation of the derivative for white noise of one unit."""


def response(times: int, window: int, degree: int, step_s: float) -> Response:
    """Return the response of `derived`, against the true derivative (2 pi f)^times."""
    taps = signal.savgol_coeffs(window, degree, deriv=times, delta=step_s)
    frequency_hz, gain = signal.freqz(taps, worN=8192, fs=1 / step_s)
    ideal = (2 * np.pi * frequency_hz[1:]) ** times
    ratio = np.abs(gain[1:]) / ideal
    beyond = np.abs(ratio - 1) > ACCURATE
    below = ratio < math.sqrt(HALF_POWER)
    nyquist_hz = 0.5 / step_s
    return Response(
        float(frequency_hz[1:][beyond.argmax()]) if beyond.any() else nyquist_hz,
        float(frequency_hz[1:][below.argmax()]) if below.any() else nyquist_hz,
        float(np.sqrt((taps**2).sum())),
    )


@dataclass(frozen=True, slots=True)
class Mode:
    """A peak of the power spectrum."""

    frequency_hz: float
    amplitude: float
    """Of the sine with the power of the peak between its half-power points."""
    damping: float
    """Part of critical by the half-power width; NaN where the spectrum does not resolve it."""
    above_db: float
    """Height above the spectrum's median."""


def modes(
    stretches: list[Stretch], column: int, resolution_hz: float | None, least_db: float
) -> tuple[list[Mode], float]:
    """Return the peaks of one column's power spectrum, the highest first, and its resolution.

    Welch's method over the stretches (Hann windows, half overlapping, of `1 / resolution_hz`
    seconds; None: half of the longest stretch), from its second step on; peaks that stand
    `least_db` above the median and above what is beside them. Damping is the half-power width over
    twice the frequency; a width of fewer than three steps is the window's and not the structure's,
    so it is NaN.
    """
    step_s = stretches[0].step_s
    longest = max(len(stretch.values) for stretch in stretches)
    size = longest // 2 if resolution_hz is None else round(1 / (resolution_hz * step_s))
    if not 16 <= size <= longest:
        raise SignalError(
            f"windows of {size} values do not fit; the longest stretch has {longest}, "
            "and 16 is the least"
        )
    density = np.zeros(size // 2 + 1)
    weight = 0
    for stretch in stretches:
        if len(stretch.values) >= size:
            frequency_hz, part = signal.welch(
                stretch.values[:, column], 1 / step_s, "hann", nperseg=size, detrend=signal.detrend
            )
            density += part * len(stretch.values)
            weight += len(stretch.values)
    density /= weight
    step_hz = float(frequency_hz[1])
    level_db = 10 * np.log10(np.maximum(density, np.finfo(float).tiny))
    floor_db = float(np.median(level_db[1:]))
    peaks, _ = signal.find_peaks(level_db, height=floor_db + least_db, prominence=least_db)
    found = [_mode(int(peak), density, level_db, step_hz, floor_db) for peak in peaks if peak > 1]
    return sorted(found, key=lambda mode: -mode.amplitude), step_hz


def _mode(peak: int, density: Floats, level_db: Floats, step_hz: float, floor_db: float) -> Mode:
    half = density[peak] * HALF_POWER
    left = peak
    while left > 0 and density[left] > half:
        left -= 1
    right = peak
    while right < len(density) - 1 and density[right] > half:
        right += 1
    low = left + (half - density[left]) / (density[left + 1] - density[left])
    high = right - (half - density[right]) / (density[right - 1] - density[right])
    before, at, after = level_db[peak - 1 : peak + 2] if peak + 1 < len(density) else (0, 1, 0)
    shift = 0.5 * (before - after) / (before - 2 * at + after)
    frequency_hz = (peak + shift) * step_hz
    power = density[left : right + 1].sum() * step_hz
    width_hz = (high - low) * step_hz
    return Mode(
        float(frequency_hz),
        float(math.sqrt(2 * power)),
        float(width_hz / (2 * frequency_hz)) if width_hz >= 3 * step_hz else math.nan,
        float(level_db[peak] - floor_db),
    )
