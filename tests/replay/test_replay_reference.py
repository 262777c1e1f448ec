"""Reference files of every kind, written by other libraries; and what cannot be used."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
import pyuff
from scipy.io import savemat

from vdms_replay.reference import read_reference
from vdms_replay.source import ReplayError

RATE_HZ = 6000.0
TIME_S = 12.25 + np.arange(600) / RATE_HZ
X_MM = np.round(3 * np.sin(np.arange(600) / 50), 6)
Y_MM = np.round(X_MM / 2, 6)


def csv(path: Path) -> None:
    rows = "".join(f"{t:.7f},{x},{y}\n" for t, x, y in zip(TIME_S, X_MM, Y_MM, strict=True))
    path.write_text("time_s,x_mm,y_mm\n" + rows)


def german(path: Path) -> None:
    """A preamble, a line of units, semicolons, decimal commas."""
    rows = "".join(
        f"{t * 1000:.4f};{x * 1000:.3f};{y * 1000:.3f}\n".replace(".", ",")
        for t, x, y in zip(TIME_S, X_MM, Y_MM, strict=True)
    )
    head = "Messung 12\nDatum;24.11.2026\n\nTime;x;y\n[ms];[\u00b5m];[\u00b5m]\n"
    path.write_text(head + rows, encoding="utf-8")


def tabs(path: Path) -> None:
    rows = "".join(f"{t:.7f}\t{x}\t{y}\t\n" for t, x, y in zip(TIME_S, X_MM, Y_MM, strict=True))
    path.write_text("# a vibrometer\n# Time [ s ]\tx [ mm ]\ty [ mm ]\n" + rows)


def mat(path: Path) -> None:
    savemat(path, {"t": TIME_S, "x_mm": X_MM, "y_mm": Y_MM, "note": "run 7"})


def mat_struct(path: Path) -> None:
    savemat(path, {"ldv": {"time_s": TIME_S, "x_mm": X_MM, "y_mm": Y_MM}})


def mat73(path: Path) -> None:
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, values in (("t", TIME_S), ("x_mm", X_MM), ("y_mm", Y_MM)):
            file[name] = values[None]
    with path.open("r+b") as raw:
        raw.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM")


def uff(path: Path) -> None:
    writer = pyuff.UFF(str(path))
    for name, values in (("x", X_MM), ("y", Y_MM)):
        one = pyuff.prepare_58(
            binary=0, func_type=1, id1=name, rsp_node=1, rsp_dir=1, ref_node=1, ref_dir=1,
            data=values, x=TIME_S, ordinate_axis_units_lab="mm", abscissa_spacing=1,
            abscissa_min=float(TIME_S[0]), abscissa_inc=1 / RATE_HZ, orddenom_spec_data_type=0,
        )  # fmt: skip
        writer.write_sets(one, "add")


def tdms(path: Path) -> None:
    nptdms = pytest.importorskip("nptdms")
    timing = {"wf_increment": 1 / RATE_HZ, "wf_start_offset": float(TIME_S[0])}
    with nptdms.TdmsWriter(str(path)) as writer:
        writer.write_segment(
            [
                nptdms.ChannelObject("ldv", name, values, {"unit_string": "mm", **timing})
                for name, values in (("x", X_MM), ("y", Y_MM))
            ]
        )


@pytest.mark.parametrize(
    ("write", "name", "column"),
    [
        (csv, "ldv.csv", "x_mm"),
        (csv, "ldv.csv", "x"),
        (german, "ldv.txt", "x"),
        (tabs, "ldv.txt", "x"),
        (mat, "ldv.mat", "x_mm"),
        (mat_struct, "ldv.mat", "ldv.x_mm"),
        (mat73, "ldv.mat", "x_mm"),
        (uff, "ldv.uff", "x"),
        (tdms, "ldv.tdms", "x"),
    ],
)
def test_every_kind_gives_the_same_series(
    tmp_path: Path, write: Callable[[Path], None], name: str, column: str
) -> None:
    path = tmp_path / name
    write(path)
    series = read_reference(path, column).series
    assert series.values == pytest.approx(X_MM, abs=1e-5)
    assert series.rate_hz == pytest.approx(RATE_HZ, rel=5e-6)
    assert series.start_s == pytest.approx(TIME_S[0], abs=2e-6)


@pytest.mark.parametrize(("unit", "mm"), [("m", 1e3), ("um", 1e-3), ("nm", 1e-6), ("in", 25.4)])
def test_units_on_request(tmp_path: Path, unit: str, mm: float) -> None:
    path = tmp_path / "ldv.csv"
    path.write_text("\n".join(map(str, X_MM)))
    series = read_reference(path, unit=unit, rate_hz=500).series
    assert series.values == pytest.approx(mm * X_MM)
    assert (series.start_s, series.rate_hz) == (0, 500)


def test_a_rate_takes_the_place_of_times_with_few_digits(tmp_path: Path) -> None:
    path = tmp_path / "ldv.csv"
    rows = "".join(f"{t:.4f},{x}\n" for t, x in zip(TIME_S, X_MM, strict=True))
    path.write_text("time_s,x_mm\n" + rows)
    assert read_reference(path, rate_hz=RATE_HZ).series.rate_hz == RATE_HZ


@pytest.mark.parametrize(
    ("text", "options", "sentence"),
    [
        ("time_s,x_mm,y_mm\n0,1,2\n1,2,3\n", {}, "has the columns x_mm, y_mm; choose one"),
        ("time_s,x\n0,1\n1,2\n", {}, "column x does not say its unit; give it with --units"),
        ("time_s,v_mm_per_s\n0,1\n1,2\n", {}, r"column v_mm_per_s is in mm/s, which is no length"),
        ("time_s,x [mm/s]\n0,1\n1,2\n", {}, r"column x \[mm/s\] is in mm/s, which is no length"),
        ("x_mm\n1\n2\n", {}, "has no column of times; give the sampling rate in hertz"),
        ("time_s,x_mm\n0,1\n1,2\n2,3\n", {}, "column x_mm: 3 values are too few"),
        (
            "time_s,x_mm\n" + "".join(f"{n + 5 * (n > 4)},1\n" for n in range(9)),
            {},
            "time_s is not even: its steps go from 1 to 6 s",
        ),
        ("time_s,x_mm\n0,1\nnan,2\n2,3\n", {}, "time_s holds values that are no numbers"),
        ("time_s,x_mm\n0,1\n1,two\n", {}, "ldv.csv: .*two"),
        ("nothing here\n", {}, "no line of numbers in its first 1 lines"),
    ],
)
def test_a_reference_that_cannot_be_used(
    tmp_path: Path, text: str, options: dict[str, str], sentence: str
) -> None:
    path = tmp_path / "ldv.csv"
    path.write_text(text)
    with pytest.raises(ReplayError, match=sentence) as told:
        read_reference(path, **options)
    assert len(str(told.value).splitlines()) == 1


@pytest.mark.parametrize(
    ("name", "data", "sentence"),
    [
        ("ldv.mat", b"no MAT file at all" * 20, "not a MAT file"),
        ("ldv.uff", b"    -1\n    58\nnonsense\n    -1\n", "universal file|no data set 58"),
        ("ldv.doc", b"", "a reference is a .csv, .txt, .mat, .uff, .unv or .tdms file, not .doc"),
    ],
)
def test_a_file_that_is_none_of_its_kind(
    tmp_path: Path, name: str, data: bytes, sentence: str
) -> None:
    path = tmp_path / name
    path.write_bytes(data)
    with pytest.raises(ReplayError, match=sentence):
        read_reference(path)


@pytest.mark.parametrize("name", ["ldv.csv", "ldv.mat", "ldv.uff", "ldv.tdms"])
def test_a_file_that_is_not_there(tmp_path: Path, name: str) -> None:
    if name.endswith("tdms"):
        pytest.importorskip("nptdms")
    with pytest.raises(ReplayError, match="cannot be read: no such file or directory"):
        read_reference(tmp_path / name)
