"""One strict TOML file, read once before any thread, into frozen models with bounds on all."""

from __future__ import annotations

import difflib
import json
import tomllib
import typing
from fractions import Fraction
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationError,
    model_validator,
)

from vdms_rt.model import ConfigError, MarkerShape, Region


def _rate(value: object) -> Fraction:
    try:
        rate = Fraction(value) if isinstance(value, (int, str)) else Fraction(str(value))
    except (ValueError, ZeroDivisionError):
        raise ValueError('a number or a fraction such as "30000/1001"') from None
    if not Fraction(1, 10) <= rate <= 1000:
        raise ValueError("between 0.1 and 1000")
    return rate


Rate = Annotated[Fraction, BeforeValidator(_rate)]
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,63}$")]
"""A chunk of a zenoh key and of a file name."""
Pair = tuple[float, float]


class Section(BaseModel):
    model_config = ConfigDict(
        frozen=True, extra="forbid", strict=True, allow_inf_nan=False, arbitrary_types_allowed=True
    )


class Station(Section):
    name: Name = "station"


class V4l2(Section):
    device: str = "auto"
    input: int = Field(default=0, ge=0, le=31)
    standard: Literal[
        "auto", "ntsc", "ntsc-m", "ntsc-m-jp", "ntsc-m-kr", "ntsc-443", "pal", "pal-m", "pal-60"
    ] = "auto"
    pixel_format: Literal["auto", "YUYV", "UYVY", "GREY", "MJPG"] = "auto"
    width_px: int = Field(default=720, ge=16, le=4096)
    height_px: int = Field(default=0, ge=0, le=4096)
    """0: what the standard has."""
    buffers: int = Field(default=8, ge=2, le=32)
    field_order: Literal["auto", "progressive", "top-first", "bottom-first"] = "auto"


class Clip(Section):
    path: str = ""
    rate_hz: Rate = Fraction(30000, 1001)
    field_order: Literal["progressive", "top-first", "bottom-first"] = "progressive"
    pace: Literal["realtime", "fast"] = "realtime"
    loop: bool = False


class Log(Section):
    path: str = ""
    pace: Literal["realtime", "fast"] = "fast"


class Motion(Section):
    """What the virtual table does after its rest."""

    kind: Literal["still", "harmonic", "sweep", "step", "record"] = "harmonic"
    amplitude_mm: float = Field(default=10.0, ge=0, le=1000)
    frequency_hz: float = Field(default=1.0, gt=0, le=60)
    """Of the harmonic; where the sweep begins."""
    end_frequency_hz: float = Field(default=5.0, gt=0, le=60)
    """Where the sweep arrives after sweep_s, on a logarithmic course, and goes on."""
    sweep_s: float = Field(default=60.0, gt=0, le=3600)
    direction_deg: float = Field(default=0.0, ge=-180, le=180)
    """In the marker plane, from x towards y."""
    file: str = ""
    """CSV of an earthquake record: columns time_s, x_mm and, if there is one, y_mm."""

    @model_validator(mode="after")
    def _consistent(self) -> Motion:
        if self.kind == "record" and not self.file:
            raise ValueError('kind = "record" needs file, a CSV with the columns time_s and x_mm')
        return self


class TableSheet(Section):
    """A marker that hangs in the virtual laboratory."""

    marker: Name = "m1"
    at_mm: Pair = (0.0, 0.0)
    """Where its zero hangs, in the plane of the table's motion."""
    moves: bool = True


class Table(Section):
    """The virtual shaking table: laboratory, camera and grabber in one."""

    distance_m: float = Field(default=8.0, ge=0.2, le=200)
    angle_deg: float = Field(default=0.0, ge=-75, le=75)
    """Between the line of sight and the normal of the marker plane, about the vertical; positive:
    the right side is the farther one."""
    roll_deg: float = Field(default=0.0, ge=-45, le=45)
    """How far the picture is turned, counter-clockwise."""
    fill: float = Field(default=0.65, gt=0.02, le=1.0)
    """Height of the first sheet (its circles' extent + half a diameter on each side) as a part
    of the picture's height, at angle 0: this sets the zoom. Without a sheet the first marker
    counts."""
    pixel_aspect: float = Field(default=1.1, ge=0.5, le=2.0)
    """Pixels per unit length along a row over pixels along a column."""
    width_px: int = Field(default=720, ge=64, le=1920)
    height_px: int = Field(default=480, ge=64, le=1080)
    frame_rate_hz: Rate = Fraction(30000, 1001)
    scan: Literal["progressive", "top-first", "bottom-first"] = "bottom-first"
    exposure_ms: float = Field(default=0.0, ge=0, le=40)
    """Of each field; it ends as the field's readout begins."""
    black_grey: float = Field(default=30.0, ge=0, le=255)
    white_grey: float = Field(default=200.0, ge=0, le=400)
    blur_x_px: float = Field(default=0.85, ge=0, le=5)
    blur_y_px: float = Field(default=0.6, ge=0, le=5)
    noise_grey: float = Field(default=2.0, ge=0, le=30)
    light_gradient: float = Field(default=0.1, ge=0, le=1)
    """How much brighter the right side of the picture is lit than the left, as a part of the
    mean."""
    distortion: float = Field(default=0.0, ge=-0.2, le=0.2)
    """Radial displacement in the picture's corner as a part of its radius; negative is barrel."""
    stamp_jitter_ms: float = Field(default=0.0, ge=0, le=20)
    """Peak of the driver's lateness, uniform from 0."""
    clock_error_ppm: float = Field(default=0.0, ge=-500, le=500)
    """Positive when frames come faster than frame_rate_hz by the computer's clock."""
    lost_frames: float = Field(default=0.0, ge=0, le=0.5)
    """Part of the frames that never arrive."""
    sequence_counts_lost: bool = False
    clutter: bool = True
    rest_s: float = Field(default=2.0, ge=0, le=600)
    motion: Motion = Motion()
    shake_mm: float = Field(default=0.0, ge=0, le=50)
    """Amplitude in x of the camera's own movement, as seen in the marker plane; in y it is half
    as much at 1.5 times the frequency. It begins with the table's motion."""
    shake_hz: float = Field(default=0.7, gt=0, le=30)
    sheet: tuple[TableSheet, ...] = (TableSheet(),)
    pace: Literal["realtime", "fast"] = "realtime"
    frames: int = Field(default=0, ge=0)
    """Ends after it has given so many; 0 goes on."""
    seed: int = Field(default=1, ge=0)
    """Of noise, jitter, losses and the laboratory."""

    @model_validator(mode="after")
    def _consistent(self) -> Table:
        markers = [sheet.marker for sheet in self.sheet]
        if doubles := sorted({m for m in markers if markers.count(m) > 1}):
            raise ValueError(f"sheet hangs marker {', '.join(doubles)} twice; hang each once")
        period_ms = 1000 / self.frame_rate_hz
        for name in ("exposure_ms", "stamp_jitter_ms"):
            value_ms = getattr(self, name)
            if value_ms >= period_ms:
                raise ValueError(
                    f"{name} = {value_ms:g} must be shorter than the frame period, "
                    f"{float(period_ms):.4g} ms at frame_rate_hz"
                )
        return self


class Camera(Section):
    exposure_ms: float = Field(default=16.683, ge=0, le=1000)
    """Time for which each field collects light."""
    chain_delay_ms: float = Field(default=0.0, ge=-1000, le=1000)
    """Constant extra delay of camera and grabber, from a test against a reference."""


class Lens(Section):
    """What the lens bends: a point seen at the radius r belongs at r (1 - k1 rho^2 - k2 rho^4),
    where rho is r over half the picture's diagonal."""

    k1: float = Field(default=0.0, ge=-0.2, le=0.2)
    k2: float = Field(default=0.0, ge=-0.2, le=0.2)
    centre_px: Pair | None = None
    """None: the middle of the picture."""
    pixel_aspect: float = Field(default=1.1, ge=0.5, le=2.0)
    """Pixels per unit length along a row over pixels along a column."""
    file: str = ""
    """A TOML with a section [lens], read in place of the other keys; empty in the values in
    force."""

    @model_validator(mode="after")
    def _consistent(self) -> Lens:
        # The ideal radius must rise up to the corner; its slope is a parabola in rho^2.
        steepest = [1.0]
        if self.k2 and 0 < (turn := -3 * self.k1 / (10 * self.k2)) < 1:
            steepest.append(turn)
        if any(1 - 3 * self.k1 * s - 5 * self.k2 * s * s <= 0 for s in steepest):
            raise ValueError(
                f"k1 = {self.k1:g} with k2 = {self.k2:g} folds the picture over before its corner, "
                "which no lens does; take both from one `vdms-rt lens`"
            )
        return self


def _lens_of_file(lens: Lens) -> Lens:
    if not lens.file:
        return lens
    if others := sorted(lens.model_fields_set - {"file"}):
        raise ValueError(
            f"file = {lens.file!r} is read in place of {', '.join(others)}; leave out one or other"
        )
    try:
        text = Path(lens.file).expanduser().read_text(encoding="utf-8")
        found = Lens.model_validate_json(json.dumps(tomllib.loads(text)["lens"], default=str))
    except OSError as error:
        raise ValueError(
            f"{lens.file}: cannot be read: {error.strerror}; `vdms-rt lens` prints such a file"
        ) from None
    except ValidationError as error:
        fault = error.errors()[0]
        key = _key(["lens", *fault["loc"]])
        raise ValueError(f"{lens.file}: {key}: {_rule(fault['msg'])}") from None
    except (UnicodeDecodeError, tomllib.TOMLDecodeError, KeyError):
        raise ValueError(
            f"{lens.file}: not a TOML with a section [lens]; `vdms-rt lens` prints such a file"
        ) from None
    if found.file:
        raise ValueError(f"{lens.file}: lens.file = {found.file!r}: names yet another file")
    return found


class Marker(Section):
    """One printed marker. The four-circle sheet is the default."""

    name: Name = "m1"
    spacing_mm: float = Field(default=120.0, gt=0, le=10000)
    """Between neighbouring circles' centres of the four-circle sheet."""
    diameter_mm: float = Field(default=50.0, gt=0, le=5000)
    circles_mm: tuple[Pair, ...] = ()
    """Instead of spacing_mm: any four or more centres, x right, y up."""
    colour: Literal["white-on-black", "black-on-white"] = "white-on-black"
    find: Literal["auto", "regions"] = "auto"
    regions_px: tuple[tuple[int, int, int, int], ...] = ()
    """With find = "regions": left, top, width, height around each circle, in order."""
    fixed: bool = False
    axis_deg: float = Field(default=0.0, ge=-180, le=180)
    """Direction of the table's motion in the marker plane, from x towards y: x_mm is along it."""

    @model_validator(mode="after")
    def _consistent(self) -> Marker:
        circles = self.shape.circles_mm
        if len(circles) < 4:
            raise ValueError(f"circles_mm has {len(circles)} circles, at least 4 are needed")
        if self.find == "regions" and len(self.regions_px) != len(circles):
            raise ValueError(
                f'find = "regions" needs one region for each of the {len(circles)} circles, '
                f"regions_px has {len(self.regions_px)}"
            )
        for i, (ax, ay) in enumerate(circles):
            for j, (bx, by) in enumerate(circles[:i]):
                if (ax - bx) ** 2 + (ay - by) ** 2 <= self.diameter_mm**2:
                    raise ValueError(
                        f"circles {j + 1} and {i + 1} touch: their centres must lie more than "
                        f"diameter_mm = {self.diameter_mm:g} apart"
                    )
        return self

    @property
    def shape(self) -> MarkerShape:
        """The marker in millimetres; of the four-circle sheet the order is top left, top right,
        bottom left, bottom right."""
        half = self.spacing_mm / 2
        square = ((-half, half), (half, half), (-half, -half), (half, -half))
        return MarkerShape(
            name=self.name,
            circles_mm=self.circles_mm or square,
            diameter_mm=self.diameter_mm,
            white_on_black=self.colour == "white-on-black",
            fixed=self.fixed,
        )

    @property
    def regions(self) -> tuple[Region, ...]:
        return tuple(Region(*r) for r in self.regions_px)


class SetUpSection(Section):
    file: str = "set-up.json"
    """In `directory`; loaded at start, written after each reference."""
    directory: str = ""
    """Empty: $STATE_DIRECTORY of the service, else ~/.local/state/vdms-rt."""
    load: bool = True
    store: bool = True
    reference_pictures: int = Field(default=30, ge=1, le=1000)
    still_px: float = Field(default=0.3, gt=0, le=10)
    """The most that any circle may move, peak to peak, while the reference is taken."""
    stale_px: float = Field(default=0.5, gt=0, le=50)
    """The most that a stored reference may differ from fresh stills."""


class Process(Section):
    method: Literal["otsu", "smooth"] = "smooth"
    sampling: Literal["auto", "frame", "field"] = "auto"
    ring_slots: int = Field(default=64, ge=64, le=4096)


class Publish(Section):
    enabled: bool = True
    mode: Literal["peer", "client"] = "peer"
    """peer listens itself; client needs a router at `connect`."""
    listen: tuple[str, ...] = ("tcp/0.0.0.0:7447",)
    connect: tuple[str, ...] = ()
    recover_s: float = Field(default=60.0, ge=1, le=600)
    """How long samples are kept for subscribers whose link was down."""


class Record(Section):
    enabled: bool = True
    directory: str = "recordings"
    pixels: Literal["none", "regions", "frames"] = "regions"
    queue_messages: int = Field(default=4096, ge=64, le=1_000_000)
    rotate_s: float = Field(default=3600.0, ge=1, le=604800)
    rotate_mb: float = Field(default=2000.0, ge=1, le=1_000_000)
    sync_s: float = Field(default=0.5, gt=0, le=1)
    """Most that a pulled plug may cost."""


class Config(Section):
    source: Literal["v4l2", "clip", "log", "table"] = "v4l2"
    station: Station = Station()
    v4l2: V4l2 = V4l2()
    clip: Clip = Clip()
    log: Log = Log()
    table: Table = Table()
    camera: Camera = Camera()
    lens: Annotated[Lens, AfterValidator(_lens_of_file)] = Lens()
    marker: tuple[Marker, ...] = Field(default=(Marker(),), min_length=1, max_length=16)
    setup: SetUpSection = SetUpSection()
    process: Process = Process()
    publish: Publish = Publish()
    record: Record = Record()

    @model_validator(mode="after")
    def _consistent(self) -> Config:
        names = [m.name for m in self.marker]
        if doubles := sorted({n for n in names if names.count(n) > 1}):
            raise ValueError(f"two markers are named {', '.join(doubles)}; give each its own name")
        if self.source == "clip" and not self.clip.path:
            raise ValueError('source = "clip" needs clip.path, a video or a folder of pictures')
        if self.source == "log" and not self.log.path:
            raise ValueError('source = "log" needs log.path, an MCAP that vdms-rt recorded')
        if self.source == "table":
            for sheet in self.table.sheet:
                if sheet.marker not in names:
                    raise ValueError(
                        f"table.sheet hangs marker {sheet.marker}, which no [[marker]] defines"
                    )
        if self.publish.mode == "client" and not self.publish.connect:
            raise ValueError(
                'publish.mode = "client" needs publish.connect, the address of a router'
            )
        return self


def is_live(config: Config) -> bool:
    """Return whether frames come at their own pace, and are lost if nobody takes them."""
    match config.source:
        case "clip":
            return config.clip.pace == "realtime"
        case "log":
            return config.log.pace == "realtime"
        case "table":
            return config.table.pace == "realtime"
        case _:
            return True


def load_config(path: Path | str | None) -> tuple[Config, str]:
    """Return the configuration and the text it came from (empty without a file).

    Raises ConfigError with one line for each thing that is wrong: file, key, value, rule.
    """
    if path is None:
        return Config(), ""
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise ConfigError(
            f"{path}: cannot read the configuration: {error.strerror}; give the path of a TOML file"
        ) from None
    except UnicodeDecodeError as error:
        raise ConfigError(
            f"{path}: byte {error.start} is not UTF-8 text; save the file as UTF-8"
        ) from None
    return parse_config(text, str(path)), text


def parse_config(text: str, source: str) -> Config:
    """Return the configuration in a TOML text; `source` names it in errors."""
    try:
        document = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{source}: not valid TOML: {error}") from None
    try:
        return Config.model_validate_json(json.dumps(document, default=str))
    except ValidationError as error:
        faults = error.errors()
        # A list with a bad element is also reported as too short; the element says it all.
        inner = {tuple(e["loc"][: n + 1]) for e in faults for n in range(len(e["loc"]) - 1)}
        lines = [_line(source, document, dict(e)) for e in faults if tuple(e["loc"]) not in inner]
        raise ConfigError("\n".join(lines)) from None


def effective_values(config: Config) -> str:
    """Return every value in force, defaults included, as JSON text for the log."""
    return json.dumps(config.model_dump(mode="json"), indent=1, default=str)


def _line(source: str, document: dict[str, Any], error: dict[str, Any]) -> str:
    location = [part for part in error["loc"] if part not in ("function-before", "tuple")]
    key = _key(location)
    if error["type"] == "extra_forbidden":
        known = _known_names(location[:-1])
        near = difflib.get_close_matches(str(location[-1]), known, n=1, cutoff=0.5)
        hint = f"did you mean {near[0]}?" if near else f"known here: {', '.join(sorted(known))}"
        return f"{source}: {key}: unknown key; {hint}"
    message = _rule(error["msg"])
    value = _value_at(document, location)
    shown = f" = {json.dumps(value, default=str)}" if not isinstance(value, dict) else ""
    return f"{source}: {key or 'configuration'}{shown}: {message}"


def _rule(message: str) -> str:
    message = message.removeprefix("Value error, ")
    return message[:1].lower() + message[1:]


def _key(location: list[Any]) -> str:
    text = ""
    for part in location:
        text += f"[{part + 1}]" if isinstance(part, int) else f".{part}" if text else str(part)
    return text


def _value_at(document: Any, location: list[Any]) -> Any:
    for part in location:
        try:
            document = document[part]
        except (KeyError, IndexError, TypeError):
            return {}
    return document


def _known_names(location: list[Any]) -> list[str]:
    section: type[BaseModel] = Config
    for part in location:
        if isinstance(part, int):
            continue
        section = _section_of(section.model_fields[part].annotation)
    return list(section.model_fields)


def _section_of(annotation: Any) -> type[BaseModel]:
    while arguments := typing.get_args(annotation):
        annotation = arguments[0]
    return typing.cast("type[BaseModel]", annotation)
