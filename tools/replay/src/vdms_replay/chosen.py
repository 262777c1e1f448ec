"""The samples of one marker that belong together, out of a recording."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from vdms_replay.align import Camera
from vdms_replay.load import Recording
from vdms_replay.source import ReplayError
from vdms_rt.setup import MarkerSetUp, SetUp, SetUpError

FIELD_SCANS = ("top", "bottom")


@dataclass(frozen=True, slots=True)
class Chosen:
    """One marker's samples against one reference."""

    marker: str
    table: pd.DataFrame
    """All samples after the set-up, those without a position too, in the order of time."""
    valid: pd.DataFrame
    """Those that are measurements against the reference with most of them."""
    set_up: SetUp | None
    """The last one in force for them."""
    own: MarkerSetUp | None
    left_out: int
    """Valid samples against another reference: their zero is another."""

    @property
    def exposed(self) -> str:
        """`field`, `frame` (whole, of two fields) or `progressive`."""
        scans = set(self.valid["scan"].astype(str))
        if scans <= set(FIELD_SCANS):
            return "field"
        return "progressive" if scans == {"progressive"} else "frame"


def choose(
    recording: Recording,
    marker: str | None = None,
    from_s: float = 0.0,
    to_s: float = math.inf,
) -> Chosen:
    """Return one marker's samples between two times, in seconds from the recording's first sample.

    Raises ReplayError where there are none, or whole frames and fields are mixed.
    """
    table = recording.of_marker(marker)
    name = str(table["marker"].iloc[0])
    inside = table[(table["time_s"] >= from_s) & (table["time_s"] <= to_s)]
    if inside.empty:
        raise ReplayError(
            f"{_named(recording)}: no sample of marker {name} lies {_between(from_s, to_s)}; "
            f"it has samples from {table['time_s'].iloc[0]:.1f} to "
            f"{table['time_s'].iloc[-1]:.1f} s"
        )
    measured = inside[inside["valid"]]
    if measured.empty:
        raise ReplayError(
            f"{_named(recording)}: marker {name} has no valid sample; the recording ends before "
            "its reference was taken, or the marker was not seen"
        )
    pairs = list(zip(measured["session"], measured["setup_revision"], strict=True))
    zeros = {pair: _reference_of(recording, name, *pair) for pair in set(pairs)}
    keys = [zeros[pair] for pair in pairs]
    ((most, _),) = Counter(keys).most_common(1)
    valid = measured[[key == most for key in keys]]
    times_s = valid["time_s"].to_numpy()
    valid = valid[np.concatenate([[True], np.diff(np.maximum.accumulate(times_s)) > 0])]
    scans = set(valid["scan"].astype(str))
    if scans & set(FIELD_SCANS) and scans - set(FIELD_SCANS):
        raise ReplayError(
            f"{_named(recording)}: marker {name} was measured in whole frames and in fields; cut "
            "out one part with --from-s and --to-s"
        )
    set_up, own = _set_up(recording, name, valid)
    begin = int(np.argmax((inside["status"].to_numpy() & 1) == 0))
    return Chosen(
        marker=name,
        table=inside.iloc[begin:].reset_index(drop=True),
        valid=valid.reset_index(drop=True),
        set_up=set_up,
        own=own,
        left_out=len(measured) - len(valid),
    )


def camera_of(recording: Recording, chosen: Chosen, exposure_s: float | None = None) -> Camera:
    """Return the chosen samples as a camera took them; `exposure_s` in place of the recorded."""
    valid = chosen.valid
    fields_s: tuple[float, ...] = (0.0,)
    if chosen.exposed == "frame":
        quarter_s = frame_period_s(valid) / 4
        fields_s = (-quarter_s, quarter_s)
    return Camera(
        time_s=valid["time_s"].to_numpy(np.float64),
        x_mm=valid["x_mm"].to_numpy(np.float64),
        y_mm=valid["y_mm"].to_numpy(np.float64),
        exposure_s=exposure_of(recording.about.config) if exposure_s is None else exposure_s,
        fields_s=fields_s,
    )


def exposure_of(config: dict[str, Any]) -> float:
    """Return the exposure of a field or frame in seconds, by the recorded configuration."""
    section = "table" if config.get("source") == "table" else "camera"
    return float(config.get(section, {}).get("exposure_ms", 0.0)) / 1000


def frame_period_s(table: pd.DataFrame) -> float:
    """Return the time from one frame to the next; NaN of a single frame."""
    alike = table[table["scan"] == table["scan"].iloc[0]]
    frames = np.diff(alike["frame_seq"].to_numpy())
    steps_s = np.diff(alike["time_s"].to_numpy())[frames > 0]
    return float(np.median(steps_s / frames[frames > 0])) if len(steps_s) else math.nan


def _reference_of(recording: Recording, marker: str, session: str, revision: int) -> object:
    """Return what tells one zero from another: the same for all set-ups of one reference."""
    try:
        set_up = recording.about.set_ups[session, revision].set_up()
    except (KeyError, SetUpError):
        return session, revision
    return session, next((m.homography for m in set_up.markers if m.shape.name == marker), revision)


def _set_up(
    recording: Recording, marker: str, valid: pd.DataFrame
) -> tuple[SetUp | None, MarkerSetUp | None]:
    last = valid.iloc[-1]
    try:
        set_up = recording.about.set_ups[last["session"], int(last["setup_revision"])].set_up()
    except (KeyError, SetUpError):
        return None, None
    return set_up, next((m for m in set_up.markers if m.shape.name == marker), None)


def _between(from_s: float, to_s: float) -> str:
    return f"after {from_s:g} s" if math.isinf(to_s) else f"between {from_s:g} and {to_s:g} s"


def _named(recording: Recording) -> str:
    return ", ".join(str(path) for path in recording.paths)
