"""HDF5 and MATLAB: a group for each marker, a vector for each column."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pandas as pd
import scipy.io
from numpy.typing import NDArray

from vdms_replay.formats import FormatError, Meta

CHUNK_ROWS = 16384
MATLAB_BYTES = (1 << 31) - 1
MATLAB_NAME = 63


class Hdf5Writer:
    """HDF5: `/<marker>/<column>`, unit and meaning as attributes; the file's attributes hold what
    the recording says about itself, structures of it as JSON.

    UTC is `utc_ns`: nanoseconds since 1970.
    """

    def __init__(self, path: Path, meta: Meta) -> None:
        self.notes: list[str] = []
        self._meta = meta
        self._file = h5py.File(path, "w")
        about = self._file.create_group("about")
        for name, value in meta.items():
            text = value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)
            # An attribute holds 64 kB at most; a dataset has no limit.
            about.create_dataset(name, data=text, dtype=h5py.string_dtype())

    def add(self, marker: str, table: pd.DataFrame) -> None:
        group = self._file.require_group(marker if marker != "about" else "about-marker")
        for name in table.columns:
            if name not in ("utc", "marker"):
                self._append(group, name, _vector(table[name]))

    def _append(self, group: h5py.Group, name: str, values: NDArray[Any]) -> None:
        if name not in group:
            dataset = group.create_dataset(
                name,
                shape=(0,),
                maxshape=(None,),
                chunks=(CHUNK_ROWS,),
                dtype=h5py.string_dtype() if values.dtype.kind in "OU" else values.dtype,
                compression="gzip",
                shuffle=values.dtype.kind not in "OU",
            )
            dataset.attrs["unit"] = self._meta["units"].get(name, "")
            dataset.attrs["meaning"] = self._meta["meanings"].get(name, "")
        dataset = group[name]
        start = dataset.shape[0]
        dataset.resize((start + len(values),))
        dataset[start:] = values

    def close(self) -> None:
        self._file.close()


class MatWriter:
    """MATLAB level 5: a struct for each marker with a column vector for each column, and `about`.

    Text columns are character matrices (`cellstr` makes cells of them). The format ends at 2 GB a
    variable, and everything is held in memory; HDF5 has neither limit, and MATLAB reads it too.
    """

    def __init__(self, path: Path, meta: Meta) -> None:
        self.notes: list[str] = []
        self._path = path
        self._meta = meta
        self._parts: dict[str, list[pd.DataFrame]] = {}
        self._bytes = 0

    def add(self, marker: str, table: pd.DataFrame) -> None:
        table = table.drop(columns=["utc", "marker"])
        self._bytes += int(table.memory_usage(index=False).sum())
        if self._bytes > MATLAB_BYTES:
            raise FormatError(
                "a .mat file ends at 2 GB, and this recording has more; "
                "use --to hdf5, which MATLAB reads with h5read"
            )
        self._parts.setdefault(marker, []).append(table)

    def close(self) -> None:
        values: dict[str, Any] = {"about": _matlab(self._meta)}
        for marker, parts in self._parts.items():
            table = pd.concat(parts, ignore_index=True)
            name = matlab_name(marker, values)
            if name != marker:
                self.notes.append(f"marker {marker} is the variable {name}")
            values[name] = {column: _column(_vector(table[column])) for column in table.columns}
        scipy.io.savemat(
            self._path, values, appendmat=False, long_field_names=True, do_compression=True
        )


def matlab_name(name: str, taken: dict[str, Any]) -> str:
    """Return a name that MATLAB allows and that is not in `taken`."""
    clean = re.sub(r"\W", "_", name, flags=re.ASCII)
    clean = clean if clean[:1].isalpha() else f"m_{clean}"
    clean = clean[:MATLAB_NAME]
    number = 2
    free = clean
    while free in taken:
        free = f"{clean[: MATLAB_NAME - 4]}_{number}"
        number += 1
    return free


def _column(values: NDArray[Any]) -> NDArray[Any]:
    if values.dtype.kind == "O":
        return values.astype(str)
    return values.reshape(-1, 1)


def _matlab(value: Any) -> Any:
    """Return a value of the metadata as MATLAB takes it."""
    if isinstance(value, dict):
        names: dict[str, Any] = {}
        for key, inner in value.items():
            names[matlab_name(str(key), names)] = _matlab(inner)
        return names or np.zeros((0, 0))
    if isinstance(value, list):
        cells = np.empty((len(value), 1), dtype=object)
        for number, inner in enumerate(value):
            cells[number, 0] = _matlab(inner)
        return cells
    return value


def _vector(column: pd.Series[Any]) -> NDArray[Any]:
    """Return a column as numpy has it: numbers as they are, text as objects."""
    if column.dtype.kind in "biuf":
        return column.to_numpy()
    return column.astype(object).to_numpy()
