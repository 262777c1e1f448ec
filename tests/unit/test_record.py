"""The recorder: what is in its files, what it drops and says, and how it lives with the disk."""

from __future__ import annotations

import errno
import os
import shutil
import threading
from pathlib import Path

import pytest
from logbook import (
    EVENTS,
    PIXELS,
    SAMPLES,
    SESSION,
    SETUPS,
    files,
    put_sample,
    read_whole,
    recorder_for,
    rerun,
    running,
    sample_bytes,
    samples_in,
)
from mcap.reader import make_reader

from vdms_rt import backlog
from vdms_rt.logfile.reader import LogReader, StoredMessage
from vdms_rt.logfile.repair import repair, repair_directory
from vdms_rt.record import RecordError
from vdms_rt.wire import topics
from vdms_rt.wire import vdms_pb2 as pb


@pytest.fixture(autouse=True)
def no_thread_survives():
    before = set(threading.enumerate())
    yield
    assert set(threading.enumerate()) <= before


def set_up_bytes(revision):
    return pb.SetUp(session=SESSION, revision=revision, json="{}").SerializeToString()


def pixels_bytes(size, number=0):
    patch = pb.Patch(codec="raw8", data=os.urandom(size))
    return pb.Pixels(frame_seq=number, patches=[patch]).SerializeToString()


def test_everything_comes_back_typed_by_what_the_file_itself_says(tmp_path):
    recorder, _ = recorder_for(tmp_path)
    with running(recorder):
        assert recorder.put(topics.SETUP, SETUPS, 5, set_up_bytes(3))
        recorder.attach("reference.png", "image/png", b"\x89PNG")
        for seq in range(300):
            assert put_sample(recorder, seq)
    (path,) = files(tmp_path)
    assert path.suffix == ".mcap"
    assert path.name.startswith("lab_20")
    assert path.name.endswith("Z_001.mcap")
    messages = read_whole(path)
    assert messages[0][0] == "vdms/lab/run"
    run = messages[0][2]
    assert (run.version, run.station, run.config_text) == ("9.9", "lab", "[station]")
    assert messages[-1][0] == "vdms/lab/end"
    assert messages[-1][2].reason == "stopped by the test"
    assert messages[-1][2].health.captured == 7
    samples = [(sequence, m.seq, m.x_mm) for topic, sequence, m in messages if topic == SAMPLES]
    assert samples == [(seq, seq, seq / 8) for seq in range(300)]
    assert [m.revision for topic, _, m in messages if topic == SETUPS] == [3]
    with path.open("rb") as file:
        reader = make_reader(file)
        (attachment,) = reader.iter_attachments()
        (metadata,) = reader.iter_metadata()
        times = [m.log_time for _, c, m in reader.iter_messages(topics=[SAMPLES])]
    assert (attachment.name, attachment.media_type) == ("reference.png", "image/png")
    assert attachment.data == b"\x89PNG"
    assert metadata.name == "vdms"
    assert metadata.metadata["device"] == "virtual"
    assert metadata.metadata["part"] == "1"
    assert times == [1_000_000 * seq for seq in range(300)]
    counters = recorder.counters()
    assert counters.file == str(path)
    assert counters.not_recorded == 0
    assert counters.recorded == len(messages) - 2  # all but run and end
    assert counters.trouble == ""


def test_an_independent_reader_sees_typed_fields(tmp_path):
    recorder, _ = recorder_for(tmp_path / "log")
    with running(recorder):
        for seq in range(20):
            put_sample(recorder, seq)
    (path,) = files(tmp_path / "log")
    info = rerun(tmp_path, "mcap", "info", str(path))
    assert info.returncode == 0, info.stderr
    (line,) = [line for line in info.stdout.splitlines() if SAMPLES in line]
    assert line.split()[2] == "20"
    assert line.endswith("vdms.Displacement  protobuf")
    assert "Summary                  embedded" in info.stdout
    check = rerun(tmp_path, "mcap", "check", "--full", str(path))
    assert check.returncode == 0, check.stdout + check.stderr
    converted = tmp_path / "log.rrd"
    done = rerun(tmp_path, "mcap", "convert", str(path), "-o", str(converted))
    assert done.returncode == 0, done.stderr
    printed = rerun(tmp_path, "rrd", "print", "-vvv", "--entity", f"/{SAMPLES}", str(converted))
    assert '"x_mm": non-null Float64' in printed.stdout
    assert '"seq": non-null UInt64' in printed.stdout
    assert f"session: {SESSION}, marker: m1, seq: 19" in printed.stdout


def test_each_part_can_be_read_alone_and_nothing_is_between_them(tmp_path):
    recorder, _ = recorder_for(tmp_path, rotate_mb=1.0)
    with running(recorder):
        recorder.put(topics.SETUP, SETUPS, 0, set_up_bytes(1))
        recorder.attach("reference.png", "image/png", b"picture")
        for seq in range(240):
            put_sample(recorder, seq)
            assert recorder.put(topics.PIXELS, PIXELS, 1_000_000 * seq, pixels_bytes(30_000, seq))
            if seq % 20 == 19:
                wait_until_written(recorder)
    paths = files(tmp_path)
    assert len(paths) >= 3
    assert [path.name[-8:] for path in paths] == [f"{n:03}.mcap" for n in range(1, len(paths) + 1)]
    seqs, sequences = [], []
    for number, path in enumerate(paths, 1):
        messages = read_whole(path)
        assert messages[0][0] == "vdms/lab/run"
        assert (SETUPS, 0) in [message[:2] for message in messages]
        assert messages[-1][0] == "vdms/lab/end"
        reason = messages[-1][2].reason
        if number < len(paths):
            assert reason == "continued in the next file after 1 MB"
        else:
            assert reason == "stopped by the test"
        seqs += [m.seq for topic, _, m in messages if topic == SAMPLES]
        sequences += [sequence for topic, sequence, _ in messages if topic == PIXELS]
        with path.open("rb") as file:
            reader = make_reader(file)
            assert [a.data for a in reader.iter_attachments()] == [b"picture"]
            assert [m.metadata["part"] for m in reader.iter_metadata()] == [str(number)]
    assert seqs == list(range(240))
    assert sequences == list(range(240))


def wait_until_written(recorder):
    while recorder.counters().queued:
        threading.Event().wait(0.01)


def wait_until_recorded(recorder, messages):
    while recorder.counters().recorded < messages:
        threading.Event().wait(0.01)


def test_the_set_up_at_the_head_of_a_later_part_keeps_its_own_time(tmp_path):
    recorder, told = recorder_for(tmp_path, rotate_s=1.0)
    with running(recorder):
        recorder.put(topics.SETUP, SETUPS, 7, set_up_bytes(1))
        while len(files(tmp_path)) < 2:
            put_sample(recorder, 1000)
            threading.Event().wait(0.02)
    with files(tmp_path)[1].open("rb") as file:
        (found,) = make_reader(file).iter_messages(topics=[SETUPS])
    message = found[2]
    assert message.publish_time == 7
    assert message.log_time >= 1_000_000
    assert told.codes().count("recording") >= 2


def test_two_recorders_of_one_station_never_share_or_overwrite_a_file(tmp_path):
    recorders = [recorder_for(tmp_path)[0] for _ in range(3)]
    with running(recorders[0]), running(recorders[1]), running(recorders[2]):
        for number, recorder in enumerate(recorders):
            put_sample(recorder, number)
    assert sorted(seq for path in files(tmp_path) for seq in samples_in(path)) == [0, 1, 2]
    assert len(files(tmp_path)) == 3


def test_a_missing_directory_is_made(tmp_path):
    recorder, _ = recorder_for(tmp_path / "a" / "b")
    with running(recorder):
        put_sample(recorder, 1)
    assert samples_in(files(tmp_path / "a" / "b")[0]) == [1]


def test_a_directory_that_cannot_be_used_is_told_in_one_sentence(tmp_path):
    (tmp_path / "file").write_text("")
    for directory, reason in (
        (tmp_path / "file", "is a file"),
        (tmp_path / "file" / "below", "not a directory"),
        (Path("/proc/vdms-rt"), "cannot be written"),
    ):
        with pytest.raises(RecordError) as caught:
            recorder_for(directory)
        sentence = str(caught.value)
        assert sentence.startswith(f"record.directory = {directory}: ")
        assert reason in sentence
        assert "record.enabled = false" in sentence
        assert "\n" not in sentence


def test_behind_a_live_source_a_full_queue_drops_and_tells_exactly_what(tmp_path):
    recorder, told = recorder_for(tmp_path, queue_messages=64)
    kept = [put_sample(recorder, seq) for seq in range(100)]
    assert kept == [True] * 64 + [False] * 36
    assert recorder.counters().not_recorded == 36
    with running(recorder):
        event = told.wait_for("not-recorded")
        wait_until_written(recorder)
        put_sample(recorder, 100)
    assert event.text == f"not recorded: 36 (seq 64-99) of {SAMPLES}"
    assert event.facts == ((SAMPLES, "36 (seq 64-99)"),)
    messages = read_whole(files(tmp_path)[0])
    assert [m.seq for topic, _, m in messages if topic == SAMPLES] == [*range(64), 100]
    assert [s for topic, s, _ in messages if topic == SAMPLES] == [*range(64), 100]
    logged = [m.text for topic, _, m in messages if topic == EVENTS and m.code == "not-recorded"]
    assert logged == [event.text]


def test_what_was_lost_at_the_very_end_is_in_the_file_too(tmp_path):
    recorder, told = recorder_for(tmp_path, queue_messages=64)
    for seq in (*range(70), 200):
        put_sample(recorder, seq)
    with running(recorder):
        pass
    texts = [m.text for topic, _, m in read_whole(files(tmp_path)[0]) if topic == EVENTS]
    assert f"not recorded: 7 (seq 64-69, 200) of {SAMPLES}" in texts
    assert told.codes().count("not-recorded") == 1


def test_pixels_are_dropped_before_displacements_and_events_after_them(tmp_path):
    recorder, _ = recorder_for(tmp_path, queue_messages=64)
    pixels = [recorder.put(topics.PIXELS, PIXELS, 0, pixels_bytes(10)) for _ in range(60)]
    assert pixels.count(True) == 48
    assert [put_sample(recorder, seq) for seq in range(20)].count(True) == 16
    assert recorder.put(topics.EVENT, EVENTS, 0, pb.Event(code="last").SerializeToString())
    with running(recorder):
        pass
    codes = [m.code for topic, _, m in read_whole(files(tmp_path)[0]) if topic == EVENTS]
    assert "last" in codes


def test_the_queue_is_bounded_in_bytes(tmp_path, monkeypatch):
    monkeypatch.setattr(backlog, "LIMIT_BYTES", 1_000_000)
    recorder, _ = recorder_for(tmp_path)
    kept = [recorder.put(topics.PIXELS, PIXELS, 0, pixels_bytes(100_000)) for _ in range(10)]
    assert kept.count(True) == 7
    assert put_sample(recorder, 0)
    with running(recorder):
        pass


def test_behind_a_clip_nothing_is_dropped(tmp_path):
    recorder, _ = recorder_for(tmp_path, live=False, queue_messages=64)
    producer = threading.Thread(
        target=lambda: [put_sample(recorder, seq) for seq in range(2000)], name="producer"
    )
    producer.start()
    with running(recorder):
        producer.join(30.0)
        assert not producer.is_alive()
    assert recorder.counters().not_recorded == 0
    assert samples_in(files(tmp_path)[0]) == list(range(2000))


def test_hurry_lets_go_whoever_waits(tmp_path):
    recorder, _ = recorder_for(tmp_path, live=False, queue_messages=64)
    kept = []
    producer = threading.Thread(
        target=lambda: kept.extend(put_sample(recorder, seq) for seq in range(66)), name="producer"
    )
    producer.start()
    while recorder.counters().queued < 64:
        threading.Event().wait(0.01)
    recorder.hurry()
    producer.join(30.0)
    assert kept == [True] * 64 + [False] * 2


def test_after_finish_nothing_more_is_taken_and_it_is_counted(tmp_path):
    recorder, _ = recorder_for(tmp_path)
    with running(recorder):
        put_sample(recorder, 0)
    assert not put_sample(recorder, 1)
    assert recorder.counters().not_recorded == 1


def test_a_slow_disk_shows_and_loses_nothing(tmp_path, monkeypatch):
    go_on, slow = threading.Event(), threading.Event()
    fsync = os.fsync

    def slow_fsync(fd):
        slow.set()
        assert go_on.wait(60.0)
        fsync(fd)

    recorder, _ = recorder_for(tmp_path)
    with running(recorder):
        put_sample(recorder, 0)
        wait_until_recorded(recorder, 1)
        monkeypatch.setattr(os, "fsync", slow_fsync)
        put_sample(recorder, 1)
        assert slow.wait(60.0)
        assert all(put_sample(recorder, seq) for seq in range(2, 1000))
        while recorder.counters().fsync_ms < 100.0:  # it shows while it lasts
            threading.Event().wait(0.02)
        go_on.set()
    assert recorder.counters().fsync_ms >= 100.0
    assert recorder.counters().fsync_ms == 0.0  # the slowest is sought anew
    assert samples_in(files(tmp_path)[0]) == list(range(1000))


def test_a_vanished_directory_pauses_and_recording_goes_on_by_itself(tmp_path):
    directory = tmp_path / "log"
    recorder, told = recorder_for(directory)
    with running(recorder):
        put_sample(recorder, 0)
        told.wait_for("recording")
        wait_until_written(recorder)
        shutil.rmtree(directory)
        directory.write_text("in the way")
        event = told.wait_for("record-trouble")
        assert recorder.counters().trouble == event.text
        assert all(put_sample(recorder, seq) for seq in range(1, 50))
        directory.unlink()
        told.wait_for("record-resumed")
        assert recorder.counters().trouble == ""
        put_sample(recorder, 50)
    assert "\n" not in event.text
    assert event.text.startswith(f"recording pauses: {directory}")
    assert told.codes().count("record-trouble") == 1
    found = [seq for path in files(directory) for seq in samples_in(path)]
    assert found == sorted(found)
    assert set(found) >= set(range(1, 51))
    assert recorder.counters().not_recorded == 0


def test_a_failed_flush_loses_no_message_and_doubles_none(tmp_path, monkeypatch):
    recorder, told = recorder_for(tmp_path)
    fsync, failing = os.fsync, threading.Event()

    def failing_fsync(fd):
        if failing.is_set():
            failing.clear()
            raise OSError(errno.EIO, "Input/output error")
        fsync(fd)

    monkeypatch.setattr(os, "fsync", failing_fsync)
    with running(recorder):
        put_sample(recorder, 0)
        wait_until_recorded(recorder, 2)  # the sample and the event
        for seq in range(1, 200):
            put_sample(recorder, seq)
        failing.set()
        put_sample(recorder, 200)
        event = told.wait_for("record-trouble")
        told.wait_for("record-resumed")
        put_sample(recorder, 201)
    assert "input/output error" in event.text
    assert repair_directory(tmp_path)
    found = [seq for path in files(tmp_path) for seq in samples_in(path)]
    assert found == list(range(202))
    assert recorder.counters().not_recorded == 0


def test_a_file_removed_under_it_costs_only_what_was_in_it(tmp_path):
    recorder, told = recorder_for(tmp_path)
    with running(recorder):
        put_sample(recorder, 0)
        wait_until_recorded(recorder, 2)  # the sample and the event
        (part,) = files(tmp_path)
        part.unlink()
        for seq in range(1, 10):
            put_sample(recorder, seq)
    (path,) = files(tmp_path)
    assert samples_in(path) == list(range(1, 10))
    assert "no such file" in told.wait_for("record-trouble").text
    assert recorder.counters().not_recorded == 0


def test_trouble_that_lasts_to_the_end_is_counted_and_leaves_a_readable_file(tmp_path, monkeypatch):
    recorder, told = recorder_for(tmp_path)
    fsync, failing = os.fsync, threading.Event()

    def failing_fsync(fd):
        if failing.is_set():
            raise OSError(errno.ENOSPC, "No space left on device")
        fsync(fd)

    monkeypatch.setattr(os, "fsync", failing_fsync)
    with running(recorder):
        put_sample(recorder, 0)
        wait_until_recorded(recorder, 2)  # the sample and the event
        failing.set()
        for seq in range(1, 10):
            put_sample(recorder, seq)
        told.wait_for("record-trouble")
    assert recorder.counters().trouble
    assert recorder.counters().not_recorded >= 9
    (lost,) = [dict(event.facts) for event in told.events if event.code == "not-recorded"]
    assert lost[SAMPLES] == "9 (seq 1-9)"
    (part,) = files(tmp_path)
    (told_why,) = repair_directory(tmp_path)
    assert told_why.sentence == f"{part}: cannot be repaired, and stays: no space left on device"
    assert files(tmp_path) == [part]
    failing.clear()
    (repaired,) = repair_directory(tmp_path)
    assert samples_in(repaired.path) == [0]


def test_an_unfinished_file_is_locked_against_repair(tmp_path):
    recorder, _ = recorder_for(tmp_path)
    with running(recorder):
        put_sample(recorder, 0)
        wait_until_recorded(recorder, 1)
        (part,) = files(tmp_path)
        assert part.name.endswith(".mcap.part")
        assert repair_directory(tmp_path) == []
        with pytest.raises(BlockingIOError):
            repair(part)
        with LogReader(part) as reader:
            stored = [r for r in reader if isinstance(r, StoredMessage)]
        assert [m.message.data for m in stored if m.channel.topic == SAMPLES] == [sample_bytes(0)]
        put_sample(recorder, 1)
    assert samples_in(files(tmp_path)[0]) == [0, 1]
