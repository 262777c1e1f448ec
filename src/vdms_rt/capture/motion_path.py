"""Where the virtual table is at any moment: the motions that it can make, after its rest."""

from __future__ import annotations

import csv
import functools
import itertools
import math
from collections.abc import Callable
from pathlib import Path
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from vdms_rt.config import Motion
from vdms_rt.model import SourceError

Floats: TypeAlias = NDArray[np.float64]
Strokes: TypeAlias = Callable[[Floats], Floats]
"""Seconds since the start of motion, shape (n,), to millimetres along and across, (n, 2)."""

STEP_RISE_S = 0.1
"""What a small servo-hydraulic table needs for a step."""


@functools.cache
def gauss_legendre(count: int) -> tuple[Floats, Floats]:
    """Return nodes in -1..1 and weights that sum to 1, both (count,)."""
    nodes, weights = np.polynomial.legendre.leggauss(count)
    return nodes, weights / 2


class MotionPath:
    """The table's motion: `rest_s` of rest, then what the configuration asks for.

    The position is continuous. A harmonic is A sin(2 pi f t) from the first moment on. A sweep is
    logarithmic (equal time for each octave, as in IEC 60068-2-6) at constant amplitude and goes on
    at its end frequency. A step is a fifth-order polynomial without a jump in velocity or
    acceleration, lasts STEP_RISE_S and stays. A record is a cubic spline through its rows,
    relative to the first one, and stays at its last.
    """

    def __init__(self, motion: Motion, rest_s: float) -> None:
        """Raises SourceError when the file of a record cannot be used."""
        self._rest_s = rest_s
        self.reach_mm = motion.amplitude_mm
        """The farthest that it ever gets from its rest."""
        highest_hz = motion.frequency_hz
        duration_s = 0.0
        self._strokes: Strokes
        match motion.kind:
            case "still":
                self._strokes = _still
                self.reach_mm = 0.0
            case "harmonic":
                self._strokes = _harmonic(motion.amplitude_mm, motion.frequency_hz)
            case "sweep":
                self._strokes = _sweep(motion)
                highest_hz = max(motion.frequency_hz, motion.end_frequency_hz)
                duration_s = motion.sweep_s
            case "step":
                self._strokes = _step(motion.amplitude_mm)
                highest_hz, duration_s = 1 / STEP_RISE_S, STEP_RISE_S
            case "record":
                times_s, rows_mm = read_record(Path(motion.file))
                rows_mm = rows_mm - rows_mm[0]
                self._strokes = _spline(times_s - times_s[0], rows_mm)
                self.reach_mm = float(np.hypot(rows_mm[:, 0], rows_mm[:, 1]).max())
                highest_hz = float(1 / np.median(np.diff(times_s)))
                duration_s = float(times_s[-1] - times_s[0])
        self._breaks_s = sorted({rest_s, rest_s + duration_s})
        self._panel_s = 0.5 / highest_hz
        angle = math.radians(motion.direction_deg)
        self._turn = np.array(
            [[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]]
        )

    def at(self, times_s: Floats) -> Floats:
        """Return the positions in the marker plane, (n, 2) mm, x right, y up, relative to the
        rest, at times since the start of the table, (n,) s."""
        return np.asarray(self._strokes(np.maximum(times_s - self._rest_s, 0.0)) @ self._turn)

    def mean(self, start_s: float, end_s: float) -> Floats:
        """Return the mean position from one time to another, (2,) mm, by Gauss-Legendre quadrature
        with panels of at most half a period, split where motion begins and ends."""
        if end_s <= start_s:
            return np.asarray(self.at(np.array([start_s]))[0])
        inside_s = [b for b in self._breaks_s if start_s < b < end_s]
        edges = [start_s, *inside_s, end_s]
        nodes, weights = gauss_legendre(10)
        total = np.zeros(2)
        for left_s, right_s in itertools.pairwise(edges):
            panels = math.ceil((right_s - left_s) / self._panel_s)
            width_s = (right_s - left_s) / panels
            middles_s = left_s + width_s * (np.arange(panels) + 0.5)
            times_s = middles_s[:, None] + width_s / 2 * nodes
            total += width_s * np.tile(weights, panels) @ self.at(times_s.ravel())
        return total / (end_s - start_s)


def _along(values_mm: Floats) -> Floats:
    return np.stack([values_mm, np.zeros_like(values_mm)], axis=1)


def _still(times_s: Floats) -> Floats:
    return np.zeros((len(times_s), 2))


def _harmonic(amplitude_mm: float, frequency_hz: float) -> Strokes:
    return lambda times_s: _along(amplitude_mm * np.sin(2 * np.pi * frequency_hz * times_s))


def _sweep(motion: Motion) -> Strokes:
    begin_hz, end_hz = motion.frequency_hz, motion.end_frequency_hz
    if begin_hz == end_hz:
        return _harmonic(motion.amplitude_mm, begin_hz)
    folding_s = motion.sweep_s / math.log(end_hz / begin_hz)

    def strokes(times_s: Floats) -> Floats:
        swept_s = np.minimum(times_s, motion.sweep_s)
        cycles = begin_hz * folding_s * np.expm1(swept_s / folding_s)
        cycles += end_hz * (times_s - swept_s)
        return _along(motion.amplitude_mm * np.sin(2 * np.pi * cycles))

    return strokes


def _step(amplitude_mm: float) -> Strokes:
    def strokes(times_s: Floats) -> Floats:
        s = np.minimum(times_s / STEP_RISE_S, 1.0)
        return _along(amplitude_mm * s**3 * (10 - 15 * s + 6 * s**2))

    return strokes


def _spline(times_s: Floats, rows_mm: Floats) -> Strokes:
    """The cubic spline through the rows that is at rest at both ends (de Boor, A Practical Guide
    to Splines, ch. IV, complete spline)."""
    steps_s = np.diff(times_s)
    slopes = np.zeros_like(rows_mm)
    if len(times_s) > 2:
        chords = np.diff(rows_mm, axis=0) / steps_s[:, None]
        lower, upper = steps_s[1:].copy(), steps_s[:-1].copy()
        middle = 2 * (lower + upper)
        right = 3 * (lower[:, None] * chords[:-1] + upper[:, None] * chords[1:])
        for i in range(1, len(middle)):
            part = lower[i] / middle[i - 1]
            middle[i] -= part * upper[i - 1]
            right[i] -= part * right[i - 1]
        slopes[-2] = right[-1] / middle[-1]
        for i in range(len(middle) - 2, -1, -1):
            slopes[i + 1] = (right[i] - upper[i] * slopes[i + 2]) / middle[i]

    def strokes(at_s: Floats) -> Floats:
        at_s = np.minimum(at_s, times_s[-1])
        i = np.clip(np.searchsorted(times_s, at_s, side="right") - 1, 0, len(steps_s) - 1)
        h = steps_s[i][:, None]
        s = (at_s - times_s[i])[:, None] / h
        return np.asarray(
            rows_mm[i] * (1 + 2 * s) * (1 - s) ** 2
            + rows_mm[i + 1] * s**2 * (3 - 2 * s)
            + h * s * (1 - s) * (slopes[i] * (1 - s) - slopes[i + 1] * s)
        )

    return strokes


def read_record(path: Path) -> tuple[Floats, Floats]:
    """Return times (n,) s and positions (n, 2) mm from a CSV with the columns time_s, x_mm and, if
    there is one, y_mm (else zeros).

    Raises SourceError with the row that is wrong.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not UTF-8 text"
        raise SourceError(
            f"{path}: cannot read the record of table.motion.file: {reason}; "
            "give the path of a CSV with the columns time_s, x_mm and, if wanted, y_mm"
        ) from None
    lines = [(n, row) for n, row in enumerate(csv.reader(text.splitlines()), 1) if row]
    header = [name.strip() for name in lines[0][1]] if lines else []
    if sorted(header) not in (["time_s", "x_mm"], ["time_s", "x_mm", "y_mm"]):
        raise SourceError(
            f"{path}: the columns are {', '.join(header) or 'missing'}; "
            "the first line must be time_s,x_mm or time_s,x_mm,y_mm"
        )
    values = np.array([_numbers(path, n, row, len(header)) for n, row in lines[1:]])
    if len(values) < 2:
        raise SourceError(
            f"{path}: {len(values)} rows of numbers; a record needs at least 2 below its header"
        )
    times_s = values[:, header.index("time_s")]
    back = np.flatnonzero(np.diff(times_s) <= 0)
    if len(back):
        line, after_s, before_s = lines[back[0] + 2][0], times_s[back[0] + 1], times_s[back[0]]
        raise SourceError(
            f"{path}: line {line}: time_s = {after_s:g} comes after {before_s:g}; "
            "times must rise from row to row"
        )
    rows_mm = np.zeros((len(values), 2))
    for axis, name in enumerate(("x_mm", "y_mm")):
        if name in header:
            rows_mm[:, axis] = values[:, header.index(name)]
    return times_s, rows_mm


def _numbers(path: Path, line: int, row: list[str], count: int) -> list[float]:
    try:
        numbers = [float(cell) for cell in row]
    except ValueError:
        numbers = []
    if len(numbers) != count or not all(math.isfinite(n) for n in numbers):
        raise SourceError(
            f"{path}: line {line}: {','.join(row)!r} must be {count} numbers, one for each column"
        )
    return numbers
