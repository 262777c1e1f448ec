"""A recording becomes a table: the numbers, times and words of what was recorded."""

from __future__ import annotations

import json

import numpy as np
import pandas as pd
import pytest
from replaying import (
    PERIOD_NS,
    SESSION,
    START_T_NS,
    START_UTC_NS,
    sample,
    t_ns_of,
    write_recording,
    x_mm_of,
)

import vdms_replay
from vdms_replay import ReplayError
from vdms_rt.wire import vdms_pb2 as pb


def test_every_value_of_a_sample_is_in_the_table(tmp_path):
    path = write_recording(tmp_path / "a.mcap", range(10), status={4: pb.NOT_FOUND, 5: 8 | 64})
    table = vdms_replay.load(path)
    assert list(table["seq"]) == list(range(10))
    np.testing.assert_array_equal(
        table["x_mm"], [np.nan if n == 4 else x_mm_of(n) for n in range(10)]
    )
    np.testing.assert_array_equal(table["t_ns"], [t_ns_of(n) for n in range(10)])
    np.testing.assert_allclose(table["time_s"], np.arange(10) * PERIOD_NS / 1e9, rtol=0, atol=1e-12)
    assert table["utc"].dtype == "datetime64[ns, UTC]"
    assert [int(t.value) for t in table["utc"]] == list(table["utc_ns"])
    assert table["utc_ns"][0] == START_UTC_NS
    assert list(table["valid"]) == [n != 4 for n in range(10)]
    assert table["status_text"][4] == "marker not found"
    assert table["status_text"][5] == "fewer circles, field order unconfirmed"
    assert table["status_text"][0] == "ok"
    assert list(table["scan"][:2]) == ["bottom", "top"]
    assert set(table["session"]) == {f"{SESSION:016x}"}
    one = sample(3)
    for name in ("rotation_mrad", "sigma_x_mm", "sigma_y_mm", "residual_mm", "stamp_ns"):
        assert table[name][3] == getattr(one, name)
    assert (table["frame_seq"][3], table["setup_revision"][3], table["segment"][3]) == (1, 1, 0)


def test_metadata_travels_in_the_attributes_and_is_plain(tmp_path):
    path = write_recording(tmp_path / "a.mcap", range(10))
    attrs = vdms_replay.load(path).attrs
    assert json.loads(json.dumps(attrs)) == attrs
    assert attrs["station"] == "lab"
    assert attrs["recorded_by"] == "vdms-rt 9.9"
    assert attrs["device"] == {"source": "written by a test"}
    assert attrs["ends"] == ["stopped by the test"]
    assert attrs["events"] == ["2026-09-21T14:13:20.273606939Z warning: a frame was missed"]
    assert attrs["units"]["x_mm"] == "mm"
    assert attrs["recorded_at"].startswith("2026-")


def test_parts_in_any_order_and_overlapping_are_one_recording(tmp_path):
    first = write_recording(tmp_path / "a_001.mcap", range(50))
    second = write_recording(tmp_path / "a_002.mcap", range(45, 100))
    recording = vdms_replay.read(second, first, first)
    assert recording.paths == (first, second)
    assert list(recording.samples["seq"]) == list(range(100))
    assert recording.doubled == 5


def test_sessions_without_a_common_monotonic_clock_are_joined_by_utc(tmp_path):
    first = write_recording(tmp_path / "a.mcap", range(10))
    an_hour_ns = 3600 * 10**9
    later = write_recording(
        tmp_path / "b.mcap",
        range(10),
        session=7,
        utc_offset_ns=START_UTC_NS - START_T_NS + an_hour_ns,
    )
    time_s = vdms_replay.load(first, later)["time_s"]
    assert time_s[10] - time_s[0] == pytest.approx(3600, abs=1e-9)


def test_without_utc_there_are_seconds_and_no_false_date(tmp_path):
    path = write_recording(tmp_path / "a.mcap", range(10), utc_offset_ns=0)
    table = vdms_replay.load(path)
    assert table["utc"].isna().all()
    assert table["time_s"][9] == pytest.approx(9 * PERIOD_NS / 1e9, abs=1e-12)


def test_one_marker_of_several(tmp_path):
    path = write_recording(tmp_path / "a.mcap", range(10), markers=("m1", "m2"))
    assert len(vdms_replay.load(path)) == 20
    assert set(vdms_replay.load(path, marker="m2")["marker"]) == {"m2"}
    with pytest.raises(ReplayError, match="has no marker m3; it has m1, m2"):
        vdms_replay.load(path, marker="m3")
    with pytest.raises(ReplayError, match="choose one with --marker"):
        vdms_replay.read(path).of_marker()


def test_valid_samples_alone_and_circles(tmp_path):
    path = write_recording(tmp_path / "a.mcap", range(10), status={4: pb.NOT_FOUND})
    table = vdms_replay.load(path, valid_only=True, circles=True)
    assert list(table["seq"]) == [0, 1, 2, 3, 5, 6, 7, 8, 9]
    assert list(table["circle3_x_px"]) == [102.0] * 9
    assert list(table["circle4_flags"]) == [0.0] * 9


def test_truth_joins_the_samples(tmp_path):
    path = write_recording(tmp_path / "a.mcap", range(40), truth=True)
    recording = vdms_replay.read(path)
    joined = recording.samples.merge(recording.truth, on=["marker", "stamp_ns", "scan"])
    assert len(joined) == 40
    np.testing.assert_array_equal(joined["x_mm_x"], joined["x_mm_y"])
    np.testing.assert_array_equal(joined["time_s_x"], joined["time_s_y"])
    assert isinstance(recording.health["utc"].dtype, pd.DatetimeTZDtype)


def test_two_stations_are_refused(tmp_path):
    paths = [
        write_recording(tmp_path / f"{name}.mcap", range(5), station=name) for name in ("a", "b")
    ]
    with pytest.raises(ReplayError, match="of the stations a and b"):
        vdms_replay.load(*paths)


def test_what_is_no_recording_is_refused_in_a_sentence(tmp_path):
    for name, content, match in (
        ("absent", None, "absent: cannot be read: no such file"),
        ("text", b"hello", "text: not an MCAP file"),
        ("head", b"\x89MCAP0\r\n", "head: an MCAP, but not one that vdms-rt recorded"),
    ):
        path = tmp_path / name
        if content is not None:
            path.write_bytes(content)
        with pytest.raises(ReplayError, match=match):
            vdms_replay.load(path)
    with pytest.raises(ReplayError, match="no file was named"):
        vdms_replay.load()
