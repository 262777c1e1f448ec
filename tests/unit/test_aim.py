"""What is said of a marker while the camera is aimed, on pictures whose making is known."""

import dataclasses
import math

import cv2
import numpy as np
import pytest
from lab_picture import SQUARE, Lab, View, picture

from vdms_rt.capture.table import TableSource
from vdms_rt.config import parse_config
from vdms_rt.measure.aim import aim
from vdms_rt.measure.gate import Workspace
from vdms_rt.measure.marker import find_markers
from vdms_rt.model import Aim, Luma, MarkerShape, Scan

PLAIN = Lab(clutter=None, gradient=0.0)


def seen(
    image: Luma,
    shape: MarkerShape = SQUARE,
    scan: Scan = Scan.PROGRESSIVE,
    pixel_aspect: float = 1.1,
) -> Aim:
    (found,) = find_markers(image, [shape], scan)
    rows, step = (image[0::2], 2) if scan.interlaced else (image, 1)
    return aim(
        rows,
        0,
        step,
        image.shape[0],
        shape,
        found.centres_px,
        found.semi_axes_px,
        pixel_aspect,
        Workspace(),
    )


def on_table(text: str) -> Aim:
    config = parse_config(f'source = "table"\n[table]\npace = "fast"\n{text}', "test")
    source = TableSource(config.table, [SQUARE], lambda truth: None)
    image = np.empty((480, 720), np.uint8)
    source.read(image, 1)
    source.close()
    return seen(image, scan=source.info.scan)


@pytest.mark.parametrize("scan", ["progressive", "bottom-first"])
@pytest.mark.parametrize(
    ("angle", "roll"), [(15, 0), (-15, 10), (30, -10), (45, 0), (-60, 0), (60, 10)]
)
def test_the_tables_angles_are_recovered(angle: float, roll: float, scan: str) -> None:
    told = on_table(f"angle_deg = {angle}\nroll_deg = {roll}\nscan = '{scan}'")
    assert told.angle_deg == pytest.approx(abs(angle), abs=0.5)
    assert told.side_known
    assert told.turn_deg == pytest.approx(angle, abs=0.5)
    assert told.roll_deg == pytest.approx(roll, abs=0.2)
    assert not told.advice


def test_an_angle_about_both_axes_is_told_apart() -> None:
    told = seen(picture([View(angle_deg=30, pitch_deg=20)], PLAIN))
    normal = math.cos(math.radians(30)) * math.cos(math.radians(20))
    assert told.angle_deg == pytest.approx(math.degrees(math.acos(normal)), abs=0.5)
    assert abs(told.turn_deg) < told.angle_deg - 3


def test_far_away_nobody_knows_which_side_is_the_farther_one() -> None:
    told = seen(picture([View(angle_deg=-30, distance_m=1000)], PLAIN))
    assert not told.side_known
    assert told.turn_deg == pytest.approx(30, abs=0.5)


@pytest.mark.parametrize("angle", [0, 15, 30, 60])
def test_the_error_of_the_angle_is_that_of_a_pixel_aspect_one_percent_off(angle: float) -> None:
    told = seen(picture([View(angle_deg=angle)], PLAIN), pixel_aspect=1.1 * 1.01)
    assert abs(told.angle_deg - angle) <= told.angle_error_deg + 1.0


@pytest.mark.parametrize("blur_px", [(0.85, 0.6), (1.5, 1.2), (2.2, 2.0)])
@pytest.mark.parametrize("scan", [Scan.PROGRESSIVE, Scan.TOP_FIRST])
def test_the_edges_width_is_that_of_the_blur(blur_px: tuple[float, float], scan: Scan) -> None:
    told = seen(
        picture([View()], dataclasses.replace(PLAIN, blur_px=blur_px, scan=scan)), scan=scan
    )
    for width, blur in zip((told.edge_x_px, told.edge_y_px), blur_px, strict=True):
        assert width == pytest.approx(math.sqrt(blur**2 + 1 / 12), rel=0.1)
    words = {0.85: "sharp", 1.5: "a little soft", 2.2: "out of focus"}
    assert told.focus == words[blur_px[0]]
    assert any("focus ring" in a for a in told.advice) == (told.focus != "sharp")


def inside(view: View, depth_px: float, image: Luma) -> list[np.ndarray]:
    """The grey levels of each circle farther than `depth_px` from its edge."""
    greys = []
    for outline in view.outlines():
        left, top = np.floor(outline.min(axis=0)).astype(int)
        right, bottom = np.ceil(outline.max(axis=0)).astype(int)
        polygon = (outline - (left, top)).astype(np.float32)
        deep = [
            image[y, x]
            for y in range(top, bottom)
            for x in range(left, right)
            if cv2.pointPolygonTest(polygon, (float(x - left), float(y - top)), True) > depth_px
        ]
        greys.append(np.array(deep))
    return greys


@pytest.mark.parametrize("white", [249.0, 252.0, 256.0])
def test_the_saturated_part_of_the_brightest_disc(white: float) -> None:
    lab = dataclasses.replace(PLAIN, white=white, gradient=0.04)
    image = picture([View()], lab)
    told = seen(image)
    true = max(100 * np.mean(g >= 254) for g in inside(View(), 3.0, image))
    assert 1 < true < 100
    assert told.saturated_percent == pytest.approx(true, abs=1.5)
    assert told.advice == (
        f"turn the iris down: {told.saturated_percent:.0f} % of the disc is saturated",
    )


def test_a_grabber_that_clips_at_video_white_is_seen_through() -> None:
    lab = dataclasses.replace(PLAIN, white=238.0)
    clipped = np.minimum(picture([View()], lab), 235)
    assert seen(clipped).saturated_percent > 80
    assert seen(picture([View()], dataclasses.replace(PLAIN, white=228.0))).saturated_percent == 0


def test_of_a_dark_disc_the_sheet_saturates() -> None:
    shape = dataclasses.replace(SQUARE, white_on_black=False)
    view = View(shape=shape)
    bright = picture([view], dataclasses.replace(PLAIN, white=258.0))
    told = seen(bright, shape)
    assert told.saturated_percent > 90
    assert "of the sheet" in told.advice[0]
    assert told.white_grey > told.black_grey
    assert seen(picture([view], PLAIN), shape).saturated_percent == 0


def test_levels_contrast_and_noise_are_those_of_the_picture() -> None:
    told = seen(picture([View()], dataclasses.replace(PLAIN, black=90.0, white=150.0, noise=7.0)))
    assert told.black_grey == pytest.approx(90, abs=1)
    assert told.white_grey == pytest.approx(150, abs=1)
    assert told.contrast_grey == pytest.approx(60, abs=1.5)
    assert told.noise_grey == pytest.approx(7, rel=0.05)
    assert [a.split(":")[0] for a in told.advice] == [
        "open the iris or give more light",
        "give more light and less gain",
    ]


@pytest.mark.parametrize("angle", [0, 50])
def test_the_room_ends_where_a_circle_touches_the_border(angle: float) -> None:
    view = View(angle_deg=angle, px_per_mm=0.7, at_px=(300.0, 220.0))
    told = seen(picture([view], PLAIN))
    for way, room_mm in (
        ((-1, 0), told.left_mm),
        ((1, 0), told.right_mm),
        ((0, 1), told.up_mm),
        ((0, -1), told.down_mm),
    ):
        rims = view.outlines(np.array(way) * room_mm).reshape(-1, 2)
        left, right = rims[:, 0].min(), 719 - rims[:, 0].max()
        top, bottom = rims[:, 1].min(), 479 - rims[:, 1].max()
        touching = {(-1, 0): left, (1, 0): right, (0, 1): top, (0, -1): bottom}[way]
        assert touching == pytest.approx(2, abs=1)


def test_a_marker_near_a_border_is_a_reason_to_turn_the_camera() -> None:
    told = seen(picture([View(px_per_mm=0.7, at_px=(78.0, 240.0))], PLAIN))
    assert told.left_mm < 17
    assert told.advice == (
        f"turn the camera to the left, or zoom out: there are only {told.left_mm:.0f} mm to the "
        "left border",
    )


def test_what_lies_beyond_the_sheet_of_a_small_marker_is_no_noise() -> None:
    told = seen(picture([View(px_per_mm=0.26)], PLAIN))
    assert told.disc_px < 15
    assert told.noise_grey == pytest.approx(2, rel=0.3)


def test_small_circles_and_an_unlikely_pixel_aspect_are_told() -> None:
    small = seen(
        picture([View(px_per_mm=0.2, margin=1.0)], dataclasses.replace(PLAIN, blur_px=(0.4, 0.4)))
    )
    assert "zoom in: the circles are only 10 px across" in small.advice
    square = picture([View(aspect=1.0)], dataclasses.replace(PLAIN, width=640))
    assert "lens.pixel_aspect = 1.1" in seen(square).advice[-1]
    assert not seen(square, pixel_aspect=1.0).advice
