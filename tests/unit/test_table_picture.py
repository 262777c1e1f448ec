"""The virtual table's picture, against pictures that share no code with it."""

import math

import cv2
import numpy as np
import pytest

from vdms_rt.capture.laboratory import WALL
from vdms_rt.capture.motion_path import MotionPath, gauss_legendre
from vdms_rt.capture.scene import Pose, Scene
from vdms_rt.capture.table import TableSource
from vdms_rt.config import Marker, Motion, Table, TableSheet
from vdms_rt.model import MarkerShape, SourceError

SHEET = Marker().shape
FINE = 24
"""Rays for each pixel, along x and along y."""


def supersampled(
    table: Table,
    shape: MarkerShape,
    moved_mm: tuple[float, float],
    box: tuple[int, int, int, int],
    shake_mm: tuple[float, float] = (0.0, 0.0),
) -> np.ndarray:
    """Send FINE^2 rays through each pixel of left, top, width, height, ask what each one meets in
    the marker plane, blur on the fine grid, and average over the pixels."""
    left, top, width, height = box
    blurs_px = (table.blur_x_px, table.blur_y_px)
    pads = [math.ceil(4.5 * blur_px) for blur_px in blurs_px]
    columns = (np.arange((width + 2 * pads[0]) * FINE) + 0.5) / FINE - 0.5 + left - pads[0]
    across, down = (
        averages(blur_px, pad, count)
        for blur_px, pad, count in zip(blurs_px, pads, (width, height), strict=True)
    )
    picture = np.zeros((height, width))
    for n in range(height + 2 * pads[1]):
        rows = (np.arange(FINE) + 0.5) / FINE - 0.5 + top - pads[1] + n
        met = meets(table, shape, moved_mm, shake_mm, columns[None, :], rows[:, None])
        picture += down[:, n * FINE : (n + 1) * FINE] @ (met @ across.T)
    return picture * (1 + table.light_gradient * ((np.arange(width) + left) / 719 - 0.5))


def meets(
    table: Table,
    shape: MarkerShape,
    moved_mm: tuple[float, float],
    shake_mm: tuple[float, float],
    column: np.ndarray,
    row: np.ndarray,
) -> np.ndarray:
    """What the rays through places of the picture see: grey levels of a sharp, even picture."""
    x = (column - (table.width_px - 1) / 2) / table.pixel_aspect
    y = row - (table.height_px - 1) / 2
    corner2 = (table.width_px / 2 / table.pixel_aspect) ** 2 + (table.height_px / 2) ** 2
    lens = 1 - table.distortion * (x**2 + y**2) / corner2
    x, y = x * lens, y * lens
    c, s = math.cos(math.radians(table.roll_deg)), math.sin(math.radians(table.roll_deg))
    x, y = c * x - s * y, s * x + c * y
    circles = np.array(shape.circles_mm)
    low, high = circles.min(axis=0) - shape.diameter_mm, circles.max(axis=0) + shape.diameter_mm
    distance_mm = 1000 * table.distance_m
    focal = table.fill * table.height_px / (high[1] - low[1]) * distance_mm
    pan = cv2.Rodrigues(np.array([0.0, math.atan(shake_mm[0] / distance_mm), 0.0]))[0]
    tilt = cv2.Rodrigues(np.array([-math.atan(shake_mm[1] / distance_mm), 0.0, 0.0]))[0]
    turn = math.radians(table.angle_deg)
    plane = np.array(
        [
            [math.cos(turn), 0, math.sin(turn)],
            [0, 1, 0],
            [-math.sin(turn), 0, math.cos(turn)],
        ]
    )
    to_plane = plane @ (tilt @ pan).T
    right, up, ahead = (x * a - y * b + focal * c for a, b, c in to_plane.tolist())
    right = right / ahead * distance_mm * math.cos(turn) - distance_mm * math.sin(turn)
    right -= moved_mm[0]
    up = up / ahead * distance_mm * math.cos(turn) - moved_mm[1]
    ground, ink = table.black_grey, table.white_grey
    if not shape.white_on_black:
        ground, ink = ink, ground
    grey = np.full(right.shape, wall_grey(table))
    grey[(right > low[0]) & (right < high[0]) & (up > low[1]) & (up < high[1])] = ground
    for centre in circles:
        grey[(right - centre[0]) ** 2 + (up - centre[1]) ** 2 < shape.diameter_mm**2 / 4] = ink
    return grey


def wall_grey(table: Table) -> float:
    return table.black_grey + WALL * (table.white_grey - table.black_grey)


def averages(blur_px: float, pad: int, count: int) -> np.ndarray:
    """The weights of the padded fine grid in each pixel: blurred, then averaged."""
    offsets_px = np.arange(-pad * FINE, pad * FINE + 1) / FINE
    blur = np.exp(-0.5 * (offsets_px / max(blur_px, 1e-9)) ** 2)
    kernel = np.convolve(blur / blur.sum(), np.full(FINE, 1 / FINE))
    weights = np.zeros((count, (count + 2 * pad) * FINE))
    for n in range(count):
        weights[n, n * FINE : n * FINE + len(kernel)] = kernel
    return weights


def rendered(
    table: Table,
    shape: MarkerShape,
    moved_mm: tuple[float, float],
    shake_mm: tuple[float, float] = (0.0, 0.0),
) -> tuple[Scene, np.ndarray]:
    scene = Scene(table, [shape], 50.0)
    scene.render([Pose(1.0, moved_mm, shake_mm)], 0, 1)
    return scene, scene.picture.astype(np.float64)


def box_around(
    scene: Scene,
    table: Table,
    place_mm: tuple[float, float],
    shake_mm: tuple[float, float] = (0.0, 0.0),
) -> tuple[int, int, int, int]:
    """A part of the picture a little larger than a disc: left, top, width, height."""
    place = scene.camera.project(scene.camera.homography(shake_mm), np.array([place_mm]))[0]
    radius = table.fill * table.height_px / 220 * 25
    shortened = table.pixel_aspect * math.cos(math.radians(table.angle_deg))
    half = np.ceil(1.15 * radius * np.array([shortened, 1.0])).astype(int) + 4
    left, top = np.round(place).astype(int) - half
    return int(left), int(top), int(2 * half[0] + 1), int(2 * half[1] + 1)


def centre(light: np.ndarray) -> np.ndarray:
    rows, columns = np.indices(light.shape)
    return np.array([(light * columns).sum(), (light * rows).sum()]) / light.sum()


CAMERAS = {
    "square on": {},
    "60 deg from 4 m": {"angle_deg": 60.0, "distance_m": 4.0},
    "barrel, uneven light": {"distortion": -0.05, "roll_deg": -20.0, "light_gradient": 0.5},
    "no blur": {"blur_x_px": 0.0, "blur_y_px": 0.0, "angle_deg": 20.0, "roll_deg": 5.0},
}
MORE_CAMERAS = {
    "-45 deg from 20 m, rolled": {"angle_deg": -45.0, "distance_m": 20.0, "roll_deg": 10.0},
    "pincushion, near, tall pixels": {
        "distortion": 0.2,
        "distance_m": 0.6,
        "angle_deg": 30.0,
        "pixel_aspect": 0.8,
    },
    "wide blur along rows": {"blur_x_px": 2.0, "blur_y_px": 0.4},
    "sharp in y alone": {"blur_y_px": 0.1},
}


@pytest.mark.parametrize(
    "camera",
    [pytest.param(camera, id=name) for name, camera in CAMERAS.items()]
    + [pytest.param(c, id=name, marks=pytest.mark.slow) for name, c in MORE_CAMERAS.items()],
)
def test_a_disc_is_what_rays_through_every_pixel_meet(camera: dict) -> None:
    table = Table(clutter=False, fill=0.3, **{"light_gradient": 0.0, **camera})
    moved_mm = (7.3, -4.1)
    scene, picture = rendered(table, SHEET, moved_mm)
    x_mm, y_mm = SHEET.circles_mm[1]
    box = box_around(scene, table, (x_mm + moved_mm[0], y_mm + moved_mm[1]))
    left, top, width, height = box
    own = picture[top : top + height, left : left + width]
    rays = supersampled(table, SHEET, moved_mm, box)
    # The rays' own error is a 24th of a pixel along a sharp edge, some tenths of a grey level.
    sharp = min(table.blur_x_px, table.blur_y_px) < 0.3
    assert np.abs(own - rays).max() < (3.0 if sharp else 1.2)
    assert math.sqrt(((own - rays) ** 2).mean()) < (0.1 if sharp else 0.06)
    ground = rays.min()
    lit = rays - ground > 0.05
    assert centre((own - ground) * lit) == pytest.approx(centre((rays - ground) * lit), abs=0.001)


def test_black_on_white_with_the_edge_of_the_sheet_before_the_wall() -> None:
    shape = Marker(colour="black-on-white").shape
    table = Table(clutter=False, fill=0.3, angle_deg=30.0, roll_deg=3.0)
    scene, picture = rendered(table, shape, (0.0, 0.0))
    for place_mm in ((110.0, 110.0), (-60.0, 60.0)):
        left, top, width, height = box = box_around(scene, table, place_mm)
        rays = supersampled(table, shape, (0.0, 0.0), box)
        own = picture[top : top + height, left : left + width]
        assert np.abs(own - rays).max() < 1.2


def test_a_shaking_camera_moves_every_sheet_alike() -> None:
    table = Table(
        clutter=False,
        fill=0.3,
        angle_deg=30.0,
        roll_deg=-5.0,
        shake_mm=15.0,
        sheet=(TableSheet(marker="m1", moves=False),),
    )
    shake_mm = (12.0, -7.0)
    scene, picture = rendered(table, SHEET, (3.0, 3.0), shake_mm)
    left, top, width, height = box = box_around(scene, table, SHEET.circles_mm[2], shake_mm)
    rays = supersampled(table, SHEET, (0.0, 0.0), box, shake_mm)
    own = picture[top : top + height, left : left + width]
    assert np.abs(own - rays).max() < 1.2
    scale = table.fill * table.height_px / 220
    still = Scene(table, [SHEET], 0.0)
    there, here = (
        s.camera.project(s.camera.homography(by_mm), np.zeros((1, 2)))[0]
        for s, by_mm in ((scene, shake_mm), (still, (0.0, 0.0)))
    )
    turn = math.radians(table.roll_deg)
    shift = complex(*((there - here) / (table.pixel_aspect, -1))) * np.exp(-1j * turn) / scale
    assert (shift.real, shift.imag) == pytest.approx(shake_mm, rel=1e-3)


def test_the_laboratory_shakes_with_the_camera() -> None:
    table = Table(shake_mm=15.0, sheet=(), light_gradient=0.0)
    scale = table.fill * table.height_px / 220
    scene, moved = rendered(table, SHEET, (0.0, 0.0), (8 / scale / 1.1, -5 / scale))
    scene.render([Pose(1.0, (0.0, 0.0), (0.0, 0.0))], 0, 1)
    assert np.abs(moved[20:, 20:] - scene.picture[15:-5, 12:-8]).max() < 1.0
    scene.render([Pose(1.0, (0.0, 0.0), (8 / scale / 1.1, -5 / scale))], 1, 2)
    assert np.array_equal(scene.picture[1::2], moved[1::2].astype(np.float32))


def test_a_sheet_hides_the_laboratory_and_no_more() -> None:
    table = Table()
    _, with_sheet = rendered(table, SHEET, (0.0, 0.0))
    _, without = rendered(table.model_copy(update={"sheet": ()}), SHEET, (0.0, 0.0))
    inside = (slice(95, -95), slice(200, -200))
    outside = np.ones(with_sheet.shape, bool)
    outside[75:-75, 180:-180] = False
    assert np.array_equal(with_sheet[outside], without[outside])
    light = 1 + 0.1 * (np.arange(720) / 719 - 0.5)
    assert (with_sheet / light)[inside].min() == pytest.approx(table.black_grey, abs=0.01)
    assert (with_sheet / light)[inside].max() == pytest.approx(table.white_grey, abs=0.05)
    assert without[inside].std() > 15


@pytest.mark.parametrize("moved_mm", [(200.0, 0.0), (-230.0, 120.0), (0.0, 180.0), (900.0, 900.0)])
def test_a_sheet_that_leaves_the_picture_is_cut_off(moved_mm: tuple[float, float]) -> None:
    table = Table(clutter=False, light_gradient=0.0, roll_deg=4.0)
    _, cut = rendered(table, SHEET, moved_mm)
    wide = table.model_copy(
        update={"width_px": 1720, "height_px": 1480, "fill": table.fill * 480 / 1480}
    )
    _, whole = rendered(wide, SHEET, moved_mm)
    assert np.abs(cut - whole[500:-500, 500:-500]).max() < 0.02


def test_each_field_shows_the_sheet_at_its_own_time() -> None:
    motion = Motion(frequency_hz=4.0, amplitude_mm=20.0, direction_deg=30.0)
    fast = {"pace": "fast", "rest_s": 0.0, "noise_grey": 0.0, "motion": motion, "angle_deg": 20.0}
    fields = frames(Table(scan="progressive", frame_rate_hz="60000/1001", **fast), 12)
    for scan, first in (("top-first", 0), ("bottom-first", 1)):
        for n, frame in enumerate(frames(Table(scan=scan, **fast), 6)):
            for k, row in enumerate((first, 1 - first)):
                own, whole = frame[row::2].astype(int), fields[2 * n + k][row::2].astype(int)
                assert np.abs(own - whole).max() <= 1
                assert (own != whole).mean() < 0.001


def frames(table: Table, count: int) -> list[np.ndarray]:
    source = TableSource(table, [SHEET], lambda truth: None)
    out = np.zeros((table.height_px, table.width_px), np.uint8)
    pictures = []
    for _ in range(count):
        assert source.read(out, 1.0) is not None
        pictures.append(out.copy())
    return pictures


@pytest.mark.parametrize("exposure_ms", [1.0, 16.683])
def test_an_exposure_is_the_mean_of_its_moments(exposure_ms: float) -> None:
    motion = Motion(frequency_hz=5.0, amplitude_mm=10.0, direction_deg=20.0)
    table = Table(
        pace="fast",
        rest_s=0.01,
        noise_grey=0.0,
        exposure_ms=exposure_ms,
        scan="progressive",
        motion=motion,
    )
    own = frames(table, 3)[2].astype(np.float64)
    path, scene = MotionPath(motion, table.rest_s), Scene(table, [SHEET], 10.0)
    end_s = 2 * 1001 / 30000
    nodes, weights = gauss_legendre(40)
    mean = np.zeros(own.shape)
    for node, weight in zip(nodes, weights, strict=True):
        at_s = end_s - exposure_ms / 1000 * (1 - node) / 2
        x_mm, y_mm = path.at(np.array([at_s]))[0].tolist()
        scene.render([Pose(1.0, (x_mm, y_mm), (0.0, 0.0))], 0, 1)
        mean += weight * scene.picture
    assert np.abs(own - np.minimum(mean, 255)).max() < 0.6


def test_noise_is_white_fresh_and_as_strong_as_asked() -> None:
    still = {"pace": "fast", "motion": Motion(kind="still"), "clutter": False, "sheet": ()}
    quiet = frames(Table(noise_grey=0.0, **still), 1)[0].astype(np.float64)
    table = Table(noise_grey=3.0, light_gradient=0.0, **still)
    noise = [frame - wall_grey(table) for frame in frames(table, 3)]
    assert quiet.std() > 0
    for n in noise:
        assert n.mean() == pytest.approx(0, abs=5 * 3 / math.sqrt(n.size))
        assert n.var() == pytest.approx(9 + 1 / 12, rel=0.01)
        assert ((n / 3) ** 4).mean() == pytest.approx(3, rel=0.03)
    limit = 5 / math.sqrt(noise[0].size)
    pairs = [
        (noise[0], noise[1]),
        (noise[0], noise[2]),
        (noise[0][1:], noise[0][:-1]),
        (noise[0][2:], noise[0][:-2]),
        (noise[0][:, 1:], noise[0][:, :-1]),
        (noise[0][:, 4:], noise[0][:, :-4]),
    ]
    for a, b in pairs:
        assert abs(np.corrcoef(a.ravel(), b.ravel())[0, 1]) < limit


def test_too_much_light_clips() -> None:
    table = Table(white_grey=380.0, noise_grey=2.0, pace="fast", motion=Motion(kind="still"))
    picture = frames(table, 1)[0]
    assert picture.max() == 255
    disc = picture[140:170, 250:280]
    assert (disc == 255).all()


def test_the_same_seed_gives_the_same_pictures() -> None:
    tables = [Table(pace="fast", rest_s=0.0, seed=seed) for seed in (1, 1, 2)]
    first, again, other = (frames(table, 3) for table in tables)
    assert all(np.array_equal(a, b) for a, b in zip(first, again, strict=True))
    assert not np.array_equal(first[0], other[0])


def test_a_sheet_that_would_touch_the_camera_is_refused() -> None:
    with pytest.raises(SourceError, match=r"the sheet of marker m1 comes within .* of the camera"):
        Scene(Table(distance_m=0.2, angle_deg=70.0), [SHEET], 150.0)
