"""The two-sided refit of a record's times."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest

from tools.bench.clock import DRIVERS, Driver, simulate, uniform
from vdms_rt.capture.refit import refit
from vdms_rt.model import NTSC_FRAME_PERIOD_S


@pytest.mark.parametrize("name", DRIVERS)
@pytest.mark.parametrize("frames", [1800, 9000])
def test_every_time_of_a_record_is_right(name: str, frames: int) -> None:
    record = simulate(DRIVERS[name], frames, seed=8)
    error_ns = refit(record.stamps_ns, record.frames, NTSC_FRAME_PERIOD_S) - record.true_ns
    assert error_ns.std() < 50e3
    if name != "1 ms normal":
        assert np.abs(error_ns).max() < 60e3


def test_segments_are_fitted_each_by_itself() -> None:
    first, second = (simulate(Driver(uniform(5)), 1800, seed) for seed in (1, 2))
    stamps_ns = np.concatenate([first.stamps_ns, second.stamps_ns + 10**11 + 7_000_000])
    true_ns = np.concatenate([first.true_ns, second.true_ns + 10**11 + 7_000_000])
    frames = np.concatenate([first.frames, second.frames + 5000])
    segments = np.repeat([0, 1], [len(first.frames), len(second.frames)])
    offset_ns = -25_000_000
    error_ns = refit(stamps_ns, frames, NTSC_FRAME_PERIOD_S, offset_ns, segments) - true_ns
    assert np.abs(error_ns - offset_ns).max() < 80e3


def test_a_quartz_that_warms_up_is_followed() -> None:
    seconds = np.arange(27000) / 30
    period_ns = float(NTSC_FRAME_PERIOD_S * 10**9) * (1 + 3e-6 * np.exp(-seconds / 300))
    true_ns = (10**12 + np.cumsum(period_ns)).astype(np.int64)
    late_ns = np.random.default_rng(1).integers(0, 5_000_000, len(true_ns))
    error_ns = refit(true_ns + late_ns, np.arange(len(true_ns)), NTSC_FRAME_PERIOD_S) - true_ns
    assert error_ns.std() < 50e3


@pytest.mark.parametrize("frames", [1, 2, 3, 10, 63, 64, 65])
def test_short_records(frames: int) -> None:
    record = simulate(Driver(uniform(1), lost=0.0), frames, seed=1)
    times_ns = refit(record.stamps_ns, record.frames, NTSC_FRAME_PERIOD_S)
    assert times_ns.dtype == np.int64
    assert np.abs(times_ns - record.true_ns).max() < 3e6


def test_nothing_gives_nothing() -> None:
    assert len(refit([], [], Fraction(1, 30))) == 0


def test_what_does_not_belong_together_is_refused() -> None:
    with pytest.raises(ValueError, match=r"3 stamps, 2 indices and 2 segments do not belong"):
        refit([1, 2, 3], [0, 1], Fraction(1, 30))
    with pytest.raises(ValueError, match="indices must ascend within a segment"):
        refit([1, 2, 3], [0, 1, 1], Fraction(1, 30))
