import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vdms_rt.measure.homography import (
    GeometryError,
    homography,
    homography_normalised,
    independence,
    jacobian_mm_per_px,
    jacobian_px_per_mm,
    reference_covariance_mm2,
    reference_sensitivity,
    roll_deg,
    scale_px_per_mm,
    to_image_px,
    to_marker_mm,
    viewing_angle_deg,
)

SQUARE_MM = np.array([(-60.0, 60.0), (60.0, 60.0), (-60.0, -60.0), (60.0, -60.0)])
SIX_MM = np.vstack((SQUARE_MM, [(0.0, 95.0), (20.0, -110.0)]))


def view(distance_m=8.0, angle_deg=30.0, roll=0.0, px_per_mm=1.4, aspect=1.1):
    """A pinhole's map of the marker plane, built from the camera's side."""
    angle, turn = math.radians(angle_deg), math.radians(roll)
    f = px_per_mm * distance_m * 1000
    rotation = np.array(
        [[math.cos(angle), 0.0], [0.0, 1.0], [math.sin(angle), 0.0]]
    )  # columns: marker's x and y in camera axes (x right, y up, z away)
    rolled = np.eye(3)
    rolled[:2, :2] = [[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]]
    pose = np.column_stack((rolled @ rotation, [0.0, 0.0, distance_m * 1000]))
    return np.array([[f * aspect, 0, 360], [0, -f, 240], [0, 0, 1]]) @ pose


views = st.builds(
    view,
    distance_m=st.floats(0.5, 20),
    angle_deg=st.floats(-70, 70),
    roll=st.floats(-45, 45),
    px_per_mm=st.floats(0.1, 5),
    aspect=st.floats(0.9, 1.2),
)
markers = st.sampled_from([SQUARE_MM, SIX_MM, SQUARE_MM * [3, 1] + [500, -200]])


@settings(deadline=None)
@given(views, markers)
def test_both_forms_find_the_map_that_made_the_picture(h, marker_mm):
    image_px = to_image_px(h, marker_mm)
    expected = h / np.linalg.norm(h)
    if (marker_mm @ h[2, :2] + h[2, 2] <= 0).any():
        return
    for find in (homography, homography_normalised):
        found = find(marker_mm, image_px)
        assert np.linalg.norm(found) == pytest.approx(1)
        np.testing.assert_allclose(to_image_px(found, marker_mm), image_px, atol=1e-7)
        probe = marker_mm.mean(axis=0) + np.array([[10.0, -7.0]])
        np.testing.assert_allclose(to_image_px(found, probe), to_image_px(h, probe), atol=1e-6)
        np.testing.assert_allclose(found, expected, atol=1e-6 * np.abs(expected).max())


@settings(deadline=None)
@given(views, st.integers(0, 2**32 - 1))
def test_both_forms_agree_on_four_disturbed_points(h, seed):
    noise = np.random.default_rng(seed).normal(0, 0.02, (4, 2))
    image_px = to_image_px(h, SQUARE_MM) + noise
    probe = image_px.mean(axis=0) + np.array([[1.0, 2.0], [-8.0, 5.0]])
    plain = to_marker_mm(homography(SQUARE_MM, image_px), probe)
    scaled = to_marker_mm(homography_normalised(SQUARE_MM, image_px), probe)
    np.testing.assert_allclose(plain, scaled, atol=1e-6)


def test_both_forms_agree_within_the_noise_on_six_points():
    rng = np.random.default_rng(3)
    truth = view(angle_deg=45)
    exact = to_image_px(truth, SIX_MM)
    plain, scaled = [], []
    for _ in range(300):
        image_px = exact + rng.normal(0, 0.05, exact.shape)
        probe = np.array([[370.0, 230.0]])
        plain.append(to_marker_mm(homography(SIX_MM, image_px), probe)[0])
        scaled.append(to_marker_mm(homography_normalised(SIX_MM, image_px), probe)[0])
    expected = to_marker_mm(truth, np.array([[370.0, 230.0]]))[0]
    deviation = np.std(scaled, axis=0)
    assert (np.abs(np.mean(scaled, axis=0) - expected) < 4 * deviation / math.sqrt(300)).all()
    assert (np.std(np.subtract(plain, scaled), axis=0) < 0.5 * deviation).all()


@settings(deadline=None)
@given(views)
def test_inverse_mapping_returns_to_the_same_point(h):
    points_mm = np.array([(0.0, 0.0), (13.0, -40.0), (-55.0, 22.0)])
    np.testing.assert_allclose(to_marker_mm(h, to_image_px(h, points_mm)), points_mm, atol=1e-8)


def test_the_sign_makes_the_marker_lie_before_the_camera():
    h = homography(SQUARE_MM, to_image_px(view(), SQUARE_MM))
    assert h[2, 2] > 0


def test_jacobians_are_the_differences_of_the_map():
    h = view(angle_deg=50, roll=12, distance_m=1.5)
    points_mm = np.array([(0.0, 0.0), (60.0, -60.0), (-31.0, 47.0)])
    points_px = to_image_px(h, points_mm)
    step = 1e-4
    for axis in range(2):
        ahead = np.zeros(2)
        ahead[axis] = step
        forward = (to_image_px(h, points_mm + ahead) - to_image_px(h, points_mm - ahead)) / 2 / step
        np.testing.assert_allclose(jacobian_px_per_mm(h, points_mm)[:, :, axis], forward, rtol=1e-6)
        back = (to_marker_mm(h, points_px + ahead) - to_marker_mm(h, points_px - ahead)) / 2 / step
        np.testing.assert_allclose(
            jacobian_mm_per_px(h, points_px)[:, :, axis], back, rtol=1e-6, atol=1e-9
        )


@pytest.mark.parametrize("marker_mm", [SQUARE_MM, SIX_MM])
def test_sensitivity_is_the_difference_that_one_moved_centre_makes(marker_mm):
    reference_px = to_image_px(view(angle_deg=60, roll=10, distance_m=2), marker_mm)
    points_px = reference_px[:3] + np.array([3.0, -5.0])
    moved = reference_sensitivity(marker_mm, reference_px, points_px)
    assert moved.shape == (3, len(marker_mm), 2, 2)
    step = 1e-4
    for n in range(len(marker_mm)):
        for axis in range(2):
            either = []
            for sign in (1, -1):
                shifted = reference_px.copy()
                shifted[n, axis] += sign * step
                either.append(to_marker_mm(homography_normalised(marker_mm, shifted), points_px))
            expected = (either[0] - either[1]) / (2 * step)
            np.testing.assert_allclose(moved[:, n, :, axis], expected, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("marker_mm", [SQUARE_MM, SIX_MM])
def test_reference_covariance_agrees_with_repeated_references(marker_mm):
    rng = np.random.default_rng(7)
    exact = to_image_px(view(angle_deg=40, roll=-8, distance_m=3), marker_mm)
    n = len(marker_mm)
    spread = rng.normal(0, 0.05, (n, 2, 2))
    covariance_px2 = spread @ spread.transpose(0, 2, 1)
    points_px = np.array([exact[0] + 4.0, exact.mean(axis=0), exact[3] + [-30.0, 10.0]])
    predicted = reference_covariance_mm2(marker_mm, exact, covariance_px2, points_px)
    trials = 4000
    errors = np.einsum("nij,tnj->tni", spread, rng.normal(size=(trials, n, 2)))
    mapped = np.array(
        [to_marker_mm(homography_normalised(marker_mm, exact + e), points_px) for e in errors]
    )
    for m in range(len(points_px)):
        seen = np.cov(mapped[:, m].T)
        scale = np.sqrt(np.outer(np.diag(predicted[m]), np.diag(predicted[m])))
        # A variance of 4000 trials has a standard error of 2.2 %.
        np.testing.assert_allclose(seen / scale, predicted[m] / scale, atol=0.09)


@pytest.mark.parametrize("angle", [0.0, 20.0, 45.0, 60.0, -60.0])
@pytest.mark.parametrize("roll", [0.0, 15.0, -40.0])
def test_scale_angle_and_roll_are_those_of_the_view(angle, roll):
    h = view(angle_deg=angle, roll=roll, aspect=1.0)
    across, up = scale_px_per_mm(h)
    assert across == pytest.approx(1.4 * math.cos(math.radians(angle)), rel=1e-3)
    assert up == pytest.approx(1.4, rel=1e-3)
    stretched = view(angle_deg=angle, roll=roll, aspect=1.1)
    assert viewing_angle_deg(stretched, 1.1) == pytest.approx(abs(angle), abs=0.2)
    assert roll_deg(stretched, 1.1) == pytest.approx(roll, abs=1e-6)


def test_a_wrong_pixel_aspect_spoils_the_angle_as_documented():
    assert viewing_angle_deg(view(angle_deg=0), 1.1 * 1.01) == pytest.approx(8, abs=0.2)
    assert viewing_angle_deg(view(angle_deg=60), 1.1 * 1.01) == pytest.approx(60.33, abs=0.02)


@pytest.mark.parametrize(
    ("marker_mm", "image_px", "says"),
    [
        (SQUARE_MM[:3], SQUARE_MM[:3], "at least 4"),
        (SQUARE_MM, SQUARE_MM[:3], "do not pair up"),
        (SQUARE_MM, SQUARE_MM * [np.nan, 1], "must be seen"),
        ([(0, 0), (10, 0), (20, 0), (5, 9)], SQUARE_MM, "on one line on the marker"),
        (SQUARE_MM, [(0, 0), (100, 0), (200, 0), (50, 90)], "on one line in the picture"),
        ([(0, 0), (1, 1), (2, 2), (3, 3)], SQUARE_MM, "on one line on the marker"),
        ([(5, 5), (5, 5), (5, 5), (5, 5)], SQUARE_MM, "on one line on the marker"),
        ([(0, 0), (1, 0), (2, 0), (3, 0), (1, 5)], [*SQUARE_MM, (0, 0)], "all but one"),
        (SQUARE_MM, SQUARE_MM[[0, 1, 3, 2]], "in the order of the marker"),
    ],
)
@pytest.mark.parametrize("find", [homography, homography_normalised])
def test_points_that_fix_no_map_are_refused_with_a_sentence(find, marker_mm, image_px, says):
    with pytest.raises(GeometryError, match=says):
        find(np.array(marker_mm, dtype=float), np.array(image_px, dtype=float))


def test_independence_does_not_depend_on_size_or_shear():
    assert independence(SQUARE_MM) == pytest.approx(0.357, abs=0.001)
    sheared = SQUARE_MM @ np.array([[20.0, 3.0], [0.0, 0.1]]) + 1e4
    assert independence(sheared) == pytest.approx(independence(SQUARE_MM), rel=1e-6)


def test_five_circles_with_three_in_a_line_are_enough():
    marker_mm = np.array([(0.0, 0.0), (100.0, 0.0), (50.0, 0.0), (50.0, 30.0), (50.0, 70.0)])
    image_px = to_image_px(view(), marker_mm)
    found = homography(marker_mm, image_px)
    np.testing.assert_allclose(to_image_px(found, marker_mm), image_px, atol=1e-7)
