"""Tables written in the formats that others read; one writer a format.

A writer gets each marker's samples batch by batch, columns with the unit in their names, and what
the recording says about itself. None of them changes a number.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

import pandas as pd

Meta = dict[str, Any]


class Writer(Protocol):
    """Writes one file."""

    notes: list[str]
    """What a reader of the file must know, in sentences; complete once it is closed."""

    def add(self, marker: str, table: pd.DataFrame, /) -> None:
        """Write samples of one marker that follow those before. Raises FormatError."""
        ...

    def close(self) -> None:
        """Complete the file. Raises FormatError."""
        ...

    def discard(self) -> None:
        """Let go of the file, which stays unfinished."""
        ...


MakeWriter = Callable[[Path, Meta], Writer]


class FormatError(Exception):
    """The format cannot hold this; the text is a phrase that says why and what can."""


def _csv(path: Path, meta: Meta) -> Writer:
    from vdms_replay.formats.tables import CsvWriter

    return CsvWriter(path, meta)


def _parquet(path: Path, meta: Meta) -> Writer:
    from vdms_replay.formats.tables import ParquetWriter

    return ParquetWriter(path, meta)


def _xlsx(path: Path, meta: Meta) -> Writer:
    from vdms_replay.formats.tables import XlsxWriter

    return XlsxWriter(path, meta)


def _hdf5(path: Path, meta: Meta) -> Writer:
    from vdms_replay.formats.channels import Hdf5Writer

    return Hdf5Writer(path, meta)


def _mat(path: Path, meta: Meta) -> Writer:
    from vdms_replay.formats.matlab import MatWriter

    return MatWriter(path, meta)


def _tdms(path: Path, meta: Meta) -> Writer:
    from vdms_replay.formats.tdms import TdmsWriter

    return TdmsWriter(path, meta)


def _uff58(path: Path, meta: Meta) -> Writer:
    from vdms_replay.formats.uff58 import Uff58Writer

    return Uff58Writer(path, meta)


FORMATS: dict[str, tuple[str, MakeWriter]] = {
    "csv": (".csv", _csv),
    "parquet": (".parquet", _parquet),
    "mat": (".mat", _mat),
    "hdf5": (".h5", _hdf5),
    "uff58": (".uff", _uff58),
    "tdms": (".tdms", _tdms),
    "xlsx": (".xlsx", _xlsx),
}
"""Ending and writer by name; the libraries are loaded where they are needed."""
