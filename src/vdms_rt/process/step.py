"""One picture on: the pure heart of the process stage."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np

from vdms_rt.measure.centroid import otsu_circle
from vdms_rt.measure.motion import mean_displacement, mean_rotation_mrad
from vdms_rt.measure.regions import check_regions, regions_around
from vdms_rt.model import (
    UNUSABLE_CIRCLE,
    Circle,
    CircleFlag,
    ConfigError,
    Displacement,
    Event,
    FoundMarker,
    MarkerShape,
    Picture,
    Severity,
    Status,
)
from vdms_rt.process.progress import Phase, Plan, Progress, references_of
from vdms_rt.process.reference import gather
from vdms_rt.setup import SetUp

Step = tuple[Progress, tuple[Displacement, ...], tuple[Event, ...]]


def begin(
    plan: Plan, session: int, width_px: int, height_px: int, revision: int, stored: SetUp | None
) -> Progress:
    """Return the start of a run on pictures of this size (of whole frames, in pixels).

    `stored` is used if it is of the same size. Raises ConfigError for regions that do not fit.
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
            references=references_of(stored),
            revision=max(revision, stored.revision),
            regions=tuple(m.regions for m in stored.markers),
        )
    if all(plan.regions):
        return dataclasses.replace(progress, phase=Phase.STILLS, regions=plan.regions)
    return progress


def trusted(progress: Progress) -> Progress:
    """Return the run with its stored set-up taken as it is: for recordings made with it."""
    return dataclasses.replace(progress, phase=Phase.MEASURING)


def found(progress: Progress, markers: Sequence[FoundMarker]) -> tuple[Progress, tuple[Event, ...]]:
    """Return the run after a search: regions for all markers, or still searching."""
    if progress.phase is not Phase.SEARCHING:
        return progress, ()
    by_name = {m.name: m for m in markers}
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


def _middle(marker: FoundMarker) -> str:
    x, y = np.mean(marker.centres_px, axis=0)
    return f"({x:.0f}, {y:.0f}) px"


def step(progress: Progress, picture: Picture) -> Step:
    """Return the run after one picture, one displacement for each marker, and events.

    Pure: the same progress and picture give the same values, bit for bit.
    """
    if picture.damage:
        return progress, _blank(progress, picture, Status.DAMAGED | _standing(progress)), ()
    if progress.phase is Phase.SEARCHING:
        return progress, _blank(progress, picture, Status.SET_UP), ()
    circles = tuple(
        tuple(
            otsu_circle(
                picture.image, region, shape.white_on_black, picture.row_offset, picture.row_step
            )
            for region in regions
        )
        for shape, regions in zip(progress.plan.shapes, progress.regions, strict=True)
    )
    if progress.phase in (Phase.MEASURING, Phase.STALE):
        return progress, _displacements(progress, picture, circles), ()
    blank = _blank(progress, picture, Status.SET_UP, circles)
    progress, events = gather(progress, picture, circles)
    return progress, blank, events


def _displacements(
    progress: Progress, picture: Picture, circles: tuple[tuple[Circle, ...], ...]
) -> tuple[Displacement, ...]:
    out = []
    standing = _standing(progress)
    for shape, reference, own in zip(
        progress.plan.shapes, progress.references, circles, strict=True
    ):
        good = [n for n, c in enumerate(own) if not c.flags & UNUSABLE_CIRCLE]
        if len(good) < min(3, len(own)):
            out.append(_blank_one(progress, picture, shape, standing | Status.NOT_FOUND, own))
            continue
        centres = np.array([(own[n].x_px, own[n].y_px) for n in good])
        reference_mm = reference.zero_mm[good]
        x_mm, y_mm, residual_mm = mean_displacement(reference.homography, centres, reference_mm)
        status = standing
        if len(good) < len(own):
            status |= Status.FEWER_CIRCLES
        if any(c.flags & CircleFlag.SATURATED for c in own):
            status |= Status.SATURATED
        out.append(
            dataclasses.replace(
                _blank_one(progress, picture, shape, status, own),
                x_mm=x_mm,
                y_mm=y_mm,
                rotation_mrad=mean_rotation_mrad(reference.homography, centres, reference_mm),
                residual_mm=residual_mm,
            )
        )
    return tuple(out)


def _standing(progress: Progress) -> Status:
    match progress.phase:
        case Phase.MEASURING:
            return Status.OK
        case Phase.STALE:
            return Status.SET_UP_STALE
        case _:
            return Status.SET_UP


def _blank(
    progress: Progress,
    picture: Picture,
    status: Status,
    circles: tuple[tuple[Circle, ...], ...] = (),
) -> tuple[Displacement, ...]:
    own = circles or ((),) * len(progress.plan.shapes)
    return tuple(
        _blank_one(progress, picture, shape, status, c)
        for shape, c in zip(progress.plan.shapes, own, strict=True)
    )


def _blank_one(
    progress: Progress,
    picture: Picture,
    shape: MarkerShape,
    status: Status,
    circles: tuple[Circle, ...],
) -> Displacement:
    return Displacement(
        session=progress.session,
        marker=shape.name,
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
