"""Columns of any length, kept on the disk until a format can take them whole."""

from __future__ import annotations

import tempfile
from bisect import bisect_right
from collections.abc import Hashable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

BLOCK_ROWS = 65536
"""At most of a block: what is in memory at once."""


class Spill:
    """Columns in a nameless file in `folder`, which is gone with the process however that ends.

    Raises OSError as the disk gives it.
    """

    def __init__(self, folder: Path) -> None:
        self._file = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115  # closed by close()
        self._ends: dict[Hashable, list[int]] = {}
        """Of each column: rows up to the end of each block."""
        self._places: dict[Hashable, list[int]] = {}
        """Of each column: where each block begins, in bytes."""
        self._types: dict[Hashable, np.dtype[Any]] = {}

    def append(self, key: Hashable, values: NDArray[Any]) -> None:
        """Add values to the end of a column, all of one dtype."""
        ends = self._ends.setdefault(key, [])
        places = self._places.setdefault(key, [])
        self._types.setdefault(key, values.dtype)
        for first in range(0, len(values), BLOCK_ROWS):
            part = values[first : first + BLOCK_ROWS]
            places.append(self._file.seek(0, 2))
            self._file.write(part.tobytes())
            ends.append((ends[-1] if ends else 0) + len(part))

    def rows(self, key: Hashable) -> int:
        ends = self._ends.get(key)
        return ends[-1] if ends else 0

    def dtype(self, key: Hashable) -> np.dtype[Any]:
        return self._types[key]

    def blocks(
        self, key: Hashable, first: int = 0, end: int | None = None
    ) -> Iterator[NDArray[Any]]:
        """Give the rows from `first` up to `end` (all for None), block by block."""
        ends, places, dtype = self._ends[key], self._places[key], self._types[key]
        end = self.rows(key) if end is None else end
        number = bisect_right(ends, first)
        while first < end:
            begin = ends[number - 1] if number else 0
            stop = min(ends[number], end)
            self._file.seek(places[number] + (first - begin) * dtype.itemsize)
            data = self._file.read((stop - first) * dtype.itemsize)
            yield np.frombuffer(data, dtype)
            first, number = stop, number + 1

    def close(self) -> None:
        self._file.close()
