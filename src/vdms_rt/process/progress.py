"""What one picture leaves for the next, from nothing to measuring."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np

from vdms_rt.config import Config
from vdms_rt.measure.expect import Forecast
from vdms_rt.measure.fieldorder import OrderEvidence
from vdms_rt.measure.homography import (
    Matrix,
    reference_covariance_mm2,
    scale_px_per_mm,
    to_marker_mm,
)
from vdms_rt.measure.rigid import Covariances
from vdms_rt.measure.smooth import CircleReading, Slow
from vdms_rt.measure.validity import Limits
from vdms_rt.model import Circle, MarkerShape, Points, Region, Scan, State
from vdms_rt.process.track import Track
from vdms_rt.setup import FieldSetUp, MarkerSetUp, SetUp


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
    axes_deg: tuple[float, ...]
    reference_pictures: int
    still_px: float
    stale_px: float
    method: str

    @classmethod
    def of(cls, config: Config) -> Plan:
        return cls(
            shapes=tuple(m.shape for m in config.marker),
            regions=tuple(m.regions if m.find == "regions" else () for m in config.marker),
            axes_deg=tuple(m.axis_deg for m in config.marker),
            reference_pictures=config.setup.reference_pictures,
            still_px=config.setup.still_px,
            stale_px=config.setup.stale_px,
            method=config.process.method,
        )


@dataclass(frozen=True, slots=True)
class View:
    """One marker's reference in one kind of picture, in the form that every picture needs."""

    zero_mm: Points
    """The circles at rest, by the homography."""
    covariance_mm2: Covariances
    """Of the circles' displacement, from the errors of the reference alone."""
    mm_per_px: float
    forecast: Forecast | None
    limits: Limits | None


@dataclass(frozen=True, slots=True)
class Watch:
    """What is known of one marker from picture to picture."""

    homography: Matrix
    views: dict[Scan, View]
    slow: dict[Scan, Slow]
    regions: tuple[Region, ...]
    """Where its circles are; with method smooth they go with them."""
    track: Track = Track()
    lost_since_ns: int | None = None
    relocated: bool = False
    """Found again, and not yet measured since."""


@dataclass(frozen=True, slots=True)
class Still:
    """One picture of the stills that the reference is taken from."""

    kind: Scan
    row_offset: int
    row_step: int
    circles: tuple[Circle, ...]
    """All markers' circles, one after the other, as the method measured them."""
    readings: tuple[tuple[Sequence[CircleReading], Slow], ...]
    """For each marker, with method smooth: what `smooth.study` returned."""


@dataclass(frozen=True, slots=True)
class Progress:
    """All that one picture leaves for the next. Immutable; its dictionaries are never changed."""

    plan: Plan
    session: int
    width_px: int
    height_px: int
    """Of whole frames."""
    phase: Phase
    regions: tuple[tuple[Region, ...], ...] = ()
    """For each marker; empty while searching."""
    set_up: SetUp | None = None
    watches: tuple[Watch, ...] = ()
    revision: int = 0
    stills: tuple[Still, ...] = ()
    waiting: bool = False
    """The last pictures are there, but they are not still."""
    lost_since_ns: int | None = None
    order: Scan | None = None
    """Of the fields, where it is known better than by the driver's habit."""
    evidence: OrderEvidence = OrderEvidence()
    order_wrong: bool = False
    """Motion contradicts an order that was set by hand."""

    @property
    def state(self) -> State:
        if self.phase is Phase.STILLS and self.waiting:
            return State.WAITING_FOR_STILL
        return self.phase.value

    @property
    def searched(self) -> bool:
        """Some marker has to be found in the picture."""
        return self.phase is Phase.SEARCHING or any(lost_long(w) for w in self.watches)


def lost_long(watch: Watch) -> bool:
    """Return whether a marker is gone for so long that only a search finds it."""
    return watch.lost_since_ns == GONE


GONE = -1


def watches_of(set_up: SetUp, exposure_ns: int, period_ns: int) -> tuple[Watch, ...]:
    """Return what measuring against a set-up begins with.

    `exposure_ns` is of a field, `period_ns` of a frame.
    """
    return tuple(_watch(m, set_up, exposure_ns, period_ns) for m in set_up.markers)


def _watch(marker: MarkerSetUp, set_up: SetUp, exposure_ns: int, period_ns: int) -> Watch:
    h = np.array(marker.homography)
    return Watch(
        homography=h,
        views={f.kind: _view(f, marker, set_up, h, exposure_ns, period_ns) for f in marker.fields},
        slow={
            f.kind: Slow(f.appearance.variance_grey2, f.appearance.edge_px)
            for f in marker.fields
            if f.appearance is not None
        },
        regions=marker.regions,
    )


def _view(
    field_: FieldSetUp,
    marker: MarkerSetUp,
    set_up: SetUp,
    h: Matrix,
    exposure_ns: int,
    period_ns: int,
) -> View:
    exposure_s = exposure_ns / 1e9
    if field_.kind is Scan.PROGRESSIVE and set_up.scan.interlaced:
        # Two fields a quarter of a period before and after the middle smear as an exposure of the
        # same variance does.
        exposure_s = (exposure_s**2 + 12 * (period_ns / 4e9) ** 2) ** 0.5
    forecast = None
    if field_.appearance is not None:
        forecast = Forecast(field_.appearance, h, exposure_s)
    at_px = np.array(field_.reference_px)
    variance = marker.noise_px**2 / set_up.stills * np.eye(2)
    return View(
        zero_mm=to_marker_mm(h, at_px),
        covariance_mm2=reference_covariance_mm2(
            np.array(marker.shape.circles_mm),
            np.array(marker.reference_px),
            np.broadcast_to(variance, (len(at_px), 2, 2)),
            at_px,
        ),
        mm_per_px=1 / max(scale_px_per_mm(h)),
        forecast=forecast,
        limits=field_.limits,
    )
