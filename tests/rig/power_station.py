"""Records on the disk until the power is cut; runs in the virtual machine.

Repairs what the last cut left, as the daemon does at its start, then says each sample on stdout as
`put SEQ MONOTONIC_NS` and the end as `cut MONOTONIC_NS`: power_station.py DISK SECONDS
"""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from pathlib import Path

from logbook import PIXELS, put_sample, recorder_for

from vdms_rt.logfile.repair import repair_directory
from vdms_rt.wire import topics
from vdms_rt.wire import vdms_pb2 as pb

PICTURES_PER_S = 25
ROTATE_S = 2.0
"""So short that cuts fall on a file that is being closed, too."""


def say(*words: object) -> None:
    os.write(1, (" ".join(map(str, words)) + "\n").encode())


def cut() -> None:
    """At once, with all that is in this computer's memory."""
    say("cut", time.monotonic_ns())
    Path("/proc/sysrq-trigger").write_text("b")


def main(disk: str, seconds: float) -> None:
    for module in ("virtio_blk", "ext4"):
        subprocess.run(["modprobe", module], check=True)
    mounted = Path("/run/disk")
    mounted.mkdir()
    subprocess.run(["mount", "-t", "ext4", disk, mounted], check=True)
    directory = mounted / "recordings"
    directory.mkdir(exist_ok=True)
    for repaired in repair_directory(directory):
        say("repaired", repaired.sentence)
    recorder, _ = recorder_for(directory, rotate_s=ROTATE_S)
    threading.Thread(target=recorder.run, name="record").start()
    seq = 0
    cut_s = time.monotonic() + seconds
    while time.monotonic() < cut_s:
        patch = pb.Patch(data=os.urandom(20_000))
        data = pb.Pixels(frame_seq=seq, patches=[patch]).SerializeToString()
        at_ns = time.monotonic_ns()
        assert put_sample(recorder, seq)
        assert recorder.put(topics.PIXELS, PIXELS, 1_000_000 * seq, data)
        say("put", seq, at_ns)
        seq += 1
        time.sleep(1 / PICTURES_PER_S)
    assert recorder.counters().trouble == ""
    cut()


if __name__ == "__main__":
    main(sys.argv[1], float(sys.argv[2]))
