"""The lens: its map and inverse, discs, and its estimate from a marker that stays rigid."""

from __future__ import annotations

import numpy as np
import pytest
from lens_pictures import (
    ASPECT,
    HEIGHT_PX,
    MIDDLE_PX,
    SHAPE,
    SQUARE_MM,
    WIDTH_PX,
    bent_px,
    centroid_px,
    path_mm,
    seen_px,
)

from vdms_rt.capture.table import TableSource
from vdms_rt.config import Motion, Table
from vdms_rt.measure.bundle import LensError
from vdms_rt.measure.centroid import otsu_circle
from vdms_rt.measure.homography import GeometryError, homography
from vdms_rt.measure.lens import (
    Lens,
    distort_point,
    distort_px,
    fold_radius,
    lens_for,
    undistort_jacobian,
    undistort_px,
)
from vdms_rt.measure.lensfit import estimate_lens
from vdms_rt.measure.motion import mean_displacement
from vdms_rt.model import ConfigError, Region

LENSES = [(-0.05, 0.0), (0.05, 0.0), (-0.2, 0.1), (0.19, -0.1), (0.1, 0.05), (-0.2, -0.2), (0.2, 0)]


def lens_of(k1, k2=0.0, centre_px=None):
    return lens_for(k1, k2, centre_px, ASPECT, WIDTH_PX, HEIGHT_PX)


def estimate(centres_px):
    return estimate_lens(SHAPE, centres_px, WIDTH_PX, HEIGHT_PX, ASPECT)


def picture_points(count=500):
    return np.random.default_rng(1).uniform((0, 0), (WIDTH_PX - 1, HEIGHT_PX - 1), (count, 2))


@pytest.mark.parametrize(("k1", "k2"), LENSES)
@pytest.mark.parametrize("centre_px", [None, (300.0, 260.0)])
def test_distorting_undoes_undistorting_all_over_the_picture(k1, k2, centre_px):
    lens, points = lens_of(k1, k2, centre_px), picture_points()
    assert np.abs(distort_px(lens, undistort_px(lens, points)) - points).max() < 1e-10


@pytest.mark.parametrize(("k1", "k2"), LENSES)
def test_one_point_in_plain_floats_is_the_same(k1, k2):
    lens, points = lens_of(k1, k2), picture_points(50)
    ideal = undistort_px(lens, points)
    slopes = np.linalg.inv(undistort_jacobian(lens, points))
    for (x, y), seen, slope in zip(ideal.tolist(), points, slopes, strict=True):
        u, v, *row_by_row = distort_point(lens, x, y)
        assert np.abs((u, v) - seen).max() < 1e-7
        assert np.abs(np.reshape(row_by_row, (2, 2)) - slope).max() < 1e-7


@pytest.mark.parametrize(("k1", "k2"), LENSES)
def test_the_jacobian_is_the_slope_of_the_map(k1, k2):
    lens, points, step = lens_of(k1, k2), picture_points(), 1e-4
    numeric = np.stack(
        [
            (undistort_px(lens, points + d) - undistort_px(lens, points - d)) / (2 * step)
            for d in ([step, 0.0], [0.0, step])
        ],
        axis=-1,
    )
    assert np.abs(undistort_jacobian(lens, points) - numeric).max() < 1e-7


def test_barrel_is_negative_and_tells_the_displacement_in_the_corner():
    corner = np.array([[WIDTH_PX - 0.5, HEIGHT_PX - 0.5]])
    there = undistort_px(lens_of(-0.04, -0.01), corner) - MIDDLE_PX
    assert there == pytest.approx((corner - MIDDLE_PX) * 1.05, abs=1e-9)


def test_a_lens_that_bends_nothing_is_no_lens_and_changes_nothing():
    assert lens_of(0.0) is None
    points = picture_points(5)
    assert undistort_px(None, points) is points
    assert distort_px(None, points) is points
    assert (undistort_jacobian(None, points) == np.eye(2)).all()


def test_the_centre_of_the_lens_stays_where_it_is():
    lens = lens_of(-0.1, 0.02, (300.0, 200.0))
    centre = np.array([[300.0, 200.0]])
    assert (undistort_px(lens, centre) == centre).all()
    assert (distort_px(lens, centre) == centre).all()


def test_what_the_lens_shows_nowhere_is_nan():
    lens = lens_of(0.15)
    fold = fold_radius(0.15, 0.0)
    assert fold == pytest.approx((3 * 0.15) ** -0.5)
    beyond = np.array([[MIDDLE_PX[0], MIDDLE_PX[1] + 2 * fold * lens.half_diagonal_px]])
    assert np.isnan(distort_px(lens, beyond)).all()


def test_a_disc_is_undistorted_to_the_ideal_disc():
    around = 2 * np.pi * np.arange(4000) / 4000
    ellipse = np.column_stack([38 * np.cos(around), 30 * np.sin(around + 0.3)])
    ideal = np.array([130.0, 120.0]) + ellipse
    seen = bent_px(ideal, -0.1, 0.02)
    at = centroid_px(seen)
    # A fine fan of triangles from the centroid gives the second moments.
    a, b = seen - at, np.roll(seen, -1, axis=0) - at
    weight = (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])[:, None, None]
    outer = [u[:, :, None] * v[:, None, :] for u, v in ((a, a), (b, b), (a, b), (b, a))]
    spread = (
        (weight * (2 * outer[0] + 2 * outer[1] + outer[2] + outer[3])).sum(0) / weight.sum() / 12
    )
    lens = lens_of(-0.1, 0.02)
    plain = undistort_px(lens, at[None])[0] - centroid_px(ideal)
    disc = undistort_px(lens, at[None], spread[None])[0] - centroid_px(ideal)
    assert np.hypot(*plain) > 0.2
    assert np.hypot(*disc) < 2e-3


def test_a_centre_outside_of_the_picture_and_a_fold_inside_are_refused():
    with pytest.raises(ConfigError, match=r"lens\.centre_px = \[720, 10\] lies outside"):
        lens_of(-0.05, 0.0, (720.0, 10.0))
    with pytest.raises(ConfigError, match="folds the picture over"):
        lens_of(0.2, 0.0, (0.0, 0.0))


@pytest.mark.parametrize(
    "case",
    [
        {"k1": -0.05},
        {"k1": 0.03, "angle_deg": 45.0},
        {"k1": -0.01, "angle_deg": 0.0},
        {"k1": -0.15, "turn_mrad": 40.0},
        {"k1": -0.05, "print_mm": 0.1},
        {"k1": -0.05, "centre_px": (371.0, 233.0)},
        {"k1": -0.06, "k2": 0.03, "noise_px": 0.005},
    ],
    ids=str,
)
def test_the_estimate_finds_the_lens_within_its_own_error(case):
    found = estimate(seen_px(**case))
    assert found.enough
    assert found.bends
    assert abs(found.lens.k1 - case["k1"]) < 3.5 * found.sigma_k1
    if "k2" in case:
        assert abs(found.lens.k2 - case["k2"]) < 3.5 * found.sigma_k2
    else:
        assert (found.lens.k2, found.sigma_k2) == (0.0, 0.0)
    if "centre_px" in case:
        away = np.abs(np.subtract(found.lens.centre_px, case["centre_px"]))
        assert away.max() < 4 * found.sigma_centre_px < 2
    else:
        assert (found.lens.centre_px, found.sigma_centre_px) == (MIDDLE_PX, 0.0)
    assert found.sigma_corner < 0.001


def test_the_standard_error_is_true():
    off = []
    for seed in range(30):
        found = estimate(seen_px(-0.03, pictures=100, amplitude_mm=30.0, print_mm=0.1, seed=seed))
        off.append((found.lens.k1 + 0.03) / found.sigma_k1)
    assert 0.7 < np.sqrt(np.mean(np.square(off))) < 1.3


def test_pictures_in_one_place_do_not_count_as_independent():
    moving = seen_px(-0.05, noise_px=0.02)
    once, often = estimate(moving), estimate(np.repeat(moving, 10, axis=0))
    assert often.sigma_k1 > 0.9 * once.sigma_k1


def test_no_distortion_is_told_as_such():
    found = estimate(seen_px(0.0, noise_px=0.02))
    assert found.enough
    assert not found.bends
    assert found.effect_mm < 0.01


def test_effect_and_residual_are_in_millimetres_of_the_marker():
    quiet = seen_px(-0.05, noise_px=0.0, angle_deg=0.0)
    found = estimate(quiet)
    h = homography(SQUARE_MM, quiet[0])
    rigid = [mean_displacement(h, q, SQUARE_MM) for q in quiet]
    truth = path_mm(len(quiet), 60.0)
    worst = max(np.hypot(x - tx, y - ty) for (x, y, _), (tx, ty) in zip(rigid, truth, strict=True))
    assert found.effect_mm == pytest.approx(worst, rel=0.05)
    assert found.residual_before_mm == pytest.approx(
        np.sqrt(np.mean([r**2 for _, _, r in rigid])), rel=0.05
    )
    assert found.residual_after_mm < 0.02 * found.residual_before_mm
    assert found.travel_mm == pytest.approx(np.hypot(*truth.T).max(), rel=0.01)


def test_a_circle_that_is_not_good_or_not_where_the_others_are_is_left_out():
    seen = seen_px(-0.05)
    seen[100:150, 3] = np.nan
    seen[120:140, 2, 0] = np.nan
    seen[::9, 1] += (3.0, -4.0)
    found = estimate(seen)
    assert found.pictures <= 230
    assert abs(found.lens.k1 + 0.05) < 3.5 * found.sigma_k1 < 0.001


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda seen: seen[:0], "no picture shows all circles"),
        (lambda seen: np.where(np.arange(4)[:, None] == 1, np.nan, seen), "no picture shows all"),
        (lambda seen: np.repeat(seen[:1], 100, axis=0), "stood in 1 places .* at least 30"),
        (lambda seen: seen + np.random.default_rng(3).normal(0, 20, seen.shape), "no rigid marker"),
        (lambda seen: seen * np.linspace(1, 1.05, len(seen))[:, None, None], "no rigid marker"),
    ],
)
def test_pictures_that_hold_no_estimate_are_refused_with_a_sentence(change, said):
    with pytest.raises(LensError, match=said):
        estimate(change(seen_px(-0.05)))


def test_circles_in_a_wrong_order_are_refused():
    with pytest.raises(GeometryError, match="order"):
        estimate(seen_px(-0.05)[:, [0, 1, 3, 2]])


def test_too_little_motion_is_told_and_how_to_mend_it():
    found = estimate(seen_px(-0.05, amplitude_mm=9.0, noise_px=0.12, pictures=80))
    assert not found.enough
    assert found.sigma_corner > 0.005
    assert "move the marker slowly as far across the picture" in found.shortfall


def grey_centroid(image, region):
    """Mean of the grey levels between the two classes' medians: coarser than the estimator's own
    kind, and independent of it."""
    left, top = region.x_px, region.y_px
    view = image[top : top + region.height_px, left : left + region.width_px].astype(float)
    black, white = np.median(view[view < 115]), np.median(view[view >= 115])
    part = np.clip((view - black) / (white - black), 0.1, 0.9) - 0.1
    x = part.sum(axis=0) @ np.arange(region.width_px) / part.sum()
    y = part.sum(axis=1) @ np.arange(region.height_px) / part.sum()
    return left + x, top + y


def table_centres(distortion, motion, frames):
    """Centres by Otsu and by grey level in pictures of the virtual table, and the true x."""
    table = Table(
        pace="fast",
        scan="progressive",
        frames=frames,
        rest_s=1.0,
        distortion=distortion,
        motion=motion,
        angle_deg=10.0,
    )
    truth = []
    source = TableSource(table, [SHAPE], truth.append)
    image = np.zeros((HEIGHT_PX, WIDTH_PX), np.uint8)
    at = np.array([(264.0, 154.0), (454.0, 154.0), (264.0, 325.0), (454.0, 325.0)])
    velocity = np.zeros((4, 2))
    otsu, grey = [], []
    for _ in range(frames):
        source.read(image, 1.0)
        regions = [Region(round(x) - 56, round(y) - 52, 113, 105) for x, y in at + velocity]
        circles = [otsu_circle(image, region, white=True) for region in regions]
        assert not any(c.flags for c in circles)
        now = np.array([(c.x_px, c.y_px) for c in circles])
        velocity, at = (now - at) * bool(otsu), now
        otsu.append(now)
        grey.append([grey_centroid(image, region) for region in regions])
    return np.array(otsu), np.array(grey), np.array([t.x_mm for t in truth])


def error_percent(centres, truth_mm, lens: Lens | None):
    """Eq. 3.1 of Lee, Cho and Sim (2015), the first 30 pictures being the reference."""
    ideal = np.array([undistort_px(lens, c) for c in centres])
    h = homography(SQUARE_MM, ideal[:30].mean(axis=0))
    x = np.array([mean_displacement(h, c, SQUARE_MM)[0] for c in ideal[30:]])
    return 100 * np.std(truth_mm[30:] - x) / np.std(truth_mm[30:])


@pytest.mark.slow
def test_the_lens_of_the_virtual_table_is_found_and_undone(tmp_path):
    times_s = np.linspace(0, 9, 1000)
    record = tmp_path / "star.csv"
    np.savetxt(
        record,
        np.column_stack([times_s, path_mm(1000, 60.0)]),
        fmt="%.6f",
        delimiter=",",
        header="time_s,x_mm,y_mm",
        comments="",
    )
    otsu, grey, _ = table_centres(-0.05, Motion(kind="record", file=str(record)), 300)
    by_otsu, by_grey = estimate(otsu), estimate(grey)
    for found in (by_otsu, by_grey):
        assert found.enough
        assert abs(found.lens.k1 + 0.05) < 3 * found.sigma_k1
        assert (found.lens.k2, found.sigma_centre_px) == (0.0, 0.0)
        assert found.residual_after_mm < 0.15 * found.residual_before_mm
    assert by_grey.sigma_k1 < 0.3 * by_otsu.sigma_k1

    harmonic = Motion(kind="harmonic", amplitude_mm=10.0, frequency_hz=1.0)
    _, straight, straight_mm = table_centres(0.0, harmonic, 180)
    otsu, bent, bent_mm = table_centres(-0.05, harmonic, 180)
    assert error_percent(straight, straight_mm, None) < 0.03
    assert error_percent(bent, bent_mm, None) > 0.3
    assert error_percent(bent, bent_mm, by_grey.lens) < 0.03
    assert error_percent(bent, bent_mm, by_otsu.lens) < 0.03
    assert error_percent(otsu, bent_mm, by_otsu.lens) < 0.6 * error_percent(otsu, bent_mm, None)
