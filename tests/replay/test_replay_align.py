"""Bringing a reference's clock and the camera's together, on series that are known."""

from __future__ import annotations

import math

import numpy as np
import pytest

from vdms_replay.agreement import agreement, spectrum
from vdms_replay.align import AlignError, Camera, Wanted, align
from vdms_replay.series import Series, SeriesError

RATE_HZ = 60 / 1.001


def shaken(time_s: np.ndarray) -> np.ndarray:
    """A motion that never repeats, in mm."""
    parts = [(4.0, 0.71, 0.1), (3.0, 1.917, 1.0), (1.0, 3.3313, 2.0), (0.3, 7.73, 0.4)]
    return sum(a * np.sin(2 * np.pi * f * time_s + p) for a, f, p in parts)


def reference(motion=shaken, begin_s=-1.0, seconds=25.0, rate_hz=6000.0, ppm=0.0) -> Series:
    """By a clock that shows 7.5 s at the camera's zero."""
    clock_s = 7.5 + begin_s + np.arange(int(seconds * rate_hz)) / rate_hz
    return Series(float(clock_s[0]), 1 / rate_hz, motion((clock_s - 7.5) / (1 + ppm * 1e-6)))


def camera(motion=shaken, axis_deg=0.0, noise_mm=1e-3, exposure_s=0.0, samples=1200) -> Camera:
    random = np.random.default_rng(3)
    time_s = np.arange(samples) / RATE_HZ
    lit_s = exposure_s * ((np.arange(200) + 0.5) / 200 - 0.5)
    seen = np.array([motion(t + lit_s).mean() for t in time_s]) if exposure_s else motion(time_s)
    angle = math.radians(axis_deg)
    noise = random.normal(0, noise_mm, (2, samples))
    return Camera(
        time_s, seen * math.cos(angle) + noise[0], seen * math.sin(angle) + noise[1], exposure_s
    )


@pytest.mark.parametrize("rate_hz", [100.0, 1000.0, 51200.0])
def test_the_offset_is_found_at_any_rate_of_the_reference(rate_hz: float) -> None:
    found = align(camera(), reference(rate_hz=rate_hz), Wanted())
    assert found.offset_s == pytest.approx(7.5, abs=5e-6)
    assert found.sigma_offset_s < 5e-6
    assert math.isnan(found.other_offset_s)


@pytest.mark.parametrize("begin_s", [-300.0, 6.0, -4.0])
def test_the_two_need_not_begin_or_end_together(begin_s: float) -> None:
    seconds = 600.0 if begin_s < -100 else 12.0 if begin_s > 0 else 18.0
    found = align(camera(), reference(begin_s=begin_s, seconds=seconds, rate_hz=1000), Wanted())
    assert found.offset_s == pytest.approx(7.5, abs=1e-5)


def test_the_clock_rate_is_found_on_request() -> None:
    series = reference(ppm=-120.0)
    assert align(camera(), series, Wanted()).rate_if_found == pytest.approx(-120e-6, abs=2e-6)
    found = align(camera(), series, Wanted(clock_rate=True))
    assert found.rate == pytest.approx(-120e-6, abs=2e-6)
    assert found.offset_s == pytest.approx(7.5, abs=1e-5)


def test_a_reference_that_counts_the_other_way() -> None:
    other_way = reference(lambda t: -shaken(t))
    assert align(camera(), other_way, Wanted()).mirrored
    found = align(camera(), other_way, Wanted(sign=True))
    assert (found.sign, found.mirrored) == (-1, False)
    assert agreement(camera(), other_way, found).gain == pytest.approx(1, abs=1e-4)


@pytest.mark.parametrize("axis_deg", [30.0, -75.0, 160.0])
def test_the_axis_is_found_on_request(axis_deg: float) -> None:
    found = align(camera(axis_deg=axis_deg), reference(), Wanted(axis=True))
    assert found.axis_deg == pytest.approx(axis_deg, abs=0.01)
    both = align(camera(axis_deg=axis_deg), reference(), Wanted(axis=True, sign=True))
    assert -90 < both.axis_deg <= 90
    assert both.sign == (-1 if abs(axis_deg) > 90 else 1)


def test_the_exposure_is_taken_into_the_reference() -> None:
    exposed = camera(exposure_s=1 / 60, noise_mm=1e-5)
    found = align(exposed, reference(), Wanted())
    assert agreement(exposed, reference(), found).error_percent < 5e-4
    sharp = Camera(exposed.time_s, exposed.x_mm, exposed.y_mm, 0.0)
    assert agreement(sharp, reference(), found).error_percent > 0.1


def sine(time_s: np.ndarray) -> np.ndarray:
    return 10 * np.sin(2 * np.pi * time_s)


def test_a_motion_that_repeats_leaves_a_choice_which_is_told_and_can_be_made() -> None:
    series = reference(sine)
    found = align(camera(sine), series, Wanted())
    assert not math.isnan(found.other_offset_s)
    assert (found.offset_s - 7.5) % 1 == pytest.approx(0, abs=1e-5) or (
        found.offset_s - 7.5
    ) % 1 == pytest.approx(1, abs=1e-5)
    near = align(camera(sine), series, Wanted(offset_s=7.7))
    assert near.offset_s == pytest.approx(7.5, abs=1e-5)
    assert math.isnan(near.other_offset_s)


def test_an_offset_that_is_known_is_taken_as_it_is() -> None:
    found = align(camera(), reference(), Wanted(offset_s=7.501, within_s=0))
    assert (found.offset_s, found.sigma_offset_s) == (7.501, 0)


def test_what_has_nothing_in_common_is_refused() -> None:
    noise = np.random.default_rng(1).normal(0, 1, 30000)
    with pytest.raises(AlignError, match="no common motion"):
        align(camera(), Series(0.0, 1e-3, noise), Wanted())
    with pytest.raises(AlignError, match="3 valid samples are too few"):
        align(camera(samples=3), reference(), Wanted())


def test_values_that_are_missing_in_the_reference_cost_only_what_needs_them() -> None:
    series = reference()
    values = series.values.copy()
    values[60000:60600] = np.nan
    holed = Series(series.start_s, series.step_s, values)
    found = align(camera(), holed, Wanted())
    assert found.offset_s == pytest.approx(7.5, abs=1e-5)
    assert 1190 <= found.overlap < 1200


def test_gain_and_delay_at_each_frequency() -> None:
    late_s = 2e-3
    weak = camera(lambda t: 0.99 * shaken(t - late_s), noise_mm=1e-4)
    fixed = align(weak, reference(), Wanted(offset_s=7.5, within_s=0))
    found = agreement(weak, reference(), fixed)
    lines = spectrum(weak, reference(), fixed, found).lines
    assert [round(line.frequency_hz, 1) for line in lines] == [0.7, 1.9, 3.3, 7.7]
    for line, amplitude_mm in zip(lines, (4.0, 3.0, 1.0, 0.3), strict=True):
        assert line.reference_mm == pytest.approx(amplitude_mm, rel=0.05)
        assert line.gain == pytest.approx(0.99, abs=2e-3)
        assert line.delay_ms == pytest.approx(2.0, abs=0.05)
        assert line.coherence > 0.999
    assert found.gain == pytest.approx(0.99, abs=2e-3)


def test_samples_that_are_missing_do_not_bend_the_spectrum() -> None:
    whole = camera(noise_mm=1e-4)
    kept = np.random.default_rng(2).random(1200) > 0.05
    holed = Camera(whole.time_s[kept], whole.x_mm[kept], whole.y_mm[kept])
    found = align(holed, reference(), Wanted())
    spectra = spectrum(holed, reference(), found, agreement(holed, reference(), found))
    assert spectra.filled == 1200 - kept.sum()
    assert all(line.gain == pytest.approx(1, abs=1e-3) for line in spectra.lines)


def test_a_drift_is_told() -> None:
    still = camera()
    drifting = Camera(still.time_s, still.x_mm + 0.01 * still.time_s / 60, still.y_mm)
    found = agreement(drifting, reference(), align(drifting, reference(), Wanted()))
    assert found.drift_mm_per_min == pytest.approx(0.01, abs=5 * found.sigma_drift_mm_per_min)
    assert found.sigma_drift_mm_per_min < 1e-3


@pytest.mark.parametrize("width_s", [0.0, 0.3e-3, 1 / 60])
@pytest.mark.parametrize("rate_hz", [200.0, 6000.0])
def test_the_mean_of_a_series_about_a_time(width_s: float, rate_hz: float) -> None:
    at_s = np.arange(0, 10, 1 / rate_hz)
    series = Series(3.0, 1 / rate_hz, 100 + np.sin(2 * np.pi * 5 * at_s))
    asked_s = np.random.default_rng(1).uniform(3.1, 12.9, 300)
    true = 100 + np.sin(2 * np.pi * 5 * (asked_s - 3)) * np.sinc(5 * width_s)
    assert series.mean_about(asked_s, width_s) == pytest.approx(true, abs=2e-5)
    assert np.isnan(series.mean_about(np.array([2.9, 3.0, 13.0]), width_s)).all()


def test_a_series_needs_values() -> None:
    with pytest.raises(SeriesError, match="3 values are too few"):
        Series(0.0, 1.0, np.arange(3.0))
