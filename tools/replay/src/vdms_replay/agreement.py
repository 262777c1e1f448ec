"""How far a camera and a reference agree, once their clocks do."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from vdms_replay.align import Alignment, Camera, reference_at
from vdms_replay.series import Series

Floats: TypeAlias = NDArray[np.float64]

LONGEST_BLOCK = 2048
BLOCKS = 4
"""Pieces of the series, at least, that a spectrum is the mean of."""
LINES = 12
LINE_PART = 0.01
"""A line is told from this part of the strongest one's amplitude on."""
MOST_FILLED = 0.2
"""Part of the samples that may be missing for a spectrum."""


@dataclass(frozen=True, slots=True)
class Line:
    """What the camera makes of one frequency of the reference."""

    frequency_hz: float
    reference_mm: float
    """Amplitude of a steady sine of the same power."""
    gain: float
    """Camera over reference."""
    phase_deg: float
    """Of the camera against the reference; negative: the camera is late."""
    delay_ms: float
    coherence: float


@dataclass(frozen=True, slots=True)
class Spectrum:
    """Both series' spectra, (n,) each, means over overlapping Hann windows (Welch)."""

    frequency_hz: Floats
    reference_mm2_per_hz: Floats
    camera_mm2_per_hz: Floats
    error_mm2_per_hz: Floats
    coherence: Floats
    filled: int
    """Samples that were missing, at which the error is interpolated."""
    lines: tuple[Line, ...]


@dataclass(frozen=True, slots=True)
class Agreement:
    """Figures over all samples that the reference covers."""

    samples: int
    seconds: float
    error_percent: float
    """Lee, Cho and Sim (2015), Eq. 3.1: std(reference - camera) / std(reference)."""
    rmse_mm: float
    """Root mean square difference, each series about its mean: their zeros are arbitrary."""
    worst_mm: float
    """Largest difference, with its sign (camera - reference)."""
    worst_at_s: float
    """On the recording's clock."""
    peak_to_peak_mm: float
    """Of the reference."""
    peak_to_peak_error_mm: float
    """Of the camera's peak to peak."""
    zero_mm: float
    """Mean of camera - reference."""
    gain: float
    """Slope of the camera over the reference."""
    sigma_gain: float
    drift_mm_per_min: float
    """Slope of the difference over time."""
    sigma_drift_mm_per_min: float
    time_s: Floats
    """Recording's clock, (samples,)."""
    reference_mm: Floats
    """What the camera would see of the reference, about its mean."""
    camera_mm: Floats
    """Along the reference's axis, about its mean."""

    @property
    def difference_mm(self) -> Floats:
        """Camera - reference, about its mean."""
        return self.camera_mm - self.reference_mm


def agreement(camera: Camera, series: Series, alignment: Alignment) -> Agreement:
    """Return the figures with the reference taken at the camera's times."""
    there = reference_at(camera, series, alignment)
    on = np.isfinite(there)
    return _figures(camera.time_s[on], there[on], camera.along(alignment.axis_deg)[on])


def paper_error_percent(camera: Camera, series: Series, alignment: Alignment) -> float:
    """Return Eq. 3.1 as the paper took it: both series at the union of their times, each by linear
    interpolation, whatever lies between the camera's samples."""
    own_s = camera.time_s
    at_s = (series.times_s() - alignment.offset_s) / (1 + alignment.rate)
    begin_s, end_s = max(own_s[0], at_s[0]), min(own_s[-1], at_s[-1])
    union = np.union1d(own_s, at_s)
    union = union[(union >= begin_s) & (union <= end_s)]
    good = series.good
    ldv = alignment.sign * np.interp(union, at_s[good], series.values[good])
    vdms = np.interp(union, own_s, camera.along(alignment.axis_deg))
    return float(100 * np.std(ldv - vdms) / np.std(ldv))


def _figures(time_s: Floats, reference: Floats, camera: Floats) -> Agreement:
    r, c = reference - reference.mean(), camera - camera.mean()
    rest = c - r
    worst = int(np.argmax(np.abs(rest)))
    n = len(r)
    gain = float(c @ r / (r @ r))
    late = time_s - time_s.mean()
    drift = float(rest @ late / (late @ late))
    spread = float(np.std(rest - drift * late))
    return Agreement(
        samples=n,
        seconds=float(np.ptp(time_s)),
        error_percent=float(100 * np.std(rest) / np.std(r)),
        rmse_mm=float(np.sqrt(np.mean(rest**2))),
        worst_mm=float(rest[worst]),
        worst_at_s=float(time_s[worst]),
        peak_to_peak_mm=float(np.ptp(r)),
        peak_to_peak_error_mm=float(np.ptp(c) - np.ptp(r)),
        zero_mm=float(camera.mean() - reference.mean()),
        gain=gain,
        sigma_gain=float(np.std(c - gain * r)) / math.sqrt(float(r @ r)),
        drift_mm_per_min=60 * drift,
        sigma_drift_mm_per_min=60 * spread / math.sqrt(float(late @ late)),
        time_s=time_s,
        reference_mm=r,
        camera_mm=c,
    )


def spectrum(
    camera: Camera, series: Series, alignment: Alignment, found: Agreement
) -> Spectrum | None:
    """Return the spectra of the agreement's series; None where too many samples are missing, or
    there are too few.

    At a missing sample the reference is what it is, and the difference is interpolated.
    """
    step_s = float(np.median(np.diff(found.time_s)))
    places = np.rint(np.cumsum(np.diff(found.time_s, prepend=found.time_s[0])) / step_s)
    every = np.arange(int(places[-1]) + 1)
    filled = len(every) - len(places)
    block = min(LONGEST_BLOCK, 2 ** int(math.log2(max(1, 2 * len(every) // (BLOCKS + 1)))))
    if block < 32 or filled > MOST_FILLED * len(every):
        return None
    time_s = np.interp(every, places, found.time_s)
    grid = Camera(time_s, time_s, time_s, camera.exposure_s, camera.fields_s)
    r = reference_at(grid, series, alignment)
    on = np.isfinite(r)
    r = np.interp(every, every[on], r[on])
    r -= r.mean()
    c = r + np.interp(every, places, found.difference_mm)
    rate_hz = 1 / step_s

    def density(a: Floats, b: Floats) -> NDArray[np.complex128]:
        _, found = signal.csd(a, b, rate_hz, "hann", block)
        return np.asarray(found, np.complex128)

    f = np.asarray(np.fft.rfftfreq(block, step_s), np.float64)
    rr, cc, ee = (density(v, v).real for v in (r, c, c - r))
    rc = density(r, c)
    with np.errstate(divide="ignore", invalid="ignore"):
        coherence = np.where(rr * cc > 0, np.abs(rc) ** 2 / (rr * cc), 0.0)
    lines = _lines(f, rr, rc, coherence)
    return Spectrum(f, rr, cc, ee, coherence, filled, lines)


def _lines(
    f: Floats, rr: Floats, rc: NDArray[np.complex128], coherence: Floats
) -> tuple[Line, ...]:
    step_hz = float(f[1])
    tops, _ = signal.find_peaks(rr)
    lines = []
    # A window of Hann holds no line below its third bin.
    for k in tops[tops > 1].tolist():
        around = slice(max(k - 2, 1), k + 3)
        power = float(rr[around].sum()) * step_hz
        ratio = complex(rc[k] / rr[k])
        frequency_hz = summit(f, rr, k)
        phase_deg = math.degrees(math.atan2(ratio.imag, ratio.real))
        lines.append(
            Line(
                frequency_hz=frequency_hz,
                reference_mm=math.sqrt(2 * power),
                gain=abs(ratio),
                phase_deg=phase_deg,
                delay_ms=-1000 * phase_deg / 360 / frequency_hz,
                coherence=float(coherence[k]),
            )
        )
    largest = max((line.reference_mm for line in lines), default=0.0)
    strong = [line for line in lines if line.reference_mm >= LINE_PART * largest]
    strong.sort(key=lambda line: -line.reference_mm)
    return tuple(sorted(strong[:LINES], key=lambda line: line.frequency_hz))


def summit(f: Floats, density: Floats, k: int) -> float:
    """Return where the parabola through three values of the logarithm is highest."""
    if not 0 < k < len(f) - 1 or density[k - 1 : k + 2].min() <= 0:
        return float(f[k])
    a, b, c = np.log(density[k - 1 : k + 2])
    bend = a - 2 * b + c
    return float(f[k] + (0.0 if bend >= 0 else 0.5 * (a - c) / bend) * f[1])
