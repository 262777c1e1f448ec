"""Rigid motion from circles that carry their own covariances."""

from __future__ import annotations

import math

import numpy as np
import pytest

from vdms_rt.measure import rigid

SQUARE = np.array([(-60.0, 60.0), (60.0, 60.0), (-60.0, -60.0), (60.0, -60.0)])
ALL = np.ones(4, bool)


def spreads(covariances):
    return [(c[0, 0], c[0, 1], c[1, 1]) for c in covariances]


def rigid_motion(reference, now, covariances, good, **more):
    return rigid.rigid_motion(
        reference.tolist(), now.tolist(), spreads(covariances), good.tolist(), **more
    )


def agreeing_motion(reference, now, covariances, good, limit):
    return rigid.agreeing_motion(
        reference.tolist(), now.tolist(), spreads(covariances), good.tolist(), limit
    )


def matrix(covariance):
    """Return a covariance of (x, y) or (x, y, rotation) as a matrix."""
    n = 2 if len(covariance) == 3 else 3
    full = np.zeros((n, n))
    full[np.triu_indices(n)] = covariance
    return full + np.triu(full, 1).T


def moved(reference_mm, x_mm, y_mm, rotation_mrad):
    centre = reference_mm.mean(axis=0)
    c, s = math.cos(rotation_mrad / 1000), math.sin(rotation_mrad / 1000)
    return (reference_mm - centre) @ np.array([[c, s], [-s, c]]) + centre + (x_mm, y_mm)


def even(sigma_mm, n=4):
    return np.tile(sigma_mm**2 * np.eye(2), (n, 1, 1))


@pytest.mark.parametrize("pose", [(0, 0, 0), (10, -3, 0), (-0.2, 0.1, 25), (30, 5, -400)])
def test_exact_circles_give_their_motion(pose):
    motion = rigid_motion(SQUARE, moved(SQUARE, *pose), even(0.001), ALL)
    assert (motion.x_mm, motion.y_mm, motion.rotation_mrad) == pytest.approx(pose, abs=1e-6)
    assert motion.residual_mm < 1e-6


def test_counter_clockwise_is_positive():
    turned = np.array([(-60.0, -60.0), (-60.0, 60.0), (60.0, -60.0), (60.0, 60.0)])
    motion = rigid_motion(SQUARE, moved(SQUARE, 0, 0, 500), even(0.001), ALL)
    assert motion.rotation_mrad > 0
    assert np.allclose(moved(SQUARE, 0, 0, 500 * math.pi), turned)


def test_three_circles_give_the_displacement_of_the_mean_of_four():
    now = moved(SQUARE, 4, 1, 30)
    now[2] += 7.0
    motion = rigid_motion(SQUARE, now, even(0.001), np.array([True, True, False, True]))
    assert (motion.x_mm, motion.y_mm) == pytest.approx((4, 1), abs=1e-6)
    assert motion.rotation_mrad == pytest.approx(30, abs=1e-6)
    assert motion.used == (True, True, False, True)


def test_two_circles_are_not_enough():
    good = np.array([True, False, False, True])
    assert rigid_motion(SQUARE, SQUARE, even(0.001), good) is None
    assert agreeing_motion(SQUARE, SQUARE, even(0.001), good, 4.0) == (None, True)


def test_scatter_is_what_the_covariance_says():
    rng = np.random.default_rng(7)
    roots = np.array(
        [[[1, 0], [0.5, 0.8]], [[2, 0], [0, 1]], [[0.5, 0], [0.2, 1]], [[1, 0], [-1, 1]]]
    )
    roots = roots * 1e-3
    covariances = roots @ roots.transpose(0, 2, 1)
    results, squares = [], []
    for _ in range(3000):
        noise = (roots @ rng.standard_normal((4, 2, 1)))[:, :, 0]
        motion = rigid_motion(SQUARE, moved(SQUARE, 3, 0, 10) + noise, covariances, ALL)
        results.append((motion.x_mm - 3, motion.y_mm, motion.rotation_mrad / 1000 - 0.01))
        squares.append(np.square(motion.misfit))
    assert np.allclose(np.cov(np.array(results).T), matrix(motion.covariance), rtol=0.1, atol=2e-9)
    # Chi-square with two degrees of freedom: mean 2, of each circle.
    assert np.allclose(np.mean(squares, axis=0), 2, rtol=0.08)


def test_precise_circles_count_more_than_coarse_ones():
    covariances = even(0.001)
    covariances[0] *= 1e6
    now = SQUARE.copy()
    now[0] += (5.0, 0.0)
    motion = rigid_motion(SQUARE, now, covariances, ALL)
    assert abs(motion.x_mm) < 1e-4


def test_a_wrong_circle_is_found_and_left_out():
    rng = np.random.default_rng(3)
    for wrong in range(4):
        now = moved(SQUARE, 2, 1, 5) + 0.001 * rng.standard_normal((4, 2))
        now[wrong] += (0.02, -0.01)
        motion, agree = agreeing_motion(SQUARE, now, even(0.001), ALL, 4.5)
        assert agree
        assert [i for i, used in enumerate(motion.used) if not used] == [wrong]
        assert motion.misfit[wrong] > 4.5
        assert motion.x_mm == pytest.approx(2, abs=0.004)


def test_three_circles_that_contradict_each_other_are_told():
    now = SQUARE.copy()
    now[3] += (0.05, 0.0)
    good = np.array([True, False, True, True])
    motion, agree = agreeing_motion(SQUARE, now, even(0.001), good, 4.5)
    assert not agree
    assert motion.residual_mm > 0.01


def test_tolerance_forgives_what_the_lens_bends():
    now = SQUARE.copy()
    now[1] += (0.01, 0.0)
    strict = rigid_motion(SQUARE, now, even(0.001), ALL)
    lenient = rigid_motion(SQUARE, now, even(0.001), ALL, tolerance_mm=0.02)
    assert max(strict.misfit) > 4
    assert max(lenient.misfit) < 1
    assert lenient.x_mm == strict.x_mm


def test_the_reference_has_its_share():
    rng = np.random.default_rng(11)
    still = rigid_motion(SQUARE, SQUARE, even(0.001), ALL)
    alone = matrix(still.covariance)[:2, :2]
    both = matrix(rigid.position_covariance(still, SQUARE.tolist(), spreads(even(0.001))))
    assert np.allclose(both, 2 * alone)
    errors = []
    for _ in range(2000):
        reference = SQUARE + 0.001 * rng.standard_normal((4, 2))
        now = SQUARE + 0.001 * rng.standard_normal((4, 2))
        motion = rigid_motion(reference, now, even(0.001), ALL)
        errors.append((motion.x_mm, motion.y_mm))
    assert np.allclose(np.var(errors, axis=0), np.diag(both), rtol=0.1)


def test_circles_that_disagree_beyond_noise_are_doubted():
    sigma = 0.001
    quiet = SQUARE + 0.5 * sigma * np.array([(1, 0), (0, 1), (-1, 0), (0, -1)])
    torn = quiet.copy()
    torn[0] += (8 * sigma, 0.0)
    covariances, tiny = even(sigma), spreads(even(1e-9))
    spread = {}
    for name, now in (("quiet", quiet), ("torn", torn)):
        motion = rigid_motion(SQUARE, now, covariances, ALL)
        spread[name] = rigid.position_covariance(motion, SQUARE.tolist(), tiny)
    assert spread["quiet"][0] == pytest.approx(sigma**2 / 4, rel=1e-3)
    # The marker is off by a quarter of what one circle is: within three of its sigmas.
    assert 2 * sigma < 3 * spread["torn"][0] ** 0.5


def test_noise_alone_is_hardly_ever_doubted():
    rng = np.random.default_rng(5)
    doubted = 0
    for _ in range(4000):
        now = SQUARE + 0.001 * rng.standard_normal((4, 2))
        motion = rigid_motion(SQUARE, now, even(0.001), ALL)
        doubted += motion.chi2 > rigid.BIRGE_LIMIT[1]
    assert doubted <= 12
