"""A reference instrument's series out of its own file, in millimetres at even steps."""

from __future__ import annotations

import csv
import re
from collections.abc import Callable
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from vdms_replay.series import Series, SeriesError
from vdms_replay.source import ReplayError

Floats: TypeAlias = NDArray[np.float64]

MM_PER_UNIT = {
    "m": 1e3,
    "cm": 10.0,
    "mm": 1.0,
    "um": 1e-3,
    "nm": 1e-6,
    "in": 25.4,
    "mil": 0.0254,
}
SECONDS_PER_UNIT = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_ALIASES = {
    "micron": "um",
    "microns": "um",
    "micrometer": "um",
    "micrometre": "um",
    "millimeter": "mm",
    "millimetre": "mm",
    "meter": "m",
    "metre": "m",
    "inch": "in",
    "inches": "in",
    "sec": "s",
    "seconds": "s",
    "second": "s",
}
_TIME_NAMES = ("time", "t", "x_time", "abscissa")
_HEAD_LINES = 60
"""Instruments write pages of text before their numbers."""
_RATE = re.compile(r"_([a-z]+_per_s2?)$")
"""A velocity or an acceleration, as names say it."""
_DECIMAL_COMMA = re.compile(r"^[+-]?\d+,\d+(?:[eE][+-]?\d+)?$")


@dataclass(frozen=True, slots=True)
class Column:
    """One series of a file, as it stands there."""

    name: str
    values: Floats
    unit: str = ""
    """As the file says it, or empty."""
    step_s: float = 0.0
    """Where the file gives the series a rate of its own."""
    start_s: float = 0.0


@dataclass(frozen=True, slots=True)
class Reference:
    """What a reference file gave."""

    path: Path
    column: str
    unit: str
    series: Series
    """In millimetres, by the reference's own clock in seconds."""


def read_reference(
    path: Path, column: str | None = None, unit: str | None = None, rate_hz: float | None = None
) -> Reference:
    """Return a displacement out of a .csv (or .txt), .mat, .uff or .unv (58), or .tdms file.

    `column` names the series, where there is more than one; `unit` is one of MM_PER_UNIT, where
    the file does not say it; `rate_hz` the sampling rate, where there is no time column or its
    digits are too few. Raises ReplayError with a sentence.
    """
    read = _reader(path)
    try:
        columns = read(path)
    except OSError as error:
        raise ReplayError(
            f"{path}: cannot be read: {(error.strerror or str(error)).lower()}; --reference must "
            "name the reference instrument's file"
        ) from None
    if not columns:
        raise ReplayError(f"{path}: holds no column of numbers")
    times = next((c for c in columns if _is_time(c)), None)
    found = _choose(path, [c for c in columns if c is not times] or columns, column)
    scale = _mm_per_unit(path, found, unit)
    start_s, step_s = _grid(path, found, times, rate_hz)
    del columns, times  # a vibrometer's hour is 20 million values
    try:
        series = Series(start_s, step_s, found.values * scale[1])
    except SeriesError as error:
        raise ReplayError(f"{path}: column {found.name}: {error}") from None
    return Reference(path, found.name, scale[0], series)


def _reader(path: Path) -> Callable[[Path], list[Column]]:
    readers = {
        ".csv": _csv,
        ".txt": _csv,
        ".tsv": _csv,
        ".mat": _mat,
        ".uff": _uff,
        ".unv": _uff,
        ".uff58": _uff,
        ".tdms": _tdms,
    }
    reader = readers.get(path.suffix.lower())
    if reader is None:
        raise ReplayError(
            f"{path}: a reference is a .csv, .txt, .mat, .uff, .unv or .tdms file, "
            f"not {path.suffix or 'one without a suffix'}"
        )
    return reader


def _choose(path: Path, columns: list[Column], asked: str | None) -> Column:
    names = ", ".join(c.name for c in columns)
    if asked is None:
        if len(columns) == 1:
            return columns[0]
        raise ReplayError(f"{path}: has the columns {names}; choose one with --column")
    for found in columns:
        if asked in (found.name, _bare_name(found.name)):
            return found
    raise ReplayError(f"{path}: has no column {asked}; it has {names}")


def _is_time(column: Column) -> bool:
    name = _bare_name(column.name).rpartition(".")[2].lower()
    return name in _TIME_NAMES or (
        _unit_of(column) in SECONDS_PER_UNIT and name.startswith(("time", "t_"))
    )


def _bare_name(name: str) -> str:
    """Return a column's name without its unit: `x` of x_mm, x [mm] and x (mm)."""
    text = re.split(r"[\[(]", name)[0].strip()
    stem, _, last = text.rpartition("_")
    return stem if stem and _known_unit(last) else text


def _unit_of(column: Column) -> str:
    """Return the unit that a column says it has, or empty."""
    if column.unit:
        return _known_unit(column.unit) or column.unit
    bracket = re.search(r"[\[(]([^\])]*)[\])]", column.name)
    if bracket:
        return _known_unit(bracket[1]) or bracket[1].strip()
    if rate := _RATE.search(column.name):
        return rate[1].replace("_per_", "/")
    return _known_unit(column.name.rpartition("_")[2])


def _known_unit(text: str) -> str:
    """Return the unit as it is named here; empty for one that is not known."""
    unit = text.strip().replace("\u00b5", "u").replace("\u03bc", "u")
    unit = _ALIASES.get(unit.lower(), unit)
    return unit if unit in MM_PER_UNIT or unit in SECONDS_PER_UNIT else ""


def _mm_per_unit(path: Path, column: Column, asked: str | None) -> tuple[str, float]:
    unit = asked or _unit_of(column)
    if unit in MM_PER_UNIT:
        return unit, MM_PER_UNIT[unit]
    known = ", ".join(MM_PER_UNIT)
    if not unit:
        raise ReplayError(
            f"{path}: column {column.name} does not say its unit; give it with --units ({known})"
        )
    raise ReplayError(
        f"{path}: column {column.name} is in {unit}, which is no length; a displacement in one of "
        f"{known} is needed: integrate what is a velocity in the instrument's own software "
        "(--units says so where the file is wrong)"
    )


def _grid(
    path: Path, column: Column, times: Column | None, rate_hz: float | None
) -> tuple[float, float]:
    """Return the time of the first value and the step from value to value, in seconds."""
    if times is None or len(times.values) < 2:
        if rate_hz:
            return column.start_s, 1 / rate_hz
        if column.step_s > 0:
            return column.start_s, column.step_s
        raise ReplayError(
            f"{path}: has no column of times; give the sampling rate in hertz with --rate"
        )
    at_s = times.values * SECONDS_PER_UNIT.get(_unit_of(times), 1.0)
    if len(at_s) != len(column.values):
        raise ReplayError(
            f"{path}: {times.name} has {len(at_s)} values and {column.name} {len(column.values)}"
        )
    if not np.isfinite(at_s).all():
        raise ReplayError(f"{path}: {times.name} holds values that are no numbers")
    first_s = float(at_s[0])
    at_s -= first_s
    # The least squares of evenly numbered values: with millions of them a solver's copies tell.
    count = len(at_s)
    places = np.arange(count) - (count - 1) / 2
    slope = float(places @ at_s) / (count * (count**2 - 1) / 12)
    start_s = float(at_s.mean()) - slope * (count - 1) / 2
    step_s = 1 / rate_hz if rate_hz else slope
    places += (count - 1) / 2
    places *= -slope
    places += at_s
    off_s = max(float(places.max()) - start_s, start_s - float(places.min()))
    if step_s <= 0 or off_s > slope:
        steps_s = np.diff(at_s)
        raise ReplayError(
            f"{path}: {times.name} is not even: its steps go from {steps_s.min():g} to "
            f"{steps_s.max():g} s; resample the reference at a constant rate"
        )
    return first_s + start_s, step_s


def _csv(path: Path) -> list[Column]:
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        head = list(islice(file, _HEAD_LINES))
    comma, separator, first = _layout(head)
    if first is None:
        raise ReplayError(
            f"{path}: no line of numbers in its first {len(head)} lines; name a text file with a "
            "column for each series"
        )
    count = len(_cells(head[first], separator))
    try:
        table = pd.read_csv(
            path,
            sep=separator or r"\s+",
            decimal="," if comma else ".",
            header=None,
            skiprows=first,
            usecols=range(count),
            encoding="utf-8",
            encoding_errors="replace",
            skipinitialspace=True,
            dtype=np.float64,
        )
    except (ValueError, pd.errors.ParserError) as error:
        raise ReplayError(f"{path}: {_first_line(error)}") from None
    names = _header(head[:first], separator, count)
    return [
        Column(name, table[number].to_numpy(np.float64, copy=True))
        for number, name in enumerate(names)
    ]


def _layout(head: list[str]) -> tuple[bool, str, int | None]:
    """Return whether the decimal sign is a comma, the separator (empty: spaces), and the first line
    of numbers."""
    for number, line in enumerate(head):
        for separator in ("\t", ";", ",", ""):
            cells = _cells(line, separator)
            if not cells or (separator and len(cells) < 2):
                continue
            if all(_is_number(cell) for cell in cells):
                return False, separator, number
            if separator != "," and all(
                _is_number(cell) or _DECIMAL_COMMA.match(cell) for cell in cells
            ):
                return True, separator, number
    return False, "", None


def _cells(line: str, separator: str) -> list[str]:
    if not separator:
        return line.split()
    cells = next(csv.reader([line.rstrip("\r\n")], delimiter=separator), [])
    while cells and not cells[-1].strip():
        cells.pop()
    return [cell.strip() for cell in cells]


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _header(lines: list[str], separator: str, count: int) -> list[str]:
    """Return the columns' names: of the last line before the numbers with a name for each, and a
    unit for each from the line after it, if that is one of units."""
    rows = [_cells(line.lstrip("#% "), separator) for line in lines]
    rows = [row for row in rows if len(row) == count and all(row)]
    if not rows:
        return [str(number + 1) for number in range(count)]
    last = [re.sub(r"^[\[(](.*)[\])]$", r"\1", cell) for cell in rows[-1]]
    if len(rows) > 1 and all(_known_unit(cell) for cell in last):
        return [f"{name} [{unit}]" for name, unit in zip(rows[-2], last, strict=True)]
    return rows[-1]


def _mat(path: Path) -> list[Column]:
    from scipy.io import loadmat
    from scipy.io.matlab import MatReadError

    path.stat()
    try:
        named = _flat(loadmat(path, squeeze_me=True, struct_as_record=True))
    except NotImplementedError:
        named = _mat73(path)
    except (MatReadError, ValueError, TypeError) as error:
        raise ReplayError(f"{path}: not a MAT file: {_first_line(error)}") from None
    return [Column(name, values) for name, values in named.items()]


def _flat(named: dict[str, Any], within: str = "") -> dict[str, Floats]:
    """Return every numeric vector, those in structs as `struct.field`."""
    found: dict[str, Floats] = {}
    for name, value in named.items():
        if name.startswith("__"):
            continue
        array = np.asarray(value)
        if array.dtype.names and array.ndim == 0:
            found |= _flat({n: array[n].item() for n in array.dtype.names}, f"{within}{name}.")
        elif array.dtype.kind in "fiu" and array.ndim == 1 and len(array) > 1:
            found[within + name] = array.astype(np.float64)
        elif array.dtype.kind in "fiu" and array.ndim == 2 and min(array.shape) > 1:
            tall = array if array.shape[0] >= array.shape[1] else array.T
            for k in range(tall.shape[1]):
                found[f"{within}{name}:{k + 1}"] = tall[:, k].astype(np.float64)
    return found


def _mat73(path: Path) -> dict[str, Floats]:
    import h5py

    found: dict[str, Floats] = {}

    def take(name: str, item: Any) -> None:
        if isinstance(item, h5py.Dataset) and item.dtype.kind in "fiu":
            found.update(_flat({name.replace("/", "."): np.squeeze(item[()])}))

    try:
        with h5py.File(path) as file:
            file.visititems(take)
    except OSError as error:
        raise ReplayError(f"{path}: not a MAT file: {_first_line(error)}") from None
    return found


def _uff(path: Path) -> list[Column]:
    import pyuff

    path.stat()
    try:
        sets = pyuff.UFF(str(path)).read_sets()
    except Exception as error:  # noqa: BLE001 - pyuff raises what it likes on a damaged file
        raise ReplayError(f"{path}: not a universal file: {_first_line(error)}") from None
    columns = []
    for number, one in enumerate(sets if isinstance(sets, list) else [sets], 1):
        if one.get("type") != 58 or np.iscomplexobj(one["data"]):
            continue
        x = np.asarray(one["x"], np.float64)
        even = one.get("abscissa_spacing") == 1
        step_s = float(one["abscissa_inc"]) if even else float(np.mean(np.diff(x)))
        columns.append(
            Column(
                name=str(one.get("id1", "")).strip() or f"set {number}",
                values=np.asarray(one["data"], np.float64),
                unit=str(one.get("ordinate_axis_units_lab", "")).strip().replace("NONE", ""),
                step_s=step_s,
                start_s=float(x[0]) if len(x) else 0.0,
            )
        )
    if not columns:
        raise ReplayError(f"{path}: holds no data set 58 of real numbers")
    return columns


def _tdms(path: Path) -> list[Column]:
    try:
        from nptdms import TdmsFile
    except ImportError:
        raise ReplayError(
            f"{path}: TDMS needs the package npTDMS; install it with: pip install vdms-replay[tdms]"
        ) from None
    path.stat()
    try:
        file = TdmsFile.read(path)
    except Exception as error:  # noqa: BLE001 - npTDMS raises what it likes on a damaged file
        raise ReplayError(f"{path}: not a TDMS file: {_first_line(error)}") from None
    columns = []
    groups = file.groups()
    for group in groups:
        for channel in group.channels():
            values = np.asarray(channel[:])
            if values.dtype.kind not in "fiu":
                continue
            name = channel.name if len(groups) == 1 else f"{group.name}/{channel.name}"
            columns.append(
                Column(
                    name=name,
                    values=values.astype(np.float64),
                    unit=str(channel.properties.get("unit_string", "")),
                    step_s=float(channel.properties.get("wf_increment", 0.0)),
                    start_s=float(channel.properties.get("wf_start_offset", 0.0)),
                )
            )
    return columns


def _first_line(error: BaseException) -> str:
    return (str(error) or type(error).__name__).splitlines()[0]
