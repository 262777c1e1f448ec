"""The values that travel along the path of a frame, and nothing else: no I/O, no threads.

Units are in the names (`_px _mm _ns _s _hz _mrad _deg`). Times are integer nanoseconds. Picture
coordinates have their origin at the centre of the top-left pixel, x to the right, y down, in rows
of the whole frame (also for a single field). Marker coordinates are x to the right, y up, as one
looks at the marker; their zero is the reference pose.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum, IntFlag, StrEnum
from fractions import Fraction
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

Luma: TypeAlias = NDArray[np.uint8]
"""Grey levels, shape (height, width), dtype uint8."""
Points: TypeAlias = NDArray[np.float64]
"""Points, shape (n, 2), dtype float64; the unit is in the name of the variable."""

NTSC_FRAME_PERIOD_S = Fraction(1001, 30000)
PAL_FRAME_PERIOD_S = Fraction(1, 25)


class VdmsError(Exception):
    """Something a person can mend; the text is one sentence that says what, where and how."""


class ConfigError(VdmsError):
    """The configuration is wrong; the process ends with exit status 78."""


class SourceError(VdmsError):
    """A source cannot be opened, or stopped giving frames. A live one is tried again."""


class SourceEnded(VdmsError):
    """A source that is not live has given its last frame."""


class Scan(IntEnum):
    """How the rows of an image came about.

    In an interlaced image the top field is rows 0, 2, ... and the bottom field rows 1, 3, ...;
    `TOP_FIRST` and `BOTTOM_FIRST` tell which of them was exposed earlier. `TOP` and `BOTTOM` mean
    that the image is that one field alone, with half the rows.
    """

    PROGRESSIVE = 0
    TOP_FIRST = 1
    BOTTOM_FIRST = 2
    TOP = 3
    BOTTOM = 4

    @property
    def interlaced(self) -> bool:
        return self in (Scan.TOP_FIRST, Scan.BOTTOM_FIRST)


class Damage(IntFlag):
    """What is wrong with an image. Such a picture is never measured as if whole."""

    NONE = 0
    FLAGGED = 1
    SHORT = 2
    REPEATED = 4
    """The picture before, delivered once more."""
    NO_SIGNAL = 8
    """What a grabber shows without a camera: blank, noise, a test card."""


class StampEvent(StrEnum):
    """The moment that a source's stamp marks."""

    END_OF_FRAME = "end of frame"
    START_OF_EXPOSURE = "start of exposure"
    MID_EXPOSURE = "mid-exposure"


@dataclass(frozen=True, slots=True)
class SourceInfo:
    """What is known of a source once it is open."""

    kind: str
    name: str
    width_px: int
    height_px: int
    """Rows of the image that `read` fills: of a whole frame, or of one field if it alternates."""
    frame_period_s: Fraction
    scan: Scan
    """Of the images. `TOP` stands for alternating fields; each grab then says which one it is."""
    live: bool
    """Frames come at their own pace and are lost if nobody takes them."""
    stamp_event: StampEvent
    sequence_counts_lost: bool
    """A lost frame leaves a gap in the driver's sequence."""
    scan_known: bool = False
    """The order of the fields is a fact, not a driver's habit."""
    exposure_ns: int | None = None
    """Where the source knows its own exposure; otherwise `camera.exposure_ms` holds."""
    facts: tuple[tuple[str, str], ...] = ()
    """Names and values for the log and the person: driver, card, bus, input, standard, format."""
    warnings: tuple[str, ...] = ()
    """Sentences on what a person should know of it before trusting its pictures."""


@dataclass(frozen=True, slots=True)
class Tick:
    """When a frame was: the clock's answer."""

    index: int
    """Frame periods since the first frame; a lost frame leaves a gap."""
    t_ns: int
    """Middle of the exposure of the whole frame (for an interlaced one the mean of its two
    fields, which lie a quarter of a period before and after it), on the monotonic clock."""
    sigma_t_ns: int
    """Standard deviation of `t_ns`, a constant delay of the chain aside."""
    segment: int
    """Goes up at every break after which times are not on the old grid."""
    utc_ns: int
    """`t_ns` on the UTC clock, or 0 where that is unknown."""


@dataclass(frozen=True, slots=True)
class Grab:
    """What a driver says of the image that it has just filled."""

    stamp_ns: int
    sequence: int
    scan: Scan
    damage: Damage = Damage.NONE
    tick: Tick | None = None
    """Only from a recording, which knows its times already."""


@dataclass(frozen=True, slots=True)
class Frame:
    """One frame in its leased slot of the ring. `image` is read-only and ends with the lease."""

    seq: int
    stamp_ns: int
    t_ns: int
    sigma_t_ns: int
    utc_ns: int
    segment: int
    period_ns: int
    image: Luma
    scan: Scan
    damage: Damage
    exposure_ns: int = 0
    """Time for which each field collected light."""
    order_known: bool = False
    """The order of the fields is a fact, not a driver's habit."""


@dataclass(frozen=True, slots=True)
class Picture:
    """What gets measured: a whole frame, or one field of it as a strided view.

    Row r of `image` is row `row_offset + r * row_step` of the frame.
    """

    seq: int
    frame_seq: int
    stamp_ns: int
    t_ns: int
    sigma_t_ns: int
    utc_ns: int
    segment: int
    period_ns: int
    """From one picture to the next."""
    image: Luma
    scan: Scan
    row_offset: int
    row_step: int
    damage: Damage
    exposure_ns: int = 0
    order_known: bool = False

    @property
    def kind(self) -> Scan:
        """TOP or BOTTOM for a single field, PROGRESSIVE for any whole frame: pictures of one kind
        show a resting marker alike."""
        return self.scan if self.row_step == 2 else Scan.PROGRESSIVE


class CircleFlag(IntFlag):
    """Why a circle is not trusted."""

    NONE = 0
    LOST = 1
    """Nothing like the circle in its region."""
    BORDER = 2
    """Touches the border of its region or of the picture."""
    CONTRAST = 4
    AREA = 8
    FILL = 16
    """Its area is not that of an ellipse of the same second moments."""
    MOMENT = 32
    SATURATED = 64
    RESIDUAL = 128
    """Not where the other circles say that it should be."""
    REFITTED = 256
    """Disturbed, and measured by its edge instead; trusted, with a larger sigma."""


UNUSABLE_CIRCLE = ~(CircleFlag.REFITTED | CircleFlag.SATURATED)
"""Mask of the flags that keep a circle out of the displacement."""


class Status(IntFlag):
    """Standing of a sample. 0 is a good one."""

    OK = 0
    SET_UP = 1
    """Taken before the reference was complete: not a measurement."""
    NOT_FOUND = 2
    """Too few good circles: no position."""
    DAMAGED = 4
    """The driver delivered a short or flagged buffer."""
    FEWER_CIRCLES = 8
    """Some circles were not used, the rest suffice; valid."""
    RESIDUAL = 16
    """The circles do not agree with a rigid marker."""
    SET_UP_STALE = 32
    """The stored reference does not match this picture: the camera or marker was moved."""
    FIELD_ORDER_UNCONFIRMED = 64
    """The order of the fields is the driver's habit, not yet proved by motion; valid."""
    FIELD_ORDER_WRONG = 128
    """Motion contradicts the order of the fields in use."""
    CLOCK_SETTLING = 256
    """The frame clock has seen too few stamps to be at its best; valid."""
    RELOCATED = 512
    """A lost circle was found again since the sample before; valid."""
    SATURATED = 1024
    """Part of a circle is as bright as the picture can be; valid, with more error."""
    FIXED_LOST = 2048
    """The fixed marker was not seen, so the camera's shake could not be taken off."""
    REPEATED = 4096
    """The driver delivered the picture before once more, which is of another time."""
    NO_SIGNAL = 8192
    """The grabber has no camera's signal."""


INVALID_STATUS = (
    Status.SET_UP
    | Status.NOT_FOUND
    | Status.DAMAGED
    | Status.RESIDUAL
    | Status.SET_UP_STALE
    | Status.FIELD_ORDER_WRONG
    | Status.FIXED_LOST
    | Status.REPEATED
    | Status.NO_SIGNAL
)
"""A sample with any of these is not a measurement."""
_INVALID = int(INVALID_STATUS)
"""As a number, for it takes a flag over a microsecond to be masked."""


def damage_status(damage: Damage) -> Status:
    """Return what a picture's damage makes of its samples."""
    status = Status.OK
    if damage & (Damage.FLAGGED | Damage.SHORT):
        status |= Status.DAMAGED
    if damage & Damage.REPEATED:
        status |= Status.REPEATED
    if damage & Damage.NO_SIGNAL:
        status |= Status.NO_SIGNAL
    return status


@dataclass(frozen=True, slots=True)
class Circle:
    """One circle in one picture, in rows and columns of the whole frame."""

    x_px: float
    y_px: float
    area_px: float
    """Area in pixels of the whole frame (for a field: its pixels times two)."""
    contrast: float
    """Grey levels between the circle and its surroundings."""
    flags: CircleFlag


@dataclass(frozen=True, slots=True)
class Displacement:
    """One marker in one picture. Positions are NaN where there is none."""

    session: int
    """Of one run of the daemon, random."""
    marker: str
    seq: int
    frame_seq: int
    scan: Scan
    segment: int
    stamp_ns: int
    t_ns: int
    sigma_t_ns: int
    utc_ns: int
    setup_revision: int
    x_mm: float
    y_mm: float
    rotation_mrad: float
    sigma_x_mm: float
    sigma_y_mm: float
    residual_mm: float
    status: Status
    circles: tuple[Circle, ...]

    @property
    def valid(self) -> bool:
        return not int(self.status) & _INVALID


@dataclass(frozen=True, slots=True)
class Truth:
    """Where the virtual table's sheet really was in one picture; joins a `Displacement` by
    `(stamp_ns, scan)`."""

    marker: str
    frame: int
    """Frame periods since the table's start, frames that were dropped included."""
    scan: Scan
    stamp_ns: int
    t_ns: int
    """True middle of the exposure on the monotonic clock."""
    x_mm: float
    y_mm: float
    rotation_mrad: float
    mean_x_mm: float
    """Mean of the position over the exposure."""
    mean_y_mm: float


class State(StrEnum):
    """What the daemon is doing, in words for a person."""

    STARTING = "starting"
    NO_DEVICE = "no device"
    NO_SIGNAL = "no signal"
    STREAMING = "streaming"
    """Of the capture stage alone: what is made of the frames, the process stage says."""
    SEARCHING = "looking for the marker"
    WAITING_FOR_STILL = "waiting for still"
    REFERENCE = "taking the reference"
    CHECKING = "checking the stored set-up"
    MEASURING = "measuring"
    SET_UP_STALE = "set-up stale"
    STALLED = "stalled"
    LOST = "lost"
    STOPPING = "stopping"


class Severity(IntEnum):
    INFO = 0
    WARNING = 1
    ERROR = 2


@dataclass(frozen=True, slots=True)
class Event:
    """Something that happened, in one sentence."""

    severity: Severity
    code: str
    """A stable word for programs: `state`, `set-up`, `frames-missed`, ..."""
    text: str
    t_ns: int = 0
    utc_ns: int = 0
    facts: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True, slots=True)
class Health:
    """How the daemon is, once a second."""

    session: int
    """Of one run of the daemon, random."""
    utc_ns: int
    uptime_s: float
    state: State
    device: str
    captured: int
    """Frames taken from the source."""
    missed: int
    """Frames lost before they came, while others did: an outage is a state and not counted."""
    damaged: int
    overwritten: int
    """Frames that the process thread was too slow for."""
    measured: int
    """Samples with a valid position."""
    invalid: int
    """Samples after the reference without one."""
    not_recorded: int
    unsent: int
    frame_rate_hz: float
    """Over the last seconds; 0 when no frames come."""
    sample_age_ms: float
    """From mid-exposure to the published sample, mean over the last second; NaN without samples."""
    ring_used: int
    record_queue: int
    recording: str
    """The file, or empty."""
    record_trouble: str
    """One sentence, or empty."""
    fsync_ms: float
    """The slowest flush to disk in the last second."""
    disk_free_bytes: int
    clock_jitter_us: float
    """Standard deviation of the driver's stamps about the frame clock."""
    clock_sigma_us: float
    clock_rate_ppm: float
    """Of the source's frame clock against the computer's, positive when frames come fast."""
    utc_state: str
    """`synchronised`, `not synchronised` or `unknown`, of the computer's UTC clock."""
    repeated: int = 0
    """Frames that were the one before, delivered once more."""
    no_signal: int = 0
    """Frames in which the grabber showed no camera's picture."""
    pixels_left_out: int = 0
    """Frames whose pixels are in no file, for lack of room on the disk or of time; of the messages
    `not_recorded`."""


@dataclass(frozen=True, slots=True)
class Region:
    """A rectangle of whole-frame pixels, left-top corner included."""

    x_px: int
    y_px: int
    width_px: int
    height_px: int


@dataclass(frozen=True, slots=True)
class MarkerShape:
    """A marker's circles in its own plane: at least four, in millimetres, x right, y up."""

    name: str
    circles_mm: tuple[tuple[float, float], ...]
    diameter_mm: float
    white_on_black: bool = True
    fixed: bool = False
    """Its motion is the camera's shake, and is taken off the others."""


@dataclass(frozen=True, slots=True)
class FoundMarker:
    """A marker seen in a picture, in the order of the shape's circles."""

    name: str
    centres_px: tuple[tuple[float, float], ...]
    semi_axes_px: tuple[tuple[float, float], ...]
    """Half the extent of each circle's picture in x and in y (of its bounding box)."""
    contrast: float
    score: float = field(default=0.0)
    """Root mean square misfit to the shape, in pixels."""


@dataclass(frozen=True, slots=True)
class Aim:
    """How the camera sees a marker. Lengths in millimetres are along the marker's own x and y."""

    marker: str
    scale_x_px_per_mm: float
    scale_y_px_per_mm: float
    pixel_aspect: float
    """Taken for the angles: pixels per unit length along a row over pixels along a column."""
    angle_deg: float
    """Between the line of sight and the marker's normal."""
    angle_error_deg: float
    """What an error of 1 % of `pixel_aspect` makes of it: much near 0, little at 60."""
    turn_deg: float
    """The angle's part about the marker's vertical; positive: the right side is the farther one."""
    side_known: bool
    """Perspective shows which side is the farther one; if not, `turn_deg` is positive."""
    roll_deg: float
    """How far the marker appears turned counter-clockwise in the picture."""
    disc_px: float
    """Smallest extent of the smallest circle."""
    edge_x_px: float
    edge_y_px: float
    """Widths of the blurred edge, as standard deviations, the pixel's own included."""
    focus: str
    """`sharp`, `a little soft` or `out of focus`."""
    black_grey: float
    white_grey: float
    contrast_grey: float
    """Of the faintest circle."""
    saturated_percent: float
    """Of the brightest disc; of a dark disc, of the sheet around it."""
    noise_grey: float
    """Standard deviation, the rounding to whole grey levels included."""
    sigma_x_mm: float
    sigma_y_mm: float
    """Standard deviation of one sample of the marker at rest."""
    left_mm: float
    right_mm: float
    up_mm: float
    down_mm: float
    """How far the marker may go before a circle touches the picture's border."""
    advice: tuple[str, ...]
    """What to do, one sentence each, the most important first; empty if all is well."""
