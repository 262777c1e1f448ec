"""One picture on: the pure heart of the process stage."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np

from vdms_rt.measure.fieldorder import with_field
from vdms_rt.measure.gate import Workspace
from vdms_rt.measure.regions import check_regions, regions_around
from vdms_rt.model import (
    Circle,
    ConfigError,
    Displacement,
    Event,
    FoundMarker,
    Picture,
    Scan,
    Severity,
    Status,
    damage_status,
)
from vdms_rt.process.observing import Seen, look, mm_per_px, relocated, shake_px
from vdms_rt.process.progress import Phase, Plan, Progress, lost_long, watches_of
from vdms_rt.process.reference import frame_scan, gather
from vdms_rt.setup import SetUp

SETTLED_NS = 200_000
"""Standard deviation of a picture's time above which the frame clock is not at its best: 0.2 ms is
0.13 % of a motion at 1 Hz."""

Step = tuple[Progress, tuple[Displacement, ...], tuple[Event, ...]]


def begin(
    plan: Plan,
    session: int,
    width_px: int,
    height_px: int,
    revision: int = 0,
    stored: SetUp | None = None,
    exposure_ns: int = 0,
    period_ns: int = 0,
) -> Progress:
    """Return the start of a run on pictures of this size (of whole frames, in pixels).

    `stored` is used if it is of the same size; `exposure_ns` is of a field, `period_ns` of a frame.
    Raises ConfigError for regions that do not fit.
    """
    progress = Progress(plan, session, width_px, height_px, Phase.SEARCHING, revision=revision)
    fixed = [region for regions in plan.regions for region in regions]
    if faults := check_regions(fixed, width_px, height_px):
        raise ConfigError("\n".join(faults))
    if stored is not None and (stored.width_px, stored.height_px) == (width_px, height_px):
        return dataclasses.replace(
            progress,
            phase=Phase.CHECKING,
            set_up=stored,
            watches=watches_of(stored, plan, exposure_ns, period_ns),
            exposure_ns=exposure_ns,
            period_ns=period_ns,
            revision=max(revision, stored.revision),
            regions=tuple(m.regions for m in stored.markers),
            order=stored.scan if stored.order_proved else None,
        )
    if all(plan.regions):
        return dataclasses.replace(progress, phase=Phase.STILLS, regions=plan.regions)
    return progress


def trusted(progress: Progress) -> Progress:
    """Return the run with its stored set-up taken as it is: for recordings made with it."""
    return dataclasses.replace(progress, phase=Phase.MEASURING)


def found(
    progress: Progress, markers: Sequence[FoundMarker], t_ns: int
) -> tuple[Progress, tuple[Event, ...]]:
    """Return the run after a search in a picture taken at `t_ns`: regions for all markers, lost
    ones at their new place, or still searching."""
    by_name = {m.name: m for m in markers}
    if progress.phase is not Phase.SEARCHING:
        return _found_again(progress, by_name, t_ns)
    regions = []
    for shape, fixed in zip(progress.plan.shapes, progress.plan.regions, strict=True):
        if not fixed and shape.name not in by_name:
            return progress, ()
        regions.append(
            fixed
            or regions_around(by_name[shape.name], shape, progress.width_px, progress.height_px)
        )
    seen = ", ".join(f"{m.name} at {_middle(m)}" for m in markers)
    event = Event(Severity.INFO, "marker-found", f"found marker {seen}")
    return (
        dataclasses.replace(
            progress, phase=Phase.STILLS, regions=tuple(regions), lost_since_ns=None, stills=()
        ),
        (event,),
    )


def _found_again(
    progress: Progress, by_name: dict[str, FoundMarker], t_ns: int
) -> tuple[Progress, tuple[Event, ...]]:
    watches = list(progress.watches)
    events = []
    for n, (shape, watch) in enumerate(zip(progress.plan.shapes, watches, strict=True)):
        if lost_long(watch) and shape.name in by_name:
            watches[n] = relocated(watch, by_name[shape.name].centres_px, t_ns)
            text = f"found marker {shape.name} again at {_middle(by_name[shape.name])}"
            events.append(Event(Severity.INFO, "marker-found-again", text))
    return dataclasses.replace(progress, watches=tuple(watches)), tuple(events)


def _middle(marker: FoundMarker) -> str:
    x, y = np.mean(marker.centres_px, axis=0)
    return f"({x:.0f}, {y:.0f}) px"


def step(progress: Progress, picture: Picture, work: Workspace) -> Step:
    """Return the run after one picture, one displacement for each marker, and events.

    Pure: the same progress and picture give the same values, bit for bit; `work` is scratch.
    """
    if picture.damage:
        status = damage_status(picture.damage) | _standing(progress, picture)
        return progress, _blank(progress, picture, status), ()
    if progress.phase is Phase.SEARCHING:
        return progress, _blank(progress, picture, Status.SET_UP), ()
    if progress.phase in (Phase.MEASURING, Phase.STALE):
        return _measured(progress, picture, work)
    progress, circles, events = gather(progress, picture, work)
    return progress, _blank(progress, picture, Status.SET_UP, circles), events


def _measured(progress: Progress, picture: Picture, work: Workspace) -> Step:
    watches = []
    sights = []
    events: list[Event] = []
    for shape, watch in zip(progress.plan.shapes, progress.watches, strict=True):
        seen, after = look(shape, watch, picture, progress.height_px, work)
        if lost_long(after) and not lost_long(watch):
            text = f"marker {shape.name} is lost: it is searched in the whole picture"
            events.append(Event(Severity.WARNING, "marker-lost", text))
        watches.append(after)
        sights.append(seen)
    progress = dataclasses.replace(
        progress, watches=tuple(watches), regions=tuple(w.regions for w in watches)
    )
    progress, said = _ordered(progress, picture, sights)
    standing = _standing(progress, picture)
    samples = tuple(
        _sample(progress, picture, n, seen, standing, _shake(progress, sights, n))
        for n, seen in enumerate(sights)
    )
    return progress, samples, (*events, *said)


Shake = tuple[tuple[float, float], Seen] | None


def _shake(progress: Progress, sights: Sequence[Seen], n: int) -> Shake:
    """Return the camera's shake in pixels and the fixed marker that shows it; None where marker n
    is itself fixed or no marker is."""
    if progress.plan.shapes[n].fixed:
        return None
    for shape, watch, seen in zip(progress.plan.shapes, progress.watches, sights, strict=True):
        if shape.fixed:
            at = shake_px(watch, seen.pose) if seen.pose else (math.nan, math.nan)
            return at, seen
    return None


def _sample(
    progress: Progress, picture: Picture, n: int, seen: Seen, standing: Status, shake: Shake
) -> Displacement:
    blank = _blank_one(progress, picture, n, standing | seen.status, seen.circles)
    if seen.pose is None:
        return blank
    x_mm, y_mm, rotation_mrad = seen.pose
    xx, xy, yy = seen.covariance_mm2
    if shake is not None:
        (shift_x, shift_y), fixed = shake
        if fixed.pose is None:
            return dataclasses.replace(blank, status=blank.status | Status.FIXED_LOST)
        (a, b), (c, d) = mm_per_px(progress.watches[n], seen.pose)
        x_mm -= a * shift_x + b * shift_y
        y_mm -= c * shift_x + d * shift_y
        fxx, fxy, fyy = fixed.covariance_mm2
        xx, xy, yy = xx + fxx, xy + fxy, yy + fyy
    # The position's error from the time's: v sigma_t.
    time_s = picture.sigma_t_ns / 1e9
    vx, vy = seen.velocity[0] * time_s, seen.velocity[1] * time_s
    xx, xy, yy = xx + vx * vx, xy + vx * vy, yy + vy * vy
    if axis_deg := progress.plan.axes_deg[n]:
        cos, sin = math.cos(math.radians(axis_deg)), math.sin(math.radians(axis_deg))
        x_mm, y_mm = cos * x_mm + sin * y_mm, cos * y_mm - sin * x_mm
        xx, yy = (
            cos * cos * xx + 2 * cos * sin * xy + sin * sin * yy,
            sin * sin * xx - 2 * cos * sin * xy + cos * cos * yy,
        )
    return dataclasses.replace(
        blank,
        x_mm=x_mm,
        y_mm=y_mm,
        rotation_mrad=rotation_mrad,
        sigma_x_mm=math.sqrt(xx),
        sigma_y_mm=math.sqrt(yy),
        residual_mm=seen.residual_mm,
    )


def _ordered(
    progress: Progress, picture: Picture, sights: Sequence[Seen]
) -> tuple[Progress, tuple[Event, ...]]:
    """Return the run with one field more of evidence for the order of the fields."""
    if picture.kind is Scan.PROGRESSIVE:
        return progress, ()
    moving = [
        s.pose for s, shape in zip(sights, progress.plan.shapes, strict=True) if not shape.fixed
    ]
    if not moving or moving[0] is None:
        return progress, ()
    sigma_mm = math.sqrt(max(sights[0].covariance_mm2[0], 0.0))
    evidence = with_field(
        progress.evidence,
        picture.frame_seq,
        picture.scan,
        moving[0][:2],
        0.02 if math.isnan(sigma_mm) else sigma_mm,
    )
    progress = dataclasses.replace(progress, evidence=evidence)
    used = frame_scan(picture)
    proved = evidence.order
    if proved is None or (proved is used and (progress.order or picture.order_known)):
        if proved is used and progress.order_wrong:
            return dataclasses.replace(progress, order_wrong=False), ()
        return progress, ()
    words = "top field first" if proved is Scan.TOP_FIRST else "bottom field first"
    if picture.order_known:
        if progress.order_wrong:
            return progress, ()
        text = (
            f"the field order that was set is wrong: motion shows {words} ({evidence.how_sure}); "
            "correct field_order in the configuration"
        )
        event = Event(Severity.ERROR, "field-order-wrong", text)
        return dataclasses.replace(progress, order_wrong=True), (event,)
    verb = "proved" if proved is used else "corrected"
    text = f"field order {verb} by motion: {words}, {evidence.how_sure}"
    return _with_order(progress, proved), (Event(Severity.INFO, "field-order", text),)


def _with_order(progress: Progress, order: Scan) -> Progress:
    set_up = progress.set_up
    if set_up is None:
        return dataclasses.replace(progress, order=order)
    set_up = set_up.model_copy(
        update={"scan": order, "order_proved": True, "revision": set_up.revision + 1}
    )
    return dataclasses.replace(progress, order=order, set_up=set_up, revision=set_up.revision)


def _standing(progress: Progress, picture: Picture) -> Status:
    match progress.phase:
        case Phase.MEASURING:
            status = Status.OK
        case Phase.STALE:
            status = Status.SET_UP_STALE
        case _:
            return Status.SET_UP
    if picture.sigma_t_ns > SETTLED_NS:
        status |= Status.CLOCK_SETTLING
    if picture.kind is not Scan.PROGRESSIVE:
        if progress.order_wrong:
            status |= Status.FIELD_ORDER_WRONG
        elif progress.order is None and not picture.order_known:
            status |= Status.FIELD_ORDER_UNCONFIRMED
    return status


def _blank(
    progress: Progress,
    picture: Picture,
    status: Status,
    circles: tuple[tuple[Circle, ...], ...] = (),
) -> tuple[Displacement, ...]:
    own = circles or ((),) * len(progress.plan.shapes)
    return tuple(_blank_one(progress, picture, n, status, c) for n, c in enumerate(own))


def _blank_one(
    progress: Progress, picture: Picture, n: int, status: Status, circles: tuple[Circle, ...]
) -> Displacement:
    return Displacement(
        session=progress.session,
        marker=progress.plan.shapes[n].name,
        seq=picture.seq,
        frame_seq=picture.frame_seq,
        scan=picture.scan,
        segment=picture.segment,
        stamp_ns=picture.stamp_ns,
        t_ns=picture.t_ns,
        sigma_t_ns=picture.sigma_t_ns,
        utc_ns=picture.utc_ns,
        setup_revision=progress.revision,
        x_mm=math.nan,
        y_mm=math.nan,
        rotation_mrad=math.nan,
        sigma_x_mm=math.nan,
        sigma_y_mm=math.nan,
        residual_mm=math.nan,
        status=status,
        circles=circles,
    )
