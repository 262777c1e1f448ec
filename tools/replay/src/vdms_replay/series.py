"""A series at even steps, and its mean over any short time."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

Floats: TypeAlias = NDArray[np.float64]

LEAST_VALUES = 8
TIMES_AT_ONCE = 1 << 16
"""What is held beside them is many times as much."""


class SeriesError(ValueError):
    """The values do not make a series; a phrase says why."""


class Series:
    """Values at `start_s + n * step_s`, between which it is the cubic through the four nearest.

    Where a value is not a number, what would need it is not a number either.
    """

    def __init__(self, start_s: float, step_s: float, values: Floats) -> None:
        """Raises SeriesError for too few values."""
        good = np.isfinite(values)
        if len(values) < LEAST_VALUES or not good.any():
            raise SeriesError(
                f"{int(good.sum())} values are too few; a series needs {LEAST_VALUES} or more"
            )
        self.start_s, self.step_s = start_s, step_s
        self.values = values
        self.good = good
        middle = float(np.mean(values, where=good))
        # About the middle, so that the integral below keeps its digits.
        self._middle = middle
        flat = values - middle
        flat[~good] = 0.0
        self._flat = flat
        pieces = np.zeros(len(values))
        inner = pieces[2:-1]
        np.add(flat[1:-2], flat[2:-1], out=inner)
        inner *= 13
        inner -= flat[:-3]
        inner -= flat[3:]
        inner /= 24
        self._integral = np.cumsum(pieces, out=pieces)
        """Of the cubics from value 1 to value n, in values times steps."""
        self._bad = np.zeros(len(values) + 1, np.int32)
        np.cumsum(~good, out=self._bad[1:])

    def __len__(self) -> int:
        return len(self.values)

    @property
    def end_s(self) -> float:
        return self.start_s + (len(self.values) - 1) * self.step_s

    @property
    def rate_hz(self) -> float:
        return 1 / self.step_s

    def times_s(self) -> Floats:
        """Return the time of each value."""
        return np.asarray(self.start_s + np.arange(len(self.values)) * self.step_s)

    def mean_about(self, times_s: Floats, width_s: float) -> Floats:
        """Return the mean of the series over `width_s` about each time, or for 0 its value there;
        NaN where the series does not reach."""
        found = np.empty(len(times_s))
        for begin in range(0, len(times_s), TIMES_AT_ONCE):
            some = slice(begin, begin + TIMES_AT_ONCE)
            found[some] = self._mean_about(times_s[some], width_s)
        return found

    def _mean_about(self, times_s: Floats, width_s: float) -> Floats:
        place = (times_s - self.start_s) / self.step_s
        half = width_s / self.step_s / 2
        first, last = np.floor(place - half), np.floor(place + half)
        inside = (first >= 1) & (last <= len(self.values) - 3)
        low = np.where(inside, first, 1).astype(np.int64)
        high = np.where(inside, last, 1).astype(np.int64)
        inside &= self._bad[high + 3] == self._bad[low - 1]
        if width_s > 0:
            total = self._to(high, place + half) - self._to(low, place - half)
            found = total / (2 * half)
        else:
            found = self._at(low, place - low)
        return np.where(inside, found + self._middle, np.nan)

    def _at(self, i: NDArray[np.int64], f: Floats) -> Floats:
        y = self._flat
        return (
            -y[i - 1] * f * (f - 1) * (f - 2) / 6
            + y[i] * (f + 1) * (f - 1) * (f - 2) / 2
            - y[i + 1] * (f + 1) * f * (f - 2) / 2
            + y[i + 2] * (f + 1) * f * (f - 1) / 6
        )

    def _to(self, i: NDArray[np.int64], place: Floats) -> Floats:
        """Return the integral from value 1 to a place between the values i and i + 1."""
        y = self._flat
        f = place - i
        f2, f3, f4 = f * f, f**3, f**4
        return (
            self._integral[i]
            - y[i - 1] * (f4 / 4 - f3 + f2) / 6
            + y[i] * (f4 / 4 - 2 * f3 / 3 - f2 / 2 + 2 * f) / 2
            - y[i + 1] * (f4 / 4 - f3 / 3 - f2) / 2
            + y[i + 2] * (f4 / 4 - f2 / 2) / 6
        )
