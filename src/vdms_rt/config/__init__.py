"""One strict TOML file, read once before any thread, into frozen models with bounds on all."""

from __future__ import annotations

import difflib
import json
import tomllib
import typing
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, Field, ValidationError, model_validator

from vdms_rt.config.base import Name, Section
from vdms_rt.config.camera import Camera, Lens, lens_of_file
from vdms_rt.config.marker import Marker, Process, SetUpSection
from vdms_rt.config.sinks import Control, Publish, Record
from vdms_rt.config.sources import Clip, Log, V4l2
from vdms_rt.config.table import Motion, Table, TableSheet
from vdms_rt.config.wording import key_of, rule
from vdms_rt.model import ConfigError

__all__ = [
    "Camera",
    "Clip",
    "Config",
    "Control",
    "Lens",
    "Log",
    "Marker",
    "Motion",
    "Process",
    "Publish",
    "Record",
    "SetUpSection",
    "Station",
    "Table",
    "TableSheet",
    "V4l2",
    "effective_values",
    "is_live",
    "load_config",
    "parse_config",
]


class Station(Section):
    name: Name = "station"


class Config(Section):
    source: Literal["v4l2", "clip", "log", "table"] = "v4l2"
    station: Station = Station()
    v4l2: V4l2 = V4l2()
    clip: Clip = Clip()
    log: Log = Log()
    table: Table = Table()
    camera: Camera = Camera()
    lens: Annotated[Lens, AfterValidator(lens_of_file)] = Lens()
    marker: tuple[Marker, ...] = Field(default=(Marker(),), min_length=1, max_length=16)
    setup: SetUpSection = SetUpSection()
    process: Process = Process()
    publish: Publish = Publish()
    control: Control = Control()
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
        if self.control.through_router and self.publish.mode != "client":
            raise ValueError(
                'control.through_router needs publish.mode = "client": a station that listens '
                "itself would let everyone control who reaches it"
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
    key = key_of(location)
    if error["type"] == "extra_forbidden":
        known = _known_names(location[:-1])
        near = difflib.get_close_matches(str(location[-1]), known, n=1, cutoff=0.5)
        hint = f"did you mean {near[0]}?" if near else f"known here: {', '.join(sorted(known))}"
        return f"{source}: {key}: unknown key; {hint}"
    message = rule(error["msg"])
    value = _value_at(document, location)
    shown = f" = {json.dumps(value, default=str)}" if not isinstance(value, dict) else ""
    return f"{source}: {key or 'configuration'}{shown}: {message}"


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
