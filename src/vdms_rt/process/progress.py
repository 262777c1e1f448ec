"""What one picture leaves for the next, from nothing to measuring."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from vdms_rt.config import Config
from vdms_rt.measure.homography import to_marker_mm
from vdms_rt.model import Circle, MarkerShape, Points, Region, State
from vdms_rt.setup import SetUp


class Phase(Enum):
    """Where a run stands on its way from nothing to measuring."""

    SEARCHING = State.SEARCHING
    STILLS = State.REFERENCE
    CHECKING = State.CHECKING
    MEASURING = State.MEASURING
    STALE = State.SET_UP_STALE


@dataclass(frozen=True, slots=True)
class Plan:
    """What the configuration asks for; the same for a whole run."""

    shapes: tuple[MarkerShape, ...]
    regions: tuple[tuple[Region, ...], ...]
    """For each marker those of the configuration; empty where it is to be found."""
    reference_pictures: int
    still_px: float
    stale_px: float
    method: str

    @classmethod
    def of(cls, config: Config) -> Plan:
        return cls(
            shapes=tuple(m.shape for m in config.marker),
            regions=tuple(m.regions if m.find == "regions" else () for m in config.marker),
            reference_pictures=config.setup.reference_pictures,
            still_px=config.setup.still_px,
            stale_px=config.setup.stale_px,
            method=config.process.method,
        )


@dataclass(frozen=True, slots=True)
class Reference:
    """One marker's reference in the form that every picture needs."""

    homography: NDArray[np.float64]
    zero_mm: Points


@dataclass(frozen=True, slots=True)
class Progress:
    """All that one picture leaves for the next. Immutable."""

    plan: Plan
    session: int
    width_px: int
    height_px: int
    phase: Phase
    regions: tuple[tuple[Region, ...], ...] = ()
    """For each marker; empty while searching."""
    set_up: SetUp | None = None
    references: tuple[Reference, ...] = ()
    revision: int = 0
    stills: tuple[Points, ...] = ()
    """Centres of all circles of all markers in the last pictures, newest last."""
    readings: tuple[tuple[Circle, ...], ...] = ()
    """The circles behind `stills`."""
    waiting: bool = False
    """The last pictures are there, but they are not still."""
    lost_since_ns: int | None = None

    @property
    def state(self) -> State:
        if self.phase is Phase.STILLS and self.waiting:
            return State.WAITING_FOR_STILL
        return self.phase.value


def references_of(set_up: SetUp) -> tuple[Reference, ...]:
    """Return the markers' references, in the set-up's order."""
    out = []
    for marker in set_up.markers:
        h = np.array(marker.homography)
        out.append(Reference(h, to_marker_mm(h, np.array(marker.reference_px))))
    return tuple(out)
