"""One marker in one picture, against its reference: circles, pose, uncertainty, status."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median

import numpy as np

from vdms_rt.measure.centroid import otsu_circle
from vdms_rt.measure.expect import Expected, Forecast
from vdms_rt.measure.gate import Workspace
from vdms_rt.measure.homography import to_image_px, to_marker
from vdms_rt.measure.lens import Lens, undistort_px
from vdms_rt.measure.motion import mean_displacement, mean_rotation_mrad
from vdms_rt.measure.observe import motion_of, observe
from vdms_rt.measure.rigid import Point, Spread, position_covariance
from vdms_rt.measure.smooth import CircleReading
from vdms_rt.measure.validity import Limits
from vdms_rt.model import UNUSABLE_CIRCLE, Circle, CircleFlag, MarkerShape, Picture, Status
from vdms_rt.process.progress import GONE, View, Watch, spread_matrices
from vdms_rt.process.reference import circle_of, region_at
from vdms_rt.process.track import REST, Course, Pose, Track

GONE_S = 0.3
"""A marker not seen for so long is searched in the whole picture."""
BENT_PX = 0.005
"""How much a circle may be off for other reasons than noise: no print and no optics are ideal."""
BENT_MM_PER_MM = 5e-4
"""The same for each millimetre of the marker's way: what is left of a lens that bends."""


@dataclass(frozen=True, slots=True)
class Seen:
    """A marker in a picture."""

    circles: tuple[Circle, ...]
    pose: Pose | None
    """None where there are too few good circles."""
    covariance_mm2: Spread
    """Of x and y; NaN with method otsu."""
    residual_mm: float
    velocity: Pose
    status: Status


UNKNOWN = (math.nan, math.nan, math.nan)


def look(
    shape: MarkerShape, watch: Watch, picture: Picture, height_px: int, work: Workspace
) -> tuple[Seen, Watch]:
    """Return a marker in a picture and what is known of it for the next.

    `height_px` is of a whole frame.
    """
    view = watch.views.get(picture.kind)
    if view is None:
        # The reference knows no such picture: a source that began to alternate, say.
        return Seen((), None, UNKNOWN, math.nan, REST, Status.NOT_FOUND), watch
    if view.forecast is None or view.limits is None:
        return _paper(shape, watch, view, picture)
    return _smooth(watch, view, view.forecast, view.limits, picture, height_px, work)


def _paper(shape: MarkerShape, watch: Watch, view: View, picture: Picture) -> tuple[Seen, Watch]:
    circles = tuple(
        otsu_circle(
            picture.image, region, shape.white_on_black, picture.row_offset, picture.row_step
        )
        for region in watch.regions
    )
    good = [n for n, c in enumerate(circles) if not c.flags & UNUSABLE_CIRCLE]
    if len(good) < 3:
        return Seen(circles, None, UNKNOWN, math.nan, REST, Status.NOT_FOUND), watch
    seen_px = np.array([(circles[n].x_px, circles[n].y_px) for n in good])
    centres = undistort_px(watch.lens, seen_px)
    zero_mm = np.array(view.zero_mm)[good]
    x_mm, y_mm, residual_mm = mean_displacement(watch.ideal, centres, zero_mm)
    rotation_mrad = mean_rotation_mrad(watch.ideal, centres, zero_mm)
    status = Status.FEWER_CIRCLES if len(good) < len(circles) else Status.OK
    return Seen(circles, (x_mm, y_mm, rotation_mrad), UNKNOWN, residual_mm, REST, status), watch


def _smooth(
    watch: Watch,
    view: View,
    forecast: Forecast,
    limits: Limits,
    picture: Picture,
    height_px: int,
    work: Workspace,
) -> tuple[Seen, Watch]:
    course = watch.track.ahead(picture.t_ns)
    expected = forecast.at(
        course.pose, course.velocity, course.acceleration, slack_px=course.slack_px
    )

    def refined(readings: Sequence[CircleReading]) -> Expected:
        nonlocal course
        course = _course(watch, course, expected, readings, picture.t_ns)
        return forecast.at(
            course.pose,
            course.velocity,
            course.acceleration,
            doubt=course.doubt,
            smeared=expected.smeared,
        )

    readings, flags, slow = observe(
        picture.image,
        picture.row_offset,
        picture.row_step,
        expected,
        limits,
        watch.slow[picture.kind],
        work,
        height_px,
        refined,
    )
    way_mm = math.hypot(course.pose[0], course.pose[1])
    tolerance_mm = BENT_PX * view.mm_per_px + BENT_MM_PER_MM * way_mm
    observation = motion_of(
        _undistorted(watch.lens, readings), flags, watch.back, view.zero_mm, tolerance_mm
    )
    circles = tuple(circle_of(r, f) for r, f in zip(readings, observation.flags, strict=True))
    motion = observation.motion
    if motion is None:
        since = watch.lost_since_ns
        if since is None:
            since = picture.t_ns
        if since != GONE and picture.t_ns - since > GONE_S * 1e9:
            since = GONE
        lost = Seen(circles, None, UNKNOWN, math.nan, REST, Status.NOT_FOUND)
        return lost, dataclasses.replace(watch, lost_since_ns=since)
    status = Status.OK
    if not all(motion.used):
        status |= Status.FEWER_CIRCLES
    if not observation.agree:
        status |= Status.RESIDUAL
    if any(c.flags & CircleFlag.SATURATED for c in circles):
        status |= Status.SATURATED
    if watch.relocated:
        status |= Status.RELOCATED
    covariance = position_covariance(motion, view.zero_mm, view.covariance_mm2)
    off_x, off_y = watch.uneven.of(picture.kind)
    now: Pose = (motion.x_mm - off_x, motion.y_mm - off_y, motion.rotation_mrad)
    # With this picture in it, so that a sudden start is not missed.
    velocity = watch.track.now(picture.t_ns, now).velocity
    seen = Seen(circles, now, covariance, motion.residual_mm, velocity, status)
    track = watch.track.with_pose(picture.t_ns, now) if observation.agree else watch.track
    after = dataclasses.replace(
        watch,
        slow={**watch.slow, picture.kind: slow},
        regions=tuple(
            region_at(region, (c.x_px, c.y_px) if not c.flags & UNUSABLE_CIRCLE else at)
            for region, c, at in zip(
                watch.regions, circles, zip(expected.x_px, expected.y_px, strict=True), strict=True
            )
        ),
        track=track,
        uneven=watch.uneven.after(picture.kind, picture.t_ns, now, watch.track, covariance),
        lost_since_ns=None,
        relocated=False,
    )
    return seen, after


def _course(
    watch: Watch,
    foretold: Course,
    expected: Expected,
    readings: Sequence[CircleReading],
    t_ns: int,
) -> Course:
    """Return how a marker moves now that its circles are seen: all of them lie as far from where
    they were foretold as the one in the middle."""
    away_x = median(r.x_px - x for r, x in zip(readings, expected.x_px, strict=True))
    away_y = median(r.y_px - y for r, y in zip(readings, expected.y_px, strict=True))
    shift_x, shift_y = expected.shift_px[0]
    away_x, away_y = away_x + shift_x, away_y + shift_y
    (a, b), (c, d) = mm_per_px(watch, foretold.pose)
    x_mm, y_mm, rotation_mrad = foretold.pose
    seen = (x_mm + a * away_x + b * away_y, y_mm + c * away_x + d * away_y, rotation_mrad)
    return watch.track.now(t_ns, seen)


def _undistorted(lens: Lens | None, readings: list[CircleReading]) -> list[CircleReading]:
    """Return the readings with their centres where a lens that bends nothing would show them."""
    if lens is None:
        return readings
    ideal = undistort_px(
        lens,
        np.array([(r.x_px, r.y_px) for r in readings]),
        spread_matrices([r.moments_px2 for r in readings]),
    )
    return [r._replace(x_px=x, y_px=y) for r, (x, y) in zip(readings, ideal.tolist(), strict=True)]


def relocated(watch: Watch, centres_px: tuple[tuple[float, float], ...], t_ns: int) -> Watch:
    """Return a lost marker's watch after a search has found its circles again."""
    (view, *_) = watch.views.values()
    zero_mm = np.array(view.zero_mm)
    centres = undistort_px(watch.lens, np.array(centres_px))
    x_mm, y_mm, _ = mean_displacement(watch.ideal, centres, zero_mm)
    turn = mean_rotation_mrad(watch.ideal, centres, zero_mm)
    return dataclasses.replace(
        watch,
        track=Track(((t_ns, (x_mm, y_mm, turn)),)),
        lost_since_ns=None,
        relocated=True,
    )


def shake_px(watch: Watch, pose: Pose) -> tuple[float, float]:
    """Return how far a fixed marker's middle has moved in the picture: the camera's shake."""
    (view, *_) = watch.views.values()
    x, y = view.middle_mm
    there = to_image_px(watch.homography, np.array([(x, y), (x + pose[0], y + pose[1])]))
    return float(there[1, 0] - there[0, 0]), float(there[1, 1] - there[0, 1])


def mm_per_px(watch: Watch, pose: Pose) -> tuple[Point, Point]:
    """Return d(mm)/d(px), 2 x 2, at the middle of a marker at a pose."""
    (view, *_) = watch.views.values()
    x, y = view.middle_mm
    at_px = to_image_px(watch.homography, np.array([(x + pose[0], y + pose[1])]))
    _, (a, b, c, d) = to_marker(watch.back, *at_px[0].tolist())
    return ((a, b), (c, d))
