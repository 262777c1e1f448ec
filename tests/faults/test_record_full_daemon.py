"""A station whose disk gets full, and one whose disk is slow: it measures, publishes, and tells."""

from __future__ import annotations

import contextlib
import os
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from hosts import ROOT
from logbook import SAMPLES, put_sample, read_whole, recorder_for, running, samples_in
from reading import Reader

from vdms_rt.logfile.repair import repair_directory

SLOW_S = 2.0


@pytest.fixture
def disk(tmp_path):
    """A file system of 64 MB."""
    directory = tmp_path / "disk"
    directory.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=64m", "tmpfs", str(directory)]
    done = subprocess.run(mount, capture_output=True, text=True, check=False)
    if done.returncode:
        pytest.skip(f"needs to mount a small file system: {done.stderr.strip()}")
    yield directory
    subprocess.run(["umount", str(directory)], check=True)


class Station:
    """A daemon at the virtual table, recording whole frames, and what it says."""

    def __init__(self, directory: Path, recordings: Path) -> None:
        with socket.socket() as taken:
            taken.bind(("127.0.0.1", 0))
            self.address = f"tcp/127.0.0.1:{taken.getsockname()[1]}"
        config = directory / "vdms.toml"
        config.write_text(
            f"""
source = "table"
[station]
name = "lab"
[table]
fill = 0.3
[process]
ring_slots = 1024
method = "otsu"
sampling = "frame"
[setup]
directory = "{directory}"
[publish]
listen = ["{self.address}"]
[record]
directory = "{recordings}"
pixels = "frames"
free_mb = 20
"""
        )
        self.process = subprocess.Popen(
            [sys.executable, "-m", "vdms_rt", "run", "--config", str(config)],
            stderr=subprocess.PIPE,
            text=True,
        )
        self.said: list[str] = []
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._read, name="station")
        self._thread.start()

    def _read(self) -> None:
        assert self.process.stderr is not None
        for line in self.process.stderr:
            with self._changed:
                self.said.append(line)
                self._changed.notify_all()
        self.process.stderr.close()

    def wait_until_said(self, what: str) -> None:
        with self._changed:
            found = self._changed.wait_for(lambda: any(what in line for line in self.said), 90)
        assert found, "".join(self.said)

    def end(self) -> int:
        self.process.terminate()
        status = self.process.wait(60)
        self._thread.join()
        return status


def fill(directory: Path) -> Path:
    """Take all the room that is left, as another program might."""
    filler = directory / "filler"
    with contextlib.suppress(OSError), filler.open("ab", buffering=0) as file:
        while file.write(bytes(65536)):
            pass
    return filler


@pytest.mark.slow
@pytest.mark.timeout(400)
def test_on_a_full_disk_no_published_sample_is_lost(tmp_path, disk):
    station = Station(tmp_path, disk)
    listening = None
    try:
        station.wait_until_said("recording into")
        listening = Reader(
            subprocess.Popen(
                [sys.executable, ROOT / "tests" / "reader_loop.py", station.address],
                stdout=subprocess.PIPE,
                text=True,
                env=os.environ | {"PYTHONPATH": str(ROOT / "tests")},
            )
        )
        # The frames themselves fill it until the room is kept for displacements.
        station.wait_until_said("from now on no pixels are recorded")
        filler = fill(disk)
        while not any("recording pauses" in line for line in station.said):
            filler = fill(disk)  # it also takes what a closed buffer gave back
            time.sleep(0.05)
        (session,) = listening.seen.samples
        at_pause = listening.newest(session)
        listening.wait(session, at_pause + 60)
        filler.unlink()
        station.wait_until_said("recording again")
        listening.wait(session, listening.newest(session) + 60)
    finally:
        status = station.end()
        seen = listening.end() if listening is not None else None
    said = "".join(station.said)
    assert status == 0, said
    assert "Traceback" not in said
    (published,) = seen.samples.values()
    # A busy machine comes too late for frames of the table; on the way nothing may be lost.
    assert not any(on_the_way for *_, on_the_way in seen.missed)
    assert published == sorted(set(published))

    # The files are whole: nothing is left to repair, and every sample is in one.
    assert repair_directory(disk) == []
    whole = sorted(disk.glob("*.mcap"))
    recorded = [seq for path in whole for seq in samples_in(path)]
    assert recorded == sorted(set(recorded))
    assert set(published) <= set(recorded)
    events = [m.code for path in whole for t, _, m in read_whole(path) if t == "vdms/lab/event"]
    assert {"room-low", "record-trouble", "record-resumed", "not-recorded"} <= set(events)


def test_a_disk_that_takes_two_seconds_loses_nothing(tmp_path, monkeypatch):
    fsync = os.fsync

    def slow_fsync(fd: int) -> None:
        time.sleep(SLOW_S)  # the fault itself
        fsync(fd)

    monkeypatch.setattr(os, "fsync", slow_fsync)
    recorder, told = recorder_for(tmp_path, rotate_s=4.0)
    seq = 0
    with running(recorder):
        while told.codes().count("slow-disk") < 3:
            assert put_sample(recorder, seq)
            seq += 1
            time.sleep(1 / 60)
    assert recorder.counters().not_recorded == 0
    assert "record-trouble" not in told.codes()
    paths = sorted(tmp_path.iterdir())
    assert [s for path in paths for s in samples_in(path)] == list(range(seq))
    assert SAMPLES in {topic for topic, _, _ in read_whole(paths[0])}
