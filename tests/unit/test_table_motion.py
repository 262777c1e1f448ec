import math
from pathlib import Path

import numpy as np
import pytest

from vdms_rt.capture.motion_path import STEP_RISE_S, MotionPath, read_record
from vdms_rt.config import Motion, parse_config
from vdms_rt.model import ConfigError, SourceError

REST_S = 2.0


def along(path: MotionPath, times_s: np.ndarray) -> np.ndarray:
    return path.at(times_s)[:, 0]


def record(folder: Path, text: str) -> Motion:
    file = folder / "record.csv"
    file.write_text(text, encoding="utf-8")
    return Motion(kind="record", file=str(file))


@pytest.mark.parametrize("kind", ["still", "harmonic", "sweep", "step"])
def test_every_motion_rests_first_and_begins_where_it_rested(kind: str) -> None:
    path = MotionPath(Motion(kind=kind), REST_S)
    assert np.array_equal(path.at(np.array([-1.0, 0.0, 1.0, REST_S])), np.zeros((4, 2)))
    assert np.abs(path.at(np.array([REST_S + 1e-9]))).max() < 1e-6


def test_a_harmonic_is_a_pure_sine_in_its_direction() -> None:
    path = MotionPath(Motion(amplitude_mm=7.0, frequency_hz=2.5, direction_deg=30.0), REST_S)
    t = np.linspace(0, 3, 200)
    s = 7.0 * np.sin(2 * np.pi * 2.5 * t)
    expected = np.stack([s * math.cos(math.pi / 6), s * math.sin(math.pi / 6)], axis=1)
    assert path.at(REST_S + t) == pytest.approx(expected, abs=1e-9)


def test_a_sweep_takes_equal_time_for_each_octave_and_goes_on_at_its_end() -> None:
    motion = Motion(
        kind="sweep", amplitude_mm=3.0, frequency_hz=1.0, end_frequency_hz=8.0, sweep_s=30.0
    )
    path = MotionPath(motion, 0.0)
    t = np.arange(0, 40, 1e-4)
    x = along(path, t)
    crossings_s = t[1:][(x[:-1] < 0) & (x[1:] >= 0)]
    middles_s = (crossings_s[1:] + crossings_s[:-1]) / 2
    frequencies_hz = 1 / np.diff(crossings_s)
    expected = np.minimum(2 ** (middles_s / 10), 8.0)
    assert frequencies_hz == pytest.approx(expected, rel=0.01)
    assert np.abs(x).max() == pytest.approx(3.0, rel=1e-4)


def test_a_sweep_may_go_down_or_stay() -> None:
    down = MotionPath(Motion(kind="sweep", frequency_hz=8.0, end_frequency_hz=1.0), 0.0)
    crossings_s = np.flatnonzero(np.diff(np.sign(along(down, np.linspace(70, 80, 10001)))))
    assert len(crossings_s) == 20
    level = Motion(kind="sweep", frequency_hz=2.0, end_frequency_hz=2.0)
    t = np.linspace(0, 80, 999)
    same = along(MotionPath(Motion(frequency_hz=2.0), 0.0), t)
    assert along(MotionPath(level, 0.0), t) == pytest.approx(same, abs=1e-9)


def test_a_step_rises_without_a_jump_and_stays() -> None:
    path = MotionPath(Motion(kind="step", amplitude_mm=4.0), REST_S)
    t = REST_S + np.linspace(-0.01, STEP_RISE_S + 0.01, 1201)
    x = along(path, t)
    velocity = np.gradient(x, t)
    acceleration = np.gradient(velocity, t)
    assert (np.diff(x) >= 0).all()
    assert x[-1] == 4.0
    assert np.abs(np.diff(velocity)).max() < 0.01 * velocity.max()
    assert np.abs(np.diff(acceleration)).max() < 0.05 * acceleration.max()
    assert along(path, np.array([99.0]))[0] == 4.0


def test_a_record_is_followed_smoothly_from_its_first_row_to_its_last(tmp_path: Path) -> None:
    t = np.arange(0, 4.0001, 0.02)
    x = 5 + 8 * np.sin(2 * np.pi * 1.5 * t) ** 3
    y = 2 - 3 * np.sin(2 * np.pi * 0.5 * t) ** 2
    rows = "".join(f"{a + 10:.6f},{c:.9f},{b:.9f}\n" for a, b, c in zip(t, x, y, strict=True))
    path = MotionPath(record(tmp_path, "time_s,y_mm,x_mm\n" + rows), REST_S)
    fine = np.linspace(0, 4, 3001)
    expected = np.stack(
        [8 * np.sin(2 * np.pi * 1.5 * fine) ** 3, -3 * np.sin(2 * np.pi * 0.5 * fine) ** 2], axis=1
    )
    assert path.at(REST_S + fine) == pytest.approx(expected, abs=2e-3)
    assert path.at(REST_S + t) == pytest.approx(np.stack([x - x[0], y - y[0]], axis=1), abs=1e-8)
    assert np.abs(path.at(np.array([0.0, REST_S]))).max() == 0
    assert path.at(np.array([50.0]))[0] == pytest.approx((x[-1] - x[0], y[-1] - y[0]), abs=1e-8)
    assert path.reach_mm == pytest.approx(np.hypot(x - x[0], y - y[0]).max(), abs=1e-6)
    slopes = np.diff(path.at(REST_S + np.linspace(1, 3, 20001)), axis=0) / 1e-4
    assert np.abs(np.diff(slopes, axis=0)).max() < 0.5


def test_a_record_of_two_rows_and_without_y_is_enough(tmp_path: Path) -> None:
    path = MotionPath(record(tmp_path, " time_s , x_mm \n0,1\n\n1,3\n"), 0.0)
    assert path.at(np.array([0.0, 0.5, 2.0])) == pytest.approx(np.array([[0, 0], [1, 0], [2, 0]]))


BAD = {
    "": "the columns are missing; the first line must be time_s,x_mm or time_s,x_mm,y_mm",
    "t,x\n0,0\n": "the columns are t, x; the first line must be time_s,x_mm or time_s,x_mm,y_mm",
    "time_s,x_mm,z_mm\n0,0,0\n": "the columns are time_s, x_mm, z_mm; ",
    "time_s,x_mm\n": "0 rows of numbers; a record needs at least 2 below its header",
    "time_s,x_mm\n0,0\n": "1 rows of numbers; ",
    "time_s,x_mm\n0,0\n1,0\n\n1,3\n": "line 5: time_s = 1 comes after 1; times must rise",
    "time_s,x_mm\n0,0\n0.1,abc\n": "line 3: '0.1,abc' must be 2 numbers, one for each column",
    "time_s,x_mm\n0,0\n0.1\n": "line 3: '0.1' must be 2 numbers",
    "time_s,x_mm\n0,0\n0.1,nan\n": "line 3: '0.1,nan' must be 2 numbers",
}


@pytest.mark.parametrize(("text", "sentence"), BAD.items())
def test_a_bad_record_gets_one_sentence(text: str, sentence: str, tmp_path: Path) -> None:
    motion = record(tmp_path, text)
    with pytest.raises(SourceError) as error:
        MotionPath(motion, 0.0)
    assert str(error.value).startswith(f"{motion.file}: {sentence}")
    assert "\n" not in str(error.value)


def test_a_record_that_is_not_there_or_not_text_gets_one_sentence(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match=r"gone\.csv: cannot read the record .*No such file"):
        read_record(tmp_path / "gone.csv")
    (tmp_path / "raw.csv").write_bytes(b"time_s,x_mm\n\xff\xfe")
    with pytest.raises(SourceError, match=r"raw\.csv: cannot read the record .*not UTF-8 text"):
        read_record(tmp_path / "raw.csv")


def test_the_configuration_wants_a_file_for_a_record() -> None:
    with pytest.raises(ConfigError, match=r'kind = "record" needs file'):
        parse_config('[table.motion]\nkind = "record"\n', "a.toml")


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ('[[table.sheet]]\n[[table.sheet]]\nmarker = "m1"', "sheet hangs marker m1 twice"),
        ("[table]\nexposure_ms = 35.0", "exposure_ms = 35 must be shorter than the frame period"),
        (
            "[table]\nframe_rate_hz = 60\nstamp_jitter_ms = 18.0",
            r"stamp_jitter_ms = 18 must be shorter than the frame period, 16\.67 ms",
        ),
    ],
)
def test_the_configuration_refuses_an_impossible_table(text: str, sentence: str) -> None:
    with pytest.raises(ConfigError, match=sentence):
        parse_config(text, "a.toml")


@pytest.mark.parametrize(
    "motion",
    [
        Motion(frequency_hz=5.0, direction_deg=50.0),
        Motion(frequency_hz=60.0),
        Motion(kind="sweep", frequency_hz=1.0, end_frequency_hz=20.0, sweep_s=0.3),
        Motion(kind="step"),
    ],
    ids=lambda motion: f"{motion.kind} {motion.frequency_hz:g} Hz",
)
@pytest.mark.parametrize("begin_s", [1.99, 2.0, 2.0777, 2.29])
def test_the_mean_is_the_integral_over_the_exposure(motion: Motion, begin_s: float) -> None:
    path = MotionPath(motion, REST_S)
    t = begin_s + 0.03 * (np.arange(200000) + 0.5) / 200000
    assert path.mean(begin_s, begin_s + 0.03) == pytest.approx(path.at(t).mean(axis=0), abs=1e-7)


def test_the_mean_of_a_harmonic_is_its_closed_form() -> None:
    path = MotionPath(Motion(amplitude_mm=10.0, frequency_hz=1.0), 0.0)
    w, begin_s, end_s = 2 * math.pi, 0.3, 0.3 + 1 / 60
    mean = 10 * (math.cos(w * begin_s) - math.cos(w * end_s)) / (w * (end_s - begin_s))
    assert path.mean(begin_s, end_s)[0] == pytest.approx(mean, abs=1e-12)
    assert path.mean(0.3, 0.3)[0] == pytest.approx(10 * math.sin(w * 0.3), abs=1e-12)
