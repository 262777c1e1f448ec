"""Universal file format, dataset 58, for modal analysis: one function for each coordinate."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import pyuff
from numpy.typing import NDArray

from vdms_replay.formats import FormatError, Meta

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
DIGITS_LOST_S = 1e-6
"""Rounding of the step that is worth a word."""


class Uff58Writer:
    """ASCII, double precision, valid samples only, evenly spaced.

    The format has no value for "not measured", so each stretch without a gap is a function of its
    own, and nothing is made up. One node for each marker, in the order of the file.
    """

    def __init__(self, path: Path, meta: Meta) -> None:
        self.notes: list[str] = []
        self._path = path
        self._meta = meta
        self._parts: dict[str, list[pd.DataFrame]] = {}
        self._left_out = 0

    def add(self, marker: str, table: pd.DataFrame) -> None:
        names = [name for name in table.columns if _direction(name)]
        keep = table["valid"].to_numpy() & np.isfinite(table[names].to_numpy()).all(axis=1)
        self._left_out += int((~keep).sum())
        self._parts.setdefault(marker, []).append(table.loc[keep, ["time_s", *names]])

    def close(self) -> None:
        tables = {marker: pd.concat(parts) for marker, parts in self._parts.items()}
        tables = {marker: table for marker, table in tables.items() if len(table) >= LEAST}
        if not tables:
            raise FormatError("there are no two valid samples, so there is no function to write")
        file = pyuff.UFF(str(self._path))
        columns = {name for table in tables.values() for name in table.columns}
        millimetres = any("mm" in name.split("_") for name in columns)
        file.write_sets([_units(millimetres)], "overwrite")
        for node, (marker, table) in enumerate(tables.items(), 1):
            self._write(file, node, marker, table)
        if self._left_out:
            self.notes.append(f"{self._left_out} samples without a valid position were left out")

    def discard(self) -> None:
        self._parts.clear()

    def _write(self, file: Any, node: int, marker: str, table: pd.DataFrame) -> None:
        time_s = table["time_s"].to_numpy()
        grid = _grid(time_s)
        if grid.off_s > OFF_GRID * grid.step_s:
            raise FormatError(
                f"the samples of marker {marker} are up to {grid.off_s * 1e3:.1f} ms away from "
                "even steps, and the format needs even ones; make them with derive --resample"
            )
        stretches = np.split(np.arange(len(time_s)), np.flatnonzero(np.diff(grid.place) > 1) + 1)
        long_enough = [rows for rows in stretches if len(rows) >= LEAST]
        self._left_out += len(time_s) - sum(len(rows) for rows in long_enough)
        for rows in long_enough:
            times_s = np.asarray(grid.start_s + grid.step_s * grid.place[rows], np.float64)
            sets = [
                self._function(
                    marker, node, name, times_s, grid.step_s, table[name].to_numpy()[rows]
                )
                for name in table.columns
                if name != "time_s"
            ]
            file.write_sets(sets, "add")
        note = f"marker {marker} is node {node}, at {1 / grid.step_s:.4f} Hz; "
        note += f"the samples are up to {grid.off_s * 1e3:.3f} ms away from even steps"
        if len(long_enough) > 1:
            note += (
                f"; gaps part it into {len(long_enough)} functions for each coordinate "
                "(derive --max-gap closes them)"
            )
        self.notes.append(note)
        late_s = abs(float(f"{grid.step_s:.5e}") - grid.step_s) * max(map(len, stretches))
        if late_s > DIGITS_LOST_S:
            self.notes.append(
                f"the format rounds the step to {grid.step_s:.5e} s, which adds up to "
                f"{late_s * 1e3:.3f} ms; with derive --resample 50 or 62.5 it is exact"
            )

    def _function(
        self,
        marker: str,
        node: int,
        name: str,
        times_s: NDArray[np.float64],
        step_s: float,
        values: NDArray[np.float64],
    ) -> dict[str, Any]:
        quantity, kind, unit = _named(name)
        meta = self._meta
        lines = (
            f"{meta['station']} {marker} {quantity} {kind or 'displacement'} in {unit}",
            f"time 0 is {meta.get('start') or 'unknown in UTC'}",
            f"first value at {times_s[0]:.9f} s, step {step_s:.12g} s",
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
            data=values,
            x=times_s,
        )
        return found


class _Grid(NamedTuple):
    """Even steps through uneven times."""

    start_s: float
    step_s: float
    place: NDArray[np.int64]
    """Of each time on the grid."""
    off_s: float
    """Farthest of a time from its place."""


def _grid(time_s: NDArray[np.float64]) -> _Grid:
    """Return the even steps that fit the times best (least squares)."""
    between_s = np.diff(time_s)
    steps = np.maximum(np.rint(between_s / np.median(between_s)), 1).astype(np.int64)
    place = np.concatenate(([0], np.cumsum(steps)))
    step_s, start_s = np.polyfit(place, time_s, 1)
    off_s = float(np.abs(time_s - start_s - step_s * place).max())
    return _Grid(round(float(start_s), 12) + 0.0, float(step_s), place, off_s)


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
