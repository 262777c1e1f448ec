from __future__ import annotations

import contextlib
import csv
import math
import resource
from collections.abc import Iterator
from pathlib import Path

import pytest
from loopback import displacement

from vdms_rt.model import Scan, Status
from vdms_rt.watch import CsvError
from vdms_rt.watch.csv_file import COLUMNS, CsvFile


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def write(path: Path, *seqs: int, session: int = 7) -> int:
    file = CsvFile(path)
    for seq in seqs:
        file.write("s1", displacement(seq, session=session))
    file.close()
    return file.samples


def test_a_sample_is_a_line_with_units_in_the_header(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    file = CsvFile(path)
    file.write(
        "s1",
        displacement(
            12,
            session=0xABC,
            scan=Scan.TOP,
            frame_seq=6,
            t_ns=5_000_000_001,
            utc_ns=1_800_000_000_000_000_001,
            x_mm=-1.25,
            status=Status.FIELD_ORDER_UNCONFIRMED | Status.CLOCK_SETTLING,
        ),
    )
    file.write(
        "s1", displacement(13, x_mm=math.nan, utc_ns=0, status=Status.NOT_FOUND, marker="m2")
    )
    file.close()
    first, second = rows(path)
    assert tuple(first) == COLUMNS
    assert first == {
        "utc": "2027-01-15T08:00:00.000000001Z",
        "t_s": "5.000000001",
        "station": "s1",
        "marker": "m1",
        "session": "0000000000000abc",
        "seq": "12",
        "frame_seq": "6",
        "scan": "top",
        "x_mm": "-1.250000",
        "y_mm": "-0.500000",
        "rotation_mrad": "0.250000",
        "sigma_x_mm": "0.007812",
        "sigma_y_mm": "0.015625",
        "residual_mm": "0.003906",
        "valid": "1",
        "status": "field order unconfirmed, clock settling",
    }
    assert (second["utc"], second["x_mm"], second["valid"]) == ("", "", "0")
    assert (second["marker"], second["status"]) == ("m2", "marker not found")


def test_opened_again_it_goes_on_without_doubles(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    assert write(path, *range(10)) == 10
    assert write(path, *range(5, 15)) == 5
    assert write(path, *range(3), session=8) == 3
    assert [(r["session"][-1], int(r["seq"])) for r in rows(path)] == [
        *(("7", seq) for seq in range(15)),
        *(("8", seq) for seq in range(3)),
    ]


def test_a_line_that_a_kill_cut_short_is_written_anew(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    write(path, *range(10))
    whole = path.read_bytes()
    path.write_bytes(whole[:-20])
    assert write(path, *range(10)) == 1
    assert path.read_bytes() == whole


def test_a_header_that_a_kill_cut_short_is_written_anew(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text(",".join(COLUMNS)[:10])
    assert write(path, 0) == 1
    assert [r["seq"] for r in rows(path)] == ["0"]


@pytest.mark.parametrize(
    "content",
    [
        b"time,x\n1,2\n",
        b"\x89PNG\r\n\x1a\n\x00\xff\xfe\n",
        ",".join(COLUMNS).encode() + b"\n1,2\n",
        ",".join(COLUMNS).encode() + b"\n" + b"x," * 15 + b"\n",
    ],
)
def test_another_programs_file_is_left_alone(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "a.csv"
    path.write_bytes(content)
    with pytest.raises(CsvError, match=r"a\.csv is no CSV of vdms-rt watch; name another file"):
        CsvFile(path)
    assert path.read_bytes() == content


def test_a_place_that_cannot_be_written_is_one_sentence(tmp_path: Path) -> None:
    with pytest.raises(CsvError, match=r"cannot write .*none/a\.csv: No such file or directory;"):
        CsvFile(tmp_path / "none" / "a.csv")
    with pytest.raises(CsvError, match=r"cannot write .*: it is not a file; name another"):
        CsvFile(tmp_path)


@contextlib.contextmanager
def at_most_8_kb() -> Iterator[None]:
    """No file of this process grows beyond 8 kB: not the test runner's own output either, so this
    goes around as little as possible."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (8192, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_a_file_that_cannot_grow_is_one_sentence_and_keeps_what_it_has(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    file = CsvFile(path)

    def write_on() -> None:
        for seq in range(1000):
            file.write("s1", displacement(seq))
            file.flush()

    with at_most_8_kb():
        with pytest.raises(CsvError, match=r"cannot write .*: File too large; name another"):
            write_on()
        with pytest.raises(CsvError, match="File too large"):
            file.close()
    whole = [line for line in path.read_text().splitlines(keepends=True) if line.endswith("\n")]
    assert [row.split(",")[5] for row in whole[1:]] == [str(s) for s in range(len(whole) - 1)]
    assert len(whole) > 40
