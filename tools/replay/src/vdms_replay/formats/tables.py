"""CSV, Parquet and Excel: all markers in one table, a row for each sample."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import openpyxl
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from vdms_replay.formats import FormatError, Meta

EXCEL_ROWS = 1_048_576
EXCEL_EXACT = 1 << 53
"""Excel holds every number as a double."""


class CsvWriter:
    """Lines of `# name: value` in JSON, then the table with a line of names (pandas: comment="#").

    Numbers have as many digits as it takes to read the same number back.
    """

    def __init__(self, path: Path, meta: Meta) -> None:
        self.notes: list[str] = []
        self._file = path.open("w", encoding="utf-8", newline="")
        for name, value in meta.items():
            self._file.write(f"# {name}: {json.dumps(value, ensure_ascii=False)}\n")
        self._named = False

    def add(self, _marker: str, table: pd.DataFrame) -> None:
        table = table.assign(utc=utc_texts(table))
        table.to_csv(self._file, index=False, header=not self._named, lineterminator="\n")
        self._named = True

    def close(self) -> None:
        self._file.close()

    discard = close


class ParquetWriter:
    """Apache Parquet: unit and meaning at each field, all else as JSON under the key `vdms`."""

    def __init__(self, path: Path, meta: Meta) -> None:
        self.notes: list[str] = []
        self._path = path
        self._meta = meta
        self._writer: pq.ParquetWriter | None = None

    def add(self, _marker: str, table: pd.DataFrame) -> None:
        arrow = pa.Table.from_pandas(table, preserve_index=False)
        if self._writer is None:
            fields = [
                field.with_metadata(
                    {
                        key: text
                        for key, texts in (("unit", "units"), ("meaning", "meanings"))
                        if (text := self._meta[texts].get(field.name))
                    }
                )
                for field in arrow.schema
            ]
            own = {b"vdms": json.dumps(self._meta, ensure_ascii=False).encode()}
            schema = pa.schema(fields, metadata={**(arrow.schema.metadata or {}), **own})
            self._writer = pq.ParquetWriter(self._path, schema, compression="zstd")
        self._writer.write_table(arrow.cast(self._writer.schema))

    def close(self) -> None:
        if self._writer is not None:
            self._writer.close()

    discard = close


class XlsxWriter:
    """Excel: a sheet for each marker, and the sheet `about`.

    Times are seconds, and UTC as text, because Excel's own dates end at the millisecond; whole
    numbers beyond 2^53 are text too. Numbers have 16 digits.
    """

    def __init__(self, path: Path, meta: Meta) -> None:
        self.notes: list[str] = []
        self._path = path
        self._book = openpyxl.Workbook(write_only=True)
        about = self._book.create_sheet("about")
        for name, value in meta.items():
            text = value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)
            # A cell holds 32767 characters.
            pieces = [text[at : at + 32_000] for at in range(0, len(text), 32_000)]
            about.append([name, *(_cell(piece) for piece in pieces)])
        self._sheets: dict[str, Any] = {}
        self._rows: dict[str, int] = {}

    def add(self, marker: str, table: pd.DataFrame) -> None:
        if marker not in self._sheets:
            self._sheets[marker] = self._book.create_sheet(_sheet_name(marker, len(self._sheets)))
            self._sheets[marker].append(list(table.columns))
            self._rows[marker] = 1
        self._rows[marker] += len(table)
        if self._rows[marker] > EXCEL_ROWS:
            raise FormatError(
                f"an Excel sheet holds {EXCEL_ROWS} rows and marker {marker} has more; "
                "use --to parquet or --to csv"
            )
        table = table.assign(utc=utc_texts(table))
        big = [
            name
            for name in table.columns
            if table[name].dtype.kind in "iu" and (table[name].abs() > EXCEL_EXACT).any()
        ]
        table = table.astype(dict.fromkeys(big, str))
        sheet = self._sheets[marker]
        for row in table.astype(object).where(table.notna(), None).itertuples(index=False):
            sheet.append(row)

    def close(self) -> None:
        self._book.save(self._path)

    # Its streams end in order only so; then its temporary files go.
    discard = close


def utc_texts(table: pd.DataFrame) -> Any:
    """Return the column `utc` as ISO 8601 text with nanoseconds; nothing for an unknown one."""
    naive = table["utc"].dt.tz_localize(None).to_numpy()
    texts = pd.array(
        [f"{time}Z" for time in naive.astype("datetime64[ns]").astype(str)], dtype="str"
    )
    texts[table["utc"].isna().to_numpy()] = None
    return texts


def _sheet_name(marker: str, number: int) -> str:
    """Excel's names have 31 characters; the number keeps long ones apart."""
    return marker if len(marker) <= 31 else f"{marker[:27]}-{number}"


def _cell(text: str) -> str:
    """Excel takes a text that begins with = for a formula."""
    return f"'{text}" if text.startswith("=") else text
