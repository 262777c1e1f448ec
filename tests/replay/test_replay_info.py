"""`info` and `recover`: what a person reads of a recording, and of one that was cut off."""

from __future__ import annotations

import errno
import json
import os

import numpy as np
import pytest
from logbook import read_whole
from replaying import PERIOD_NS, RATE_HZ, write_recording

import vdms_replay
from vdms_replay.cli import run
from vdms_replay.info import info, page
from vdms_replay.summary import Axis
from vdms_rt.logfile.reader import LogReader
from vdms_rt.logfile.writer import LogWriter
from vdms_rt.wire import vdms_pb2 as pb

GAP = range(100, 105)


@pytest.fixture
def recording(tmp_path):
    return write_recording(
        tmp_path / "a.mcap",
        range(300),
        lost=[*GAP, 200],
        status=dict.fromkeys((7, 8), pb.NOT_FOUND) | {9: pb.SATURATED},
        pixels=True,
    )


def test_info_tells_rate_gaps_reasons_and_peaks(recording):
    told = info(recording)
    marker = told["markers"]["m1"]
    assert (marker["samples"], marker["valid"], marker["lost"]) == (294, 292, 6)
    assert marker["invalid"] == {"marker not found": 2}
    assert marker["flagged"] == {"too bright": 1}
    assert marker["rate_hz"] == pytest.approx(RATE_HZ, rel=1e-9)
    assert [(gap["first_seq"], gap["last_seq"]) for gap in marker["gaps"]] == [
        (100, 104),
        (200, 200),
    ]
    assert marker["gaps"][0]["seconds"] == pytest.approx(6 * PERIOD_NS / 1e9)
    table = vdms_replay.load(recording, valid_only=True)
    axis = marker["axes"]["x_mm"]
    assert axis["highest"] == table["x_mm"].max()
    assert axis["highest_at_s"] == table["time_s"][table["x_mm"].idxmax()]
    assert axis["lowest"] == table["x_mm"].min()
    assert axis["deviation"] == pytest.approx(table["x_mm"].std(ddof=0), rel=1e-12)
    assert marker["sigma_x_mm"] == pytest.approx(0.001)
    assert told["pixel_frames"] == 146
    assert told["events"][0]["text"] == "a frame was missed"
    assert told["counters"]["captured"] == 0


def test_pixels_left_out_are_told_where_there_are_any(tmp_path):
    counted = {"not_recorded": 12, "pixels_left_out": 7}
    told = info(write_recording(tmp_path / "a.mcap", range(90), finish=False, health=counted))
    assert (told["counters"]["not_recorded"], told["counters"]["pixels_left_out"]) == (12, 7)
    assert "not recorded 12, pixels left out 7" in page(told)
    whole = info(write_recording(tmp_path / "b.mcap", range(90), finish=False))
    assert whole["counters"]["pixels_left_out"] == 0
    assert "pixels left out" not in page(whole)


def test_info_over_many_batches_is_that_of_one(tmp_path, monkeypatch, recording):
    whole = info(recording)
    monkeypatch.setattr("vdms_replay.info.ROWS_AT_ONCE", 7)
    pieces = info(recording)
    for side in ("lowest", "highest", "lowest_at_s", "highest_at_s"):
        assert (
            pieces["markers"]["m1"]["axes"]["y_mm"][side]
            == (whole["markers"]["m1"]["axes"]["y_mm"][side])
        )
    assert pieces["markers"]["m1"]["gaps"] == whole["markers"]["m1"]["gaps"]
    assert pieces["markers"]["m1"]["rate_hz"] == whole["markers"]["m1"]["rate_hz"]


def test_an_axis_adds_up_to_mean_and_deviation_of_all():
    values = np.random.default_rng(1).normal(1e3, 1, 1000)
    axis = Axis()
    for part in np.array_split(values, 13):
        axis.take(part, part)
    assert axis.mean == pytest.approx(values.mean(), rel=1e-12)
    assert axis.deviation == pytest.approx(values.std(), rel=1e-9)


def test_the_quietest_second_shows_the_noise_of_a_resting_marker(tmp_path, monkeypatch):
    noise_mm = 0.0013
    chance = np.random.default_rng(3)
    resting = iter(chance.normal(0, noise_mm, 10_000))
    monkeypatch.setattr("replaying.x_mm_of", lambda seq: next(resting) if seq < 240 else seq % 50)
    path = write_recording(tmp_path / "a.mcap", range(600))
    quiet = info(path)["markers"]["m1"]["quietest_second"]
    assert quiet["at_s"] < 4
    assert quiet["x_mm"] == pytest.approx(noise_mm, rel=0.25)


def test_the_page_names_what_matters(recording, capsys):
    assert run(["info", str(recording)]) == 0
    page = capsys.readouterr().out
    for text in (
        "lab: 2026-09-21",
        "written by a test",
        "294 at 59.940 Hz, 292 valid",
        "2 marker not found",
        "2, 6 samples lost: seq 100 to 104 at 1.65 s; seq 200 to 200",
        "warning",
        "a frame was missed",
        "ended     stopped by the test",
        "-9.9999 mm at 0.751 s to +10.0000 mm at 0.250 s",
    ):
        assert text in page


def test_info_as_json_of_two_stations(tmp_path, capsys):
    paths = [
        write_recording(tmp_path / f"{name}.mcap", range(5), station=name) for name in ("a", "b")
    ]
    assert run(["info", "--json", *map(str, paths)]) == 0
    assert [one["station"] for one in json.loads(capsys.readouterr().out)] == ["a", "b"]


def test_an_unfinished_file_is_read_told_and_completed(tmp_path, capsys):
    part = write_recording(tmp_path / "a.mcap", range(300), finish=False)
    assert part.name == "a.mcap.part"
    assert run(["info", str(part)]) == 0
    page = capsys.readouterr().out
    assert "300 at" in page
    assert "unfinished; `vdms-replay recover` completes it" in page
    assert run(["recover", str(part)]) == 0
    assert "a.mcap: repaired," in capsys.readouterr().out
    assert not part.exists()
    whole = tmp_path / "a.mcap"
    assert sum(topic.endswith("displacement") for topic, _, _ in read_whole(whole)) == 300
    assert "not_readable" in info(whole)
    assert info(whole)["repairs"] == ["repaired: 0 unreadable bytes were left out"]
    assert run(["recover", str(whole)]) == 0
    assert "whole, nothing to recover" in capsys.readouterr().out


def test_a_damaged_file_stays_and_its_readable_part_is_written_beside_it(tmp_path, capsys):
    path = write_recording(tmp_path / "a.mcap", range(300))
    with LogReader(path) as reader:
        chunk = [block for block in reader.blocks() if block.chunk is not None][4]
    data = bytearray(path.read_bytes())
    data[chunk.offset + len(chunk.content) // 2] ^= 0xFF
    path.write_bytes(data)
    assert run(["recover", str(path)]) == 0
    assert "unreadable bytes left out" in capsys.readouterr().out
    assert path.read_bytes() == data
    copied = read_whole(tmp_path / "a-recovered.mcap")
    assert 200 < sum(topic.endswith("displacement") for topic, _, _ in copied) < 300
    assert run(["recover", str(path)]) == 1
    assert "a-recovered.mcap: file exists" in capsys.readouterr().err


def test_recover_into_a_named_file_leaves_the_unfinished_one(tmp_path):
    part = write_recording(tmp_path / "a.mcap", range(60), finish=False)
    before = part.read_bytes()
    assert run(["recover", str(part), "--out", str(tmp_path / "b.mcap")]) == 0
    assert part.read_bytes() == before
    assert read_whole(tmp_path / "b.mcap")


def test_what_is_being_recorded_is_not_recovered(tmp_path, capsys):
    log = LogWriter(tmp_path / "a.mcap")
    assert run(["recover", str(log.part_path)]) == 1
    assert "is being recorded right now" in capsys.readouterr().err
    log.abandon()


def test_bad_input_is_one_sentence_and_a_status(tmp_path, capsys):
    for verb in ("info", "recover"):
        assert run([verb, str(tmp_path / "none.mcap")]) == 1
        error = capsys.readouterr().err
        assert error.startswith("vdms-replay: ")
        assert error.count("\n") == 1
        assert "no such file" in error
    assert run(["recover", "a", "b", "--out", "c"]) == 1
    assert "--out takes one file" in capsys.readouterr().err


def test_a_disk_that_fails_while_reading_is_said_in_a_sentence(recording, capsys, monkeypatch):
    def fail(self, start=0):
        raise OSError(errno.EIO, os.strerror(errno.EIO), str(self.path))

    monkeypatch.setattr(LogReader, "blocks", fail)
    assert run(["info", str(recording)]) == 1
    assert capsys.readouterr().err == f"vdms-replay: {recording}: input/output error\n"
