"""The bench's pictures, against pictures that share no code with them."""

import math

import numpy as np
import pytest

from tools.bench.bound import bound
from tools.bench.film import Film, Way
from tools.bench.picture import Bench, Window, exposure_nodes, woven

FINE = 40
"""Rays for each pixel, along x and along y."""
PAD = 5


def averages(blur_px, pixels):
    """Weights that blur FINE rays a pixel and average them over each pixel, PAD pixels beyond."""
    at = (np.arange((pixels + 2 * PAD) * FINE) + 0.5) / FINE - PAD
    edges = (np.arange(pixels)[:, None] - at) / blur_px
    rise = np.vectorize(math.erf)
    step = rise((edges + 1 / blur_px) / math.sqrt(2)) - rise(edges / math.sqrt(2))
    return step / step.sum(axis=1, keepdims=True)


def rays(bench, pose, window):
    """Send FINE^2 rays through each pixel, ask what part of each meets a disc, and blur."""
    left, top, width, height = window
    x = (np.arange((width + 2 * PAD) * FINE) + 0.5) / FINE - 0.5 + left - PAD
    y = (np.arange((height + 2 * PAD) * FINE) + 0.5) / FINE - 0.5 + top - PAD
    # The camera looks along z; the sheet's plane is turned about the vertical and moved.
    x_mm, y_mm, turn_mrad, z_mm = pose
    focal = bench.fill * bench.height_px * bench.distance_m * 1000 / bench.sheet_mm
    angle, roll = math.radians(bench.angle_deg), math.radians(bench.roll_deg)
    u = (x[None] - (bench.width_px - 1) / 2) / bench.pixel_aspect / focal
    v = -(y[:, None] - (bench.height_px - 1) / 2) / focal
    u, v = math.cos(roll) * u + math.sin(roll) * v, math.cos(roll) * v - math.sin(roll) * u
    # On the ray (u, v, 1) t, the coordinate across the sheet is z_mm.
    depth = -math.sin(angle) * u + math.cos(angle)
    t = (z_mm + bench.distance_m * 1000 * math.cos(angle)) / depth
    along = math.cos(angle) * u * t + math.sin(angle) * (t - bench.distance_m * 1000) - x_mm
    up = v * t - y_mm
    turn = turn_mrad / 1000
    right = math.cos(turn) * along + math.sin(turn) * up
    high = math.cos(turn) * up - math.sin(turn) * along
    half = bench.half_spacing_mm
    beyond = np.hypot(abs(right) - half, abs(high) - half) - bench.radius_mm
    # Where the edge runs between two rays, each has its part of it.
    met = np.clip(0.5 - beyond / np.maximum(np.hypot(*np.gradient(beyond)), 1e-9), 0, 1)
    across, down = averages(bench.blur_x_px, width), averages(bench.blur_y_px, height)
    part = down @ met @ across.T
    return bench.black_grey + (bench.white_grey - bench.black_grey) * part


@pytest.mark.parametrize(
    ("changes", "pose"),
    [
        ({"fill": 0.1}, (0.0, 0.0, 0.0, 0.0)),
        ({"fill": 0.15, "angle_deg": 60.0, "roll_deg": 10.0}, (7.3, -2.1, 30.0, 15.0)),
        ({"fill": 0.12, "angle_deg": 45.0, "distance_m": 4.0, "blur_x_px": 0.6}, (-9, 4, -8, -20)),
    ],
)
def test_a_picture_is_what_rays_through_its_pixels_see(changes, pose):
    bench = Bench(**changes)
    low, high = bench.boxes_px(*pose)[0, :2], bench.boxes_px(*pose)[0, 2:]
    left, top = (np.floor(low) - 4).astype(int)
    width, height = (np.ceil(high - low) + 8).astype(int)
    window = Window(int(left), int(top), int(width), int(height))
    seen = rays(bench, pose, window)
    drawn = bench.still(*pose, window=window)
    assert drawn.max() > 195
    assert abs(drawn - seen).max() < 0.03
    y, x = np.mgrid[:height, :width]
    centres = [
        np.array([((p - 30) * x).sum(), ((p - 30) * y).sum()]) / (p - 30).sum()
        for p in (drawn, seen)
    ]
    assert abs(centres[0] - centres[1]).max() < 1e-4


@pytest.mark.parametrize(
    ("bench", "way"),
    [
        (Bench(8.0, 30.0, fill=0.2), Way(10.0)),
        (Bench(4.0, 60.0, roll_deg=10.0), Way(2.0, axis_deg=30.0, tilt_deg=2.0)),
    ],
)
def test_a_film_shows_what_is_drawn_at_any_place_of_the_way(bench, way):
    film = Film(bench, way)
    whole = Window(0, 0, bench.width_px, bench.height_px)
    for part in (-1.0, -0.123, 0.0, 0.777):
        drawn = bench.still(*way.pose(part * way.reach_mm), window=whole)
        shown = film.shown(film.clean([np.array([part * way.reach_mm])], np.ones(1)))
        for window, picture in zip(film.windows, shown, strict=True):
            left, top, width, height = window
            own = drawn[top : top + height, left : left + width]
            assert abs(picture - own).max() < 0.0015
            drawn[top : top + height, left : left + width] = bench.black_grey
        assert abs(drawn - bench.black_grey).max() < 1e-6


def test_a_film_weaves_two_fields_and_rounds_noise_to_grey_levels():
    bench = Bench(8.0, 15.0, fill=0.2)
    film = Film(bench, Way(10.0))
    clean = film.clean([np.array([7.0]), np.array([-6.0])], np.ones(1))
    frame = film.blank()
    film.grab(frame, clean, np.zeros(film.pixels, np.float32), 2.0)
    drawn = woven(bench.still(-6.0), bench.still(7.0), bottom_first=True)
    assert abs(frame - drawn).max() <= 0.502
    unit = np.random.default_rng(1).standard_normal(film.pixels, dtype=np.float32)
    film.grab(frame, clean, unit, 2.0)
    left, top, width, height = film.windows[0]
    noise = (frame - drawn)[top : top + height, left : left + width]
    assert noise.var() == pytest.approx(4 + 1 / 12, rel=0.05)
    assert np.count_nonzero(frame != 30) < film.pixels


def test_an_exposure_is_the_mean_of_many_pictures():
    bench = Bench(8.0, 30.0, fill=0.2)
    film = Film(bench, Way(10.0))
    within, shares = exposure_nodes(1.0, 24)
    shown = film.shown(film.clean([4 + 6 * within], shares))[2]
    window = film.windows[2]
    places = 4 + 6 * ((np.arange(400) + 0.5) / 400 - 0.5)
    mean = np.mean([bench.still(p, window=window) for p in places], axis=0)
    assert np.ptp(shown) > 160
    assert abs(shown - mean).max() < 0.005


def test_the_bound_is_that_of_a_blurred_edge():
    bench = Bench(8.0, 0.0, pixel_aspect=1.0, blur_x_px=0.8, blur_y_px=0.8)
    scale = bench.homography[0, 0] / bench.homography[2, 2]
    # Of four discs: the sum over the outline of n n' / (2 sqrt(pi) s), the pixel's width in s.
    edge = math.sqrt(0.8**2 + 1 / 12)
    information = 4 * math.pi * bench.radius_mm * scale * 170**2 / (2 * math.sqrt(math.pi) * edge)
    variance = (2.0**2 + 1 / 12) / information / scale**2
    covariance = bound(bench, 2.0)
    assert covariance[0, 0] == pytest.approx(variance, rel=0.02)
    assert covariance[1, 1] == pytest.approx(variance, rel=0.02)
    field = bound(bench, 2.0, slice(1, None, 2))
    assert field[0, 0] == pytest.approx(2 * covariance[0, 0], rel=0.02)
