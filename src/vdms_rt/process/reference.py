"""Taking the reference, or checking a stored one, out of pictures of a marker at rest."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from vdms_rt.measure.aim import aim, aim_of, first_study
from vdms_rt.measure.centroid import OTSU_MOVING_PX, otsu_circle, otsu_semi_axes
from vdms_rt.measure.gate import Workspace
from vdms_rt.measure.homography import homography
from vdms_rt.measure.regions import check_circles
from vdms_rt.measure.smooth import CircleReading, Slow
from vdms_rt.measure.still import is_still, noise_px
from vdms_rt.measure.validity import learn
from vdms_rt.model import (
    UNUSABLE_CIRCLE,
    Aim,
    Circle,
    CircleFlag,
    ConfigError,
    Event,
    Picture,
    Region,
    Scan,
    Severity,
    VdmsError,
)
from vdms_rt.process.progress import Phase, Progress, Still, watches_of
from vdms_rt.setup import FieldSetUp, MarkerSetUp, SetUp

LOST_S = 1.0
"""A marker that is not in its regions for so long before the reference is searched anew."""

NOISE_LIMIT = 4.0
"""Standard deviations of the noise that do not count as a turned camera."""


def gather(
    progress: Progress, picture: Picture, work: Workspace
) -> tuple[Progress, tuple[tuple[Circle, ...], ...], tuple[Event, ...]]:
    """Return the run after one more picture before the reference, each marker's circles in it, and
    events. With enough pictures of a resting marker, this takes or checks the reference.

    Raises ConfigError when two regions lie over one circle.
    """
    still = _look(progress, picture, work)
    circles = _by_marker(progress, still.circles)
    if any(c.flags & UNUSABLE_CIRCLE for c in still.circles):
        progress, events = _interrupted(progress, picture)
        return progress, circles, events
    kinds = {s.kind for s in progress.stills} | {still.kind}
    if picture.row_step == 2:
        kinds |= {Scan.TOP, Scan.BOTTOM}
    count = progress.plan.reference_pictures
    stills = (*progress.stills, still)[-count * len(kinds) :]
    progress = dataclasses.replace(progress, stills=stills, lost_since_ns=None)
    by_kind = {k: [s for s in stills if s.kind is k] for k in sorted(kinds)}
    if any(len(same) < count for same in by_kind.values()):
        return progress, circles, ()
    if not all(is_still(_centres(same), progress.plan.still_px) for same in by_kind.values()):
        progress, events = _moving(progress)
    elif progress.phase is Phase.CHECKING:
        progress, events = _checked(progress, by_kind)
    else:
        progress, events = _referenced(progress, picture, by_kind, work)
    return progress, circles, events


def _look(progress: Progress, picture: Picture, work: Workspace) -> Still:
    circles: list[Circle] = []
    readings: list[tuple[Sequence[CircleReading], Slow]] = []
    for shape, regions in zip(progress.plan.shapes, progress.regions, strict=True):
        rows = (picture.row_offset, picture.row_step)
        own = [otsu_circle(picture.image, r, shape.white_on_black, *rows) for r in regions]
        if progress.plan.method == "smooth" and not any(c.flags & UNUSABLE_CIRCLE for c in own):
            studied = first_study(
                picture.image, *rows, *_places(picture, regions, own, shape.white_on_black), work
            )
            readings.append(studied)
            own = [circle_of(r, CircleFlag.NONE) for r in studied[0]]
        circles += own
    return Still(
        picture.kind, picture.row_offset, picture.row_step, tuple(circles), tuple(readings)
    )


def _places(
    picture: Picture, regions: Sequence[Region], circles: Sequence[Circle], white: bool
) -> tuple[tuple[tuple[float, float], ...], tuple[tuple[float, float], ...]]:
    """Return the centres and the semi-axes of circles in their regions."""
    rows = (picture.row_offset, picture.row_step)
    return (
        tuple((c.x_px, c.y_px) for c in circles),
        tuple(otsu_semi_axes(picture.image, r, white, *rows) for r in regions),
    )


def circle_of(reading: CircleReading, flags: CircleFlag) -> Circle:
    """Return a reading as a sample carries it."""
    return Circle(reading.x_px, reading.y_px, reading.area_px, abs(reading.contrast), flags)


def _interrupted(progress: Progress, picture: Picture) -> tuple[Progress, tuple[Event, ...]]:
    since = progress.lost_since_ns if progress.lost_since_ns is not None else picture.t_ns
    progress = dataclasses.replace(progress, stills=(), lost_since_ns=since)
    searchable = progress.phase is Phase.STILLS and not all(progress.plan.regions)
    if picture.t_ns - since < LOST_S * 1e9 or not searchable:
        return progress, ()
    event = Event(
        Severity.WARNING, "marker-lost", "the marker left its regions before the reference"
    )
    return (
        dataclasses.replace(progress, phase=Phase.SEARCHING, regions=(), lost_since_ns=None),
        (event,),
    )


def _moving(progress: Progress) -> tuple[Progress, tuple[Event, ...]]:
    if progress.waiting:
        return progress, ()
    text = "the marker moves; the reference is taken as soon as it rests"
    return (
        dataclasses.replace(progress, waiting=True),
        (Event(Severity.INFO, "waiting-for-still", text),),
    )


def _checked(
    progress: Progress, by_kind: dict[Scan, list[Still]]
) -> tuple[Progress, tuple[Event, ...]]:
    assert progress.set_up is not None
    set_up = progress.set_up
    now = np.mean([_centres(same).mean(axis=0) for same in by_kind.values()], axis=0)
    reference = np.array([p for m in set_up.markers for p in m.reference_px])
    moved = now - reference
    moved_px = float(np.abs(moved).max())
    turned_px = 0.0
    first = 0
    for marker in set_up.markers:
        own = moved[first : first + len(marker.regions)]
        first += len(marker.regions)
        turned_px = max(turned_px, float(np.abs(own - own.mean(axis=0)).max()))
    noise = max(m.noise_px for m in set_up.markers)
    noise *= math.sqrt(1 / set_up.stills + 1 / sum(map(len, by_kind.values())))
    turned = turned_px > progress.plan.turned_px + NOISE_LIMIT * noise
    progress = dataclasses.replace(progress, stills=(), waiting=False)
    if moved_px <= progress.plan.stale_px and not turned:
        text = (
            f"the stored set-up, revision {progress.revision}, holds: "
            f"its circles are within {moved_px:.2f} px"
        )
        event = Event(Severity.INFO, "set-up-confirmed", text)
        return dataclasses.replace(progress, phase=Phase.MEASURING), (event,)
    if turned:
        what = f"a marker's circles have moved by {turned_px:.2f} px against each other"
    else:
        what = f"a circle is {moved_px:.1f} px off"
    text = (
        f"the stored set-up does not match the picture: {what}. The camera or the marker was "
        f"{'turned' if turned else 'moved'}; put it back, or start with setup.load = false to take "
        "a new reference"
    )
    return (
        dataclasses.replace(progress, phase=Phase.STALE),
        (Event(Severity.ERROR, "set-up-stale", text),),
    )


def _referenced(
    progress: Progress, picture: Picture, by_kind: dict[Scan, list[Still]], work: Workspace
) -> tuple[Progress, tuple[Event, ...]]:
    last = next(iter(by_kind.values()))[-1]
    if faults := check_circles(last.circles):
        raise ConfigError("\n".join(faults))
    markers = []
    first = 0
    for n, (shape, regions) in enumerate(zip(progress.plan.shapes, progress.regions, strict=True)):
        own = slice(first, first + len(regions))
        first += len(regions)
        try:
            marker = _marker(progress, n, own, by_kind)
            seen = _aim(progress, picture, last.circles[own], marker, work)
            markers.append(marker.model_copy(update={"aim": seen}))
        except VdmsError as error:
            event = Event(Severity.WARNING, "no-homography", f"marker {shape.name}: {error}")
            return dataclasses.replace(progress, stills=()), (event,)
    count = progress.plan.reference_pictures
    set_up = SetUp(
        revision=progress.revision + 1,
        utc_ns=picture.utc_ns,
        width_px=progress.width_px,
        height_px=progress.height_px,
        scan=frame_scan(picture),
        method=progress.plan.method,
        stills=count * len(by_kind),
        markers=tuple(_steadied(markers)),
    )
    text = f"reference taken from {set_up.stills} pictures, set-up revision {set_up.revision}"
    period_ns = picture.period_ns * picture.row_step
    return (
        dataclasses.replace(
            progress,
            phase=Phase.MEASURING,
            set_up=set_up,
            watches=watches_of(set_up, progress.plan, picture.exposure_ns, period_ns),
            exposure_ns=picture.exposure_ns,
            period_ns=period_ns,
            revision=set_up.revision,
            stills=(),
            waiting=False,
        ),
        (Event(Severity.INFO, "reference", text),),
    )


def _marker(
    progress: Progress, n: int, own: slice, by_kind: dict[Scan, list[Still]]
) -> MarkerSetUp:
    """Return marker number n, whose circles are `own`. Raises VdmsError if they do not make a
    homography."""
    learnt = {}
    if progress.plan.method == "smooth":
        stills = {same[0].row_offset: [s.readings[n] for s in same] for same in by_kind.values()}
        learnt = learn(stills, next(iter(by_kind.values()))[0].row_step)
    fields = []
    noises = []
    for kind, same in by_kind.items():
        centres = _centres(same)[:, own]
        noises.append(noise_px(centres))
        reference = [(float(x), float(y)) for x, y in centres.mean(axis=0)]
        appearance = limits = None
        if learnt:
            appearance, limits = learnt[same[0].row_offset]
            reference = list(zip(appearance.x_px, appearance.y_px, strict=True))
        circles = [s.circles[own] for s in same]
        fields.append(
            FieldSetUp(
                kind=kind,
                reference_px=tuple(reference),
                area_px=tuple(np.mean([[c.area_px for c in p] for p in circles], axis=0).tolist()),
                contrast=tuple(
                    np.mean([[c.contrast for c in p] for p in circles], axis=0).tolist()
                ),
                appearance=appearance,
                limits=limits,
            )
        )
    shape = progress.plan.shapes[n]
    mean_px = np.mean([f.reference_px for f in fields], axis=0)
    noise = math.sqrt(np.mean(np.square(noises)))
    return MarkerSetUp(
        shape=shape,
        regions=progress.regions[n],
        noise_px=0.0 if math.isnan(noise) else noise,
        homography=homography(np.array(shape.circles_mm), mean_px).tolist(),
        fields=tuple(fields),
        axis_deg=progress.plan.axes_deg[n],
    )


def _aim(
    progress: Progress,
    picture: Picture,
    circles: tuple[Circle, ...],
    marker: MarkerSetUp,
    work: Workspace,
) -> Aim:
    """Return how the camera sees a marker whose `circles` are in the picture."""
    aspect = progress.plan.lens.pixel_aspect
    for field in marker.fields:
        if field.kind is picture.kind and field.appearance is not None:
            return aim_of(
                picture.image,
                picture.row_offset,
                progress.height_px,
                marker.shape,
                field.appearance,
                aspect,
            )
    seen = aim(
        picture.image,
        picture.row_offset,
        picture.row_step,
        progress.height_px,
        marker.shape,
        *_places(picture, marker.regions, circles, marker.shape.white_on_black),
        aspect,
        work,
    )
    sigma_px = math.hypot(marker.noise_px, OTSU_MOVING_PX) / math.sqrt(len(circles))
    return dataclasses.replace(
        seen,
        sigma_x_mm=sigma_px / seen.scale_x_px_per_mm,
        sigma_y_mm=sigma_px / seen.scale_y_px_per_mm,
    )


def _steadied(markers: Sequence[MarkerSetUp]) -> Iterator[MarkerSetUp]:
    """Give the markers with the fixed marker's errors in what is expected of the others."""
    fixed = next((m.aim for m in markers if m.shape.fixed), None)
    for marker in markers:
        seen = marker.aim
        if seen is not None and fixed is not None and not marker.shape.fixed:
            seen = dataclasses.replace(
                seen,
                sigma_x_mm=math.hypot(seen.sigma_x_mm, fixed.sigma_x_mm),
                sigma_y_mm=math.hypot(seen.sigma_y_mm, fixed.sigma_y_mm),
            )
        yield marker.model_copy(update={"aim": seen})


def frame_scan(picture: Picture) -> Scan:
    """Return the scan of the frame that a picture is of: of a field, the order in use."""
    if picture.kind is Scan.PROGRESSIVE:
        return picture.scan
    first = picture.seq % 2 == 0
    return Scan.TOP_FIRST if first == (picture.scan is Scan.TOP) else Scan.BOTTOM_FIRST


def _centres(stills: list[Still]) -> NDArray[np.float64]:
    """Return all circles' centres, (pictures, circles, 2)."""
    return np.array([[(c.x_px, c.y_px) for c in s.circles] for s in stills])


def _by_marker(progress: Progress, circles: tuple[Circle, ...]) -> tuple[tuple[Circle, ...], ...]:
    out = []
    first = 0
    for regions in progress.regions:
        out.append(circles[first : first + len(regions)])
        first += len(regions)
    return tuple(out)


def region_at(region: Region, centre_px: tuple[float, float]) -> Region:
    """Return the region moved so that its middle is at a point."""
    return dataclasses.replace(
        region,
        x_px=round(centre_px[0] - (region.width_px - 1) / 2),
        y_px=round(centre_px[1] - (region.height_px - 1) / 2),
    )
