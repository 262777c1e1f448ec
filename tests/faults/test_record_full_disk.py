"""A full disk: recording pauses and says so, goes on by itself, and loses what it says it lost."""

from __future__ import annotations

import contextlib
import os
import subprocess
import threading

import pytest
from logbook import (
    PIXELS,
    SAMPLES,
    files,
    put_sample,
    read_whole,
    recorder_for,
    running,
    samples_in,
)

from vdms_rt.logfile.repair import repair_directory
from vdms_rt.wire import topics
from vdms_rt.wire import vdms_pb2 as pb


@pytest.fixture
def small_disk(tmp_path):
    directory = tmp_path / "small"
    directory.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=4m", "tmpfs", str(directory)]
    done = subprocess.run(mount, capture_output=True, text=True, check=False)
    if done.returncode:
        pytest.skip(f"needs to mount a small file system: {done.stderr.strip()}")
    yield directory
    subprocess.run(["umount", str(directory)], check=True)


def put_picture(recorder, seq):
    """Put a sample and 50 kB of pixels; return whether each was taken."""
    patch = pb.Patch(codec="raw8", data=os.urandom(50_000))
    data = pb.Pixels(frame_seq=seq, patches=[patch]).SerializeToString()
    sample = put_sample(recorder, seq)
    return sample, recorder.put(topics.PIXELS, PIXELS, 1_000_000 * seq, data)


def fill(recorder, told, seq):
    """Put pictures until recording pauses; return the next seq."""
    while "record-trouble" not in told.codes():
        assert all(put_picture(recorder, seq))
        seq += 1
        threading.Event().wait(0.005)
    return seq


def test_recording_pauses_and_goes_on_when_there_is_room(small_disk):
    filler = small_disk / "filler"
    filler.write_bytes(bytes(2_000_000))
    recorder, told = recorder_for(small_disk, queue_messages=200)
    with running(recorder):
        seq = fill(recorder, told, 0)
        event = told.wait_for("record-trouble")
        assert "no space left on device" in event.text
        assert recorder.counters().trouble == event.text
        kept = {number: put_sample(recorder, number) for number in range(seq, seq + 400)}
        assert not all(kept.values())
        filler.unlink()
        told.wait_for("record-resumed")
        told.wait_for("not-recorded")
        kept[seq + 400] = put_sample(recorder, seq + 400)
        assert kept[seq + 400]
    assert recorder.counters().trouble == ""
    (path,) = [path for path in files(small_disk) if path.suffix == ".mcap"]
    taken = [*range(seq), *(number for number, was in kept.items() if was)]
    assert samples_in(path) == taken
    dropped = [number for number, was in kept.items() if not was]
    (lost,) = [dict(e.facts)[SAMPLES] for e in told.events if e.code == "not-recorded"]
    assert lost == f"{len(dropped)} (seq {dropped[0]}-{dropped[-1]})"
    assert recorder.counters().not_recorded == len(dropped)
    assert told.codes().count("record-trouble") == 1
    pixels = [m.frame_seq for topic, _, m in read_whole(path) if topic == PIXELS]
    assert pixels == list(range(seq))


def test_a_disk_that_stays_full_leaves_a_file_that_the_next_start_repairs(small_disk):
    filler = small_disk / "filler"
    filler.write_bytes(bytes(2_000_000))
    recorder, told = recorder_for(small_disk)
    with running(recorder):
        seq = fill(recorder, told, 0)
    counters = recorder.counters()
    assert "no space left" in counters.trouble
    assert counters.not_recorded > 0
    filler.unlink()
    (repaired,) = repair_directory(small_disk)
    found = samples_in(repaired.path)
    assert found == list(range(len(found)))
    lost = next(dict(e.facts).get(SAMPLES) for e in told.events if e.code == "not-recorded")
    if len(found) < seq:
        assert lost.startswith(f"{seq - len(found)} (seq {len(found)}")


def test_a_disk_that_is_full_from_the_start(small_disk):
    filler = small_disk / "filler"
    with contextlib.suppress(OSError), filler.open("wb") as file:
        while True:
            file.write(bytes(65536))
    recorder, told = recorder_for(small_disk)
    with running(recorder):
        put_sample(recorder, 0)
        told.wait_for("record-trouble")
        put_sample(recorder, 1)
        filler.unlink()
        told.wait_for("record-resumed")
        put_sample(recorder, 2)
    (path,) = files(small_disk)
    assert samples_in(path) == [0, 1, 2]
    assert recorder.counters().not_recorded == 0
