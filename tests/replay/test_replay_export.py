"""Every export read back by a reader that is not ours, with equal numbers."""

from __future__ import annotations

import json

import h5py
import nptdms
import numpy as np
import openpyxl
import pandas as pd
import pyarrow.parquet as pq
import pytest
import pyuff
import scipy.io
from replaying import START_UTC_NS, write_recording

import vdms_replay
from vdms_replay.cli import run
from vdms_replay.export import export
from vdms_replay.formats import FORMATS, tables
from vdms_rt.wire import vdms_pb2 as pb

NUMBERS = (
    "time_s", "x_mm", "y_mm", "rotation_mrad", "sigma_x_mm", "sigma_y_mm", "residual_mm", "valid",
    "status", "seq", "frame_seq", "segment", "setup_revision", "t_ns", "sigma_t_ns", "utc_ns",
    "stamp_ns",
)  # fmt: skip
TEXTS = ("status_text", "scan", "session")


@pytest.fixture
def recording(tmp_path):
    return write_recording(
        tmp_path / "a.mcap",
        range(200),
        lost=range(100, 105),
        status={7: pb.NOT_FOUND, 9: pb.SATURATED},
        markers=("m1", "m-2"),
    )


@pytest.fixture(autouse=True)
def small_batches(monkeypatch):
    """Several batches, so that what is written batch by batch is put together right."""
    monkeypatch.setattr("vdms_replay.export.ROWS_AT_ONCE", 64)


def exported(recording, to, **options):
    out = recording.with_suffix(FORMATS[to][0])
    sentences = export(recording, to=to, **options)
    assert str(out) in sentences[0]
    return out, sentences


def expected(recording, marker="m1"):
    return vdms_replay.load(recording, marker=marker)


def check_numbers(found, recording, marker="m1", digits=17):
    """`found(name)` is a column of the file, of doubles written with so many digits."""
    table = expected(recording, marker)
    for name in NUMBERS:
        if digits >= 17:
            np.testing.assert_array_equal(found(name), table[name].to_numpy(), err_msg=name)
        else:
            rtol = 10.0 ** (1 - digits)
            np.testing.assert_allclose(found(name), table[name].to_numpy(), rtol, err_msg=name)
    for name in TEXTS:
        assert [str(text).strip() for text in found(name)] == list(table[name]), name


def test_csv_by_pandas(recording):
    out, _ = exported(recording, "csv")
    table = pd.read_csv(out, comment="#", dtype={"session": str})
    for marker in ("m1", "m-2"):
        part = table[table["marker"] == marker].reset_index(drop=True)
        check_numbers(lambda name, part=part: part[name].to_numpy(), recording, marker)
        utc = pd.to_datetime(part["utc"], utc=True)
        assert [time.value for time in utc] == list(part["utc_ns"])
    assert out.read_text().startswith('# station: "lab"\n')
    meta = [line[2:].partition(": ") for line in out.read_text().splitlines() if line[:1] == "#"]
    assert json.loads({name: text for name, _, text in meta}["units"])["x_mm"] == "mm"


def test_parquet_by_pandas_and_arrow(recording):
    out, _ = exported(recording, "parquet")
    table = pd.read_parquet(out)
    whole = vdms_replay.load(recording)
    assert len(table) == len(whole) == 2 * 195
    for marker in ("m1", "m-2"):
        part = table[table["marker"] == marker].reset_index(drop=True)
        check_numbers(lambda name, part=part: part[name].to_numpy(), recording, marker)
    assert table["utc"].dtype == "datetime64[ns, UTC]"
    assert table["utc"].iloc[0].value == START_UTC_NS
    schema = pq.read_schema(out)
    assert schema.field("x_mm").metadata[b"unit"] == b"mm"
    assert json.loads(schema.metadata[b"vdms"])["station"] == "lab"


def test_hdf5_by_h5py(recording):
    out, _ = exported(recording, "hdf5")
    with h5py.File(out) as file:
        for marker in ("m1", "m-2"):
            check_numbers(
                lambda name, group=file[marker]: (
                    group[name].asstr()[:] if name in TEXTS else group[name][:]
                ),
                recording,
                marker,
            )
        assert file["m1/x_mm"].attrs["unit"] == "mm"
        assert file["about/station"].asstr()[()] == "lab"
        assert "start" in file["about"]


def test_mat_by_scipy(recording):
    out, sentences = exported(recording, "mat")
    values = scipy.io.loadmat(out)
    for marker, name in (("m1", "m1"), ("m-2", "m_2")):
        group = values[name][0, 0]
        check_numbers(lambda name, group=group: group[name].ravel(), recording, marker)
        assert group["x_mm"].shape == (195, 1)
    assert values["about"][0, 0]["station"] == ["lab"]
    assert values["about"][0, 0]["units"][0, 0]["x_mm"] == ["mm"]
    assert any("marker m-2 is the variable m_2" in sentence for sentence in sentences)


def test_tdms_by_nptdms(recording):
    out, _ = exported(recording, "tdms")
    file = nptdms.TdmsFile.read(out)
    for marker in ("m1", "m-2"):
        check_numbers(lambda name, group=file[marker]: group[name][:], recording, marker)
    assert file["m1"]["x_mm"].properties["unit_string"] == "mm"
    assert file.properties["station"] == "lab"


def test_xlsx_by_openpyxl(recording):
    out, _ = exported(recording, "xlsx")
    book = openpyxl.load_workbook(out, read_only=True)
    for marker in ("m1", "m-2"):
        rows = list(book[marker].iter_rows(values_only=True))
        table = pd.DataFrame(rows[1:], columns=rows[0])
        for name in ("t_ns", "utc_ns", "stamp_ns"):
            assert list(table[name].astype("int64")) == list(expected(recording, marker)[name])
        exact = table.astype({"t_ns": "int64", "utc_ns": "int64", "stamp_ns": "int64"})
        check_numbers(
            lambda name, exact=exact: (
                exact[name].to_numpy() if name in TEXTS else exact[name].to_numpy(dtype="float64")
            ),
            recording,
            marker,
            digits=16,
        )
        assert table["utc"][0] == "2026-09-21T14:13:20.123456789Z"
    about = {row[0]: row[1] for row in book["about"].iter_rows(values_only=True)}
    assert about["station"] == "lab"
    book.close()


def functions_of(path):
    """Return the file's units, and its functions by marker and direction."""
    units, *sets = pyuff.UFF(str(path)).read_sets()
    found = {}
    for one in sets:
        found.setdefault((one["rsp_ent_name"], one["rsp_dir"]), []).append(one)
    return units, found


def test_uff58_by_pyuff_has_the_valid_samples_and_a_function_for_each_stretch(recording):
    out, sentences = exported(recording, "uff58")
    units, functions = functions_of(out)
    assert (units["type"], units["units_code"], units["length"]) == (164, 5, 1000.0)
    assert set(functions) == {(m, d) for m in ("m1", "m-2") for d in (1, 2, 6)}
    table = expected(recording)
    stretches = [(0, 7), (8, 100), (105, 200)]
    for direction, name in ((1, "x_mm"), (2, "y_mm"), (6, "rotation_mrad")):
        assert len(functions["m1", direction]) == 3
        for one, (first, end) in zip(functions["m1", direction], stretches, strict=True):
            part = table[(table["seq"] >= first) & (table["seq"] < end)]
            np.testing.assert_allclose(one["data"], part[name], rtol=1e-11, atol=1e-14)
            np.testing.assert_allclose(one["x"], part["time_s"], rtol=0, atol=1e-5)
            assert one["ordinate_axis_units_lab"].strip() == name.split("_")[1]
            assert one["id1"].startswith("lab m1 ")
            assert one["id3"] == f"first value at {part['time_s'].iloc[0]:.9f} s, step 0.01668335 s"
    told = "\n".join(sentences)
    assert "2 samples without a valid position were left out" in told
    assert "gaps part it into 3 functions" in told
    assert "the samples are up to 0.000 ms away from even steps" in told
    assert "the format rounds the step to 1.6683" in told


def test_uff58_needs_even_times(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("replaying.t_ns_of", lambda seq: 10**12 + seq * 16_683_350 + seq**2 * 10**5)
    path = write_recording(tmp_path / "a.mcap", range(100))
    assert "away from even steps" in refused(capsys, path, "--to", "uff58")
    assert not (tmp_path / "a.uff").exists()


def test_si_changes_units_and_their_names_everywhere(recording):
    out, _ = exported(recording, "parquet", si=True)
    table = pd.read_parquet(out)
    table = table[table["marker"] == "m1"].reset_index(drop=True)
    whole = expected(recording)
    np.testing.assert_array_equal(table["x_m"], whole["x_mm"] * 1e-3)
    np.testing.assert_array_equal(table["rotation_rad"], whole["rotation_mrad"] * 1e-3)
    np.testing.assert_array_equal(table["sigma_x_m"], whole["sigma_x_mm"] * 1e-3)
    assert not [name for name in table if name.endswith(("_mm", "_mrad"))]
    assert pq.read_schema(out).field("x_m").metadata[b"unit"] == b"m"
    out, _ = exported(recording, "uff58", si=True)
    assert pyuff.UFF(str(out)).read_sets(0)["units_code"] == 1


def test_one_marker_alone(recording):
    out, _ = exported(recording, "csv", marker="m-2")
    assert set(pd.read_csv(out, comment="#")["marker"]) == {"m-2"}


def test_an_unfinished_recording_is_exported_and_said_to_be(tmp_path, capsys):
    part = write_recording(tmp_path / "a.mcap", range(60), finish=False)
    assert run(["export", str(part), "--to", "csv"]) == 0
    assert "unfinished" in capsys.readouterr().out
    assert len(pd.read_csv(tmp_path / "a.csv", comment="#")) == 60


def refused(capsys, *arguments):
    assert run(["export", *map(str, arguments)]) == 1
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    return error


def test_what_cannot_be_exported_is_refused_and_leaves_no_file(recording, capsys, monkeypatch):
    folder = recording.parent
    for to in FORMATS:
        assert "no marker m9" in refused(capsys, recording, "--to", to, "--marker", "m9")
        assert "no such file" in refused(capsys, recording, "--to", to, "--out", "/none/a")
        assert "the recording itself" in refused(
            capsys, recording, "--to", to, "--out", recording, "--force"
        )
        assert "not a directory" in refused(capsys, recording, "--to", to, "--out", recording / "a")
    monkeypatch.setattr(tables, "EXCEL_ROWS", 100)
    assert "use --to parquet" in refused(capsys, recording, "--to", "xlsx")
    monkeypatch.setattr("vdms_replay.formats.matlab.MATLAB_BYTES", 1000)
    assert "use --to hdf5" in refused(capsys, recording, "--to", "mat")
    assert [path.name for path in folder.iterdir()] == ["a.mcap"]
    (folder / "a.csv").write_text("mine")
    assert "is there already" in refused(capsys, recording, "--to", "csv")
    assert (folder / "a.csv").read_text() == "mine"
    assert run(["export", str(recording), "--to", "csv", "--force"]) == 0
    assert (folder / "a.csv").read_text() != "mine"


def test_a_recording_of_nothing_valid_has_no_function(tmp_path, capsys):
    path = write_recording(
        tmp_path / "a.mcap", range(20), status=dict.fromkeys(range(20), pb.NOT_FOUND)
    )
    assert "no two valid samples" in refused(capsys, path, "--to", "uff58")


def test_mat_is_what_scipy_writes_of_the_same_columns(recording, monkeypatch):
    """Also where the columns wait on the disk in many blocks."""
    monkeypatch.setattr("vdms_replay.formats.spill.BLOCK_ROWS", 7)
    out, _ = exported(recording, "mat")
    found = scipy.io.loadmat(out)
    for marker, name in (("m1", "m1"), ("m-2", "m_2")):
        table = expected(recording, marker).drop(columns=["utc", "marker"])
        columns = {
            column: np.array(list(table[column]), str)
            if column in TEXTS
            else table[column].to_numpy().reshape(-1, 1)
            for column in table
        }
        other = recording.with_suffix(".other.mat")
        scipy.io.savemat(other, {"m": columns}, long_field_names=True)
        same = scipy.io.loadmat(other)["m"][0, 0]
        assert found[name].dtype.names == same.dtype.names
        for column in table:
            one, two = found[name][0, 0][column], same[column]
            assert one.dtype == two.dtype, column
            np.testing.assert_array_equal(one, two, err_msg=column)
    assert found["m1"][0, 0]["valid"].dtype == np.uint8
    assert {n: c for n, _, c in scipy.io.whosmat(out)}["m1"] == "struct"


def test_nothing_stays_of_an_export_that_was_stopped(recording, monkeypatch):
    def stop(*_):
        raise KeyboardInterrupt

    for to in FORMATS:
        with monkeypatch.context() as patched:
            patched.setattr("vdms_replay.export.to_si", stop)
            with pytest.raises(KeyboardInterrupt):
                export(recording, to=to, si=True)
        assert [path.name for path in recording.parent.iterdir()] == ["a.mcap"]


def test_uff58_is_the_same_for_any_size_of_blocks(recording, monkeypatch):
    whole = exported(recording, "uff58")[0].read_bytes()
    for rows in (1, 3, 7):
        monkeypatch.setattr("vdms_replay.formats.spill.BLOCK_ROWS", rows)
        assert exported(recording, "uff58", force=True)[0].read_bytes() == whole
    assert [path.name for path in recording.parent.iterdir() if "part" in path.name] == []


def test_texts_that_are_all_empty_go_into_a_mat_file(tmp_path):
    path = tmp_path / "a.mat"
    writer = FORMATS["mat"][1](path, {"station": "lab"})
    table = pd.DataFrame({"x_mm": [1.0, 2.0], "said": pd.array(["", ""], dtype="str")})
    writer.add("m1", table.assign(utc=0, marker="m1"))
    writer.close()
    found = scipy.io.loadmat(path)["m1"][0, 0]
    np.testing.assert_array_equal(found["x_mm"].ravel(), [1.0, 2.0])
    assert [str(text).strip() for text in found["said"]] == ["", ""]
