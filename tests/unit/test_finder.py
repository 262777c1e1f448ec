import itertools
from dataclasses import replace

import cv2
import numpy as np
import pytest
from lab_picture import FINE, SQUARE, Lab, View, ellipse, picture, polygon

from vdms_rt.capture.laboratory import laboratory_grey
from vdms_rt.capture.table import TableSource
from vdms_rt.config import Motion, Table
from vdms_rt.measure.homography import homography, roll_deg, viewing_angle_deg
from vdms_rt.measure.marker import find_markers
from vdms_rt.measure.regions import check_regions, regions_around
from vdms_rt.model import MarkerShape, Scan

DISTANCES_M = (4.0, 8.0, 12.0, 16.0, 20.0)
ANGLES_DEG = (0.0, 15.0, 30.0, 45.0, 60.0)
BLACK = replace(SQUARE, name="black", white_on_black=False)
SIX = MarkerShape(
    "six",
    ((-80.0, 50.0), (0.0, 60.0), (80.0, 50.0), (-80.0, -50.0), (15.0, -55.0), (80.0, -50.0)),
    30.0,
)
DICE = MarkerShape(
    "dice", ((0.0, 0.0), (-60.0, 60.0), (60.0, 60.0), (-60.0, -60.0), (60.0, -60.0)), 30.0
)
GRID = MarkerShape(
    "grid", tuple((x, y) for y in (60.0, 0.0, -60.0) for x in (-60.0, 0.0, 60.0)), 25.0
)
SKEW = MarkerShape("skew", ((-60.0, 60.0), (50.0, 65.0), (-45.0, -60.0), (80.0, -20.0)), 40.0)


def assert_found(found, view, within_px=0.15, velocity_mm=(0.0, 0.0)):
    """`velocity_mm` in a frame period: the fields lie half of it apart, and a box holds both."""
    assert [f.name for f in found] == [view.shape.name]
    marker = found[0]
    off = np.abs(np.array(marker.centres_px) - view.centres())
    assert off.max() < within_px
    quarter = np.divide(velocity_mm, 4)
    comb = np.abs(view.centres(quarter) - view.centres(-quarter))
    boxes = (np.ptp(view.outlines(), axis=1) + comb) / 2
    assert np.abs(np.array(marker.semi_axes_px) - boxes).max() < 0.4 + 0.02 * boxes.max()
    assert marker.score < 0.3
    assert marker.contrast > 20


@pytest.mark.parametrize(
    ("distance", "angle", "roll", "scan", "seed"),
    [
        (4.0, 0.0, 0.0, Scan.PROGRESSIVE, 1),
        (8.0, 30.0, 15.0, Scan.BOTTOM_FIRST, 2),
        (12.0, 60.0, 0.0, Scan.TOP_FIRST, 3),
        (20.0, 60.0, -15.0, Scan.PROGRESSIVE, 4),
        (16.0, -45.0, 10.0, Scan.TOP, 5),
        (4.0, 15.0, -5.0, Scan.BOTTOM, 6),
        (8.0, 0.0, 40.0, Scan.PROGRESSIVE, 7),
        (8.0, 20.0, -40.0, Scan.PROGRESSIVE, 8),
    ],
)
def test_it_finds_the_sheet_in_a_cluttered_laboratory(distance, angle, roll, scan, seed):
    size = 1.418 if abs(roll) < 20 else 1.0
    view = View(distance_m=distance, angle_deg=angle, roll_deg=roll, px_per_mm=size)
    image = picture([view], Lab(clutter=seed, seed=seed, scan=scan))
    assert_found(find_markers(image, [SQUARE], scan), view)


@pytest.mark.slow
@pytest.mark.parametrize("distance", DISTANCES_M)
@pytest.mark.parametrize("angle", ANGLES_DEG)
def test_it_finds_the_sheet_in_every_case_of_the_paper(distance, angle):
    number = DISTANCES_M.index(distance) * 5 + ANGLES_DEG.index(angle)
    rng = np.random.default_rng(number)
    for noise, scan in itertools.product(
        (1.0, 4.0), (Scan.PROGRESSIVE, Scan.TOP_FIRST, Scan.BOTTOM_FIRST)
    ):
        view = View(
            distance_m=distance,
            angle_deg=angle * rng.choice((-1, 1)),
            roll_deg=rng.uniform(-15, 15),
            aspect=rng.uniform(0.9, 1.2),
            px_per_mm=rng.choice((0.5, 1.0, 1.3)),
            at_px=tuple(rng.uniform((300, 210), (420, 270))),
        )
        lab = Lab(
            clutter=int(rng.integers(10000)),
            noise=noise,
            gradient=rng.uniform(0, 0.4),
            gradient_deg=rng.uniform(0, 360),
            scan=scan,
            seed=number,
        )
        velocity_mm = (rng.uniform(-3.3, 3.3), 0.0)
        found = find_markers(picture([view], lab, velocity_mm=velocity_mm), [SQUARE], scan)
        assert_found(found, view, within_px=0.2, velocity_mm=velocity_mm)


@pytest.mark.parametrize("scan", [Scan.TOP_FIRST, Scan.BOTTOM_FIRST])
@pytest.mark.parametrize("speed_mm_s", [-100.0, 100.0, 200.0])
def test_a_combed_sheet_is_found_at_the_mean_of_its_fields(scan, speed_mm_s):
    view = View(angle_deg=15.0)
    velocity_mm = (speed_mm_s / 29.97, 0.0)
    found = find_markers(picture([view], Lab(scan=scan), velocity_mm=velocity_mm), [SQUARE], scan)
    assert_found(found, view, velocity_mm=velocity_mm)


@pytest.mark.parametrize("scan", [Scan.TOP, Scan.BOTTOM])
def test_one_field_gives_rows_of_the_whole_frame(scan):
    view = View(px_per_mm=0.8, at_px=(300.0, 200.0))
    whole = picture([view], Lab(noise=0.0))
    field = np.ascontiguousarray(whole[int(scan == Scan.BOTTOM) :: 2])
    assert_found(find_markers(field, [SQUARE], scan), view)


@pytest.mark.parametrize("angle", [0.0, 45.0])
def test_circles_of_10_pixels_are_enough(angle):
    across = 10 / 50 / np.cos(np.radians(angle))
    view = View(px_per_mm=across, aspect=1.0, angle_deg=angle)
    for seed in range(4):
        image = picture([view], Lab(clutter=seed, seed=seed))
        assert_found(find_markers(image, [SQUARE], Scan.PROGRESSIVE), view, within_px=0.2)


@pytest.mark.parametrize(("black", "white", "noise"), [(30, 80, 4), (10, 255, 4), (90, 140, 2)])
def test_weak_and_glaring_contrast_serve(black, white, noise):
    view = View(angle_deg=30.0, roll_deg=5.0)
    lab = Lab(black=black, white=white, noise=noise, gradient=0.4, gradient_deg=200.0)
    assert_found(find_markers(picture([view], lab), [SQUARE], Scan.PROGRESSIVE), view)


@pytest.mark.parametrize("shape", [BLACK, SIX, DICE, GRID, SKEW], ids=lambda s: s.name)
@pytest.mark.parametrize(("angle", "roll"), [(0.0, 0.0), (40.0, -12.0)])
def test_other_markers_are_found_too(shape, angle, roll):
    view = View(shape=shape, angle_deg=angle, roll_deg=roll, px_per_mm=1.2)
    image = picture([view], Lab(clutter=11))
    assert_found(find_markers(image, [shape], Scan.PROGRESSIVE), view)


def test_centres_come_in_the_order_of_the_shape():
    turned = replace(SQUARE, circles_mm=tuple(SQUARE.circles_mm[i] for i in (3, 0, 2, 1)))
    view = View(shape=turned, roll_deg=-30.0, px_per_mm=1.0)
    found = find_markers(picture([view], Lab()), [turned], Scan.PROGRESSIVE)
    assert_found(found, view)


def test_a_marker_off_its_own_zero_is_found():
    shape = replace(SKEW, circles_mm=tuple((x + 900.0, y - 400.0) for x, y in SKEW.circles_mm))
    far = View(shape=SKEW, angle_deg=20.0)
    found = find_markers(picture([far], Lab()), [shape], Scan.PROGRESSIVE)
    assert_found(found, far)


def test_shapes_are_told_apart_by_layout_and_by_diameter():
    thin = replace(SQUARE, name="thin", diameter_mm=36.0)
    views = [
        View(shape=SIX, px_per_mm=0.9, at_px=(190.0, 120.0)),
        View(shape=thin, px_per_mm=0.7, at_px=(520.0, 130.0)),
        View(shape=SQUARE, px_per_mm=0.7, at_px=(180.0, 350.0)),
        View(shape=BLACK, px_per_mm=0.7, at_px=(500.0, 350.0)),
    ]
    shapes = [BLACK, thin, SQUARE, SIX]
    found = find_markers(picture(views, Lab(clutter=3)), shapes, Scan.PROGRESSIVE)
    assert [f.name for f in found] == ["black", "thin", "m1", "six"]
    for marker, view in zip(found, (views[3], views[1], views[2], views[0]), strict=True):
        assert_found([marker], view)


def test_shapes_whose_diameters_differ_by_5_percent_are_told_apart():
    thin = replace(SQUARE, name="thin", diameter_mm=47.5)
    views = [
        View(shape=thin, px_per_mm=0.9, at_px=(200.0, 240.0)),
        View(shape=SQUARE, px_per_mm=0.9, at_px=(500.0, 240.0)),
    ]
    for shapes in ([SQUARE, thin], [thin, SQUARE]):
        found = find_markers(picture(views, Lab()), shapes, Scan.PROGRESSIVE)
        assert [f.name for f in found] == [s.name for s in shapes]
        by_name = {f.name: f for f in found}
        assert_found([by_name["thin"]], views[0])
        assert_found([by_name["m1"]], views[1])


def equal_shapes(*names):
    # The same layout in another size and another order is the same to a camera.
    half = tuple((x / 2, y / 2) for x, y in SQUARE.circles_mm)
    shapes = [replace(SQUARE, name=name) for name in names]
    shapes[-1] = replace(shapes[-1], circles_mm=half[::-1], diameter_mm=25.0)
    return shapes


def test_equal_shapes_are_taken_from_left_to_right_then_down():
    shapes = equal_shapes("a", "b", "c")
    views = [
        View(shape=shapes[0], px_per_mm=0.8, at_px=(200.0, 130.0)),
        View(shape=shapes[1], px_per_mm=0.8, at_px=(205.0, 350.0)),
        View(shape=shapes[2], px_per_mm=1.6, at_px=(500.0, 120.0)),
    ]
    found = find_markers(picture(views, Lab()), shapes, Scan.PROGRESSIVE)
    assert [f.name for f in found] == ["a", "b", "c"]
    for marker, view in zip(found, views, strict=True):
        assert_found([marker], view)


def test_of_equal_shapes_none_is_named_while_one_is_missing():
    shapes = equal_shapes("a", "b")
    views = [View(shape=shapes[0], px_per_mm=0.8)]
    assert find_markers(picture(views, Lab()), shapes, Scan.PROGRESSIVE) == []


def test_of_more_than_wanted_the_largest_is_taken():
    near, far = View(px_per_mm=0.9, at_px=(540.0, 240.0)), View(px_per_mm=0.7, at_px=(180.0, 240.0))
    found = find_markers(picture([far, near], Lab()), [SQUARE], Scan.PROGRESSIVE)
    assert_found(found, near)


def test_a_large_picture_is_found_at_its_full_scale():
    view = View(px_per_mm=3.0, angle_deg=30.0, aspect=1.0, at_px=(1100.0, 600.0))
    lab = Lab(width=1920, height=1080, scan=Scan.TOP_FIRST)
    assert_found(find_markers(picture([view], lab), [SQUARE], lab.scan), view, within_px=0.1)


@pytest.mark.parametrize(("angle", "roll"), [(0.0, 0.0), (30.0, 12.0), (60.0, -8.0)])
def test_regions_around_a_found_marker_are_good(angle, roll):
    view = View(angle_deg=angle, roll_deg=roll)
    found = find_markers(picture([view], Lab()), [SQUARE], Scan.PROGRESSIVE)
    regions = regions_around(found[0], SQUARE, 720, 480)
    assert check_regions(regions, 720, 480) == []
    for region, outline in zip(regions, view.outlines(), strict=True):
        assert (outline.min(axis=0) > (region.x_px, region.y_px)).all()
        far = (region.x_px + region.width_px - 1, region.y_px + region.height_px - 1)
        assert (outline.max(axis=0) < far).all()


def test_it_repeats_itself_and_leaves_the_picture_alone():
    image = picture([View()], Lab())
    kept = image.copy()
    image.flags.writeable = False
    first = find_markers(image, [SQUARE, BLACK], Scan.PROGRESSIVE)
    assert first == find_markers(image, [SQUARE, BLACK], Scan.PROGRESSIVE)
    np.testing.assert_array_equal(image, kept)


EVERY_SHAPE = (SQUARE, BLACK, SIX, DICE, GRID, SKEW)


def assert_nothing_found(seed):
    scan = Scan(seed % 3)
    lab = Lab(clutter=seed, seed=seed, noise=(1.0, 2.0, 4.0)[seed // 3 % 3], scan=scan)
    assert find_markers(picture([], lab), EVERY_SHAPE, scan) == []


@pytest.mark.parametrize("seed", range(20))
def test_clutter_alone_is_no_marker(seed):
    assert_nothing_found(seed)


@pytest.mark.slow
@pytest.mark.parametrize("first", range(1000, 1300, 50))
def test_no_clutter_is_a_marker(first):
    for seed in range(first, first + 50):
        assert_nothing_found(seed)


def plain(height=480, width=720):
    rng = np.random.default_rng(0)
    y, x = np.mgrid[0:height, 0:width]
    ramp = 20 + 200 * x / width + rng.normal(0, 2, x.shape)
    waves = 128 + 100 * np.sin(x / 9) * np.sin(y / 9)
    return {
        "black": np.zeros(x.shape),
        "white": np.full(x.shape, 255),
        "noise": rng.integers(0, 256, x.shape),
        "smooth noise": cv2.GaussianBlur(rng.uniform(-900, 1100, x.shape), (0, 0), 4),
        "ramp": ramp,
        "waves": waves,
    }


@pytest.mark.parametrize("name", plain())
def test_a_plain_picture_is_no_marker(name):
    image = np.clip(plain()[name], 0, 255).astype(np.uint8)
    assert find_markers(image, EVERY_SHAPE, Scan.PROGRESSIVE) == []


def discs_on_black(places_px, semi_axes_px, whites=200.0, wall=115.0):
    canvas = np.full((480 * FINE, 720 * FINE), wall, np.float32)
    polygon(canvas, [(140, 20), (580, 20), (580, 460), (140, 460)], 30.0)
    semi_axes = np.broadcast_to(semi_axes_px, (len(places_px), 2))
    for place, semi, grey in zip(
        places_px, semi_axes, np.broadcast_to(whites, len(places_px)), strict=True
    ):
        ellipse(canvas, place, semi, 0, grey)
    light = cv2.resize(canvas, (720, 480), interpolation=cv2.INTER_AREA)
    light = cv2.GaussianBlur(light, (0, 0), 0.8)
    noisy = light + np.random.default_rng(5).normal(0, 2, light.shape)
    return np.clip(noisy, 0, 255).astype(np.uint8)


CORNERS = np.array([(275.0, 155.0), (445.0, 155.0), (275.0, 325.0), (445.0, 325.0)])
RADIUS = 170 * 50 / 120 / 2


def test_the_right_discs_on_black_are_a_marker():
    found = find_markers(discs_on_black(CORNERS, (RADIUS, RADIUS)), [SQUARE], Scan.PROGRESSIVE)
    assert np.abs(np.array(found[0].centres_px) - CORNERS).max() < 0.1


@pytest.mark.parametrize(
    ("places_px", "semi_axes_px", "whites"),
    [
        (CORNERS, (RADIUS * 0.8, RADIUS * 0.8), 200.0),
        (CORNERS, (RADIUS * 1.25, RADIUS * 1.25), 200.0),
        (CORNERS, (RADIUS * 0.7, RADIUS), 200.0),
        (np.add(CORNERS, [(0, 0), (0, 0), (0, 0), (25, 0)]), (RADIUS, RADIUS), 200.0),
        (np.add(CORNERS, [(0, 0), (40, 0), (0, 0), (40, 0)]), (RADIUS, RADIUS), 200.0),
        (np.add(CORNERS, [(0, 0), (0, 0), (50, 0), (50, 0)]), (RADIUS, RADIUS), 200.0),
        (CORNERS, [(RADIUS, RADIUS)] * 3 + [(RADIUS * 0.75, RADIUS * 0.75)], 200.0),
        (CORNERS, (RADIUS, RADIUS), [200.0, 200.0, 90.0, 200.0]),
        (CORNERS[:3], (RADIUS, RADIUS), 200.0),
        (np.vstack((CORNERS, (360.0, 240.0))), (RADIUS, RADIUS), 200.0),
    ],
    ids=[
        "too small",
        "too large",
        "too narrow",
        "a corner out of place",
        "too wide a rectangle",
        "sheared",
        "one smaller",
        "one darker",
        "one missing",
        "one too many between",
    ],
)
def test_discs_in_no_view_of_the_sheet_are_no_marker(places_px, semi_axes_px, whites):
    image = discs_on_black(places_px, semi_axes_px, whites)
    assert find_markers(image, [SQUARE], Scan.PROGRESSIVE) == []


def test_lamps_before_a_wall_that_is_not_one_sheet_are_no_marker():
    canvas = discs_on_black(CORNERS, (RADIUS, RADIUS)).astype(np.float32)
    canvas[215:265, 140:580] = 150
    canvas[20:460, 335:385] = 150
    assert find_markers(canvas.astype(np.uint8), [SQUARE], Scan.PROGRESSIVE) == []


def test_a_cable_across_the_sheet_does_no_harm():
    image = discs_on_black(CORNERS, (RADIUS, RADIUS))
    cv2.line(image, (140, 230), (580, 255), 120, 5)
    found = find_markers(image, [SQUARE], Scan.PROGRESSIVE)
    assert np.abs(np.array(found[0].centres_px) - CORNERS).max() < 0.1


def test_a_mirrored_marker_is_no_marker():
    mirrored = replace(SKEW, circles_mm=tuple((-x, y) for x, y in SKEW.circles_mm))
    image = picture([View(shape=mirrored)], Lab())
    assert find_markers(image, [SKEW], Scan.PROGRESSIVE) == []


def test_a_wall_of_equal_discs_is_no_marker():
    places = np.array(list(itertools.product(range(175, 580, 60), range(45, 460, 60))), dtype=float)
    radius = 60 * 50 / 120 / 2
    image = discs_on_black(places, (radius, radius))
    assert find_markers(image, [SQUARE], Scan.PROGRESSIVE) == []


def table_picture(**change):
    motion = Motion(kind="harmonic", amplitude_mm=16.0, frequency_hz=1.0)
    table = Table(pace="fast", rest_s=0.0, motion=motion, **change)
    source = TableSource(table, [SQUARE], lambda _: None)
    image = np.empty((source.info.height_px, source.info.width_px), np.uint8)
    source.read(image, 1.0)
    source.close()
    return image, source.info.scan


def assert_found_before_the_table(angle, **change):
    image, scan = table_picture(angle_deg=angle, **change)
    found = find_markers(image, [SQUARE], scan)
    assert [f.name for f in found] == ["m1"]
    assert found[0].score < 0.3
    h = homography(np.array(SQUARE.circles_mm), np.array(found[0].centres_px))
    assert abs(roll_deg(h, 1.1) - change.get("roll_deg", 0.0)) < 2
    if angle >= 30:
        assert viewing_angle_deg(h, 1.1) == pytest.approx(angle, abs=2)


@pytest.mark.parametrize(
    ("distance", "angle", "scan"),
    [(4.0, 60.0, "bottom-first"), (8.0, 0.0, "bottom-first"), (20.0, 30.0, "progressive")],
)
def test_it_finds_the_sheet_of_the_virtual_table(distance, angle, scan):
    assert_found_before_the_table(angle, distance_m=distance, scan=scan)


@pytest.mark.slow
@pytest.mark.parametrize("distance", DISTANCES_M)
@pytest.mark.parametrize("angle", ANGLES_DEG)
def test_it_finds_the_sheet_of_the_virtual_table_in_every_case(distance, angle):
    for seed, scan in enumerate(("bottom-first", "top-first", "progressive"), 1):
        assert_found_before_the_table(
            angle,
            distance_m=distance,
            scan=scan,
            seed=seed,
            fill=(0.65, 0.4, 0.2)[seed - 1],
            roll_deg=(0.0, 12.0, -15.0)[seed - 1],
            noise_grey=(2.0, 4.0, 1.0)[seed - 1],
            exposure_ms=(0.0, 16.0, 16.0)[seed - 1],
        )


def room_alone(seed):
    room = laboratory_grey(Table(seed=seed), 0)
    noisy = room + np.random.default_rng(seed).normal(0, 2, room.shape)
    return np.clip(noisy, 0, 255).astype(np.uint8)


@pytest.mark.slow
@pytest.mark.parametrize("first", range(0, 48, 12))
def test_the_room_behind_the_virtual_table_is_no_marker(first):
    for seed in range(first, first + 12):
        assert find_markers(room_alone(seed), EVERY_SHAPE, Scan(seed % 3)) == []


@pytest.mark.parametrize("size", [(1, 1), (2, 2), (3, 5), (16, 16), (481, 719)])
@pytest.mark.parametrize("scan", list(Scan))
def test_a_picture_of_any_size_can_be_searched(size, scan):
    image = np.random.default_rng(0).integers(0, 256, size, dtype=np.uint8)
    assert find_markers(image, EVERY_SHAPE, scan) == []
    assert find_markers(image, [], scan) == []


def test_a_square_within_a_larger_marker_is_not_taken_for_the_sheet():
    view = View(shape=GRID, px_per_mm=1.2)
    found = find_markers(picture([view], Lab()), [SQUARE, GRID], Scan.PROGRESSIVE)
    assert_found(found, view)


def test_discs_in_half_shade_are_no_marker():
    image = discs_on_black(CORNERS, (RADIUS, RADIUS))
    for x, y in CORNERS.astype(int):
        part = image[y - 40 : y + 40, x - 8 : x + 40]
        part[part > 150] -= 60
    assert find_markers(image, [SQUARE], Scan.PROGRESSIVE) == []


@pytest.mark.parametrize("grey", [130, 160, 190])
def test_a_bright_part_around_a_disc_does_not_hide_it(grey):
    view = View(px_per_mm=0.4, angle_deg=-45.0, roll_deg=-4.9, aspect=0.986, at_px=(604.8, 281.3))
    image = picture([view], Lab(clutter=None))
    x, y = np.rint(view.centres()[3]).astype(int)
    wall = np.zeros(image.shape, np.uint8)
    wall[y - 90 : y + 91, x - 108 : x + 84] = 1
    cv2.fillPoly(wall, [np.rint(view.sheet()).astype(np.int32)], 0)
    image[wall > 0] = grey
    assert_found(find_markers(image, [SQUARE], Scan.PROGRESSIVE), view)
