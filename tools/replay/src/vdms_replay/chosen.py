"""The samples of one marker that belong together, out of a recording."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

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
    on: NDArray[np.bool_]
    """Rows of `table` that are measurements against the reference with most of them."""
    set_up: SetUp | None
    """The last one in force for them."""
    own: MarkerSetUp | None
    left_out: int
    """Valid samples against another reference: their zero is another."""

    @property
    def count(self) -> int:
        """Rows that are `on`."""
        return int(self.on.sum())

    def valid(self, name: str) -> NDArray[Any]:
        """Return a column of the rows that are `on`, (count,)."""
        values: NDArray[Any] = self.table[name].to_numpy()[self.on]
        return values

    @property
    def first(self) -> pd.Series[Any]:
        return self.table.iloc[int(self.on.argmax())]

    @property
    def last(self) -> pd.Series[Any]:
        return self.table.iloc[len(self.on) - 1 - int(self.on[::-1].argmax())]

    @property
    def exposed(self) -> str:
        """`field`, `frame` (whole, of two fields) or `progressive`."""
        scans = _scans(self.table, self.on)
        if scans <= set(FIELD_SCANS):
            return "field"
        return "progressive" if scans == {"progressive"} else "frame"


NEEDED = (
    "time_s", "utc_ns", "marker", "x_mm", "y_mm", "valid", "status", "frame_seq", "scan",
    "setup_revision", "session",
)  # fmt: skip
"""Columns without which nothing can be chosen, nor put beside a reference."""


def choose(
    recording: Recording,
    marker: str | None = None,
    from_s: float = -math.inf,
    to_s: float = math.inf,
) -> Chosen:
    """Return one marker's samples between two times, in seconds from the recording's first sample.

    Raises ReplayError where there are none, or whole frames and fields are mixed.
    """
    inside = recording.of_marker(marker, from_s, to_s)
    name = str(inside["marker"].iloc[0])
    measured = inside["valid"].to_numpy(bool)
    if not measured.any():
        raise ReplayError(
            f"{_named(recording)}: marker {name} has no valid sample; the recording ends before "
            "its reference was taken, or the marker was not seen"
        )
    on = measured & _against_one(recording, name, inside, measured)
    rows = np.flatnonzero(on)
    times_s = inside["time_s"].to_numpy()[rows]
    on[rows[1:][np.diff(np.maximum.accumulate(times_s)) <= 0]] = False
    scans = _scans(inside, on)
    if scans & set(FIELD_SCANS) and scans - set(FIELD_SCANS):
        raise ReplayError(
            f"{_named(recording)}: marker {name} was measured in whole frames and in fields; cut "
            "out one part with --from-s and --to-s"
        )
    begin = int(np.argmax((inside["status"].to_numpy() & 1) == 0))
    left_out = int(measured.sum()) - int(on.sum())
    chosen = Chosen(
        name, inside.iloc[begin:].reset_index(drop=True), on[begin:], None, None, left_out
    )
    set_up, own = _set_up(recording, chosen)
    return replace(chosen, set_up=set_up, own=own)


def _against_one(
    recording: Recording, marker: str, table: pd.DataFrame, measured: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Return the rows against the reference with most measurements."""
    numbers = table.groupby(["session", "setup_revision"], sort=False).ngroup().to_numpy()
    counts: Counter[object] = Counter()
    zeros = {}
    groups, places, many = np.unique(numbers[measured], return_index=True, return_counts=True)
    rows = np.flatnonzero(measured)[places]
    for group, row, count in sorted(
        zip(groups.tolist(), rows.tolist(), many.tolist(), strict=True), key=lambda one: one[1]
    ):
        session, revision = table["session"].iloc[row], int(table["setup_revision"].iloc[row])
        zeros[group] = _reference_of(recording, marker, session, revision)
        counts[zeros[group]] += count
    ((most, _),) = counts.most_common(1)
    found: NDArray[np.bool_] = np.isin(
        numbers, [group for group, zero in zeros.items() if zero == most]
    )
    return found


def _scans(table: pd.DataFrame, rows: NDArray[np.bool_]) -> set[str]:
    scan = table["scan"].cat
    return {str(scan.categories[code]) for code in np.unique(scan.codes.to_numpy()[rows])}


def camera_of(recording: Recording, chosen: Chosen, exposure_s: float | None = None) -> Camera:
    """Return the chosen samples as a camera took them; `exposure_s` in place of the recorded."""
    fields_s: tuple[float, ...] = (0.0,)
    if chosen.exposed == "frame":
        quarter_s = _frame_period_s(chosen) / 4
        fields_s = (-quarter_s, quarter_s)
    return Camera(
        time_s=chosen.valid("time_s"),
        x_mm=chosen.valid("x_mm"),
        y_mm=chosen.valid("y_mm"),
        exposure_s=exposure_of(recording.about.config) if exposure_s is None else exposure_s,
        fields_s=fields_s,
    )


def exposure_of(config: dict[str, Any]) -> float:
    """Return the exposure of a field or frame in seconds, by the recorded configuration."""
    section = "table" if config.get("source") == "table" else "camera"
    return float(config.get(section, {}).get("exposure_ms", 0.0)) / 1000


def _frame_period_s(chosen: Chosen) -> float:
    """Return the time from one frame to the next; NaN of a single frame."""
    codes = chosen.table["scan"].cat.codes.to_numpy()
    alike = chosen.on & (codes == codes[int(chosen.on.argmax())])
    frames = np.diff(chosen.table["frame_seq"].to_numpy()[alike])
    steps_s = np.diff(chosen.table["time_s"].to_numpy()[alike])[frames > 0]
    return float(np.median(steps_s / frames[frames > 0])) if len(steps_s) else math.nan


def _reference_of(recording: Recording, marker: str, session: str, revision: int) -> object:
    """Return what tells one zero from another: the same for all set-ups of one reference."""
    try:
        set_up = recording.about.set_ups[session, revision].set_up()
    except (KeyError, SetUpError):
        return session, revision
    return session, next((m.homography for m in set_up.markers if m.shape.name == marker), revision)


def _set_up(recording: Recording, chosen: Chosen) -> tuple[SetUp | None, MarkerSetUp | None]:
    last = chosen.last
    try:
        set_up = recording.about.set_ups[last["session"], int(last["setup_revision"])].set_up()
    except (KeyError, SetUpError):
        return None, None
    return set_up, next((m for m in set_up.markers if m.shape.name == chosen.marker), None)


def _named(recording: Recording) -> str:
    return ", ".join(str(path) for path in recording.paths)
