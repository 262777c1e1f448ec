"""MATLAB level 5: a struct for each marker, a column vector for each column."""

from __future__ import annotations

import contextlib
import re
import struct
import zlib
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import pandas as pd
import scipy.io
from numpy.typing import NDArray

from vdms_replay.formats import FormatError, Meta
from vdms_replay.formats.spill import Spill

MATLAB_BYTES = (1 << 31) - 1
MATLAB_NAME = 63
INT8, UINT16, INT32, UINT32, MATRIX, COMPRESSED = 1, 4, 5, 6, 14, 15
"""Data types of the format ("MAT-File Format", The MathWorks, table 1-1)."""
STRUCT, CHAR = 2, 4
"""Array types (table 1-3)."""
NUMBERS = {
    "b1": (2, 9), "i1": (1, 8), "u1": (2, 9), "i2": (3, 10), "u2": (4, 11), "i4": (5, 12),
    "u4": (6, 13), "f4": (7, 7), "f8": (9, 6), "i8": (12, 14), "u8": (13, 15),
}  # fmt: skip
"""Data type and array type of numpy's types."""
LOGICAL = 1 << 9


class MatWriter:
    """MATLAB level 5: a struct for each marker with a column vector for each column, and `about`.

    Text columns are character matrices (`cellstr` makes cells of them). A variable of the format
    ends at 2 GB; HDF5 has no such limit, and MATLAB reads it too. The format wants a column whole
    and its length before it, so columns wait on the disk beside the file, and go into it block by
    block: scipy, which writes `about`, would hold each variable in memory several times over.
    """

    def __init__(self, path: Path, meta: Meta) -> None:
        self.notes: list[str] = []
        self._path = path
        self._meta = meta
        self._columns: dict[str, list[str]] = {}
        self._texts: dict[tuple[str, str], dict[str, int]] = {}
        """Of each text column: its texts and their numbers, which wait in their place."""
        self._spill = Spill(path.parent)

    def add(self, marker: str, table: pd.DataFrame) -> None:
        table = table.drop(columns=["utc", "marker"])
        self._columns.setdefault(marker, list(table.columns))
        for name in table.columns:
            column = table[name]
            if column.dtype.kind in "biuf":
                self._spill.append((marker, name), column.to_numpy())
            else:
                self._spill.append((marker, name), self._numbered(marker, name, column))
        if sum(_Column(self, marker, name).size for name in table.columns) > MATLAB_BYTES:
            raise FormatError(
                "a variable of a .mat file ends at 2 GB, and this recording has more; "
                "use --to hdf5, which MATLAB reads with h5read"
            )

    def _numbered(self, marker: str, name: str, column: pd.Series[Any]) -> NDArray[np.int32]:
        known = self._texts.setdefault((marker, name), {})
        codes, texts = pd.factorize(column)
        numbers = [known.setdefault(str(text), len(known)) for text in texts]
        return np.array(numbers, np.int32)[codes]

    def close(self) -> None:
        with contextlib.closing(self._spill):
            self._write_all()

    def _write_all(self) -> None:
        names: dict[str, Any] = {"about": None}
        scipy.io.savemat(
            self._path,
            {"about": _matlab(self._meta)},
            appendmat=False,
            long_field_names=True,
            do_compression=True,
        )
        with self._path.open("r+b") as file:
            file.seek(0, 2)
            for marker, columns in self._columns.items():
                name = matlab_name(marker, names)
                names[name] = None
                if name != marker:
                    self.notes.append(f"marker {marker} is the variable {name}")
                found = {column: _Column(self, marker, column) for column in columns}
                _write_compressed(file, _struct(name, found))

    def discard(self) -> None:
        self._spill.close()


class _Column:
    """A column as an array of the format."""

    def __init__(self, writer: MatWriter, marker: str, name: str) -> None:
        key = marker, name
        self._blocks = writer._spill.blocks
        self._key = key
        rows = writer._spill.rows(key)
        texts = writer._texts.get(key)
        if texts is None:
            dtype = writer._spill.dtype(key)
            self._type, kind = NUMBERS[dtype.str[1:]]
            head = _head(kind | (LOGICAL if dtype.kind == "b" else 0), (rows, 1))
            self.size = rows * dtype.itemsize
            self._letters = None
        else:
            width = max([1, *map(len, texts)])
            # One column of letters for each of the longest text's, blanks behind shorter ones.
            padded = "".join(text.ljust(width) for text in texts)
            self._letters = np.frombuffer(padded.encode("utf-16-le"), np.uint16).reshape(-1, width)
            self._type = UINT16
            head = _head(CHAR, (rows, width))
            self.size = 2 * rows * width
        self._head = head
        self.whole_size = len(head) + 8 + self.size + -self.size % 8

    def pieces(self) -> Iterator[bytes]:
        yield struct.pack("<II", MATRIX, self.whole_size) + self._head
        yield struct.pack("<II", self._type, self.size)
        if self._letters is None:
            for block in self._blocks(self._key):
                yield block.tobytes()
        else:
            for letters in self._letters.T:
                for block in self._blocks(self._key):
                    yield letters[block].tobytes()
        yield bytes(-self.size % 8)


def _struct(name: str, columns: dict[str, _Column]) -> Iterator[bytes]:
    """Give a struct variable with these fields, piece by piece."""
    longest = max(map(len, columns)) + 1
    fields = b"".join(column.encode("ascii").ljust(longest, b"\0") for column in columns)
    head = _head(STRUCT, (1, 1), name)
    head += _element(INT32, struct.pack("<i", longest)) + _element(INT8, fields)
    size = len(head) + sum(8 + column.whole_size for column in columns.values())
    yield struct.pack("<II", MATRIX, size) + head
    for column in columns.values():
        yield from column.pieces()


def _head(flags: int, shape: tuple[int, int], name: str = "") -> bytes:
    """Return what an array begins with: its flags, dimensions and name."""
    return (
        _element(UINT32, struct.pack("<II", flags, 0))
        + _element(INT32, struct.pack("<ii", *shape))
        + _element(INT8, name.encode("ascii"))
    )


def _element(type_: int, data: bytes) -> bytes:
    """Return a data element; one of up to four bytes has the format's short form."""
    if 1 <= len(data) <= 4:
        return struct.pack("<HH", type_, len(data)) + data.ljust(4, b"\0")
    return struct.pack("<II", type_, len(data)) + data + bytes(-len(data) % 8)


def _write_compressed(file: BinaryIO, pieces: Iterable[bytes]) -> None:
    start = file.tell()
    file.write(struct.pack("<II", COMPRESSED, 0))
    packer = zlib.compressobj()
    file.writelines(packer.compress(piece) for piece in pieces)
    file.write(packer.flush())
    end = file.tell()
    file.seek(start)
    file.write(struct.pack("<II", COMPRESSED, end - start - 8))
    file.seek(end)


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
