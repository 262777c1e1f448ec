"""Runs by name in files of their own, and the list of a folder."""

import os
import time

import pytest
from logbook import SAMPLES, put_sample, read_whole, recorder_for, running
from mcap.reader import make_reader

from vdms_rt.logfile.listing import list_recordings


def wait(done) -> None:
    until_s = time.monotonic() + 30
    while not done():
        assert time.monotonic() < until_s
        time.sleep(0.01)


def metadata(path):
    with path.open("rb") as file:
        return next(m.metadata for m in make_reader(file).iter_metadata())


def test_a_run_has_files_of_its_own_between_two_without_a_name(tmp_path):
    recorder, told = recorder_for(tmp_path)
    names = ("", "shake", "")
    with running(recorder):
        for part, name in enumerate(names):
            if name:
                recorder.start_run(name)
            elif part:
                recorder.stop_run()
            assert recorder.run_name == name
            put_sample(recorder, part)
            wait(lambda part=part: told.codes().count("recording") == part + 1)
            wait(lambda: recorder.counters().queued == 0)
    listed = list_recordings(tmp_path)
    assert sorted(r.run for r in listed) == sorted(names)
    seqs = []
    for recording in listed:
        path = tmp_path / recording.name
        assert metadata(path)["run"] == recording.run
        seqs += [m.seq for topic, _, m in read_whole(path) if topic == SAMPLES]
        assert recording.size_bytes == path.stat().st_size
        assert not recording.open
    assert sorted(seqs) == [0, 1, 2]


def test_the_length_is_from_the_first_message_to_the_last(tmp_path):
    recorder, told = recorder_for(tmp_path)
    told.recorder = None  # its events would have a time of their own
    with running(recorder):
        for seq in (1000, 2000, 3500):
            put_sample(recorder, seq)
    (recording,) = list_recordings(tmp_path)
    assert recording.begin_utc_ns == 1000 * 1_000_000
    assert recording.length_s == pytest.approx(2.5)


def test_a_list_has_what_is_being_written_and_nothing_else(tmp_path):
    (tmp_path / "lab_20260101T100000Z_001.mcap").write_bytes(b"not really")
    os.utime(tmp_path / "lab_20260101T100000Z_001.mcap", (1767261605, 1767261605))
    (tmp_path / "lab_20260101T100010Z_a_b_012.mcap.part").write_bytes(b"x" * 7)
    (tmp_path / "lab.mcap").write_bytes(b"another's")
    (tmp_path / "lab_20260101T100000Z_001.csv").write_bytes(b"")
    newest, oldest = list_recordings(tmp_path)
    assert (newest.name, newest.run, newest.open, newest.size_bytes) == (
        "lab_20260101T100010Z_a_b_012.mcap",
        "a_b",
        True,
        7,
    )
    assert (oldest.run, oldest.open, oldest.length_s) == ("", False, 5.0)


def test_a_folder_that_is_not_there_has_none(tmp_path):
    assert list_recordings(tmp_path / "nowhere") == []
