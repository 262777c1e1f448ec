"""The axis and the scale from a recorded stroke."""

from __future__ import annotations

import numpy as np
import pytest

from vdms_rt.measure.axis import (
    StrokeError,
    axis_rotation,
    measure_stroke,
    principal_axis,
    rotate_mm,
)

PERIOD_S = 1001 / 30000


def stroke(
    angle_deg,
    length_mm=60.0,
    noise_mm=0.003,
    slow_s=6.0,
    rest_s=2.0,
    back=False,
    bow_mm=0.0,
    seed=0,
):
    """Times in ns and positions of a smooth way from one rest to another, and back."""
    once_s = 2 * rest_s + slow_s
    t_s = np.arange(0, once_s * (2 if back else 1), PERIOD_S)
    part = np.clip((t_s % once_s - rest_s) / slow_s, 0, 1)
    way = part**3 * (10 - 15 * part + 6 * part**2)
    way = np.where(t_s < once_s, way, 1 - way)
    a = np.radians(angle_deg)
    xy_mm = length_mm * way[:, None] * [np.cos(a), np.sin(a)]
    xy_mm += bow_mm * np.sin(np.pi * way)[:, None] * [-np.sin(a), np.cos(a)] + [3.0, -5.0]
    noise = np.random.default_rng(seed).normal(0, noise_mm, xy_mm.shape)
    return 10**15 + np.round(t_s * 1e9).astype(np.int64), xy_mm + noise


@pytest.mark.parametrize("angle_deg", [0.0, 3.3, -41.0, 89.9, -90.0, 135.0, -179.0])
def test_the_axis_is_positive_from_x_towards_y_and_within_a_half_turn(angle_deg):
    found, sigma = principal_axis(stroke(angle_deg, noise_mm=0.0)[1])
    assert -90 <= found < 90
    assert (found - angle_deg + 90) % 180 - 90 == pytest.approx(0.0, abs=1e-9)
    assert sigma < 1e-9


def test_rotating_puts_x_along_the_axis_and_carries_the_covariance():
    _, xy_mm = stroke(30.0, noise_mm=0.0)
    along, across = rotate_mm(xy_mm[:, 0], xy_mm[:, 1], 30.0)
    assert np.ptp(along) == pytest.approx(60.0)
    assert along[-1] > along[0]
    assert np.ptp(across) < 1e-12
    x, y = rotate_mm(0.0, 2.0, 90.0)
    assert (x, y) == pytest.approx((2.0, 0.0), abs=1e-15)
    r = axis_rotation(90.0)
    assert r @ np.diag([1.0, 4.0]) @ r.T == pytest.approx(np.diag([4.0, 1.0]))


def test_the_errors_of_angle_and_length_are_true():
    angle_off, length_off = [], []
    for seed in range(100):
        found = measure_stroke(*stroke(3.3, seed=seed), 60.0)
        angle_off.append((found.angle_deg - 3.3) / found.sigma_angle_deg)
        length_off.append((found.length_mm - 60.0) / found.sigma_length_mm)
        assert abs(found.length_mm - 60.0) < 0.004
    assert 0.7 < np.sqrt(np.mean(np.square(angle_off))) < 1.4
    assert 0.7 < np.sqrt(np.mean(np.square(length_off))) < 1.6


def test_the_scale_is_true_over_measured():
    t_ns, xy_mm = stroke(-20.0)
    found = measure_stroke(t_ns, xy_mm / 1.01, 60.0)
    assert found.scale == pytest.approx(1.01, abs=4 * found.sigma_scale)
    assert found.sigma_scale == pytest.approx(found.sigma_length_mm / found.length_mm, rel=0.02)
    assert found.rests == 2


def test_to_and_fro_is_one_stroke_with_three_rests():
    found = measure_stroke(*stroke(10.0, back=True), 60.0)
    assert found.rests == 3
    assert found.length_mm == pytest.approx(60.0, abs=0.004)


def test_a_bowed_way_shows_in_the_straightness_and_in_the_error_of_the_angle():
    straight = measure_stroke(*stroke(20.0), 60.0)
    bowed = measure_stroke(*stroke(20.0, bow_mm=0.5), 60.0)
    assert straight.straightness_mm == pytest.approx(0.003, rel=0.2)
    assert bowed.straightness_mm > 0.1
    assert bowed.sigma_angle_deg > 20 * straight.sigma_angle_deg
    assert abs(bowed.angle_deg - 20.0) < 3 * bowed.sigma_angle_deg


def test_a_hum_in_the_rests_widens_the_error_of_the_length():
    t_ns, xy_mm = stroke(0.0)
    slow_hum = 0.01 * np.sin(2 * np.pi * 0.7 * (t_ns - t_ns[0]) / 1e9)
    humming = measure_stroke(t_ns, xy_mm + slow_hum[:, None] * [1.0, 0.0], 60.0)
    assert humming.sigma_length_mm > 2 * measure_stroke(t_ns, xy_mm, 60.0).sigma_length_mm
    assert abs(humming.length_mm - 60.0) < 4 * humming.sigma_length_mm


def harmonic():
    t_s = np.arange(0, 10, PERIOD_S)
    return 10**9 * t_s, np.column_stack([10 * np.sin(6 * t_s), 0 * t_s])


@pytest.mark.parametrize(
    ("recorded", "said"),
    [
        (lambda: tuple(v[:19] for v in stroke(0.0)), "19 samples are no stroke"),
        (lambda: (stroke(0.0)[0], np.ones((300, 2))), "the marker did not move"),
        (lambda: stroke(0.0, length_mm=0.0), r"moved 0\.0\d+ mm in all, which its noise of 0\.003"),
        (harmonic, r"never rested for 0\.5 s"),
        (lambda: tuple(v[:150] for v in stroke(0.0)), "rested at one end alone"),
    ],
)
def test_what_is_no_stroke_is_refused_with_a_sentence(recorded, said):
    with pytest.raises(StrokeError, match=said):
        measure_stroke(*recorded(), 60.0)
