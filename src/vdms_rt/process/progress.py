"""What one picture leaves for the next, from nothing to measuring."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from vdms_rt.config import Config
from vdms_rt.config import Lens as LensSection
from vdms_rt.measure.expect import Forecast
from vdms_rt.measure.fieldorder import OrderEvidence
from vdms_rt.measure.gate import Shape
from vdms_rt.measure.homography import (
    Matrix,
    Rows,
    homography,
    inverse,
    reference_covariance_mm2,
    scale_px_per_mm,
    to_marker_mm,
)
from vdms_rt.measure.lens import Lens, lens_for, undistort_px
from vdms_rt.measure.rigid import Point, Spread
from vdms_rt.measure.smooth import CircleReading, Slow
from vdms_rt.measure.validity import Limits
from vdms_rt.model import Circle, MarkerShape, Points, Region, Scan, State
from vdms_rt.process.track import Track
from vdms_rt.process.uneven import NO_UNEVEN, Uneven
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
    lens: LensSection
    reference_pictures: int
    still_px: float
    stale_px: float
    turned_px: float
    method: str

    @classmethod
    def of(cls, config: Config) -> Plan:
        return cls(
            shapes=tuple(m.shape for m in config.marker),
            regions=tuple(m.regions if m.find == "regions" else () for m in config.marker),
            axes_deg=tuple(m.axis_deg for m in config.marker),
            lens=config.lens,
            reference_pictures=config.setup.reference_pictures,
            still_px=config.setup.still_px,
            stale_px=config.setup.stale_px,
            turned_px=config.setup.turned_px,
            method=config.process.method,
        )


@dataclass(frozen=True, slots=True)
class View:
    """One marker's reference in one kind of picture, in the form that every picture needs."""

    zero_mm: tuple[Point, ...]
    """The circles at rest, by the homography."""
    middle_mm: Point
    """Their mean."""
    covariance_mm2: tuple[Spread, ...]
    """Of the circles' displacement, from the errors of the reference alone."""
    mm_per_px: float
    forecast: Forecast | None
    limits: Limits | None


@dataclass(frozen=True, slots=True)
class Watch:
    """What is known of one marker from picture to picture."""

    homography: Matrix
    """To pixels as the lens shows them: tells where circles are seen."""
    ideal: Matrix
    """To pixels as a lens that bends nothing would show them: tells millimetres."""
    back: Rows
    """The rows of the inverse of `ideal`."""
    lens: Lens | None
    views: dict[Scan, View]
    slow: dict[Scan, Slow]
    regions: tuple[Region, ...]
    """Where its circles are; with method smooth they go with them."""
    track: Track = Track()
    uneven: Uneven = NO_UNEVEN
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
    exposure_ns: int = 0
    """Of a field, as the watches take it."""
    period_ns: int = 0
    """Of a frame, as the watches take it."""
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


def watches_of(set_up: SetUp, plan: Plan, exposure_ns: int, period_ns: int) -> tuple[Watch, ...]:
    """Return what measuring against a set-up begins with.

    `exposure_ns` is of a field, `period_ns` of a frame. Raises ConfigError for a lens that does not
    fit the picture.
    """
    lens = lens_for(
        plan.lens.k1,
        plan.lens.k2,
        plan.lens.centre_px,
        plan.lens.pixel_aspect,
        set_up.width_px,
        set_up.height_px,
    )
    exposure_s = exposure_ns / 1e9
    if set_up.scan.interlaced:
        # In a whole frame two fields, a quarter of a period before and after the middle, smear as
        # an exposure of the same variance does.
        woven_s = (exposure_s**2 + 12 * (period_ns / 4e9) ** 2) ** 0.5
    else:
        woven_s = exposure_s
    return tuple(_watch(m, set_up, lens, exposure_s, woven_s) for m in set_up.markers)


def _watch(
    marker: MarkerSetUp, set_up: SetUp, lens: Lens | None, exposure_s: float, woven_s: float
) -> Watch:
    h = np.array(marker.homography)
    circles_mm = np.array(marker.shape.circles_mm)
    kinds_px = [_ideal_px(lens, f) for f in marker.fields]
    reference_px = np.mean(kinds_px, axis=0)
    ideal = homography(circles_mm, reference_px) if lens else h
    one = marker.noise_px**2 / set_up.stills * np.eye(2)
    variance = np.broadcast_to(one, (len(circles_mm), 2, 2))
    views = {}
    for field_, at_px in zip(marker.fields, kinds_px, strict=True):
        forecast = None
        if field_.appearance is not None:
            whole = field_.kind is Scan.PROGRESSIVE
            combed = whole and set_up.scan.interlaced
            forecast = Forecast(
                field_.appearance, ideal, woven_s if combed else exposure_s, lens, combed
            )
        zero_mm = to_marker_mm(ideal, at_px)
        spreads = reference_covariance_mm2(circles_mm, reference_px, variance, at_px).tolist()
        middle_x, middle_y = zero_mm.mean(axis=0).tolist()
        views[field_.kind] = View(
            zero_mm=tuple((x, y) for x, y in zero_mm.tolist()),
            middle_mm=(middle_x, middle_y),
            covariance_mm2=tuple((xx, xy, yy) for (xx, xy), (_, yy) in spreads),
            mm_per_px=1 / max(scale_px_per_mm(h)),
            forecast=forecast,
            limits=field_.limits,
        )
    return Watch(
        homography=h,
        ideal=ideal,
        back=tuple(map(tuple, inverse(ideal).tolist())),
        lens=lens,
        views=views,
        slow={
            f.kind: Slow(f.appearance.variance_grey2, f.appearance.edge_px)
            for f in marker.fields
            if f.appearance is not None
        },
        regions=marker.regions,
    )


def _ideal_px(lens: Lens | None, field_: FieldSetUp) -> Points:
    seen_px = np.array(field_.reference_px)
    if field_.appearance is None:
        return undistort_px(lens, seen_px)
    return undistort_px(lens, seen_px, spread_matrices(field_.appearance.moments_px2))


def spread_matrices(moments_px2: Sequence[Shape]) -> NDArray[np.float64]:
    """Return second central moments (xx, xy, yy) as matrices, (n, 2, 2)."""
    return np.array([((xx, xy), (xy, yy)) for xx, xy, yy in moments_px2])
