"""HDF5: a group for each marker, a vector for each column."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import h5py
import pandas as pd
from numpy.typing import NDArray

from vdms_replay.formats import Meta

CHUNK_ROWS = 16384


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

    discard = close


def _vector(column: pd.Series[Any]) -> NDArray[Any]:
    """Return a column as numpy has it: numbers as they are, text as objects."""
    if column.dtype.kind in "biuf":
        return column.to_numpy()
    return column.astype(object).to_numpy()
