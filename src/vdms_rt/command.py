"""What may be asked of the process stage between two frames, and what it answers: values only."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

from vdms_rt.model import Displacement, Luma, Region, Scan, State, VdmsError


@dataclass(frozen=True, slots=True)
class Find:
    """Search all markers in the whole picture, then take a new reference."""


@dataclass(frozen=True, slots=True)
class UseRegions:
    """Measure a marker's circles here, and take a new reference."""

    marker: str
    regions: tuple[Region, ...]
    """In the order of the marker's circles."""


@dataclass(frozen=True, slots=True)
class TakeReference:
    """Take a new reference where the markers are."""

    stills: int | None = None
    """Pictures of each kind; None: as many as before."""


@dataclass(frozen=True, slots=True)
class SetZero:
    """Count displacement from where a resting marker is."""

    marker: str = ""
    """Empty: each that is not fixed."""


@dataclass(frozen=True, slots=True)
class UseAxis:
    """Measure x along this direction of the marker plane, from the marker's x towards its y."""

    marker: str
    axis_deg: float


@dataclass(frozen=True, slots=True)
class UseOrder:
    """Take the fields in this order."""

    order: Scan | None
    """TOP_FIRST or BOTTOM_FIRST; None: the driver's habit, until motion proves an order."""


@dataclass(frozen=True, slots=True)
class UseSize:
    """Take the printed marker to be this large, and take a new reference."""

    marker: str
    circles_mm: tuple[tuple[float, float], ...]
    diameter_mm: float


@dataclass(frozen=True, slots=True)
class Look:
    """Show a frame and what was measured in it."""


Command: TypeAlias = (
    Find | UseRegions | TakeReference | SetZero | UseAxis | UseOrder | UseSize | Look
)


@dataclass(frozen=True, slots=True)
class Applied:
    """A command was carried out."""

    seq: int
    """Of the first picture that it affects."""
    text: str
    """What it does, one sentence."""


@dataclass(frozen=True, slots=True)
class Snapshot:
    """A frame after it was measured."""

    image: Luma
    """A copy, (height, width), uint8; of a source of alternating fields, one field."""
    scan: Scan
    seq: int
    """Of its last picture."""
    t_ns: int
    utc_ns: int
    state: State
    width_px: int
    height_px: int
    """Of whole frames."""
    regions: tuple[tuple[Region, ...], ...]
    """For each marker; empty while it is searched."""
    samples: tuple[Displacement, ...]
    """Of its last picture, one for each marker."""


class Refused(VdmsError):
    """A command cannot be carried out: why, and what helps."""

    def __init__(self, code: str, text: str) -> None:
        super().__init__(text)
        self.code = code
        """A stable word for programs."""
