"""TDMS, for LabVIEW and DIAdem: a group for each marker, a channel for each column."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from vdms_replay.formats import FormatError, Meta

try:
    import nptdms
except ImportError:
    nptdms = None


class TdmsWriter:
    """Channels of equal length; `time_s` is the abscissa.

    No waveform properties: they would say that the samples are evenly spaced, which a gap makes
    untrue. `derive --resample` makes them so.
    """

    def __init__(self, path: Path, meta: Meta) -> None:
        if nptdms is None:
            raise FormatError(
                "TDMS needs the library npTDMS (LGPL-3.0), which is not installed; "
                "install it with: pip install npTDMS"
            )
        self.notes: list[str] = []
        self._meta = meta
        self._writer = nptdms.TdmsWriter(str(path))
        self._writer.open()
        properties = {
            name: value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)
            for name, value in meta.items()
        }
        self._writer.write_segment([nptdms.RootObject(properties)])

    def add(self, marker: str, table: pd.DataFrame) -> None:
        channels = []
        for name in table.columns:
            if name in ("utc", "marker"):
                continue
            properties = {
                "unit_string": self._meta["units"].get(name, ""),
                "description": self._meta["meanings"].get(name, ""),
            }
            channels.append(nptdms.ChannelObject(marker, name, _values(table[name]), properties))
        self._writer.write_segment(channels)

    def close(self) -> None:
        self._writer.close()

    discard = close


def _values(column: pd.Series[Any]) -> Any:
    if column.dtype.kind == "b":
        return column.to_numpy().astype(np.uint8)
    if column.dtype.kind in "iuf":
        return column.to_numpy()
    return [str(text) for text in column]
