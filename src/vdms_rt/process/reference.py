"""Taking the reference, or checking a stored one, out of pictures of a marker at rest."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from vdms_rt.measure.homography import homography
from vdms_rt.measure.still import is_still, noise_px
from vdms_rt.model import UNUSABLE_CIRCLE, Circle, Event, Picture, Severity, VdmsError
from vdms_rt.process.progress import Phase, Progress, references_of
from vdms_rt.setup import MarkerSetUp, SetUp

LOST_S = 1.0
"""A marker that is not in its regions for so long before the reference is searched anew."""


def gather(
    progress: Progress, picture: Picture, circles: tuple[tuple[Circle, ...], ...]
) -> tuple[Progress, tuple[Event, ...]]:
    every = [c for marker in circles for c in marker]
    if any(c.flags & UNUSABLE_CIRCLE for c in every):
        return _interrupted(progress, picture)
    count = progress.plan.reference_pictures
    centres = np.array([(c.x_px, c.y_px) for c in every])
    stills = (*progress.stills, centres)[-count:]
    readings = (*progress.readings, tuple(every))[-count:]
    progress = dataclasses.replace(progress, stills=stills, readings=readings, lost_since_ns=None)
    if len(stills) < count:
        return progress, ()
    if not is_still(np.array(stills), progress.plan.still_px):
        if progress.waiting:
            return progress, ()
        text = "the marker moves; the reference is taken as soon as it rests"
        return (
            dataclasses.replace(progress, waiting=True),
            (Event(Severity.INFO, "waiting-for-still", text),),
        )
    if progress.phase is Phase.CHECKING:
        return _checked(progress)
    return _referenced(progress, picture)


def _interrupted(progress: Progress, picture: Picture) -> tuple[Progress, tuple[Event, ...]]:
    since = progress.lost_since_ns if progress.lost_since_ns is not None else picture.t_ns
    progress = dataclasses.replace(progress, stills=(), readings=(), lost_since_ns=since)
    lost_ns = picture.t_ns - since
    searchable = progress.phase is Phase.STILLS and not all(progress.plan.regions)
    if lost_ns < LOST_S * 1e9 or not searchable:
        return progress, ()
    event = Event(
        Severity.WARNING, "marker-lost", "the marker left its regions before the reference"
    )
    return (
        dataclasses.replace(progress, phase=Phase.SEARCHING, regions=(), lost_since_ns=None),
        (event,),
    )


def _checked(progress: Progress) -> tuple[Progress, tuple[Event, ...]]:
    assert progress.set_up is not None
    reference = np.array([p for m in progress.set_up.markers for p in m.reference_px])
    moved_px = float(np.abs(np.mean(progress.stills, axis=0) - reference).max())
    progress = dataclasses.replace(progress, stills=(), readings=(), waiting=False)
    if moved_px <= progress.plan.stale_px:
        text = (
            f"the stored set-up, revision {progress.revision}, holds: "
            f"its circles are within {moved_px:.2f} px"
        )
        event = Event(Severity.INFO, "set-up-confirmed", text)
        return dataclasses.replace(progress, phase=Phase.MEASURING), (event,)
    text = (
        f"the stored set-up does not match the picture: a circle is {moved_px:.1f} px off. The "
        "camera or the marker was moved; put it back, or start with setup.load = false to take a "
        "new reference"
    )
    return (
        dataclasses.replace(progress, phase=Phase.STALE),
        (Event(Severity.ERROR, "set-up-stale", text),),
    )


def _referenced(progress: Progress, picture: Picture) -> tuple[Progress, tuple[Event, ...]]:
    stills = np.array(progress.stills)
    mean_px = stills.mean(axis=0)
    area = np.mean([[c.area_px for c in r] for r in progress.readings], axis=0)
    contrast = np.mean([[c.contrast for c in r] for r in progress.readings], axis=0)
    markers = []
    at = 0
    for shape, regions in zip(progress.plan.shapes, progress.regions, strict=True):
        own = slice(at, at + len(regions))
        at += len(regions)
        try:
            h = homography(np.array(shape.circles_mm), mean_px[own])
        except VdmsError as error:
            event = Event(Severity.WARNING, "no-homography", f"marker {shape.name}: {error}")
            return dataclasses.replace(progress, stills=(), readings=()), (event,)
        noise = noise_px(stills[:, own])
        markers.append(
            MarkerSetUp(
                shape=shape,
                regions=regions,
                reference_px=tuple((float(x), float(y)) for x, y in mean_px[own]),
                area_px=tuple(float(a) for a in area[own]),
                contrast=tuple(float(c) for c in contrast[own]),
                noise_px=0.0 if math.isnan(noise) else noise,
                homography=h.tolist(),
            )
        )
    set_up = SetUp(
        revision=progress.revision + 1,
        utc_ns=picture.utc_ns,
        width_px=progress.width_px,
        height_px=progress.height_px,
        scan=picture.scan,
        method=progress.plan.method,
        stills=len(stills),
        markers=tuple(markers),
    )
    event = Event(
        Severity.INFO,
        "reference",
        f"reference taken from {len(stills)} pictures, set-up revision {set_up.revision}",
    )
    return (
        dataclasses.replace(
            progress,
            phase=Phase.MEASURING,
            set_up=set_up,
            references=references_of(set_up),
            revision=set_up.revision,
            stills=(),
            readings=(),
            waiting=False,
        ),
        (event,),
    )
