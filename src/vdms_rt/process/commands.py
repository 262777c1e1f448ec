"""Commands between two frames: each is a change of `Progress`, as pure as a step."""

from __future__ import annotations

import dataclasses
import queue
from collections.abc import Mapping, Sequence
from concurrent.futures import Future

from vdms_rt.command import (
    Applied,
    Command,
    Find,
    Refused,
    SetZero,
    Snapshot,
    TakeReference,
    UseAxis,
    UseOrder,
    UseRegions,
    UseSize,
)
from vdms_rt.measure.fieldorder import OrderEvidence
from vdms_rt.measure.regions import check_regions
from vdms_rt.model import Displacement, Picture, Region, Scan
from vdms_rt.process.progress import Phase, Progress, lost_long
from vdms_rt.process.zero import moved_zero
from vdms_rt.setup import MarkerSetUp, SetUp

ZERO_SAMPLES = 60
"""Whose mean becomes the zero: a second of fields."""

Recent = Mapping[str, Sequence[Displacement]]
"""For each marker, its newest samples, the last one newest."""


class Mailbox:
    """Commands on their way to the process thread; any thread may submit."""

    def __init__(self) -> None:
        self._waiting: queue.SimpleQueue[tuple[Command, Future[Applied | Snapshot]]] = (
            queue.SimpleQueue()
        )

    def submit(self, command: Command) -> Future[Applied | Snapshot]:
        """Return the answer to come: Applied, of Look a Snapshot, or the exception Refused.

        Whoever stops waiting cancels it; a command that was cancelled in time is not carried out.
        """
        answer: Future[Applied | Snapshot] = Future()
        self._waiting.put((command, answer))
        return answer

    def take(self) -> tuple[Command, Future[Applied | Snapshot]] | None:
        """Return the oldest that is still wanted, which now runs, or None."""
        while not self._waiting.empty():
            command, answer = self._waiting.get()
            if answer.set_running_or_notify_cancel():
                return command, answer
        return None


def changed(
    progress: Progress, command: Command, picture: Picture, recent: Recent
) -> tuple[Progress, str]:
    """Return the run with a command carried out before `picture`, and what that does in a sentence.

    Raises Refused.
    """
    match command:
        case Find():
            return _finding(progress)
        case UseRegions():
            return _with_regions(progress, command, recent)
        case TakeReference():
            return _referencing(progress, command, recent)
        case SetZero():
            return _with_zero(progress, command, recent)
        case UseAxis():
            return _with_axis(progress, command)
        case UseOrder():
            return _with_order(progress, command.order, picture)
        case UseSize():
            return _with_size(progress, command)
        case _:
            raise AssertionError(command)


def with_axes(set_up: SetUp, axes_deg: Sequence[float]) -> SetUp:
    """Return a stored set-up with these directions of x, one for each marker: of the next revision
    if they are others than it had."""
    if tuple(m.axis_deg for m in set_up.markers) == tuple(axes_deg):
        return set_up
    markers = tuple(
        m.model_copy(update={"axis_deg": a}) for m, a in zip(set_up.markers, axes_deg, strict=True)
    )
    return set_up.model_copy(update={"markers": markers, "revision": set_up.revision + 1})


def _finding(progress: Progress) -> tuple[Progress, str]:
    plan = dataclasses.replace(progress.plan, regions=((),) * len(progress.plan.shapes))
    text = "looking for the marker; the reference is taken as soon as it rests"
    return _anew(progress, plan=plan, phase=Phase.SEARCHING, regions=()), text


def _with_regions(progress: Progress, command: UseRegions, recent: Recent) -> tuple[Progress, str]:
    n = _index(progress, command.marker)
    circles = len(progress.plan.shapes[n].circles_mm)
    if len(command.regions) != circles:
        raise Refused(
            "regions",
            f"marker {command.marker} has {circles} circles, {len(command.regions)} regions came; "
            "give one for each, in the order of its circles",
        )
    if not progress.regions and len(progress.plan.shapes) > 1:
        raise Refused(
            "searching",
            "the other markers are still being looked for; wait until all are found, then set one",
        )
    regions = list(_regions_now(progress, recent) or progress.plan.regions)
    regions[n] = command.regions
    everything = [r for one in regions for r in one]
    if faults := check_regions(everything, progress.width_px, progress.height_px):
        raise Refused("regions", "; ".join(faults))
    fixed = list(progress.plan.regions)
    fixed[n] = command.regions
    plan = dataclasses.replace(progress.plan, regions=tuple(fixed))
    text = f"measuring marker {command.marker} there; the reference is taken as soon as it rests"
    return _anew(progress, plan=plan, phase=Phase.STILLS, regions=tuple(regions)), text


def _referencing(
    progress: Progress, command: TakeReference, recent: Recent
) -> tuple[Progress, str]:
    if not progress.regions:
        raise Refused("searching", "no marker is found yet; aim the camera at it, or set regions")
    lost = [
        shape.name
        for shape, watch in zip(progress.plan.shapes, progress.watches, strict=False)
        if lost_long(watch)
    ]
    if lost:
        raise Refused("lost", f"marker {', '.join(lost)} is not in sight; uncover it, or find anew")
    plan = progress.plan
    if command.stills is not None:
        plan = dataclasses.replace(plan, reference_pictures=command.stills)
    text = f"taking the reference from {plan.reference_pictures} stills as soon as the marker rests"
    regions = _regions_now(progress, recent)
    return _anew(progress, plan=plan, phase=Phase.STILLS, regions=regions), text


def _regions_now(progress: Progress, recent: Recent) -> tuple[tuple[Region, ...], ...]:
    """Return the regions in which stills can be taken: those of the set-up, moved with their
    circles. The ones that follow the circles have these in their middle, and may reach beyond the
    sheet."""
    set_up = progress.set_up
    if set_up is None or not progress.watches:
        return progress.regions
    return tuple(
        marker.regions
        if plan_regions
        else _moved(marker, recent.get(marker.shape.name, ()), progress)
        for marker, plan_regions in zip(set_up.markers, progress.plan.regions, strict=True)
    )


def _moved(
    marker: MarkerSetUp, newest: Sequence[Displacement], progress: Progress
) -> tuple[Region, ...]:
    seen = [d.circles for d in newest if d.valid and d.setup_revision == progress.revision]
    if not seen:
        return marker.regions
    return tuple(
        dataclasses.replace(
            region,
            x_px=min(max(round(region.x_px + c.x_px - x), 0), progress.width_px - region.width_px),
            y_px=min(
                max(round(region.y_px + c.y_px - y), 0), progress.height_px - region.height_px
            ),
        )
        for region, c, (x, y) in zip(marker.regions, seen[-1], marker.reference_px, strict=True)
    )


def _with_zero(progress: Progress, command: SetZero, recent: Recent) -> tuple[Progress, str]:
    set_up = _measuring(progress)
    chosen = [
        n
        for n, shape in enumerate(progress.plan.shapes)
        if (shape.name == command.marker if command.marker else not shape.fixed)
    ]
    if not chosen:
        _index(progress, command.marker or progress.plan.shapes[0].name)
        raise Refused("fixed", "every marker is fixed: there is none whose zero could be set")
    markers = list(set_up.markers)
    told = []
    for n in chosen:
        name = progress.plan.shapes[n].name
        resting = _resting(progress, n, recent.get(name, ()))
        zero = moved_zero(markers[n].zero, resting, progress.plan.axes_deg[n])
        markers[n] = markers[n].model_copy(update={"zero": zero})
        told.append(f"{name} at ({zero.x_mm:+.3f}, {zero.y_mm:+.3f}) mm from its reference")
    progress = _revised(progress, set_up, markers)
    return progress, f"zero is now {', '.join(told)}, the mean of {ZERO_SAMPLES} samples"


def _resting(progress: Progress, n: int, newest: Sequence[Displacement]) -> Sequence[Displacement]:
    """Return the samples that are the new zero. Raises Refused unless the marker rests in them."""
    name = progress.plan.shapes[n].name
    last = list(newest)[-ZERO_SAMPLES:]
    good = [d for d in last if d.valid and d.setup_revision == progress.revision]
    if len(good) < ZERO_SAMPLES:
        raise Refused(
            "few-samples",
            f"only {len(good)} of the last {ZERO_SAMPLES} samples of marker {name} are valid and "
            "of the set-up in force; try again in a moment",
        )
    view = next(iter(progress.watches[n].views.values()))
    limit_mm = progress.plan.still_px * view.mm_per_px
    spread_mm = max(
        max(d.x_mm for d in good) - min(d.x_mm for d in good),
        max(d.y_mm for d in good) - min(d.y_mm for d in good),
    )
    if spread_mm > limit_mm:
        raise Refused(
            "moving",
            f"marker {name} moves: {spread_mm:.3f} mm peak to peak in the last {ZERO_SAMPLES} "
            f"samples, at most {limit_mm:.3f} mm is rest; stop the table and ask again",
        )
    return good


def _with_axis(progress: Progress, command: UseAxis) -> tuple[Progress, str]:
    n = _index(progress, command.marker)
    axes = list(progress.plan.axes_deg)
    axes[n] = command.axis_deg
    plan = dataclasses.replace(progress.plan, axes_deg=tuple(axes))
    progress = dataclasses.replace(progress, plan=plan)
    if progress.set_up is not None:
        markers = list(progress.set_up.markers)
        markers[n] = markers[n].model_copy(update={"axis_deg": command.axis_deg})
        progress = _revised(progress, progress.set_up, markers)
    return progress, (
        f"x of marker {command.marker} is now along {command.axis_deg:g} deg; to keep it, write "
        f"axis_deg = {command.axis_deg:g} into the configuration"
    )


def _with_order(progress: Progress, order: Scan | None, picture: Picture) -> tuple[Progress, str]:
    if picture.kind is Scan.PROGRESSIVE:
        raise Refused("whole-frames", "whole frames are measured, so there is no order of fields")
    progress = dataclasses.replace(
        progress, order=order, evidence=OrderEvidence(), order_wrong=False
    )
    set_up = progress.set_up
    if set_up is not None:
        update = {"order_proved": order is not None, "scan": order or set_up.scan}
        progress = _revised(progress, set_up.model_copy(update=update), set_up.markers)
    if order is None:
        return progress, "the fields come as the driver says, until motion proves their order"
    words = "top" if order is Scan.TOP_FIRST else "bottom"
    return progress, f"the {words} field is now taken as the first of each frame"


def _with_size(progress: Progress, command: UseSize) -> tuple[Progress, str]:
    n = _index(progress, command.marker)
    phase = Phase.STILLS if progress.regions else Phase.SEARCHING
    shapes = list(progress.plan.shapes)
    shapes[n] = dataclasses.replace(
        shapes[n], circles_mm=command.circles_mm, diameter_mm=command.diameter_mm
    )
    plan = dataclasses.replace(progress.plan, shapes=tuple(shapes))
    text = (
        f"marker {command.marker} is taken to be of that size from the next reference on; to keep "
        "it, write spacing_mm and diameter_mm into the configuration"
    )
    return _anew(progress, plan=plan, phase=phase), text


def _index(progress: Progress, marker: str) -> int:
    names = [shape.name for shape in progress.plan.shapes]
    if marker not in names:
        raise Refused(
            "unknown-marker", f'there is no marker "{marker}" here; there is {", ".join(names)}'
        )
    return names.index(marker)


def _measuring(progress: Progress) -> SetUp:
    if progress.set_up is None or progress.phase is not Phase.MEASURING:
        raise Refused(
            "not-measuring", f"nothing is measured yet: {progress.state.value}; wait for measuring"
        )
    return progress.set_up


def _anew(progress: Progress, **changes: object) -> Progress:
    """Return the run on its way to a new reference."""
    return dataclasses.replace(
        progress,
        **{  # type: ignore[arg-type]
            "watches": (),
            "stills": (),
            "waiting": False,
            "lost_since_ns": None,
        }
        | changes,
    )


def _revised(progress: Progress, set_up: SetUp, markers: Sequence[MarkerSetUp]) -> Progress:
    revision = progress.revision + 1
    set_up = set_up.model_copy(update={"markers": tuple(markers), "revision": revision})
    return dataclasses.replace(progress, set_up=set_up, revision=revision)
