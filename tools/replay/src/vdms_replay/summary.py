"""What a recording's samples are like, taken up batch by batch in bounded memory."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from vdms_rt.model import INVALID_STATUS, Status
from vdms_rt.status import status_words

GAPS_KEPT = 1000
QUIET_SPAN_S = 1.0
AXES = ("x_mm", "y_mm", "rotation_mrad")
MEASURED = ("time_s", *AXES, "sigma_x_mm", "sigma_y_mm")


@dataclass(frozen=True, slots=True)
class Gap:
    """Pictures of which there is no sample, first and last included."""

    session: str
    first_seq: int
    last_seq: int
    time_s: float
    """Of the sample before."""
    seconds: float
    """From the sample before to the one after."""

    @property
    def count(self) -> int:
        return self.last_seq - self.first_seq + 1


@dataclass(slots=True)
class Axis:
    """One coordinate over all valid samples."""

    count: int = 0
    lowest: float = math.inf
    lowest_s: float = math.nan
    highest: float = -math.inf
    highest_s: float = math.nan
    mean: float = 0.0
    _squares: float = 0.0

    @property
    def deviation(self) -> float:
        """Standard deviation about the mean."""
        return math.sqrt(self._squares / self.count) if self.count else math.nan

    def take(self, time_s: NDArray[np.float64], values: NDArray[np.float64]) -> None:
        """Add values, none of them NaN."""
        low, high = int(values.argmin()), int(values.argmax())
        if values[low] < self.lowest:
            self.lowest, self.lowest_s = float(values[low]), float(time_s[low])
        if values[high] > self.highest:
            self.highest, self.highest_s = float(values[high]), float(time_s[high])
        count, mean = len(values), float(values.mean())
        total = self.count + count
        self._squares += float(((values - mean) ** 2).sum())
        self._squares += (mean - self.mean) ** 2 * self.count * count / total
        self.mean += (mean - self.mean) * count / total
        self.count = total


@dataclass(slots=True)
class Quiet:
    """The second in which the marker moved least: its noise, if it rested there."""

    x_mm: float = math.nan
    """Standard deviation about a straight line."""
    y_mm: float = math.nan
    time_s: float = math.nan


@dataclass(slots=True)
class MarkerSummary:
    """All samples of one marker."""

    name: str
    samples: int = 0
    valid: int = 0
    invalid: Counter[str] = field(default_factory=Counter)
    """Samples that are no measurement, by their reasons in words."""
    flagged: Counter[str] = field(default_factory=Counter)
    """Valid samples with a reservation."""
    first_s: float = math.nan
    last_s: float = math.nan
    rate_hz: float = math.nan
    """Pictures a second, lost ones included; of the longest session."""
    gaps: list[Gap] = field(default_factory=list)
    """The first ones."""
    gap_count: int = 0
    lost: int = 0
    """Samples that the gaps should have held."""
    axes: dict[str, Axis] = field(default_factory=lambda: {name: Axis() for name in AXES})
    sigma_x_mm: float = math.nan
    """Root mean square of the stated standard deviations."""
    sigma_y_mm: float = math.nan
    quiet: Quiet = field(default_factory=Quiet)
    _variance: NDArray[np.float64] = field(default_factory=lambda: np.zeros(2))
    _spans: dict[str, tuple[int, float, int, float]] = field(default_factory=dict)
    """First and last seq and second of each session."""

    def take(self, table: pd.DataFrame) -> None:
        """Add samples of this marker that follow those before."""
        self.samples += len(table)
        time_s = table["time_s"].to_numpy()
        self.first_s = time_s[0] if math.isnan(self.first_s) else self.first_s
        self.last_s = time_s[-1]
        for session, part in table.groupby("session", sort=False):
            self._sequence(str(session), part["seq"].to_numpy(), part["time_s"].to_numpy())
        self._reasons(table["status"])
        rows = table["valid"].to_numpy(bool)
        valid = int(rows.sum())
        self.valid += valid
        if valid:
            self._measure({name: table[name].to_numpy()[rows] for name in MEASURED})

    def _sequence(self, session: str, seq: NDArray[np.int64], time_s: NDArray[np.float64]) -> None:
        known = self._spans.get(session)
        if known is not None:
            seq = np.concatenate(([known[2]], seq))
            time_s = np.concatenate(([known[3]], time_s))
        for at in np.flatnonzero(np.diff(seq) > 1):
            gap = Gap(
                session,
                int(seq[at]) + 1,
                int(seq[at + 1]) - 1,
                float(time_s[at]),
                float(time_s[at + 1] - time_s[at]),
            )
            self.gap_count += 1
            self.lost += gap.count
            if len(self.gaps) < GAPS_KEPT:
                self.gaps.append(gap)
        first = known[:2] if known is not None else (int(seq[0]), float(time_s[0]))
        self._spans[session] = (*first, int(seq[-1]), float(time_s[-1]))
        longest = max(self._spans.values(), key=lambda span: span[2] - span[0])
        if longest[3] > longest[1]:
            self.rate_hz = (longest[2] - longest[0]) / (longest[3] - longest[1])

    def _reasons(self, statuses: pd.Series[int]) -> None:
        for bits, count in statuses.value_counts().items():
            status = Status(int(str(bits)))
            if status & INVALID_STATUS:
                self.invalid[status_words(status & INVALID_STATUS)] += int(count)
            elif status:
                for flag in status:
                    self.flagged[status_words(flag)] += int(count)

    def _measure(self, valid: dict[str, NDArray[np.float64]]) -> None:
        time_s = valid["time_s"]
        for name, axis in self.axes.items():
            axis.take(time_s, valid[name])
        sigmas = np.column_stack([valid["sigma_x_mm"], valid["sigma_y_mm"]])
        self._variance += np.nansum(sigmas**2, axis=0)
        self.sigma_x_mm, self.sigma_y_mm = (float(s) for s in np.sqrt(self._variance / self.valid))
        self._seek_quiet(time_s, np.column_stack([valid["x_mm"], valid["y_mm"]]))

    def _seek_quiet(self, time_s: NDArray[np.float64], xy_mm: NDArray[np.float64]) -> None:
        if math.isnan(self.rate_hz) or self.rate_hz <= 0:
            return
        size = max(round(QUIET_SPAN_S * self.rate_hz), 8)
        count = len(time_s) // size
        if not count:
            return
        times = time_s[: count * size].reshape(count, size)
        values = xy_mm[: count * size].reshape(count, size, 2)
        line = np.linspace(-1, 1, size)
        line /= np.sqrt((line**2).sum())
        rest = values - values.mean(axis=1, keepdims=True)
        rest -= np.einsum("cst,s->ct", rest, line)[:, None, :] * line[None, :, None]
        deviation = np.sqrt((rest**2).sum(axis=1) / (size - 2))
        whole = times[:, -1] - times[:, 0] < 1.5 * QUIET_SPAN_S
        deviation[~whole] = np.inf
        best = int((deviation**2).sum(axis=1).argmin())
        now = np.array([self.quiet.x_mm, self.quiet.y_mm])
        if whole[best] and not (deviation[best] ** 2).sum() >= (now**2).sum():
            x_mm, y_mm = deviation[best]
            self.quiet = Quiet(float(x_mm), float(y_mm), float(times[best, 0]))

    def values(self) -> dict[str, Any]:
        """Return everything as plain values that JSON can hold; None where it is unknown."""
        return {
            "samples": self.samples,
            "valid": self.valid,
            "invalid": dict(self.invalid.most_common()),
            "flagged": dict(self.flagged.most_common()),
            "first_s": self.first_s,
            "last_s": self.last_s,
            "rate_hz": known(self.rate_hz),
            "lost": self.lost,
            "gap_count": self.gap_count,
            "gaps": [
                {
                    "session": gap.session,
                    "first_seq": gap.first_seq,
                    "last_seq": gap.last_seq,
                    "time_s": gap.time_s,
                    "seconds": gap.seconds,
                }
                for gap in self.gaps
            ],
            "axes": {
                name: {
                    "lowest": known(axis.lowest),
                    "lowest_at_s": known(axis.lowest_s),
                    "highest": known(axis.highest),
                    "highest_at_s": known(axis.highest_s),
                    "mean": axis.mean if axis.count else None,
                    "deviation": known(axis.deviation),
                }
                for name, axis in self.axes.items()
            },
            "sigma_x_mm": known(self.sigma_x_mm),
            "sigma_y_mm": known(self.sigma_y_mm),
            "quietest_second": {
                "x_mm": known(self.quiet.x_mm),
                "y_mm": known(self.quiet.y_mm),
                "at_s": known(self.quiet.time_s),
            },
        }


def known(value: float) -> float | None:
    """Return the value, None for NaN and infinity, which JSON does not have."""
    return value if math.isfinite(value) else None
