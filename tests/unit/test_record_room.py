"""The room on the disk: pixels go first, old recordings only under a limit, and it is all told."""

from __future__ import annotations

import os
import threading
import time
from collections import namedtuple

import pytest
from logbook import EVENTS, PIXELS, SAMPLES, files, put_sample, read_whole, recorder_for, running
from mcap.reader import make_reader

from vdms_rt.config import Record
from vdms_rt.logfile import shelf as shelves
from vdms_rt.logfile.shelf import Shelf
from vdms_rt.logfile.thin import thin
from vdms_rt.wire import topics
from vdms_rt.wire import vdms_pb2 as pb

CHECKPOINTS = "vdms/lab/checkpoint"
PICTURES = 40
Free = namedtuple("Free", "f_bavail f_frsize")


def wait(done) -> None:
    until_s = time.monotonic() + 60
    while not done():
        assert time.monotonic() < until_s
        time.sleep(0.01)


def put_pixels(recorder, number, size=10_000):
    patch = pb.Patch(codec="raw8", data=os.urandom(size))
    data = pb.Pixels(frame_seq=number, patches=[patch]).SerializeToString()
    return recorder.put(topics.PIXELS, PIXELS, 1_000_000 * number, data)


def put_checkpoint(recorder, number):
    data = pb.Checkpoint(seq=number, json="{}").SerializeToString()
    return recorder.put(topics.CHECKPOINT, CHECKPOINTS, 1_000_000 * number, data)


def record(directory, *, run="", passing=True, pictures=PICTURES):
    """Make a recording of so many samples and pictures; return its path."""
    before = set(directory.iterdir())
    recorder, _ = recorder_for(directory, passing=passing)
    if run:
        recorder.start_run(run)
    with running(recorder):
        for number in range(pictures):
            put_sample(recorder, number)
            put_pixels(recorder, number)
            put_checkpoint(recorder, number)
    (path,) = set(directory.iterdir()) - before
    return path


def aged(path, day, part=1):
    """Give a recording the name of one of that day in January 2026."""
    older = path.with_name(f"lab_202601{day:02}T000000Z{path.name[20:-8]}{part:03}.mcap")
    return path.rename(older)


def topics_in(path):
    return {topic for topic, _, _ in read_whole(path)}


def content(path):
    return [(topic, number, m.SerializeToString()) for topic, number, m in read_whole(path)]


def about(path):
    with path.open("rb") as file:
        return next(m.metadata for m in make_reader(file).iter_metadata() if m.name == "vdms")


def settle(shelf, current=None, length=0):
    """Let it do all that it has to do; return what it told."""
    told, last = [], None
    while last is None or shelf._thinning is not None or last:
        shelf._tidy_due_s = 0.0
        last = shelf.turn(current, length)
        told += last
    return told


def shelf(directory, **limits):
    return Shelf(directory, "lab", Record(directory=str(directory), free_mb=0, **limits))


@pytest.fixture
def free(monkeypatch):
    """The megabytes that the disk has free."""
    room = {"mb": 1000}
    monkeypatch.setattr(shelves, "FREE_S", 0.0)
    monkeypatch.setattr(shelves.os, "statvfs", lambda _: Free(room["mb"] * 1000, 1000))
    return room


def test_with_little_room_pixels_go_first_and_come_back(tmp_path, free):
    recorder, told = recorder_for(tmp_path, free_mb=100)
    with running(recorder):
        assert put_sample(recorder, 0)
        assert put_pixels(recorder, 0)
        free["mb"] = 99
        low = told.wait_for("room-low")
        for number in range(1, 11):
            assert put_sample(recorder, number)
            assert not put_pixels(recorder, number)
        assert not put_checkpoint(recorder, 10)
        assert recorder.counters().not_recorded == 11
        assert recorder.counters().pixels_left_out == 10
        assert recorder.counters().disk_free_bytes == 99_000_000
        assert recorder.counters().trouble == ""
        assert "not-recorded" not in told.codes()
        free["mb"] = 111
        told.wait_for("room-again")
        assert put_pixels(recorder, 11)
        lost = told.wait_for("not-recorded")
    assert "\n" not in low.text
    assert low.text.startswith(f"only 99 MB are free in {tmp_path} (record.free_mb = 100): ")
    assert dict(lost.facts) == {PIXELS: "10 (message 1-10)", CHECKPOINTS: "1 (message 0)"}
    messages = read_whole(files(tmp_path)[0])
    assert [m.seq for topic, _, m in messages if topic == SAMPLES] == list(range(11))
    assert [m.frame_seq for topic, _, m in messages if topic == PIXELS] == [0, 11]
    codes = [m.code for topic, _, m in messages if topic == EVENTS]
    assert [c for c in codes if c.startswith("room")] == ["room-low", "room-again"]


def test_pixels_that_the_queue_has_no_room_for_are_counted(tmp_path, free):
    recorder, _ = recorder_for(tmp_path, queue_messages=64)
    assert sum(put_pixels(recorder, number) for number in range(60)) == 48
    assert sum(put_sample(recorder, seq) for seq in range(20)) == 16
    counters = recorder.counters()
    assert (counters.not_recorded, counters.pixels_left_out) == (16, 12)
    with running(recorder):
        pass
    assert recorder.counters().pixels_left_out == 12


def test_pixels_left_out_to_the_very_end_are_in_the_file_by_number(tmp_path, free):
    free["mb"] = 1
    recorder, told = recorder_for(tmp_path, free_mb=100)
    with running(recorder):
        told.wait_for("room-low")
        put_sample(recorder, 0)
        for number in range(5):
            put_pixels(recorder, number)
    texts = [m.text for topic, _, m in read_whole(files(tmp_path)[0]) if topic == EVENTS]
    assert f"not recorded: 5 (message 0-4) of {PIXELS}" in texts


def test_the_room_does_not_flutter(tmp_path, free):
    one = Shelf(tmp_path, "lab", Record(directory=str(tmp_path), free_mb=100))
    codes = []
    for mb in (101, 99, 101, 109, 99, 111, 101):
        free["mb"] = mb
        codes.append([notice.code for notice in one.turn(None, 0)])
    assert codes == [[], ["room-low"], [], [], [], ["room-again"], []]


def test_the_pixels_of_a_recording_can_be_taken_out_alone(tmp_path):
    path = record(tmp_path)
    before, about_before = content(path), about(path)
    size = path.stat().st_size
    for _ in thin(path):
        pass
    assert path.stat().st_size < size / 10
    assert content(path) == [m for m in before if m[0] not in (PIXELS, CHECKPOINTS)]
    assert about_before["keep_pixels"] == "newest"
    assert about(path) == about_before | {"keep_pixels": "removed"}
    assert files(tmp_path) == [path]


def test_given_up_half_way_a_recording_stays_as_it_was(tmp_path):
    path = record(tmp_path, pictures=300)
    before = path.read_bytes()
    steps = thin(path)
    next(steps)
    assert len(files(tmp_path)) == 2
    steps.close()
    assert files(tmp_path) == [path]
    assert path.read_bytes() == before


def test_outside_runs_the_newest_keep_their_pixels(tmp_path):
    paths = [aged(record(tmp_path), day) for day in (1, 2, 3)]
    run = aged(record(tmp_path, run="shake"), 1, part=2)
    demo = aged(record(tmp_path, passing=False), 1, part=3)
    size_gb = paths[0].stat().st_size / 1e9
    # Two files reach 1.5 times the size of one; the third makes the oldest dispensable.
    told = settle(shelf(tmp_path, newest_pixels_gb=1.5 * size_gb))
    assert [notice.code for notice in told] == ["pixels-removed"]
    assert paths[0].name in told[0].text
    assert [PIXELS in topics_in(path) for path in paths] == [False, True, True]
    assert all(SAMPLES in topics_in(path) for path in paths)
    assert PIXELS in topics_in(run)
    assert PIXELS in topics_in(demo)
    # What is being written counts too.
    current = tmp_path / "lab_20260104T000000Z_001.mcap"
    told = settle(shelf(tmp_path, newest_pixels_gb=1.5 * size_gb), current, int(2e9 * size_gb))
    assert [notice.code for notice in told] == ["pixels-removed", "pixels-removed"]
    assert [PIXELS in topics_in(path) for path in paths] == [False, False, False]


def test_without_a_limit_nothing_is_removed(tmp_path):
    paths = [aged(record(tmp_path, run="a"), day) for day in (1, 2)]
    assert settle(shelf(tmp_path)) == []
    assert files(tmp_path) == paths


def test_under_a_limit_the_oldest_go_first_and_runs_as_a_whole(tmp_path):
    oldest = aged(record(tmp_path), 1)
    run = [aged(record(tmp_path, run="a"), 2, part) for part in (1, 2)]
    later = aged(record(tmp_path), 3)
    other = record(tmp_path)
    other = other.rename(tmp_path / "lab_x_20250101T000000Z_001.mcap")
    (tmp_path / "lab_notes.mcap").write_bytes(b"not ours")
    size_gb = later.stat().st_size / 1e9
    (told,) = settle(shelf(tmp_path, keep_gb=2.5 * size_gb))
    assert told.code == "removed-old"
    assert told.text.endswith(f": {oldest.name}, {run[0].name}, {run[1].name}")
    assert files(tmp_path) == sorted([later, other, tmp_path / "lab_notes.mcap"])


def test_the_current_run_is_never_removed(tmp_path):
    parts = [aged(record(tmp_path, run="a"), 1, part) for part in (1, 2)]
    later = aged(record(tmp_path), 2)
    current = tmp_path / "lab_20260101T000000Z_a_003.mcap"
    (told,) = settle(shelf(tmp_path, keep_gb=1e-6), current, 1_000_000)
    assert told.text.endswith(f": {later.name}")
    assert files(tmp_path) == parts


def test_what_cannot_be_tidied_is_told_and_does_not_stop_recording(tmp_path, monkeypatch):
    old = aged(record(tmp_path), 1)

    def refuse(self, *_):
        raise PermissionError(13, "Permission denied", str(self))

    monkeypatch.setattr(type(old), "unlink", refuse)
    recorder, told = recorder_for(tmp_path, keep_gb=1e-6)
    with running(recorder):
        event = told.wait_for("not-tidied")
        put_sample(recorder, 1)
    assert event.text == f"no room could be made: {old}: permission denied"
    assert len(files(tmp_path)) == 2


def test_recording_goes_on_while_pixels_are_removed(tmp_path):
    path = aged(record(tmp_path, pictures=300), 1)
    recorder, told = recorder_for(tmp_path, newest_pixels_gb=0)
    with running(recorder):
        put_sample(recorder, 0)
        told.wait_for("pixels-removed")
        put_sample(recorder, 1)
    assert PIXELS not in topics_in(path)
    assert [SAMPLES in topics_in(p) for p in files(tmp_path)] == [True, True]


def test_what_a_kill_left_of_it_is_removed(tmp_path):
    left = tmp_path / "lab_20260101T000000Z_001.mcap.thin"
    left.write_bytes(b"half")
    shelf(tmp_path)
    assert files(tmp_path) == []


def test_each_part_shows_the_reference(tmp_path):
    recorder, told = recorder_for(tmp_path)
    key = "vdms/lab/picture"
    with running(recorder):
        for number, run in enumerate(("", "a", "b")):
            if run:
                recorder.start_run(run)
            else:
                recorder.put(topics.PICTURE, key, 0, b"\x12\x03png")
            put_sample(recorder, number)
            wait(lambda n=number: told.codes().count("recording") == n + 1)
            wait(lambda: recorder.counters().queued == 0)
    assert len(files(tmp_path)) == 3
    assert all(key in topics_in(path) for path in files(tmp_path))


def test_a_slow_flush_is_told_and_shows_while_it_lasts(tmp_path, monkeypatch):
    go_on, slow = threading.Event(), threading.Event()
    fsync = os.fsync

    def slow_fsync(fd):
        slow.set()
        assert go_on.wait(60.0)
        fsync(fd)

    recorder, told = recorder_for(tmp_path)
    with running(recorder):
        put_sample(recorder, 0)
        told.wait_for("recording")
        wait(lambda: recorder.counters().queued == 0)
        monkeypatch.setattr(os, "fsync", slow_fsync)
        put_sample(recorder, 1)
        assert slow.wait(60.0)
        wait(lambda: recorder.counters().fsync_ms > 1200)
        go_on.set()
        event = told.wait_for("slow-disk")
    assert event.text.startswith("the disk took ")
    assert "nothing is lost up to 4096 (record.queue_messages)" in event.text
