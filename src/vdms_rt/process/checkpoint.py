"""A run's standing between two pictures as text: from it, and the set-up, measuring goes on with
the same numbers, bit for bit."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import ClassVar

from pydantic import ConfigDict, TypeAdapter, ValidationError

from vdms_rt.measure.fieldorder import OrderEvidence
from vdms_rt.measure.smooth import Slow
from vdms_rt.model import Region, Scan, VdmsError
from vdms_rt.process.progress import Phase, Plan, Progress, Still, watches_of
from vdms_rt.process.track import Track
from vdms_rt.process.uneven import Uneven
from vdms_rt.setup import SetUp


class CheckpointError(VdmsError):
    """A recorded checkpoint cannot be used."""


@dataclass(frozen=True, slots=True)
class _Watched:
    """Of one marker, what does not follow from the set-up."""

    slow: tuple[tuple[Scan, Slow], ...]
    regions: tuple[Region, ...]
    track: Track
    uneven: Uneven
    lost_since_ns: int | None
    relocated: bool


@dataclass(frozen=True, slots=True)
class _Checkpoint:
    __pydantic_config__: ClassVar[ConfigDict] = ConfigDict(ser_json_inf_nan="constants")

    plan: Plan
    width_px: int
    height_px: int
    phase: Phase
    regions: tuple[tuple[Region, ...], ...]
    watched: tuple[_Watched, ...]
    exposure_ns: int
    period_ns: int
    revision: int
    stills: tuple[Still, ...]
    waiting: bool
    lost_since_ns: int | None
    order: Scan | None
    evidence: OrderEvidence
    order_wrong: bool
    has_set_up: bool


@dataclass(frozen=True, slots=True)
class _Outline:
    """Of a checkpoint, what a person has set and the set-up needs; other versions have it too."""

    plan: Plan
    width_px: int
    height_px: int
    phase: Phase
    regions: tuple[tuple[Region, ...], ...]
    exposure_ns: int
    period_ns: int
    revision: int
    order: Scan | None
    has_set_up: bool


_TEXT = TypeAdapter(_Checkpoint)
_OUTLINE = TypeAdapter(_Outline)


def checkpoint(progress: Progress) -> str:
    """Return all that a run knows besides its set-up, as JSON."""
    value = _Checkpoint(
        plan=progress.plan,
        width_px=progress.width_px,
        height_px=progress.height_px,
        phase=progress.phase,
        regions=progress.regions,
        watched=tuple(
            _Watched(
                tuple(watch.slow.items()),
                watch.regions,
                watch.track,
                watch.uneven,
                watch.lost_since_ns,
                watch.relocated,
            )
            for watch in progress.watches
        ),
        exposure_ns=progress.exposure_ns,
        period_ns=progress.period_ns,
        revision=progress.revision,
        stills=progress.stills,
        waiting=progress.waiting,
        lost_since_ns=progress.lost_since_ns,
        order=progress.order,
        evidence=progress.evidence,
        order_wrong=progress.order_wrong,
        has_set_up=progress.set_up is not None,
    )
    return _TEXT.dump_json(value).decode()


def is_current(text: str) -> bool:
    """Return whether `resumed` can go on from a checkpoint: not from every other version's."""
    try:
        _TEXT.validate_json(text)
    except ValidationError:
        return False
    return True


def outlined(text: str, set_up: SetUp | None, session: int) -> Progress:
    """Return the run that `checkpoint` described without what it had learnt from its pictures; also
    of another version. Its watches are empty. Raises CheckpointError as `resumed` does."""
    try:
        value = _OUTLINE.validate_json(text)
    except ValidationError:
        raise CheckpointError("a recorded checkpoint is not one of this version") from None
    return Progress(
        plan=value.plan,
        session=session,
        width_px=value.width_px,
        height_px=value.height_px,
        phase=value.phase,
        regions=value.regions,
        set_up=_in_force(value, set_up),
        exposure_ns=value.exposure_ns,
        period_ns=value.period_ns,
        revision=value.revision,
        order=value.order,
    )


def _in_force(value: _Checkpoint | _Outline, set_up: SetUp | None) -> SetUp | None:
    if value.has_set_up and set_up is None:
        raise CheckpointError(
            f"the set-up of revision {value.revision} stands in no readable part of the recording"
        )
    return set_up if value.has_set_up else None


_watches_of = lru_cache(maxsize=8)(watches_of)
"""Many checkpoints stand against one set-up, and what follows from it costs tens of frames."""


def resumed(text: str, set_up: SetUp | None, session: int) -> Progress:
    """Return the run that `checkpoint` described; `set_up` was in force then.

    Raises CheckpointError for a text that is none of this version, or whose set-up is missing.
    """
    try:
        value = _TEXT.validate_json(text)
    except ValidationError:
        raise CheckpointError("a recorded checkpoint is not one of this version") from None
    in_force = _in_force(value, set_up)
    watches = (
        _watches_of(in_force, value.plan, value.exposure_ns, value.period_ns)
        if in_force is not None and value.watched
        else ()
    )
    return Progress(
        plan=value.plan,
        session=session,
        width_px=value.width_px,
        height_px=value.height_px,
        phase=value.phase,
        regions=value.regions,
        set_up=in_force,
        watches=tuple(
            replace(
                watch,
                slow=dict(seen.slow),
                regions=seen.regions,
                track=seen.track,
                uneven=seen.uneven,
                lost_since_ns=seen.lost_since_ns,
                relocated=seen.relocated,
            )
            for watch, seen in zip(watches, value.watched, strict=True)
        ),
        exposure_ns=value.exposure_ns,
        period_ns=value.period_ns,
        revision=value.revision,
        stills=value.stills,
        waiting=value.waiting,
        lost_since_ns=value.lost_since_ns,
        order=value.order,
        evidence=value.evidence,
        order_wrong=value.order_wrong,
    )
