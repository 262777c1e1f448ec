"""The accuracy bench on small cases: each of its results keeps its shape."""

import csv
import math

import numpy as np
import pytest

from tools.bench import accuracy, disturbance, figures
from tools.bench.cases import SETS, Choice, Setting
from tools.bench.film import Film
from tools.bench.measuring import measure, record
from tools.bench.picture import Bench

SMALL = Bench(distance_m=8.0, angle_deg=30.0, fill=0.3)
"""Discs of 36 pixels, so that a test takes a second."""
FEW = 200
"""Samples: a standard deviation of so many is good to 5 %."""


def one(**changes):
    (result,) = measure(Setting("test", **({"bench": SMALL, "samples": FEW} | changes)))
    return result


def test_whole_frames_reach_the_bound():
    result = one(bench=Bench(8.0, 30.0), amplitude_mm=1.0)
    assert result.samples == FEW
    assert result.bound_percent == pytest.approx(0.088, rel=0.02)
    assert result.error_percent < 0.115
    assert 0.85 < result.over_bound < 1.15
    assert 0.85 < result.over_bound_y < 1.15
    assert 0.91 < result.within_2_sigma < 0.99
    assert (result.flagged_percent, result.lost_percent) == (0, 0)
    assert result.error_percent == pytest.approx(
        100 * result.std_um / 1000 / (result.amplitude_mm / math.sqrt(2)), rel=0.03
    )


def test_the_papers_mean_is_far_from_the_bound_whatever_the_noise():
    results = measure(
        Setting("test", SMALL, methods=("otsu", "smooth"), noises_grey=(1.0, 4.0), samples=100)
    )
    assert [(r.noise_grey, r.method) for r in results] == [
        (1.0, "otsu"),
        (1.0, "smooth"),
        (4.0, "otsu"),
        (4.0, "smooth"),
    ]
    errors = [r.error_percent for r in results]
    assert 0.2 < errors[0] < 0.8
    assert errors[2] == pytest.approx(errors[0], rel=0.4)
    assert errors[3] / errors[1] == pytest.approx(math.hypot(4, 12**-0.5) / 1.04, rel=0.25)
    assert errors[0] > 10 * errors[1]


def test_fields_reach_their_own_bound_and_a_still_marker_shows_no_motion():
    fast = one(sampling="field", frequency_hz=5.0)
    assert fast.bound_percent == pytest.approx(0.0286 * math.sqrt(2), rel=0.03)
    assert 0.85 < fast.over_bound < 1.2
    assert fast.velocity_mm_s == pytest.approx(314.16, rel=1e-4)
    assert fast.flagged_percent < 2
    assert fast.lost_percent == 0
    still = one(sampling="field", frequency_hz=0.0)
    assert math.isnan(still.error_percent)
    assert still.std_um < 1.15 * still.bound_um
    assert still.line_um < 0.5 * still.bound_um
    assert still.line_floor_um == pytest.approx(still.std_um / math.sqrt(FEW), rel=1e-6)


@pytest.mark.parametrize(
    ("changes", "limit"),
    [
        ({"white_grey": 80.0, "fill": 0.3}, 1.2),
        ({"width_px": 640, "pixel_aspect": 1.0, "fill": 0.3}, 1.2),
        ({"roll_deg": 10.0, "fill": 0.3}, 1.2),
        ({"fill": 0.1}, 1.4),
    ],
)
def test_special_pictures_reach_their_own_bounds(changes, limit):
    result = one(bench=Bench(8.0, 30.0, **changes))
    assert 0.8 < result.over_bound < limit
    assert result.lost_percent == 0


def test_truth_is_the_mean_over_the_exposure_and_what_that_costs_is_told():
    setting = Setting(
        "test",
        SMALL,
        amplitude_mm=1.0,
        frequency_hz=5.0,
        exposure_ms=1000 / 60,
        sampling="field",
        samples=120,
    )
    (series,) = record(setting).values()
    t_s, true = np.array(series.t_s), np.array(series.true_mm)
    gain = math.sin(math.pi * 5 / 60) / (math.pi * 5 / 60)
    assert true == pytest.approx(gain * np.sin(2 * np.pi * 5 * t_s), abs=1e-9)
    assert np.diff(t_s) == pytest.approx(np.full(119, 1001 / 60000), abs=1e-6)
    (result,) = measure(setting)
    assert result.exposure_loss_percent == pytest.approx(1.138, abs=0.001)
    assert result.velocity_mm_s == pytest.approx(10 * math.pi, rel=1e-4)


def test_single_causes_of_error_come_out_as_geometry_says():
    tilted = one(tilt_deg=1.0, samples=90)
    # Motion out of the plane by z shifts the picture like x = z tan(angle).
    assert tilted.error_percent == pytest.approx(
        100 * math.sin(math.radians(1)) * math.tan(math.radians(30)), rel=0.05
    )
    along = one(axis_deg=30.0)
    assert 0.8 < along.over_bound < 1.2
    assert 0.8 < along.over_bound_y < 1.2
    late = one(sigma_t_us=1000.0)
    assert late.error_percent == pytest.approx(100 * 2 * math.pi * 1e-3, rel=0.2)
    assert 0.9 < late.within_2_sigma < 1


def test_aruco_corners_are_measured_beside_the_same_bound():
    result = one(bench=Bench(8.0, 30.0), methods=("aruco",), amplitude_mm=1.0, samples=20)
    assert result.lost_percent == 0
    assert 0.3 < result.error_percent < 10
    assert math.isnan(result.within_2_sigma)


def test_nothing_beyond_the_films_windows_is_looked_at(monkeypatch):
    settings = [
        Setting("test", SMALL, methods=("otsu", "smooth"), samples=40),
        Setting("test", SMALL, sampling="field", frequency_hz=5.0, exposure_ms=8.0, samples=40),
    ]
    before = [repr(measure(s)) for s in settings]
    garbage = np.random.default_rng(1).integers(0, 255, (480, 720), np.uint8)
    monkeypatch.setattr(Film, "blank", lambda _: garbage.copy())
    assert [repr(measure(s)) for s in settings] == before


@pytest.fixture
def small_swing(monkeypatch):
    """Less of a way has less of a film to draw."""
    monkeypatch.setattr(disturbance, "AMPLITUDE_MM", 0.5)


@pytest.mark.parametrize("kind", disturbance.KINDS)
def test_a_disturbed_disc_moves_the_marker_by_little(kind, small_swing):
    row = disturbance.trials(kind, "frame", count=4, seed=1)
    assert row.samples == 4 * disturbance.HIT_FRAMES
    assert row.lost_percent == 0
    assert max(row.rms_x_um, row.rms_y_um) < 3
    assert row.flagged_percent > 10
    assert row.silent_beyond_4_sigma <= row.beyond_4_sigma <= 6


def test_a_disturbance_of_fields_goes_with_each_field(small_swing):
    row = disturbance.trials("cut", "field", count=4, seed=1)
    assert row.samples == 4 * 2 * disturbance.HIT_FRAMES
    assert row.flagged_percent == 100
    assert max(row.rms_x_um, row.rms_y_um) < 4


def test_the_papers_set_has_all_its_cases():
    settings = list(SETS["paper"](Choice()))
    cases = {
        (s.bench.distance_m, s.bench.angle_deg, s.amplitude_mm, s.sampling, noise, method)
        for s in settings
        for noise in s.noises_grey
        for method in s.methods
    }
    assert len(cases) == 5 * 5 * 3 * 2 * 3 * 2
    assert min(s.samples for s in settings) == 2000


def test_a_choice_replaces_a_sets_own_values():
    choice = Choice(
        distances_m=(12.0,), angles_deg=(45.0,), noises_grey=(3.0,), methods=("smooth",)
    )
    for name, make in SETS.items():
        for setting in make(choice):
            assert (setting.bench.distance_m, setting.bench.angle_deg) == (12.0, 45.0)
            assert setting.noises_grey == (3.0,)
            assert setting.methods == (("aruco",) if name == "aruco" else ("smooth",))


def test_the_command_writes_rows_table_and_figures(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(figures, "SHOWN_S", 0.4)
    monkeypatch.setattr(figures, "BENCH", SMALL)
    listed, folder = tmp_path / "rows.csv", tmp_path / "figures"
    chosen = "--distance-m 8 --angle-deg 0 60 --amplitude-mm 1 --noise-grey 2 --sampling frame"
    accuracy.main(
        [*chosen.split(), "--samples=12", "--jobs=1", f"--csv={listed}", f"--figures={folder}"]
    )
    with listed.open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 4
    assert [r["method"] for r in rows] == ["otsu", "smooth"] * 2
    assert {r["samples"] for r in rows} == {"12"}
    back = figures.read_csv(listed)
    assert [f"{r.error_percent:.6g}" for r in back] == [r["error_percent"] for r in rows]
    printed = capsys.readouterr().out
    assert "smooth" in printed
    assert "otsu" in printed
    for name in ("figure-3.3", "figure-3.4"):
        assert (folder / f"{name}.png").read_bytes().startswith(b"\x89PNG")
        assert (folder / f"{name}.pdf").read_bytes().startswith(b"%PDF")


@pytest.mark.parametrize(
    ("asked", "told"),
    [
        ("--samples 1", "--samples must be at least 2"),
        ("--noise-grey 2 0", "--noise-grey must be above 0"),
        ("--angle-deg 90", "--angle-deg must be from 0 to below 90"),
        ("--csv nowhere/rows.csv", "there is no folder nowhere; make it first"),
    ],
)
def test_what_makes_no_sense_is_refused_before_anything_is_measured(asked, told, capsys):
    with pytest.raises(SystemExit) as ended:
        accuracy.main(asked.split())
    assert ended.value.code == 2
    assert told in capsys.readouterr().err
