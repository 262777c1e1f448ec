"""What the last poses tell of the next one, and of the motion now."""

import math

import numpy as np
import pytest

from vdms_rt.process.track import MOST_POSES, Track

STEP_NS = 16_683_333


def harmonic(t_ns: int, frequency_hz: float) -> tuple[float, float, float]:
    w = 2 * math.pi * frequency_hz
    t = t_ns / 1e9
    return 10 * math.sin(w * t), 10 * w * math.cos(w * t), -10 * w * w * math.sin(w * t)


def track_of(times_ns: list[int], frequency_hz: float) -> Track:
    track = Track()
    for t_ns in times_ns:
        track = track.with_pose(t_ns, (harmonic(t_ns, frequency_hz)[0], 0.0, 0.0))
    return track


@pytest.mark.parametrize("start_step", range(12))
def test_a_harmonic_of_5_hz_is_foretold_within_a_gate(start_step):
    times = [(start_step + n) * STEP_NS for n in range(MOST_POSES + 1)]
    course = track_of(times[:-1], 5).ahead(times[-1])
    x_mm, velocity, _ = harmonic(times[-1], 5)
    assert course.pose[0] == pytest.approx(x_mm, abs=0.4)
    assert course.velocity[0] == pytest.approx(velocity, abs=40)
    assert course.slack_px == 0


@pytest.mark.parametrize("start_step", range(12))
def test_the_motion_now_is_known_well_enough_for_the_mean_over_an_exposure(start_step):
    times = [(start_step + n) * STEP_NS for n in range(MOST_POSES + 1)]
    x_mm, velocity, acceleration = harmonic(times[-1], 5)
    course = track_of(times[:-1], 5).now(times[-1], (x_mm, 0.0, 0.0))
    assert course.velocity[0] == pytest.approx(velocity, abs=2.5)
    # Of 9870 mm/s^2.
    assert course.acceleration[0] == pytest.approx(acceleration, abs=310)
    assert abs(course.acceleration[0] - acceleration) <= abs(course.doubt[0]) + 150


def test_noise_is_not_carried_on_where_there_is_no_motion():
    """A table that goes far along x says nothing of y and the rotation."""
    rng = np.random.default_rng(1)
    track, foretold = Track(), []
    for n in range(400):
        y, rotation = rng.standard_normal(2).tolist()
        foretold.append(track.ahead(n * STEP_NS).pose[1:])
        track = track.with_pose(n * STEP_NS, (harmonic(n * STEP_NS, 5)[0], y, rotation))
    # Seven terms of noise would scatter by its 60-fold; three do by its 4.4-fold.
    assert np.std(foretold[10:], axis=0) == pytest.approx((5, 5), abs=2)


def test_a_blow_does_not_upset_the_forecast():
    times = [n * STEP_NS for n in range(MOST_POSES + 2)]
    track = Track()
    for t_ns in times[:-2]:
        track = track.with_pose(t_ns, (0.0, 0.0, 0.0))
    hit = track.with_pose(times[-2], (3.0, 0.0, 0.0)).ahead(times[-1])
    # A series that went on would ask for 7 x 3 mm.
    assert abs(hit.pose[0]) <= 9.0
    now = track.now(times[-2], (3.0, 0.0, 0.0))
    assert abs(now.doubt[0]) >= 3.0 / (STEP_NS / 1e9) ** 2


@pytest.mark.parametrize("gap", [2, 3, 5, 8])
def test_after_a_gap_the_forecast_does_not_run_away(gap):
    times = [n * STEP_NS for n in range(MOST_POSES)]
    after = times[-1] + gap * STEP_NS
    course = track_of(times, 1).ahead(after)
    assert course.pose[0] == pytest.approx(harmonic(after, 1)[0], abs=0.02 * (gap + 1) ** 3)


def test_times_that_go_back_are_left_out():
    track = Track()
    for n in (0, 2, 1, 4, 3, 6, 5):
        track = track.with_pose(n * STEP_NS, (float(n), 0.0, 0.0))
    course = track.ahead(7 * STEP_NS)
    assert math.isfinite(course.pose[0])
    assert track.now(7 * STEP_NS, (7.0, 0.0, 0.0)).velocity[0] > 0


def test_old_poses_say_nothing():
    track = track_of([n * STEP_NS for n in range(MOST_POSES)], 1)
    last = track.poses[-1]
    course = track.ahead(last[0] + 300_000_000)
    assert course.pose == last[1]
    assert course.velocity == (0.0, 0.0, 0.0)
    assert course.slack_px > 0
    assert Track().ahead(5).pose == (0.0, 0.0, 0.0)
