import math

import cv2
import numpy as np
import pytest

from vdms_rt.measure.centroid import otsu_circle
from vdms_rt.model import CircleFlag, Region


def disc(x, y, rx, ry, height=480, width=720, black=30.0, white=200.0, noise=0.0, seed=0):
    """An area-sampled ellipse: 8 x 8 points in each pixel, no library drawing."""
    fine = (np.arange(8) + 0.5) / 8 - 0.5
    ys = (np.arange(height)[:, None] + fine).ravel()
    xs = (np.arange(width)[:, None] + fine).ravel()
    inside = ((xs[None] - x) / rx) ** 2 + ((ys[:, None] - y) / ry) ** 2 <= 1
    part = inside.reshape(height, 8, width, 8).mean(axis=(1, 3))
    image = black + (white - black) * part
    image += np.random.default_rng(seed).normal(0, noise, image.shape) if noise else 0
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def paper_method(image, region):
    """The paper's words, as plainly as they can be coded."""
    part = image[
        region.y_px : region.y_px + region.height_px, region.x_px : region.x_px + region.width_px
    ]
    level, _ = cv2.threshold(part, 0, 255, cv2.THRESH_OTSU)
    rows, columns = np.nonzero(part > level)
    return region.x_px + columns.mean(), region.y_px + rows.mean(), len(rows)


REGION = Region(50, 40, 90, 80)


def scene(**change):
    return disc(
        **({"x": 95.3, "y": 81.7, "rx": 25.0, "ry": 22.0, "height": 160, "width": 180} | change)
    )


@pytest.mark.parametrize("noise", [0.0, 2.0, 6.0])
def test_it_is_the_mean_of_the_white_pixels_to_the_last_bit(noise):
    image = scene(noise=noise)
    circle = otsu_circle(image, REGION, white=True)
    x, y, area = paper_method(image, REGION)
    assert (circle.x_px, circle.y_px) == pytest.approx((x, y), abs=1e-12)
    assert circle.area_px == area
    assert circle.flags == CircleFlag.NONE
    assert circle == otsu_circle(image, REGION, white=True)


def test_it_finds_centre_area_and_contrast():
    circle = otsu_circle(scene(noise=2.0), REGION, white=True)
    assert (circle.x_px, circle.y_px) == pytest.approx((95.3, 81.7), abs=0.06)
    assert circle.area_px == pytest.approx(math.pi * 25 * 22, rel=0.01)
    assert circle.contrast == pytest.approx(170, abs=3)


def test_black_on_white_gives_the_same_centre():
    image = scene(noise=2.0)
    white = otsu_circle(image, REGION, white=True)
    black = otsu_circle(255 - image, REGION, white=False)
    assert (black.x_px, black.y_px) == pytest.approx((white.x_px, white.y_px), abs=0.05)
    assert black.area_px == pytest.approx(white.area_px, rel=0.01)
    assert black.contrast == pytest.approx(white.contrast, abs=0.5)


@pytest.mark.parametrize("offset", [0, 1])
@pytest.mark.parametrize("region", [REGION, Region(51, 41, 89, 79), Region(50, 0, 90, 160)])
def test_a_field_is_measured_in_rows_of_the_whole_frame(offset, region):
    image = scene()
    whole = otsu_circle(image, region, white=True)
    field = otsu_circle(image[offset::2], region, white=True, row_offset=offset, row_step=2)
    assert (field.x_px, field.y_px) == pytest.approx((whole.x_px, whole.y_px), abs=0.15)
    assert field.area_px == pytest.approx(whole.area_px, rel=0.02)
    assert field.flags == CircleFlag.NONE


@pytest.mark.parametrize("offset", [0, 1])
def test_a_field_takes_exactly_the_rows_inside_the_region(offset):
    image = np.full((40, 40), 30, np.uint8)
    image[10:20, 10:30] = 200
    region = Region(5, 11, 30, 8)
    field = otsu_circle(image[offset::2], region, white=True, row_offset=offset, row_step=2)
    rows = [r for r in range(11, 19) if r % 2 == offset]
    assert field.y_px == pytest.approx(np.mean(rows))
    assert field.area_px == 20 * len(rows) * 2
    assert field.flags == CircleFlag.BORDER


@pytest.mark.parametrize(
    "region",
    [
        Region(72, 40, 68, 80),
        Region(50, 40, 70, 80),
        Region(50, 61, 90, 59),
        Region(50, 40, 90, 63),
    ],
    ids=["left", "right", "top", "bottom"],
)
def test_a_circle_cut_by_its_region_is_flagged(region):
    circle = otsu_circle(scene(noise=2.0), region, white=True)
    assert circle.flags == CircleFlag.BORDER
    assert math.isfinite(circle.x_px)


@pytest.mark.parametrize(("x", "y"), [(10.0, 81.7), (170.0, 81.7), (95.3, 5.0), (95.3, 150.0)])
def test_a_circle_cut_by_the_picture_is_flagged(x, y):
    region = Region(round(x) - 40, round(y) - 40, 80, 80)
    circle = otsu_circle(scene(x=x, y=y, noise=2.0), region, white=True)
    assert circle.flags == CircleFlag.BORDER
    assert abs(circle.x_px - x) < 20
    assert abs(circle.y_px - y) < 20


def noise_alone():
    return np.random.default_rng(1).normal(100, 4, (160, 180)).clip(0, 255).astype(np.uint8)


@pytest.mark.parametrize(
    "image",
    [
        np.full((160, 180), 30, np.uint8),
        np.zeros((160, 180), np.uint8),
        np.full((160, 180), 255, np.uint8),
        noise_alone(),
        scene(black=30, white=38, noise=1.0),
        scene(x=95, y=80, rx=2.0, ry=2.0),
    ],
    ids=["grey", "black", "white", "noise", "no contrast", "speck"],
)
@pytest.mark.parametrize("white", [True, False])
def test_nothing_like_a_circle_is_lost(image, white):
    if not white:
        image = 255 - image
    circle = otsu_circle(image, REGION, white=white)
    assert circle.flags == CircleFlag.LOST
    assert math.isnan(circle.x_px)
    assert math.isnan(circle.y_px)


def test_a_region_full_of_white_is_lost():
    image = np.full((160, 180), 200, np.uint8)
    image[40:46] = 30
    assert otsu_circle(image, REGION, white=True).flags == CircleFlag.LOST


@pytest.mark.parametrize(
    "region",
    [
        Region(-50, 40, 30, 30),
        Region(400, 40, 90, 80),
        Region(50, 500, 90, 80),
        Region(50, 40, 0, 0),
    ],
)
def test_a_region_outside_the_picture_is_lost(region):
    assert otsu_circle(scene(), region, white=True).flags == CircleFlag.LOST


def test_it_reads_a_read_only_view_and_leaves_it_alone():
    image = scene(noise=2.0)
    kept = image.copy()
    image.flags.writeable = False
    otsu_circle(image[1::2], REGION, white=False, row_offset=1, row_step=2)
    np.testing.assert_array_equal(image, kept)
