"""One marker in one picture: its circles' centres, which of them to trust, and its motion."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from vdms_rt.measure.expect import Expected
from vdms_rt.measure.gate import Workspace
from vdms_rt.measure.homography import Rows, to_marker
from vdms_rt.measure.radial import edge_fit
from vdms_rt.measure.rigid import Motion, Point, Spread, agreeing_motion
from vdms_rt.measure.smooth import CircleReading, Slow, measure, moves
from vdms_rt.measure.validity import Limits, judge
from vdms_rt.model import UNUSABLE_CIRCLE, CircleFlag, Luma

MISFIT_LIMIT = 4.5
"""Standard deviations; with two coordinates a good circle exceeds them once in 25 000 times."""
SHIFT_SHARE = 0.05
"""How far the shift to the mean over an exposure is known."""
REFIT_SHARE = 0.5
"""The same for a circle that is measured by its edge, for which it is only like that."""
SATURATED_SHARE = 2.5
"""How much larger the error of a circle is whose disc is all saturated: its edge is clipped, and
scatters 2.2 times as much."""
NEAR_PX = 1.0
FAR_PX = 3.0
"""How well a disturbed circle's place is known with and without other circles in the picture."""


def observe(
    image: Luma,
    row_offset: int,
    row_step: int,
    expected: Expected,
    limits: Limits,
    slow: Slow,
    work: Workspace,
    frame_height_px: int,
    refined: Callable[[Sequence[CircleReading]], Expected],
) -> tuple[list[CircleReading], list[CircleFlag], Slow]:
    """Return a marker's circles in one picture, their flags, and the next slow figures.

    `image` is as for `smooth.measure`. A circle whose look is wrong is measured by what is left of
    its edge: if that succeeds it is REFITTED and may be used, else it keeps the flags that say what
    is wrong. `refined` tells, where the exposure blurs the picture, what the marker should look
    like now that it is known where it is: the velocity that was foretold would not do for that.
    """
    readings, later = measure(image, row_offset, row_step, expected, slow, work)
    moving = moves(expected)
    if moving:
        expected = refined(readings)
    noise_grey = slow.variance_grey2**0.5
    flags = judge(readings, expected, limits, noise_grey, image.shape[1], frame_height_px)
    for flag in flags:
        if flag is not CircleFlag.NONE:
            for k, what in enumerate(flags):
                if what & CircleFlag.SATURATED:
                    readings[k] = _coarser(readings[k])
            _refit(image, row_offset, row_step, expected, limits, slow, readings, flags, work)
            break
    if moving:
        readings = [
            _shifted(
                reading,
                shift,
                REFIT_SHARE if flag & CircleFlag.REFITTED else SHIFT_SHARE,
                expected.doubt_px,
            )
            for reading, shift, flag in zip(readings, expected.shift_px, flags, strict=True)
        ]
    return readings, flags, later


def _coarser(reading: CircleReading) -> CircleReading:
    xx, xy, yy = reading.covariance_px2
    part = SATURATED_SHARE * SATURATED_SHARE
    return reading._replace(covariance_px2=(part * xx, part * xy, part * yy))


def _shifted(
    reading: CircleReading, shift_px: tuple[float, float], share: float, doubt_px: float
) -> CircleReading:
    """Return a reading moved to the mean over the exposure; of the shift, `share` and `doubt_px`
    are uncertain."""
    x, y = shift_px
    xx, xy, yy = reading.covariance_px2
    part, doubt = share * share, doubt_px * doubt_px
    return reading._replace(
        x_px=reading.x_px + x,
        y_px=reading.y_px + y,
        covariance_px2=(
            xx + part * x * x + doubt,
            xy + part * x * y,
            yy + part * y * y + doubt,
        ),
    )


def _refit(
    image: Luma,
    row_offset: int,
    row_step: int,
    expected: Expected,
    limits: Limits,
    slow: Slow,
    readings: list[CircleReading],
    flags: list[CircleFlag],
    work: Workspace,
) -> None:
    good = [k for k, flag in enumerate(flags) if not flag & UNUSABLE_CIRCLE]
    off_x = off_y = 0.0
    if good:
        off_x = sum(readings[k].x_px - expected.x_px[k] for k in good) / len(good)
        off_y = sum(readings[k].y_px - expected.y_px[k] for k in good) / len(good)
    for k, flag in enumerate(flags):
        if not flag & UNUSABLE_CIRCLE:
            continue
        way_x, way_y = expected.blur_px[k]
        edge_x, edge_y = slow.edge_px[k]
        fit = edge_fit(
            image,
            row_offset,
            row_step,
            (expected.x_px[k] + off_x, expected.y_px[k] + off_y),
            expected.moments_px2[k],
            ((edge_x**2 + way_x**2 / 12) ** 0.5, (edge_y**2 + way_y**2 / 12) ** 0.5),
            limits.contrast_grey[k],
            slow.variance_grey2,
            NEAR_PX if good else FAR_PX,
            work.read,
        )
        if fit is not None:
            readings[k] = fit
            flags[k] = CircleFlag.REFITTED | (flag & CircleFlag.SATURATED)


@dataclass(frozen=True, slots=True)
class Observation:
    """One marker's motion in one picture."""

    motion: Motion | None
    """None with fewer than three usable circles."""
    flags: tuple[CircleFlag, ...]
    agree: bool
    """False when the usable circles contradict each other and nobody can say which is wrong."""
    now_mm: tuple[Point, ...]
    """The circles in the marker plane."""
    covariance_mm2: tuple[Spread, ...]


def motion_of(
    readings: Sequence[CircleReading],
    flags: Sequence[CircleFlag],
    back: Rows,
    reference_mm: Sequence[Point],
    tolerance_mm: float = 0.0,
) -> Observation:
    """Return the marker's motion from its usable circles.

    Circles that contradict the others get the flag RESIDUAL and are not used. `tolerance_mm` is how
    far a circle may be off for other reasons than noise: what the lens bends between the place at
    rest and here. `back` are the rows of the map from the picture to the marker plane.
    """
    now_mm, covariance_mm2 = [], []
    for r in readings:
        xx, xy, yy = r.covariance_px2
        at, (a, b, c, d) = to_marker(back, r.x_px, r.y_px)
        now_mm.append(at)
        covariance_mm2.append(
            (
                a * a * xx + 2 * a * b * xy + b * b * yy,
                a * c * xx + (a * d + b * c) * xy + b * d * yy,
                c * c * xx + 2 * c * d * xy + d * d * yy,
            )
        )
    good = [not flag & UNUSABLE_CIRCLE for flag in flags]
    motion, agree = agreeing_motion(
        reference_mm, now_mm, covariance_mm2, good, MISFIT_LIMIT, tolerance_mm
    )
    marked = list(flags)
    if motion is not None:
        for k, (usable, used) in enumerate(zip(good, motion.used, strict=True)):
            if usable and not used:
                marked[k] |= CircleFlag.RESIDUAL
    return Observation(motion, tuple(marked), agree, tuple(now_mm), tuple(covariance_mm2))
