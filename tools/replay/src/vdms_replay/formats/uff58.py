"""Universal file format, dataset 58, for modal analysis: one function for each coordinate."""

from __future__ import annotations

import contextlib
import itertools
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
import pandas as pd
import pyuff
from numpy.typing import NDArray

from vdms_replay.formats import FormatError, Meta
from vdms_replay.formats.spill import Spill

TIME_RESPONSE = 1
TIME = 17
DISPLACEMENT, VELOCITY, ACCELERATION = 8, 11, 12
"""Specific data types of the universal file format."""
DIRECTIONS = {"x": 1, "y": 2, "rotation": 6}
"""+X, +Y, rotation about +Z."""
KINDS = {"": DISPLACEMENT, "velocity": VELOCITY, "acceleration": ACCELERATION}
LEAST = 2
"""Values of a stretch."""
OFF_GRID = 0.25
"""Of a step: beyond it the times are not evenly spaced."""
HEAD_LINES = 13
"""Two that begin a dataset, and its records 1 to 11."""
COUNT_LINE = 8
FOUR = 4 * "%20.11e" + "\n"
DIGITS_LOST_S = 1e-6
"""Rounding of the step that is worth a word."""


class Uff58Writer:
    """ASCII, double precision, valid samples only, evenly spaced.

    The format has no value for "not measured", so each stretch without a gap is a function of its
    own, and nothing is made up. One node for each marker, in the order of the file. The even steps
    are those that fit all of a marker's times, so the samples wait for them on the disk.
    """

    def __init__(self, path: Path, meta: Meta) -> None:
        self.notes: list[str] = []
        self._path = path
        self._meta = meta
        self._spill = Spill(path.parent)
        self._names: dict[str, list[str]] = {}
        self._left_out = 0

    def add(self, marker: str, table: pd.DataFrame) -> None:
        names = [name for name in table.columns if _direction(name)]
        keep = table["valid"].to_numpy() & np.isfinite(table[names].to_numpy()).all(axis=1)
        self._left_out += int((~keep).sum())
        self._names.setdefault(marker, names)
        for name in ("time_s", *names):
            self._spill.append((marker, name), table[name].to_numpy()[keep])

    def discard(self) -> None:
        self._spill.close()

    def close(self) -> None:
        with contextlib.closing(self._spill):
            self._write_all()

    def _write_all(self) -> None:
        named = {
            marker: names
            for marker, names in self._names.items()
            if self._spill.rows((marker, "time_s")) >= LEAST
        }
        if not named:
            raise FormatError("there are no two valid samples, so there is no function to write")
        columns = {name for names in named.values() for name in names}
        millimetres = any("mm" in name.split("_") for name in columns)
        pyuff.UFF(str(self._path)).write_sets([_units(millimetres)], "overwrite")
        with self._path.open("ab") as file, tempfile.NamedTemporaryFile() as scratch:
            for node, (marker, names) in enumerate(named.items(), 1):
                self._write(file, Path(scratch.name), node, marker, names)
        if self._left_out:
            self.notes.append(f"{self._left_out} samples without a valid position were left out")

    def _write(
        self, file: BinaryIO, scratch: Path, node: int, marker: str, names: list[str]
    ) -> None:
        key = marker, "time_s"
        grid = _grid(lambda: self._spill.blocks(key))
        if grid.off_s > OFF_GRID * grid.step_s:
            raise FormatError(
                f"the samples of marker {marker} are up to {grid.off_s * 1e3:.1f} ms away from "
                "even steps, and the format needs even ones; make them with derive --resample"
            )
        long_enough = [one for one in grid.stretches if one.rows >= LEAST]
        self._left_out += self._spill.rows(key) - sum(one.rows for one in long_enough)
        for one in long_enough:
            start_s, next_s = grid.start_s + grid.step_s * np.array([one.place, one.place + 1])
            for name in names:
                head = self._head(marker, node, name, start_s, next_s, grid.step_s)
                pyuff.UFF(str(scratch)).write_sets([head], "overwrite")
                file.write(_counted(scratch.read_bytes(), one.rows))
                values = self._spill.blocks((marker, name), one.first, one.first + one.rows)
                _write_values(file, values)
        note = f"marker {marker} is node {node}, at {1 / grid.step_s:.4f} Hz; "
        note += f"the samples are up to {grid.off_s * 1e3:.3f} ms away from even steps"
        if len(long_enough) > 1:
            note += (
                f"; gaps part it into {len(long_enough)} functions for each coordinate "
                "(derive --max-gap closes them)"
            )
        self.notes.append(note)
        longest = max(one.rows for one in grid.stretches)
        late_s = abs(float(f"{grid.step_s:.5e}") - grid.step_s) * longest
        if late_s > DIGITS_LOST_S:
            self.notes.append(
                f"the format rounds the step to {grid.step_s:.5e} s, which adds up to "
                f"{late_s * 1e3:.3f} ms; with derive --resample 50 or 62.5 it is exact"
            )

    def _head(
        self, marker: str, node: int, name: str, start_s: float, next_s: float, step_s: float
    ) -> dict[str, Any]:
        """Return a function with its first two times, and values that say nothing."""
        quantity, kind, unit = _named(name)
        meta = self._meta
        lines = (
            f"{meta['station']} {marker} {quantity} {kind or 'displacement'} in {unit}",
            f"time 0 is {meta.get('start') or 'unknown in UTC'}",
            f"first value at {start_s:.9f} s, step {step_s:.12g} s",
            f"{meta['recorded_by']}, {', '.join(meta['files'])}",
            meta.get("derived", ""),
        )
        found: dict[str, Any] = pyuff.prepare_58(
            binary=0,
            **{f"id{n}": (line or "NONE")[:80] for n, line in enumerate(lines, 1)},
            func_type=TIME_RESPONSE,
            rsp_ent_name=marker[:10],
            rsp_node=node,
            rsp_dir=DIRECTIONS[quantity],
            ref_node=0,
            ref_dir=0,
            abscissa_spacing=1,
            abscissa_spec_data_type=TIME,
            abscissa_axis_units_lab="s",
            ordinate_spec_data_type=KINDS[kind],
            ordinate_axis_units_lab=unit,
            orddenom_spec_data_type=0,
            z_axis_spec_data_type=0,
            data=np.zeros(2),
            x=np.array([start_s, next_s]),
        )
        return found


class _Stretch(NamedTuple):
    """Samples one step apart."""

    first: int
    """Its first sample's row."""
    rows: int
    place: int
    """Of the first sample on the grid."""


class _Grid(NamedTuple):
    """Even steps through uneven times."""

    start_s: float
    step_s: float
    off_s: float
    """Farthest of a time from its place."""
    stretches: list[_Stretch]


Blocks = Callable[[], Iterator[NDArray[np.float64]]]


def _grid(times: Blocks) -> _Grid:
    """Return the even steps that fit the times best (least squares), block by block.

    The median step is that of the blocks' medians. The fit is of what is left of the times beside
    it, which is small, so that sums lose no digit.
    """
    period_s = float(np.median([np.median(b) for _, b in _between(times()) if len(b)]))
    begin_s = float(next(times())[0])
    count, sums = 0, np.zeros(4)
    for time_s, place in _placed(times(), period_s):
        rest_s, x = time_s - begin_s - period_s * place, place.astype(np.float64)
        count += len(x)
        sums += [x.sum(), rest_s.sum(), (x * x).sum(), (x * rest_s).sum()]
    x_mean, rest_mean_s, xx, xr = sums / count
    slope_s = (xr - x_mean * rest_mean_s) / (xx - x_mean * x_mean)
    step_s = period_s + slope_s
    start_s = begin_s + rest_mean_s - slope_s * x_mean
    off_s, stretches = 0.0, [_Stretch(0, 0, 0)]
    for time_s, place in _placed(times(), period_s):
        off_s = max(off_s, float(np.abs(time_s - start_s - step_s * place).max()))
        last = stretches[-1]
        row = last.first + last.rows
        before = np.concatenate(([last.place + last.rows - 1], place[:-1]))
        cuts = set(np.flatnonzero(place - before > 1).tolist())
        for begin, end in itertools.pairwise([*sorted({0, *cuts}), len(place)]):
            if begin in cuts:
                stretches.append(_Stretch(row + begin, 0, int(place[begin])))
            stretches[-1] = stretches[-1]._replace(rows=stretches[-1].rows + end - begin)
    return _Grid(round(float(start_s), 12) + 0.0, float(step_s), off_s, stretches)


def _between(
    times: Iterator[NDArray[np.float64]],
) -> Iterator[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Give each block of times, and the time from each to the next; the first has none before."""
    last = np.empty(0)
    for time_s in times:
        yield time_s, np.diff(np.concatenate((last, time_s)))
        last = time_s[-1:]


def _placed(
    times: Iterator[NDArray[np.float64]], period_s: float
) -> Iterator[tuple[NDArray[np.float64], NDArray[np.int64]]]:
    """Give each block of times, and their places on a grid of this period."""
    last = 0
    for time_s, between_s in _between(times):
        steps = np.maximum(np.rint(between_s / period_s), 1).astype(np.int64)
        lead = np.zeros(len(time_s) - len(steps), np.int64)
        place = last + np.cumsum(np.concatenate((lead, steps)))
        yield time_s, place
        last = int(place[-1])


def _counted(function: bytes, count: int) -> bytes:
    """Return a function's eleven records with the number of its values set (record 7, field 2)."""
    lines = function.splitlines(keepends=True)[:HEAD_LINES]
    record = lines[COUNT_LINE]
    lines[COUNT_LINE] = record[:10] + b"%10d" % count + record[20:]
    return b"".join(lines)


def _write_values(file: BinaryIO, blocks: Iterator[NDArray[np.float64]]) -> None:
    """Write values, four a line (record 12, case 5: 4E20.12), and the function's end.

    Here and not by pyuff, which holds a function in memory as Python's numbers and reads the whole
    file anew after each.
    """
    rest: list[float] = []
    for block in blocks:
        values = rest + block.tolist()
        whole = len(values) // 4 * 4
        file.write((whole // 4 * FOUR % tuple(values[:whole])).encode("ascii"))
        rest = values[whole:]
    if rest:
        file.write((len(rest) * "%20.11e" % tuple(rest) + "\n").encode("ascii"))
    file.write(b"%6d\n" % -1)


def _units(millimetres: bool) -> dict[str, Any]:
    """Return dataset 164: what the file's lengths are in."""
    found: dict[str, Any] = pyuff.prepare_164(
        units_code=5 if millimetres else 1,
        units_description="mm (milli-newton)" if millimetres else "SI: meter (newton)",
        temp_mode=1,
        length=1000.0 if millimetres else 1.0,
        force=1000.0 if millimetres else 1.0,
        temp=1.0,
        temp_offset=273.15,
    )
    return found


def _direction(name: str) -> bool:
    return name.partition("_")[0] in DIRECTIONS


def _named(name: str) -> tuple[str, str, str]:
    """Return quantity, kind and unit of a column such as `x_mm` or `x_velocity_mm_per_s`."""
    quantity, _, rest = name.partition("_")
    kind = next((kind for kind in KINDS if kind and rest.startswith(kind)), "")
    unit = rest.removeprefix(f"{kind}_") if kind else rest
    return quantity, kind, unit.replace("_per_", "/")
