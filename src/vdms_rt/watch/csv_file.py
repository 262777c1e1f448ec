"""Every sample as a line of text, for spreadsheets."""

from __future__ import annotations

import contextlib
import csv
import math
from datetime import UTC, datetime
from io import TextIOWrapper
from pathlib import Path

from vdms_rt.model import Displacement, VdmsError
from vdms_rt.status import status_words

COLUMNS = (
    "utc",
    "t_s",
    "station",
    "marker",
    "session",
    "seq",
    "frame_seq",
    "scan",
    "x_mm",
    "y_mm",
    "rotation_mrad",
    "sigma_x_mm",
    "sigma_y_mm",
    "residual_mm",
    "valid",
    "status",
)
HEADER = ",".join(COLUMNS)


class CsvError(VdmsError):
    """The file cannot be written."""


class CsvFile:
    """A CSV that grows by every sample; opened again, it goes on where it ended.

    A sample that the file holds already, from a run before, is not written twice.
    """

    def __init__(self, path: Path) -> None:
        """Open or create it. Raises CsvError with a sentence."""
        self.path = path
        self._last: dict[tuple[str, str, str], int] = {}
        self.samples = 0
        self._file = self._open()
        self._writer = csv.writer(self._file, lineterminator="\n")

    def write(self, station: str, sample: Displacement) -> None:
        """Add one sample. Raises CsvError with a sentence."""
        of = station, sample.marker, f"{sample.session:016x}"
        if sample.seq <= self._last.get(of, -1):
            return
        self._last[of] = sample.seq
        try:
            self._writer.writerow(csv_row(station, sample))
        except OSError as error:
            raise self._fault(error) from None
        self.samples += 1

    def flush(self) -> None:
        """Hand everything to the system. Raises CsvError with a sentence."""
        try:
            self._file.flush()
        except OSError as error:
            raise self._fault(error) from None

    def close(self) -> None:
        """Write the rest and close it. Raises CsvError with a sentence."""
        try:
            self._file.close()
        except OSError as error:
            with contextlib.suppress(OSError):
                self._file.close()
            raise self._fault(error) from None

    def _open(self) -> TextIOWrapper:
        if self.path.exists() and not self.path.is_file():
            raise CsvError(f"cannot write {self.path}: it is not a file; name another with --csv")
        try:
            with contextlib.ExitStack() as stack:
                file = stack.enter_context(self.path.open("a+", encoding="utf-8", newline=""))
                self._go_on(file)
                stack.pop_all()
                return file
        except OSError as error:
            raise self._fault(error) from None
        except (ValueError, IndexError, csv.Error):
            raise CsvError(f"{self.path} is no CSV of vdms-rt watch; name another file") from None

    def _go_on(self, file: TextIOWrapper) -> None:
        file.seek(0)
        whole = 0
        station, marker, session, seq = (COLUMNS.index(c) for c in COLUMNS[2:6])
        for number, line in enumerate(iter(file.readline, "")):
            if not line.endswith("\n"):
                break
            if number == 0 and line.rstrip("\r\n") != HEADER:
                raise ValueError(line)
            whole += len(line.encode())
            if number:
                row = next(csv.reader([line]))
                self._last[row[station], row[marker], row[session]] = int(row[seq])
        file.seek(0, 2)
        file.truncate(whole)
        if not whole:
            file.write(HEADER + "\n")

    def _fault(self, error: OSError) -> CsvError:
        return CsvError(f"cannot write {self.path}: {error.strerror}; name another file with --csv")


def csv_row(station: str, sample: Displacement) -> tuple[str | int, ...]:
    """Return the sample's cells: empty where there is no number, times without rounding."""
    return (
        _utc(sample.utc_ns),
        f"{sample.t_ns // 1_000_000_000}.{sample.t_ns % 1_000_000_000:09d}",
        station,
        sample.marker,
        f"{sample.session:016x}",
        sample.seq,
        sample.frame_seq,
        sample.scan.name.lower().replace("_", "-"),
        *(
            f"{value:.6f}" if math.isfinite(value) else ""
            for value in (
                sample.x_mm,
                sample.y_mm,
                sample.rotation_mrad,
                sample.sigma_x_mm,
                sample.sigma_y_mm,
                sample.residual_mm,
            )
        ),
        int(sample.valid),
        status_words(sample.status),
    )


def _utc(utc_ns: int) -> str:
    if not utc_ns:
        return ""
    second = datetime.fromtimestamp(utc_ns // 1_000_000_000, UTC)
    return f"{second:%Y-%m-%dT%H:%M:%S}.{utc_ns % 1_000_000_000:09d}Z"
