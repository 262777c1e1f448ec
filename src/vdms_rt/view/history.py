"""The last minutes of a marker, from which each browser is served at its own pace."""

from __future__ import annotations

import math
import struct
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vdms_rt.model import Displacement

SPAN_S = 600.0
"""The longest span that the page shows."""
CAPACITY = 1 << 17
"""Samples kept at most: `SPAN_S` at 200 Hz."""
CLOCK_STEP_S = 1.0
"""A UTC clock that is set by more makes a new stretch, for its times would not join the old."""

_ROW = np.dtype(
    [
        ("t_s", "<f8"),
        ("seq", "<f8"),
        ("x_mm", "<f4"),
        ("y_mm", "<f4"),
        ("sigma_x_mm", "<f4"),
        ("sigma_y_mm", "<f4"),
        ("rotation_mrad", "<f4"),
        ("status", "<u4"),
    ]
)
_HEADER = struct.Struct("<II")


class Rows(NamedTuple):
    """Samples that a browser has not had yet."""

    rows: NDArray[Any]
    next: int
    """Where the ones after them begin."""
    skipped: tuple[int, int] | None
    """First and last seq of those that were overwritten before they could be sent."""


class History:
    """A ring of the samples of one marker; places in it count up for ever. One thread uses it."""

    def __init__(self) -> None:
        self._rows: NDArray[Any] = np.empty(CAPACITY, _ROW)
        # Takes the memory now: touched only as it fills, it would look like a leak for long.
        self._rows.fill(0)
        self._begin = 0
        self._end = 0
        self._offset_s = 0.0
        self.session = 0
        self.stretch = 0
        """Goes up with each session, and where the UTC clock was set: nothing joins over it."""

    def append(self, sample: Displacement, now_s: float) -> None:
        """Add one sample. `now_s` is UTC, for a station that does not know it."""
        t_s = sample.t_ns / 1e9
        offset_s = sample.utc_ns / 1e9 - t_s if sample.utc_ns else self._offset_s
        stepped = abs(offset_s - self._offset_s) > CLOCK_STEP_S
        if sample.session != self.session or stepped:
            self.session = sample.session
            self.stretch += 1
            self._begin = self._end
            self._offset_s = offset_s if sample.utc_ns else now_s - t_s
        valid = sample.valid
        self._rows[self._end % CAPACITY] = (
            t_s + self._offset_s,
            sample.seq,
            sample.x_mm if valid else math.nan,
            sample.y_mm if valid else math.nan,
            sample.sigma_x_mm,
            sample.sigma_y_mm,
            sample.rotation_mrad if valid else math.nan,
            int(sample.status),
        )
        self._end += 1
        oldest_s = t_s + self._offset_s - SPAN_S
        self._begin = max(self._begin, self._end - CAPACITY)
        while self._rows["t_s"][self._begin % CAPACITY] < oldest_s:
            self._begin += 1

    def place_after(self, seq: int) -> int:
        """Return the place of the first sample of this stretch with a larger seq."""
        low, high = self._begin, self._end
        while low < high:
            middle = (low + high) // 2
            if self._rows["seq"][middle % CAPACITY] <= seq:
                low = middle + 1
            else:
                high = middle
        return low

    def after(self, place: int, last_seq: int | None, limit: int) -> Rows:
        """Return up to `limit` samples from `place` on; `last_seq` is the last that was sent."""
        begin = max(place, self._begin)
        end = min(begin + limit, self._end)
        rows = self._rows[np.arange(begin, end) % CAPACITY]
        skipped = None
        if place < self._begin and last_seq is not None and len(rows):
            first_seq = int(rows["seq"][0])
            if first_seq > last_seq + 1:
                skipped = last_seq + 1, first_seq - 1
        return Rows(rows, end, skipped)


def message(stream: int, rows: NDArray[Any]) -> bytes:
    """Return rows as the page reads them: `stream` and their number (uint32), then each column,
    little-endian: t_s and seq (float64), x, y, sigma x, sigma y, rotation (float32), status
    (uint32)."""
    columns = [rows[name].tobytes() for name in _ROW.names or ()]
    return b"".join([_HEADER.pack(stream, len(rows)), *columns])
