"""Recordings as pandas tables, in one call."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TypeAlias, cast

import numpy as np
import pandas as pd
from mcap.records import Attachment, Metadata
from numpy.typing import NDArray

from vdms_replay.columns import MEANINGS, UNITS, Clock, Held, Samples, Truths
from vdms_replay.source import SAMPLE, Damage, Entry, PathLike, ReplayError, Source, station_of
from vdms_rt.setup import SetUp, set_up_from_json
from vdms_rt.wire import vdms_pb2 as pb

ROWS_AT_ONCE = 16384
EVENTS_TOLD = 1000
"""In the metadata; `Recording.about.events` has all."""
PIXELS = "vdms.Pixels"


@dataclass(frozen=True, slots=True)
class RecordedSetUp:
    """One set-up of a recording, as it was said."""

    session: str
    revision: int
    utc_ns: int
    report: str
    """A page for a person."""
    json: str

    def set_up(self) -> SetUp:
        """Return its values. Raises SetUpError if it is of another version."""
        return set_up_from_json(self.json)


@dataclass(slots=True)
class About:
    """What a recording says about itself, its samples aside."""

    station: str = ""
    runs: dict[str, pb.Run] = field(default_factory=dict)
    """The newest head of each session."""
    set_ups: dict[tuple[str, int], RecordedSetUp] = field(default_factory=dict)
    """By session and revision."""
    events: list[pb.Event] = field(default_factory=list)
    ends: list[pb.End] = field(default_factory=list)
    """One for each file that was ended."""
    repairs: list[str] = field(default_factory=list)
    """What repairs have left out of the files."""
    attachments: dict[str, bytes] = field(default_factory=dict)

    def take(self, item: Entry | Attachment | Metadata) -> None:
        """Keep what `item` says. Raises ReplayError for a second station."""
        match item:
            case Attachment():
                self.attachments[item.name] = item.data
            case Metadata():
                if item.name == "repair":
                    self.repairs.append(_repair(item.metadata))
            case Entry():
                self._entry(item)

    def _entry(self, entry: Entry) -> None:
        station = station_of(entry.key)
        self.station = self.station or station
        if station and station != self.station:
            raise ReplayError(
                f"the files are of the stations {self.station} and {station}; "
                "name those of one station"
            )
        match entry.value:
            case pb.Run() as run:
                self.runs[f"{run.session:016x}"] = run
            case pb.SetUp() as said:
                session = f"{said.session:016x}"
                self.set_ups[session, said.revision] = RecordedSetUp(
                    session, said.revision, said.utc_ns, said.report, said.json
                )
            case pb.Event() as event:
                self.events.append(event)
            case pb.End() as end:
                self.ends.append(end)

    @property
    def run(self) -> pb.Run:
        """The first session's head; an empty one where none was readable."""
        return next(iter(self.runs.values()), pb.Run())

    @property
    def config(self) -> dict[str, Any]:
        """Every value in force, as the first session recorded it."""
        text = self.run.effective_config
        return cast("dict[str, Any]", json.loads(text)) if text else {}


@dataclass(frozen=True, slots=True)
class Recording:
    """All of a recording but its pixels; one station, one or several files."""

    paths: tuple[Path, ...]
    """In the order of time."""
    about: About
    samples: pd.DataFrame
    """A row for each sample of each marker, in the order of time; see `load`."""
    truth: pd.DataFrame
    """Where a virtual table's sheet really was: `time_s` (same zero), `marker`, `x_mm`, `y_mm`,
    `rotation_mrad`, `mean_x_mm`, `mean_y_mm` (over the exposure), `frame`, `scan`, `t_ns`,
    `stamp_ns`. Joins the samples by `(marker, stamp_ns, scan)`. Empty of a real camera."""
    health: pd.DataFrame
    """A row a second: the fields of `vdms.Health`, and `utc`."""
    damage: tuple[Damage, ...]
    """What of each file could not be read."""
    doubled: int
    """Samples that stood in the files twice, and are given once."""
    reach_s: Reach
    """Times of each marker's first and last sample."""

    @property
    def markers(self) -> tuple[str, ...]:
        return tuple(self.reach_s)

    def of_marker(
        self, marker: str | None = None, from_s: float = -math.inf, to_s: float = math.inf
    ) -> pd.DataFrame:
        """Return the samples of one marker between two times, in seconds from the first sample of
        the recording; for None of the only marker that is not fixed.

        Raises ReplayError if there is no such marker, or more than one, or no sample.
        """
        name = choose_marker(self.about, self.markers, marker)
        rows = (self.samples["marker"] == name).to_numpy()
        if from_s > -math.inf or to_s < math.inf:
            time_s = self.samples["time_s"].to_numpy()
            rows = rows & (time_s >= from_s) & (time_s <= to_s)
        if not rows.any():
            begin_s, end_s = self.reach_s[name]
            named = ", ".join(str(path) for path in self.paths)
            raise ReplayError(
                f"{named}: no sample of marker {name} lies {between(from_s, to_s)}; "
                f"it has samples from {begin_s:.1f} to {end_s:.1f} s"
            )
        return chosen_rows(self.samples, rows)

    @property
    def meta(self) -> dict[str, Any]:
        """Set-up and circumstances as plain values that JSON can hold: what `load` puts into
        `attrs`."""
        return metadata(self.about, self.paths, self.damage)


def load(
    *files: PathLike,
    marker: str | None = None,
    valid_only: bool = False,
    circles: bool = False,
) -> pd.DataFrame:
    """Return the displacements of a recording as a table, a row for each sample.

    Several files are the parts of one station's recording, in any order. Columns, units in their
    names: `time_s` (middle of the exposure, seconds since the first sample), `utc` (the same as
    time stamp, NaT where unknown), `marker`, `x_mm`, `y_mm`, `rotation_mrad`, `sigma_x_mm`,
    `sigma_y_mm`, `residual_mm`, `valid`, `status` (bits), `status_text`, `seq`, `frame_seq`,
    `scan`, `segment`, `setup_revision`, `session`, `t_ns`, `sigma_t_ns`, `utc_ns`, `stamp_ns`;
    with `circles` also `circle1_x_px`, `_y_px`, `_area_px`, `_contrast`, `_flags` and so on. All
    markers, or only `marker`; all samples, or with `valid_only` those that are measurements.
    Attributes (`.attrs`) hold what the recording says about itself.

    Raises ReplayError with a sentence.
    """
    recording = read(*files, circles=circles)
    table = recording.samples
    if marker is not None:
        table = recording.of_marker(marker)
    if valid_only:
        table = table[table["valid"]].reset_index(drop=True)
    table.attrs.update(recording.meta)
    return table


def read(
    *files: PathLike,
    circles: bool = False,
    columns: Sequence[str] | None = None,
    advance: Callable[[int], None] | None = None,
) -> Recording:
    """Return all of a recording but its pixels.

    `files` and `circles` are as for `load`; of the samples only `columns` are kept, which takes
    that much less memory, and all for None; `advance` is told the bytes read since its last call.
    Raises ReplayError with a sentence.
    """

    source = Source(files)
    about, clock = About(), Clock()
    samples, truths = Samples(clock, circles=circles), Truths(clock)
    held, truths_held = Held(columns), Held()
    reach_s: Reach = {}
    health: list[pb.Health] = []
    once = Once()
    session = 0

    def keep_samples() -> None:
        table = samples.take()
        extend(reach_s, table)
        held.add(table)

    for item in source.items(NOT_PIXELS, advance):
        about.take(item)
        if not isinstance(item, Entry):
            continue
        match item.value:
            case pb.Displacement() as sample:
                if once.is_new(sample):
                    samples.add(sample)
                    if len(samples) >= ROWS_AT_ONCE:
                        keep_samples()
            case pb.Truth() as truth:
                truths.add(truth, session)
                if len(truths) >= ROWS_AT_ONCE:
                    truths_held.add(truths.take())
            case pb.Health() as one:
                health.append(one)
            case pb.Run() as run:
                session = run.session
    keep_samples()
    truths_held.add(truths.take())
    return Recording(
        paths=tuple(source.paths),
        about=about,
        samples=held.whole(),
        truth=truths_held.whole(),
        health=health_table(health),
        damage=tuple(source.damage.values()),
        doubled=once.doubled,
        reach_s=reach_s,
    )


Reach: TypeAlias = dict[str, tuple[float, float]]
"""Times of the first and the last sample of each marker, in the order of their appearance."""


def extend(reach_s: Reach, table: pd.DataFrame) -> None:
    """Let each marker's reach go on to the end of the samples that follow."""
    for name, time_s in table.groupby("marker", sort=False)["time_s"]:
        begin_s, _ = reach_s.get(str(name), (math.nan, math.nan))
        if math.isnan(begin_s):
            begin_s = float(time_s.iloc[0])
        reach_s[str(name)] = begin_s, float(time_s.iloc[-1])


def chosen_rows(table: pd.DataFrame, rows: NDArray[np.bool_]) -> pd.DataFrame:
    """Return some rows, numbered from 0; without a copy if that is all of them."""
    if rows.all():
        return table.copy(deep=False)
    return pd.DataFrame({name: table[name].array[rows] for name in table.columns}, copy=False)


def between(from_s: float, to_s: float) -> str:
    """Return a part of the time in words."""
    if math.isinf(from_s):
        return "anywhere" if math.isinf(to_s) else f"before {to_s:g} s"
    return f"after {from_s:g} s" if math.isinf(to_s) else f"between {from_s:g} and {to_s:g} s"


NOT_PIXELS = (
    SAMPLE, "vdms.Truth", "vdms.Health", "vdms.Event", "vdms.SetUp", "vdms.Run", "vdms.End",
)  # fmt: skip
"""The types that tell of a recording, pixels aside."""


class Once:
    """Tells samples that were there before: two files overlap where a disk gave trouble."""

    def __init__(self) -> None:
        self._newest: dict[tuple[int, str], int] = {}
        self.doubled = 0

    def is_new(self, sample: pb.Displacement) -> bool:
        of = sample.session, sample.marker
        if sample.seq <= self._newest.get(of, -1):
            self.doubled += 1
            return False
        self._newest[of] = sample.seq
        return True


def choose_marker(about: About, markers: Sequence[str], asked: str | None) -> str:
    """Return the marker that was asked for; for None the only one that is not fixed.

    Raises ReplayError if there is none, or more than one.
    """
    if not markers:
        raise ReplayError("the recording holds no displacement")
    if asked is not None:
        if asked in markers:
            return asked
        raise ReplayError(f"the recording has no marker {asked}; it has {', '.join(markers)}")
    fixed = {m["name"] for m in about.config.get("marker", []) if m.get("fixed")}
    moving = [marker for marker in markers if marker not in fixed] or list(markers)
    if len(moving) > 1:
        raise ReplayError(
            f"the recording has the markers {', '.join(moving)}; choose one with --marker"
        )
    return moving[0]


def metadata(about: About, paths: Sequence[Path], damage: Sequence[Damage]) -> dict[str, Any]:
    """Return what a recording says about itself as plain values that JSON can hold."""
    run = about.run
    return {
        "station": about.station,
        "sessions": list(about.runs),
        "files": [path.name for path in paths],
        "recorded_by": f"vdms-rt {run.version}" if run.version else "",
        "recorded_at": iso(run.utc_ns),
        "device": {fact.name: fact.value for fact in run.facts},
        "set_ups": [
            {"session": s.session, "revision": s.revision, "utc": iso(s.utc_ns), "report": s.report}
            for s in about.set_ups.values()
        ],
        "set_up_json": [s.json for s in about.set_ups.values()],
        "config_text": run.config_text,
        "config_json": run.effective_config,
        "events": [_event_line(event) for event in about.events[:EVENTS_TOLD]],
        "ends": [end.reason for end in about.ends],
        "not_readable": [sentence for one in damage for sentence in one.sentences()],
        "repairs": list(about.repairs),
        "units": dict(UNITS),
        "meanings": dict(MEANINGS),
    }


def iso(utc_ns: int) -> str:
    """Return a UTC time with its nanoseconds as ISO 8601, or nothing for 0."""
    if not utc_ns:
        return ""
    seconds, rest_ns = divmod(utc_ns, 1_000_000_000)
    return f"{datetime.fromtimestamp(seconds, UTC):%Y-%m-%dT%H:%M:%S}.{rest_ns:09}Z"


def _event_line(event: pb.Event) -> str:
    severity = pb.Event.Severity.Name(event.severity).lower() if event.severity < 3 else "event"
    return f"{iso(event.utc_ns)} {severity}: {event.text}"


HEALTH_FIELDS = [field.name for field in pb.Health.DESCRIPTOR.fields]


def health_table(messages: Sequence[pb.Health]) -> pd.DataFrame:
    """Return a row for each message."""
    table = pd.DataFrame(
        [[getattr(message, name) for name in HEALTH_FIELDS] for message in messages],
        columns=HEALTH_FIELDS,
    )
    table.insert(0, "utc", pd.to_datetime(table["utc_ns"].astype("int64"), utc=True))
    return table


def _repair(values: dict[str, str]) -> str:
    dropped = values.get("dropped_bytes", "?")
    faults = values.get("faults", "")
    return f"repaired: {dropped} unreadable bytes were left out" + (
        f" ({faults})" if faults else ""
    )
