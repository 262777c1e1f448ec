"""How the camera sees a marker: scale, angle, focus, light, room, and what to do about them."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np

from vdms_rt.measure.expect import (
    EDGE_PX,
    MARGIN_PX,
    Appearance,
    first_look,
    spread_px2,
)
from vdms_rt.measure.gate import Shape, Workspace, distance_px
from vdms_rt.measure.homography import (
    Matrix,
    homography,
    jacobian_mm_per_px,
    jacobian_px_per_mm,
    roll_deg,
    scale_px_per_mm,
    to_marker_mm,
    viewing_angle_deg,
)
from vdms_rt.measure.rigid import rigid_motion
from vdms_rt.measure.smooth import (
    EFFICIENCY,
    CircleReading,
    Slow,
    first_slow,
    measure,
    study,
)
from vdms_rt.measure.validity import FULL_GREY, LEAST_EDGE_PX
from vdms_rt.model import Aim, Luma, MarkerShape, Points

ASPECT_PART = 0.01
"""How far the pixel aspect of a grabber is known: what is called 1.1 is 1.097 by ITU-R BT.601, and
what samplers make of it varies by as much."""
VIDEO_WHITE_GREY = 235
"""Where ITU-R BT.601 has white; some grabbers clip there."""
INSIDE_PX = 3.0
"""Farther from the edge than this there is no blurred edge any more."""
FARTHEST_MM = 1e5

SOFT_PX = 1.1
BLURRED_PX = 1.8
"""Edge widths. The noise of a centre goes with their root: 1.1 costs a sixth against the 0.8 of a
sharp analogue picture, 1.8 half as much again."""
SATURATED_PERCENT = 0.5
LOW_CONTRAST_GREY = 80.0
NOISY_GREY = 6.0
SMALL_DISC_PX = 12.0
NARROW_PART = 0.1
"""Of the marker's extent: less room than this to a border is too little for a start."""


def aim(
    image: Luma,
    row_offset: int,
    row_step: int,
    height_px: int,
    shape: MarkerShape,
    centres_px: tuple[tuple[float, float], ...],
    semi_axes_px: tuple[tuple[float, float], ...],
    pixel_aspect: float,
    work: Workspace,
) -> Aim:
    """Return how the camera sees a marker of which only the circles' places and sizes are known,
    as a `FoundMarker` has them; no reference is needed.

    `image` is a whole frame or one field of it, as for `smooth.measure`; `height_px` is of the
    frame. Raises GeometryError for circles that fix no map to millimetres. Pure; `work` is scratch.
    """
    readings, slow = first_study(image, row_offset, row_step, centres_px, semi_axes_px, work)
    appearance = Appearance(
        row_step=row_step,
        x_px=tuple(r.x_px for r in readings),
        y_px=tuple(r.y_px for r in readings),
        area_px=tuple(r.area_px for r in readings),
        moments_px2=tuple(r.moments_px2 for r in readings),
        disc_grey=tuple(r.disc_grey for r in readings),
        ground_grey=tuple(r.ground_grey for r in readings),
        light_per_px=tuple(r.light_per_px for r in readings),
        variance_grey2=slow.variance_grey2,
        edge_px=tuple((max(x, LEAST_EDGE_PX), max(y, LEAST_EDGE_PX)) for x, y in slow.edge_px),
    )
    return aim_of(image, row_offset, height_px, shape, appearance, pixel_aspect)


def first_study(
    image: Luma,
    row_offset: int,
    row_step: int,
    centres_px: tuple[tuple[float, float], ...],
    semi_axes_px: tuple[tuple[float, float], ...],
    work: Workspace,
) -> tuple[list[CircleReading], Slow]:
    """Return what `smooth.study` does, of circles of which only places and sizes are known."""
    expected = first_look(centres_px, semi_axes_px)
    begin = first_slow(len(centres_px))
    seen, _ = measure(image, row_offset, row_step, expected, begin, work)
    # The slope of light that lies on the discs at rest is theirs: with it expected, it is not
    # divided out here, as it will not be later. Around small circles a narrower gate keeps what
    # lies beyond the sheet out.
    smallest_px = min(min(semi) for semi in semi_axes_px)
    expected = expected._replace(
        x_px=tuple(r.x_px for r in seen),
        y_px=tuple(r.y_px for r in seen),
        margin_px=min(max(math.ceil(smallest_px / 2), math.ceil(MARGIN_PX)), expected.margin_px),
        light_per_px=tuple(r.light_per_px for r in seen),
    )
    return study(image, row_offset, row_step, expected, begin, work)


def aim_of(
    image: Luma,
    row_offset: int,
    height_px: int,
    shape: MarkerShape,
    appearance: Appearance,
    pixel_aspect: float,
) -> Aim:
    """Return how the camera sees a marker whose circles look as in `appearance`; `image` is one of
    the pictures that it was learnt from.

    The viewing angle follows from foreshortening, the ratio of the singular values of the local map
    once the pixel aspect is undone (the affine part of the homography); which side is the farther
    one, from the slope of the depth along the marker. Raises GeometryError.
    """
    at_px = np.column_stack((appearance.x_px, appearance.y_px))
    circles_mm = np.array(shape.circles_mm)
    h = homography(circles_mm, at_px)
    x_mm, y_mm = circles_mm.mean(axis=0).tolist()
    middle_mm = (x_mm, y_mm)
    scale_x, scale_y = scale_px_per_mm(h, middle_mm)
    covariance_px2 = _covariance_px2(appearance)
    turn_deg, side_known = _turn(h, circles_mm, at_px, covariance_px2, pixel_aspect)
    sigma_x_mm, sigma_y_mm = _sigma_mm(h, at_px, covariance_px2)
    left_mm, right_mm, up_mm, down_mm = _room_mm(h, shape, image.shape[1], height_px)
    edges = np.array(appearance.edge_px).mean(axis=0)
    whites, blacks = appearance.disc_grey, appearance.ground_grey
    if not shape.white_on_black:
        whites, blacks = blacks, whites
    angle_deg = viewing_angle_deg(h, pixel_aspect, middle_mm)
    seen = Aim(
        marker=shape.name,
        scale_x_px_per_mm=scale_x,
        scale_y_px_per_mm=scale_y,
        pixel_aspect=pixel_aspect,
        angle_deg=angle_deg,
        angle_error_deg=max(
            abs(viewing_angle_deg(h, pixel_aspect * part, middle_mm) - angle_deg)
            for part in (1 + ASPECT_PART, 1 / (1 + ASPECT_PART))
        ),
        turn_deg=turn_deg,
        side_known=side_known,
        roll_deg=roll_deg(h, pixel_aspect, middle_mm),
        disc_px=min(4 * math.sqrt(min(xx, yy)) for xx, _, yy in appearance.moments_px2),
        edge_x_px=float(edges[0]),
        edge_y_px=float(edges[1]),
        black_grey=sum(blacks) / len(blacks),
        white_grey=sum(whites) / len(whites),
        contrast_grey=min(w - b for w, b in zip(whites, blacks, strict=True)),
        saturated_percent=max(
            _saturated_percent(image, row_offset, appearance.row_step, x, y, moments, shape)
            for x, y, moments in zip(
                appearance.x_px, appearance.y_px, appearance.moments_px2, strict=True
            )
        ),
        noise_grey=math.sqrt(appearance.variance_grey2),
        sigma_x_mm=sigma_x_mm,
        sigma_y_mm=sigma_y_mm,
        left_mm=left_mm,
        right_mm=right_mm,
        up_mm=up_mm,
        down_mm=down_mm,
        focus=_focus(float(edges[0]), float(edges[1])),
        advice=(),
    )
    return dataclasses.replace(seen, advice=_advice(seen, shape, image.shape[1], height_px))


def _focus(edge_x_px: float, edge_y_px: float) -> str:
    edge_px = math.sqrt((edge_x_px**2 + edge_y_px**2) / 2)
    if edge_px > BLURRED_PX:
        return "out of focus"
    return "a little soft" if edge_px > SOFT_PX else "sharp"


def _advice(seen: Aim, shape: MarkerShape, width_px: int, height_px: int) -> tuple[str, ...]:
    """Return what a person should do to the camera and the light, most important first."""
    advice = []
    bright = "disc" if shape.white_on_black else "sheet"
    if seen.saturated_percent > SATURATED_PERCENT:
        advice.append(
            f"turn the iris down: {seen.saturated_percent:.0f} % of the {bright} is saturated"
        )
    elif seen.contrast_grey < LOW_CONTRAST_GREY:
        advice.append(
            "open the iris or give more light: the contrast is only "
            f"{seen.contrast_grey:.0f} grey levels"
        )
    if seen.focus != "sharp":
        edge_px = max(seen.edge_x_px, seen.edge_y_px)
        advice.append(f"turn the focus ring: the edges are {edge_px:.1f} px wide")
    if seen.noise_grey > NOISY_GREY:
        advice.append(
            f"give more light and less gain: the noise is {seen.noise_grey:.1f} grey levels"
        )
    if seen.disc_px < SMALL_DISC_PX:
        advice.append(f"zoom in: the circles are only {seen.disc_px:.0f} px across")
    extent_mm = np.ptp(np.array(shape.circles_mm), axis=0).max() + shape.diameter_mm
    for side, way, room_mm in (
        ("left", "to the left", seen.left_mm),
        ("right", "to the right", seen.right_mm),
        ("upper", "up", seen.up_mm),
        ("lower", "down", seen.down_mm),
    ):
        if room_mm < NARROW_PART * extent_mm:
            advice.append(
                f"turn the camera {way}, or zoom out: there are only {room_mm:.0f} mm to the "
                f"{side} border"
            )
    usual = _usual_aspect(width_px, height_px)
    if abs(seen.pixel_aspect / usual - 1) > 2 * ASPECT_PART:
        advice.append(
            f"check lens.pixel_aspect = {seen.pixel_aspect:g}: {width_px} x {height_px} px usually "
            f"have {usual:g}, and the angle hangs on it"
        )
    return tuple(advice)


def _usual_aspect(width_px: int, height_px: int) -> float:
    """Return the pixel aspect that pictures of this size usually have."""
    if 700 <= width_px <= 768 and height_px in (480, 486):
        return 1.1
    if 700 <= width_px <= 720 and height_px == 576:
        return 0.91
    return 1.0


def _covariance_px2(appearance: Appearance) -> list[Shape]:
    """Return the covariance xx, xy, yy of each centre in one picture."""
    covariance = []
    for shape, edge, disc, ground in zip(
        appearance.moments_px2,
        appearance.edge_px,
        appearance.disc_grey,
        appearance.ground_grey,
        strict=True,
    ):
        part = EFFICIENCY**2 * appearance.variance_grey2 / ((disc - ground) ** 2 + 1e-6)
        xx, xy, yy = spread_px2(shape, edge, appearance.row_step)
        covariance.append((part * xx, part * xy, part * yy))
    return covariance


def _sigma_mm(h: Matrix, at_px: Points, covariance_px2: Sequence[Shape]) -> tuple[float, float]:
    """Return the standard deviations of x and y of the marker in one picture."""
    at_mm = [(x, y) for x, y in to_marker_mm(h, at_px).tolist()]
    covariance = []
    for j, (xx, xy, yy) in zip(jacobian_mm_per_px(h, at_px), covariance_px2, strict=True):
        (cxx, cxy), (_, cyy) = (j @ np.array([[xx, xy], [xy, yy]]) @ j.T).tolist()
        covariance.append((cxx, cxy, cyy))
    motion = rigid_motion(at_mm, at_mm, covariance, [True] * len(at_mm))
    assert motion is not None, "a homography has at least four circles"
    return math.sqrt(motion.covariance[0]), math.sqrt(motion.covariance[3])


def _turn(
    h: Matrix,
    circles_mm: Points,
    at_px: Points,
    covariance_px2: Sequence[Shape],
    pixel_aspect: float,
) -> tuple[float, bool]:
    """Return the angle about the marker's vertical between the line of sight and the marker's
    normal, and whether it is sure which side is the farther one: then it is positive for the right
    one, negative for the left one."""
    middle = circles_mm.mean(axis=0)
    local = jacobian_px_per_mm(h, middle[None])[0] / [[pixel_aspect], [1.0]]
    _, (long, short), axes = np.linalg.svd(local)
    away = axes[1]

    def slope(centres_px: Points) -> float:
        """Of the depth along the foreshortened direction, per mm, as a part of the depth."""
        map_ = homography(circles_mm, centres_px)
        return float(map_[2, :2] @ away / (map_[2] @ [*middle, 1.0]))

    depth = slope(at_px)
    variance = 0.0
    for k, (xx, _, yy) in enumerate(covariance_px2):
        for axis, square in enumerate((xx, yy)):
            moved = at_px.copy()
            moved[k, axis] += math.sqrt(square)
            variance += (slope(moved) - depth) ** 2
    tangent = math.sqrt(max(float(long / short) ** 2 - 1, 0.0))
    turn_deg = math.degrees(math.atan(tangent * abs(away[0])))
    if depth * depth < 9 * variance:
        return turn_deg, False
    return math.copysign(turn_deg, depth * away[0]), True


def _room_mm(
    h: Matrix, shape: MarkerShape, width_px: int, height_px: int
) -> tuple[float, float, float, float]:
    """Return how far the marker may go left, right, up and down in its own plane before the blurred
    edge of a circle touches a border of the picture."""
    around = 2 * math.pi * np.arange(64) / 64
    rim = shape.diameter_mm / 2 * np.column_stack((np.cos(around), np.sin(around)))
    points = (np.array(shape.circles_mm)[:, None] + rim).reshape(-1, 2)
    ahead = np.column_stack((points, np.ones(len(points)))) @ h.T
    now = ahead[:, :2] / ahead[:, 2:]
    rooms = []
    for direction in ((-1, 0), (1, 0), (0, 1), (0, -1)):
        along = h[:, :2] @ direction
        room = FARTHEST_MM
        for axis, size_px in enumerate((width_px, height_px)):
            rate = along[axis] - now[:, axis] * along[2]
            for border, outwards in ((EDGE_PX, -1), (size_px - 1 - EDGE_PX, 1)):
                with np.errstate(divide="ignore", invalid="ignore"):
                    way = (border * ahead[:, 2] - ahead[:, axis]) / (
                        along[axis] - border * along[2]
                    )
                way[((now[:, axis] - border) * outwards >= 0) & (rate * outwards > 0)] = 0.0
                room = min(room, float(way[way >= 0].min(initial=FARTHEST_MM)))
        rooms.append(room)
    left_mm, right_mm, up_mm, down_mm = rooms
    return left_mm, right_mm, up_mm, down_mm


def _saturated_percent(
    image: Luma,
    row_offset: int,
    row_step: int,
    x_px: float,
    y_px: float,
    moments: Shape,
    shape: MarkerShape,
) -> float:
    """Return how much of a disc is as bright as the picture can be, its blurred edge left out; of
    a dark disc, of the sheet around it."""
    rows, columns = image.shape
    radius = 2 * math.sqrt(np.linalg.eigvalsh(np.array([moments[:2], moments[1:]]))[0])
    beyond = 0.0 if shape.white_on_black else INSIDE_PX + radius / 2
    reach_x, reach_y = (2 * math.sqrt(m) + beyond for m in (moments[0], moments[2]))
    left, right = max(round(x_px - reach_x), 0), min(round(x_px + reach_x) + 1, columns)
    top = max(round((y_px - reach_y - row_offset) / row_step), 0)
    bottom = min(round((y_px + reach_y - row_offset) / row_step) + 1, rows)
    x = np.arange(left, right) - x_px
    y = row_offset + row_step * np.arange(top, bottom)[:, None] - y_px
    distance, _, _ = distance_px(moments, x, y)
    if shape.white_on_black:
        flat = distance < -min(INSIDE_PX, radius / 2)
    else:
        flat = (distance > INSIDE_PX) & (distance < beyond)
    grey = image[top:bottom, left:right][flat]
    if not grey.size:
        return 0.0
    full = int(np.count_nonzero(grey >= FULL_GREY))
    if grey.max() == VIDEO_WHITE_GREY:
        # A clipped picture heaps up what lies above; noise alone would thin out towards its top.
        heap = int(np.count_nonzero(grey == VIDEO_WHITE_GREY))
        if heap > np.count_nonzero(grey == VIDEO_WHITE_GREY - 1):
            full = heap
    return 100.0 * full / grey.size
