"""A small plot in braille characters, eight dots to a character."""

from __future__ import annotations

import math
from collections.abc import Sequence

LABEL_WIDTH = 8
"""Characters for the ticks' labels; more where they are longer."""
LONGEST_GAP_S = 0.5
"""Points further apart are not joined."""
LEAST_SPAN_MM = 0.02

_BLANK = 0x2800
_DOTS = ((0x01, 0x08), (0x02, 0x10), (0x04, 0x20), (0x40, 0x80))
"""Bits of a character's dots, by row and column."""


def plot(
    points: Sequence[tuple[float, float]], width: int, height: int, span_s: float
) -> list[str]:
    """Return `height` lines of `width` characters: the last `span_s` of `points`.

    `points` are (s, mm) in order of time; the newest is at the right edge, and NaN leaves a gap.
    The scale has round ends, their labels in mm, and spans at least 20 um. The last line is the
    axis of time.
    """
    rows = max(height - 1, 2)
    start_s = (points[-1][0] if points else 0.0) - span_s
    shown = [(t_s - start_s, mm) for t_s, mm in points if t_s > start_s]
    low_mm, high_mm, step_mm = scale([mm for _, mm in shown], max(2, min(4, rows // 4)))
    bottom = rows * 4 - 1

    def dot_row(mm: float) -> int:
        return round((high_mm - mm) / (high_mm - low_mm) * bottom)

    labels: dict[int, str] = {}
    for tick in _ticks(low_mm, high_mm, step_mm):
        labels.setdefault(dot_row(tick * step_mm) // 4, _label(tick * step_mm, step_mm))
    label_width = max(LABEL_WIDTH, *map(len, labels.values()))
    columns = max(width - label_width - 2, 8)
    cells = [[0] * columns for _ in range(rows)]
    last: tuple[float, int, int] | None = None
    for t_s, mm in shown:
        if not math.isfinite(mm):
            last = None
            continue
        x = min(int(t_s / span_s * columns * 2), columns * 2 - 1)
        y = dot_row(mm)
        joined = last is not None and t_s - last[0] <= LONGEST_GAP_S
        _line(cells, last[1:] if joined and last else (x, y), (x, y))
        last = t_s, x, y
    lines = [
        f"{labels.get(row, ''):>{label_width}} {'┤' if row in labels else '│'}"
        + "".join(chr(_BLANK + bits) for bits in cells[row])
        for row in range(rows)
    ]
    return [*lines, f"{'':{label_width + 1}}└{_time_axis(columns, span_s)}"]


def scale(values_mm: Sequence[float], ticks: int) -> tuple[float, float, float]:
    """Return low end, high end and the step of the ticks, all round, of a scale for the values.

    There are at least `ticks` ticks.
    """
    finite = [mm for mm in values_mm if math.isfinite(mm)]
    low_mm, high_mm = (min(finite), max(finite)) if finite else (0.0, 0.0)
    widen_mm = max(0.0, LEAST_SPAN_MM - (high_mm - low_mm)) / 2
    low_mm, high_mm = low_mm - widen_mm, high_mm + widen_mm
    decade_mm = 10.0 ** math.ceil(math.log10(high_mm - low_mm))
    step_mm, ends_mm = decade_mm, (low_mm, high_mm)
    for factor in (1, 0.5, 0.2, 0.1, 0.05, 0.02, 0.01):
        step_mm = factor * decade_mm
        end_mm = step_mm / 5
        ends_mm = (
            math.floor(low_mm / end_mm + 1e-9) * end_mm,
            math.ceil(high_mm / end_mm - 1e-9) * end_mm,
        )
        if len(_ticks(*ends_mm, step_mm)) >= ticks:
            break
    return *ends_mm, step_mm


def _ticks(low_mm: float, high_mm: float, step_mm: float) -> range:
    return range(math.ceil(low_mm / step_mm - 1e-9), math.floor(high_mm / step_mm + 1e-9) + 1)


def _label(mm: float, step_mm: float) -> str:
    decimals = max(0, -math.floor(math.log10(step_mm) + 1e-9))
    text = f"{mm:+.{decimals}f}"
    return "0" if float(text) == 0 else text


def _line(cells: list[list[int]], start: tuple[int, ...], end: tuple[int, int]) -> None:
    (x0, y0), (x1, y1) = start, end
    steps = max(abs(x1 - x0), abs(y1 - y0), 1)
    for i in range(steps + 1):
        x = x0 + round((x1 - x0) * i / steps)
        y = y0 + round((y1 - y0) * i / steps)
        cells[y // 4][x // 2] |= _DOTS[y % 4][x % 2]


def _time_axis(columns: int, span_s: float) -> str:
    left, right = f"-{span_s:g} s", "now"
    middle = f"-{span_s / 2:g} s"
    axis = list(f"{left:<{columns}}")
    axis[columns - len(right) :] = right
    if columns > 3 * len(left) + len(middle):
        start = (columns - len(middle)) // 2
        axis[start : start + len(middle)] = middle
    return "".join(axis)
