"""Messages turned into columns: the names, types and units of all tables."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from vdms_rt.model import Scan, Status
from vdms_rt.status import status_words
from vdms_rt.wire import vdms_pb2 as pb

UNITS = {
    "time_s": "s",
    "utc": "UTC",
    "x_mm": "mm",
    "y_mm": "mm",
    "rotation_mrad": "mrad",
    "sigma_x_mm": "mm",
    "sigma_y_mm": "mm",
    "residual_mm": "mm",
    "mean_x_mm": "mm",
    "mean_y_mm": "mm",
    "t_ns": "ns",
    "sigma_t_ns": "ns",
    "stamp_ns": "ns",
    "utc_ns": "ns",
}
"""Of every column that has one; the name says it too."""

MEANINGS = {
    "time_s": "middle of the exposure, seconds since the first sample",
    "utc": "middle of the exposure, UTC",
    "marker": "name of the marker",
    "x_mm": "displacement to the right, as one looks at the marker",
    "y_mm": "displacement upwards",
    "rotation_mrad": "rotation, counter-clockwise positive",
    "sigma_x_mm": "standard deviation of x_mm",
    "sigma_y_mm": "standard deviation of y_mm",
    "residual_mm": "root mean square misfit of the circles to a rigid marker",
    "valid": "the sample is a measurement",
    "status": "bits of vdms.Status, 0 for a good sample",
    "status_text": "status in words",
    "seq": "number of the picture in its session; a gap means lost data",
    "frame_seq": "frame periods since the session's first frame",
    "scan": "whole frame or field",
    "segment": "goes up where times leave the old grid",
    "setup_revision": "of the set-up in force",
    "session": "of one run of vdms-rt, random",
    "t_ns": "middle of the exposure, monotonic clock of the session's computer",
    "sigma_t_ns": "standard deviation of t_ns",
    "utc_ns": "middle of the exposure, UTC since 1970; 0 where unknown",
    "stamp_ns": "the driver's own stamp",
}

_SCANS = pd.CategoricalDtype([scan.name.lower().replace("_", "-") for scan in Scan])


class Clock:
    """Seconds from start: the first sample of all is zero.

    Within a session by its monotonic clock, whose rate is steady; between sessions by UTC.
    """

    def __init__(self) -> None:
        self.start_ns: int | None = None
        """Of the first sample, on the common scale: UTC where it is known."""
        self.utc = False
        """The common scale is UTC."""
        self._offsets_ns: dict[int, int] = {}

    def offset_ns(self, session: int, t_ns: int, utc_ns: int) -> int:
        """Return what is added to the session's `t_ns`; the first call for a session fixes it."""
        offset_ns = self._offsets_ns.get(session)
        if offset_ns is None:
            offset_ns = self._offsets_ns[session] = utc_ns - t_ns if utc_ns else 0
            if self.start_ns is None:
                self.start_ns, self.utc = t_ns + offset_ns, bool(utc_ns)
        return offset_ns

    def known_offset_ns(self, session: int) -> int:
        """Return the session's offset, 0 as long as it has none."""
        return self._offsets_ns.get(session, 0)

    def seconds(self, at_ns: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return seconds from start of times on the common scale."""
        return (at_ns - (self.start_ns or 0)) / 1e9


class Samples:
    """Displacements."""

    def __init__(self, clock: Clock, *, circles: bool = False) -> None:
        """With `circles` each circle of the first sample that has some gets columns of its own."""
        self._clock = clock
        self._circles = circles
        self._count = 0
        """Circles that have columns; fixed by the first sample that has any."""
        self._rows: list[tuple[Any, ...]] = []
        self._circle_rows: list[tuple[float, ...]] = []

    def __len__(self) -> int:
        return len(self._rows)

    def add(self, d: pb.Displacement) -> None:
        at_ns = d.t_ns + self._clock.offset_ns(d.session, d.t_ns, d.utc_ns)
        self._rows.append(
            (
                at_ns, d.utc_ns, d.marker, d.x_mm, d.y_mm, d.rotation_mrad, d.sigma_x_mm,
                d.sigma_y_mm, d.residual_mm, d.valid, d.status, d.seq, d.frame_seq, d.scan,
                d.segment, d.setup_revision, d.session, d.t_ns, d.sigma_t_ns, d.stamp_ns,
            )
        )  # fmt: skip
        if self._circles:
            self._count = self._count or len(d.circles)
            self._circle_rows.append(
                tuple(
                    value
                    for c in d.circles
                    for value in (c.x_px, c.y_px, c.area_px, c.contrast, c.flags)
                )
            )

    def take(self) -> pd.DataFrame:
        """Return what was added since the last call, a row for each sample."""
        rows, self._rows = self._rows, []
        (
            at_ns, utc_ns, marker, x, y, rotation, sigma_x, sigma_y, residual, valid, status, seq,
            frame_seq, scan, segment, revision, session, t_ns, sigma_t_ns, stamp_ns,
        ) = zip(*rows, strict=True) if rows else [()] * 20  # fmt: skip
        utc = np.array(utc_ns, np.int64)
        columns = {
            "time_s": self._clock.seconds(np.array(at_ns, np.int64)),
            "utc": utc_column(utc),
            "marker": pd.array(marker, dtype="str"),
            "x_mm": np.array(x, np.float64),
            "y_mm": np.array(y, np.float64),
            "rotation_mrad": np.array(rotation, np.float64),
            "sigma_x_mm": np.array(sigma_x, np.float64),
            "sigma_y_mm": np.array(sigma_y, np.float64),
            "residual_mm": np.array(residual, np.float64),
            "valid": np.array(valid, np.bool_),
            "status": np.array(status, np.int32),
            "status_text": _texts(status, lambda bits: status_words(Status(bits))),
            "seq": np.array(seq, np.int64),
            "frame_seq": np.array(frame_seq, np.int64),
            "scan": pd.Categorical.from_codes(np.array(scan, np.int8), dtype=_SCANS),
            "segment": np.array(segment, np.int64),
            "setup_revision": np.array(revision, np.int64),
            "session": _texts(session, lambda number: f"{number:016x}"),
            "t_ns": np.array(t_ns, np.int64),
            "sigma_t_ns": np.array(sigma_t_ns, np.int64),
            "utc_ns": utc,
            "stamp_ns": np.array(stamp_ns, np.int64),
        }
        return pd.DataFrame(columns | self._take_circles())

    def _take_circles(self) -> dict[str, Any]:
        rows, self._circle_rows = self._circle_rows, []
        if not self._circles:
            return {}
        width = 5 * self._count
        values = np.full((len(rows), width), np.nan)
        for number, row in enumerate(rows):
            values[number, : len(row[:width])] = row[:width]
        names = ("x_px", "y_px", "area_px", "contrast", "flags")
        return {
            f"circle{column // 5 + 1}_{names[column % 5]}": values[:, column]
            for column in range(width)
        }


class Truths:
    """Truths of a virtual table."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._rows: list[tuple[Any, ...]] = []

    def __len__(self) -> int:
        return len(self._rows)

    def add(self, t: pb.Truth, session: int) -> None:
        """Add one truth; it carries no session, so the file's is given."""
        self._rows.append(
            (session, t.marker, t.frame, t.scan, t.stamp_ns, t.t_ns, t.x_mm, t.y_mm,
             t.rotation_mrad, t.mean_x_mm, t.mean_y_mm)
        )  # fmt: skip

    def take(self) -> pd.DataFrame:
        """Return what was added since the last call, a row for each truth."""
        rows, self._rows = self._rows, []
        session, marker, frame, scan, stamp_ns, t_ns, x, y, rotation, mean_x, mean_y = (
            zip(*rows, strict=True) if rows else [()] * 11
        )
        t = np.array(t_ns, np.int64)
        offsets_ns = np.array([self._clock.known_offset_ns(s) for s in session], np.int64)
        columns = {
            "time_s": self._clock.seconds(t + offsets_ns),
            "marker": pd.array(marker, dtype="str"),
            "x_mm": np.array(x, np.float64),
            "y_mm": np.array(y, np.float64),
            "rotation_mrad": np.array(rotation, np.float64),
            "mean_x_mm": np.array(mean_x, np.float64),
            "mean_y_mm": np.array(mean_y, np.float64),
            "frame": np.array(frame, np.int64),
            "scan": pd.Categorical.from_codes(np.array(scan, np.int8), dtype=_SCANS),
            "t_ns": t,
            "stamp_ns": np.array(stamp_ns, np.int64),
        }
        return pd.DataFrame(columns)


WORDS = ("marker", "session", "status_text")
"""Columns of texts, of which few differ."""


class Held:
    """Batches of rows until all are there. Each column is then made whole by itself, so that only
    one at a time is there twice."""

    def __init__(self, columns: Sequence[str] | None = None, *, compact: bool = False) -> None:
        """Keep `columns`, all for None; with `compact` the columns of texts as categories."""
        self._columns = columns
        self._compact = compact
        self._parts: dict[str, list[Any]] = {}
        self._words: dict[str, dict[str, int]] = {}
        self._rows = 0

    def add(self, table: pd.DataFrame, rows: NDArray[np.bool_] | None = None) -> None:
        """Take the batch that follows, or some rows of it."""
        for name in table.columns if self._columns is None else self._columns:
            # A copy, because a view of one column would keep the whole batch.
            part = table[name].array.copy() if rows is None else table[name].array[rows]
            if self._compact and name in WORDS:
                part = self._codes(name, part)
            if name not in self._parts:
                # The circles are first seen in a later batch.
                self._parts[name] = [np.full(self._rows, np.nan)] if self._rows else []
            self._parts[name].append(part)
        self._rows += len(table) if rows is None else int(rows.sum())

    def _codes(self, name: str, texts: Any) -> NDArray[np.int32]:
        known = self._words.setdefault(name, {})
        places, found = pd.factorize(texts)
        numbers = [known.setdefault(str(text), len(known)) for text in found]
        return np.array(numbers, np.int32)[places]

    def whole(self) -> pd.DataFrame:
        """Return all rows, and keep none."""
        columns = {}
        for name in list(self._parts):
            parts = self._parts.pop(name)
            if name in self._words:
                codes = np.concatenate(parts)
                columns[name] = pd.Categorical.from_codes(codes, pd.Index(list(self._words[name])))
            else:
                columns[name] = pd.concat(
                    [pd.Series(part) for part in parts], ignore_index=True
                ).array
        self._rows = 0
        return pd.DataFrame(columns, copy=False)


def utc_column(utc_ns: NDArray[np.int64]) -> Any:
    """Return UTC times; NaT where `utc_ns` is 0."""
    times = utc_ns.astype("datetime64[ns]")
    times[utc_ns == 0] = np.datetime64("NaT")
    return pd.DatetimeIndex(times, tz="UTC").array


def _texts(values: Sequence[int], text: Callable[[int], str]) -> Any:
    """Return the text of each value; few differ."""
    known = {value: text(value) for value in set(values)}
    return pd.array([known[value] for value in values], dtype="str")
