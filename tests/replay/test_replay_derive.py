"""What is derived from a recording: against motions whose derivatives are known."""

from __future__ import annotations

import math

import numpy as np
import pandas as pd
import pytest
import pyuff
from replaying import PERIOD_NS, START_UTC_NS, write_recording

from vdms_replay import signals
from vdms_replay.cli import run
from vdms_replay.derive import Recipe, derive
from vdms_replay.load import read
from vdms_replay.signals import Stretch
from vdms_rt.wire import vdms_pb2 as pb

W = 2 * math.pi
AMPLITUDE_MM = 10.0


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """Ten seconds of 10 mm at 1 Hz, a picture lost at 200 and twelve at 300."""
    path = write_recording(
        tmp_path_factory.mktemp("derive") / "a.mcap",
        range(600),
        lost=[200, *range(300, 312)],
        status={400: pb.NOT_FOUND},
    )
    return read(path)


def middle(table, name, margin_s=0.3):
    """Times and values away from the ends of the stretches."""
    time_s = table["time_s"].to_numpy()
    ends = time_s[np.flatnonzero(np.diff(time_s) > 0.05)]
    keep = (time_s > margin_s) & (time_s < time_s[-1] - margin_s)
    for end in ends:
        keep &= (time_s < end - margin_s) | (time_s > end + 0.25 + margin_s)
    return time_s[keep], table[name].to_numpy()[keep]


def test_even_steps_are_the_motion_itself_and_gaps_stay_gaps(recording):
    table = derive(recording, Recipe(rate_hz=50))
    time_s = table["time_s"].to_numpy()
    np.testing.assert_allclose(time_s, np.rint(time_s * 50) / 50, atol=1e-9)
    np.testing.assert_allclose(table["x_mm"], AMPLITUDE_MM * np.sin(W * time_s), atol=5e-3)
    gap = (300 * PERIOD_NS / 1e9, 311 * PERIOD_NS / 1e9)
    assert not ((time_s > gap[0]) & (time_s < gap[1])).any()
    assert len(table) > 480
    assert (table["utc_ns"] - START_UTC_NS - np.rint(time_s * 1e9)).abs().max() == 0
    assert table["utc"].iloc[0].value == table["utc_ns"].iloc[0]
    told = table.attrs["derived"][0]
    assert "on even steps at 50 Hz" in told
    assert "2 gaps of up to 0.04171 s are bridged" in told
    assert "part it into 2 stretches" in told


def test_without_a_rate_the_samples_keep_their_places(recording):
    table = derive(recording, Recipe())
    step_s = PERIOD_NS / 1e9
    assert table.attrs["rate_hz"] == pytest.approx(1 / step_s, rel=1e-12)
    samples = recording.samples[recording.samples["valid"]]
    place = np.rint(table["time_s"] / step_s).astype(int)
    measured = dict(zip(samples["seq"], samples["x_mm"], strict=True))
    for seq, x_mm in zip(place, table["x_mm"], strict=True):
        if seq in measured:
            assert x_mm == pytest.approx(measured[seq], abs=1e-9)
    assert {200, 400} <= set(place)
    assert set(place).isdisjoint(range(300, 312))


def test_velocity_and_acceleration_are_those_of_a_sine(recording):
    table = derive(recording, Recipe(velocity=True, acceleration=True, window=9, degree=6))
    time_s, velocity = middle(table, "x_velocity_mm_per_s")
    assert len(time_s) > 400
    truth = AMPLITUDE_MM * W * np.cos(W * time_s)
    assert np.abs(velocity - truth).max() < 1e-3 * AMPLITUDE_MM * W
    time_s, acceleration = middle(table, "x_acceleration_mm_per_s2")
    truth = -AMPLITUDE_MM * W**2 * np.sin(W * time_s)
    assert np.abs(acceleration - truth).max() < 1e-3 * AMPLITUDE_MM * W**2


@pytest.mark.parametrize("times", [1, 2])
def test_the_stated_response_of_a_derivative_is_what_it_does(times):
    step_s = 1 / 60
    does = signals.response(times, 9, 4, step_s)
    time_s = np.arange(6000) * step_s
    for frequency_hz, ratio in ((does.accurate_hz, 0.99), (does.cutoff_hz, math.sqrt(0.5))):
        omega = W * frequency_hz
        stretch = Stretch(0.0, step_s, np.sin(omega * time_s)[:, None])
        found = signals.derived(stretch, times, 9, 4)[100:-100, 0]
        gain = found.std() / (omega**times * math.sqrt(0.5))
        assert gain == pytest.approx(ratio, abs=0.005)
    noise = np.random.default_rng(5).normal(0, 1, (100_000, 1))
    found = signals.derived(Stretch(0.0, step_s, noise), times, 9, 4)
    assert found[50:-50].std() == pytest.approx(does.noise_gain, rel=0.02)


def test_a_filter_halves_at_its_edges_keeps_the_band_and_shifts_nothing():
    step_s = 1 / 60
    time_s = np.arange(12_000) * step_s

    def through(frequency_hz, low_hz, high_hz):
        wave = np.sin(W * frequency_hz * time_s)
        stretch = Stretch(0.0, step_s, wave[:, None])
        found = signals.filtered(stretch, low_hz, high_hz, 4).values[3000:-3000, 0]
        wave = wave[3000:-3000]
        return found @ wave / (wave @ wave)

    for low_hz, high_hz in ((2.0, 6.0), (None, 6.0), (2.0, None)):
        assert through(3.5, low_hz, high_hz) == pytest.approx(1, abs=0.02)
        if low_hz:
            assert through(2.0, low_hz, high_hz) == pytest.approx(0.5, abs=0.01)
            assert abs(through(0.5, low_hz, high_hz)) < 0.001
        if high_hz:
            assert through(6.0, low_hz, high_hz) == pytest.approx(0.5, abs=0.01)
            assert abs(through(20, low_hz, high_hz)) < 0.001


def test_resampling_below_the_own_rate_lets_nothing_alias(tmp_path):
    time_s = np.arange(3000) / 60
    values = np.sin(W * 1.0 * time_s) + np.sin(W * 18.0 * time_s)
    (stretch,) = signals.evenly(time_s, values[:, None], 20.0, 1.0)
    found, truth = stretch.values[100:-100, 0], np.sin(W * stretch.times_s())[100:-100]
    assert np.abs(found - truth).max() < 2e-3


def test_mean_and_line_are_taken_off():
    stretch = Stretch(0.0, 0.1, np.column_stack([np.arange(50) * 2.0 + 7, np.full(50, 3.0)]))
    assert np.abs(signals.detrended(stretch, "line").values).max() < 1e-12
    less_mean = signals.detrended(stretch, "mean").values
    assert np.abs(less_mean.mean(axis=0)).max() < 1e-12
    assert less_mean[-1, 0] - less_mean[0, 0] == pytest.approx(98)


def test_modes_of_a_damped_oscillator_under_noise():
    rate_hz, natural_hz, damping = 60.0, 4.0, 0.03
    omega = W * natural_hz
    poles = -damping * omega + 1j * omega * math.sqrt(1 - damping**2)
    z = np.exp(poles / rate_hz)
    chance = np.random.default_rng(11).normal(0, 1, 120_000)
    from scipy.signal import lfilter

    motion = lfilter([1.0], [1.0, -2 * z.real, abs(z) ** 2], chance)
    stretch = Stretch(0.0, 1 / rate_hz, motion[:, None])
    found, step_hz = signals.modes([stretch], 0, 0.03, 12.0)
    assert step_hz == pytest.approx(0.03, rel=0.01)
    assert found[0].frequency_hz == pytest.approx(natural_hz, rel=0.01)
    assert found[0].damping == pytest.approx(damping, rel=0.2)
    assert math.isnan(signals.modes([stretch], 0, 0.5, 6.0)[0][0].damping)


def test_the_amplitude_of_a_steady_sine_is_told():
    time_s = np.arange(6000) / 60
    noise = np.random.default_rng(2).normal(0, 0.01, 6000)
    wave = 3.0 * np.sin(W * 2.5 * time_s) + noise
    found, _ = signals.modes([Stretch(0.0, 1 / 60, wave[:, None])], 0, None, 12.0)
    assert len(found) == 1
    assert found[0].frequency_hz == pytest.approx(2.5, abs=0.005)
    assert found[0].amplitude == pytest.approx(3.0, rel=0.05)
    assert math.isnan(found[0].damping)


def test_the_verb_writes_a_file_that_says_what_was_done(recording, tmp_path, capsys):
    (path,) = recording.paths
    out = tmp_path / "v.csv"
    order = ["derive", str(path), "--to", "csv", "--out", str(out), "--velocity", "--modes"]
    assert run([*order, "--detrend", "mean", "--high-pass", "0.2", "--low-pass", "12"]) == 0
    told = capsys.readouterr().out
    for text in ("1.00", "Savitzky-Golay", "band-pass 0.2 Hz to 12 Hz", "less the mean"):
        assert text in told
    table = pd.read_csv(out, comment="#")
    assert "x_velocity_mm_per_s" in table
    header = out.read_text().split("time_s,")[0]
    assert "Butterworth of order 4, forwards and backwards" in header
    assert '"x_velocity_mm_per_s": "mm/s"' in header


def test_velocity_as_uff58_in_si(recording, tmp_path):
    (path,) = recording.paths
    out = tmp_path / "v.uff"
    order = ["derive", str(path), "--to", "uff58", "--out", str(out), "--velocity", "--si"]
    assert run([*order, "--resample", "50"]) == 0
    units, *sets = pyuff.UFF(str(out)).read_sets()
    assert (units["units_code"], units["length"]) == (1, 1.0)
    velocities = [one for one in sets if one["ordinate_spec_data_type"] == 11]
    assert {one["rsp_dir"] for one in velocities} == {1, 2, 6}
    first = next(one for one in velocities if one["rsp_dir"] == 1)
    assert first["ordinate_axis_units_lab"].strip() == "m/s"
    assert np.abs(first["data"]).max() == pytest.approx(AMPLITUDE_MM * W / 1000, rel=0.02)
    assert first["abscissa_inc"] == 0.02


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ([], "nothing to do"),
        (["--modes", "--low-pass", "31"], "between 0 and 29.970 Hz"),
        (["--modes", "--high-pass", "6", "--low-pass", "5"], "edges must rise"),
        (["--modes", "--window", "4"], "--window must be odd"),
        (["--modes", "--resolution", "0.001"], "do not fit"),
        (["--modes", "--marker", "m7"], "has no marker m7"),
    ],
)
def test_what_cannot_be_done_is_said_in_a_sentence(recording, options, match, capsys):
    assert run(["derive", str(recording.paths[0]), *options]) == 1
    error = capsys.readouterr().err
    assert match in error
    assert error.count("\n") == 1


def test_too_few_samples(tmp_path, capsys):
    path = write_recording(tmp_path / "a.mcap", range(3))
    assert run(["derive", str(path), "--modes"]) == 1
    assert "3 valid samples" in capsys.readouterr().err


def test_stretches_too_short_for_a_filter_are_left_out_and_said(tmp_path):
    path = write_recording(
        tmp_path / "a.mcap", range(400), lost=[*range(300, 312), *range(320, 332)]
    )
    for recipe in (Recipe(high_hz=5.0, order=8), Recipe(rate_hz=30)):
        table = derive(read(path), recipe)
        between_s = (312 * PERIOD_NS / 1e9, 319 * PERIOD_NS / 1e9)
        assert not table["time_s"].between(*between_s).any()
        assert (table["time_s"] > between_s[1]).sum() > 30
        assert "8 of 376 samples lie in stretches too short for this" in table.attrs["derived"][-1]
