import math

import numpy as np
import pytest

from vdms_rt.measure.homography import to_image_px
from vdms_rt.measure.motion import mean_displacement

CIRCLES_MM = np.array([(-60.0, 60.0), (60.0, 60.0), (-60.0, -60.0), (60.0, -60.0)])
H = np.array([[1.2, 0.1, 360.0], [0.05, -1.4, 240.0], [1e-5, 2e-6, 1.0]])


def test_a_shift_comes_back_whole_with_no_residual():
    centres_px = to_image_px(H, CIRCLES_MM + np.array([3.25, -1.5]))
    x, y, residual = mean_displacement(H, centres_px, CIRCLES_MM)
    assert (x, y) == pytest.approx((3.25, -1.5), abs=1e-9)
    assert residual == pytest.approx(0, abs=1e-9)


def test_it_is_the_mean_of_the_circles_changes():
    changes = np.array([(1.0, 0.0), (1.0, 0.0), (1.0, 0.0), (1.4, 0.3)])
    centres_px = to_image_px(H, CIRCLES_MM + changes)
    x, y, residual = mean_displacement(H, centres_px, CIRCLES_MM)
    assert (x, y) == pytest.approx((1.1, 0.075))
    assert residual == pytest.approx(math.sqrt((3 * (0.1**2 + 0.075**2) + 0.3**2 + 0.225**2) / 4))


def test_a_turn_moves_the_mean_nothing_and_shows_in_the_residual():
    turn = 0.001
    turned = CIRCLES_MM @ np.array([[1.0, turn], [-turn, 1.0]])
    x, y, residual = mean_displacement(H, to_image_px(H, turned), CIRCLES_MM)
    assert (x, y) == pytest.approx((0, 0), abs=1e-9)
    assert residual == pytest.approx(turn * math.hypot(60, 60), rel=1e-6)


def test_fewer_circles_serve_too():
    centres_px = to_image_px(H, CIRCLES_MM[:1] + np.array([2.0, 1.0]))
    x, y, residual = mean_displacement(H, centres_px, CIRCLES_MM[:1])
    assert (x, y, residual) == pytest.approx((2.0, 1.0, 0.0), abs=1e-9)
