"""How much memory each verb of vdms-replay takes at its peak, and how much processor time.

    python -m tools.bench.memory [--samples N] [--recording FILE] [VERB ...]

The recording is written by the product's own log writer: one marker in fields of NTSC with its
circles, no pixels; a second is lost every 100 000 samples, and one sample of 5000 is not valid.
Each verb runs in a process of its own, whose largest resident set the kernel gives; pages of files
that it has mapped count. A VERB is a line of the table, `info` or 'export --to mat' say, or how
several of them begin.
"""

from __future__ import annotations

import argparse
import json
import math
import multiprocessing
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from vdms_rt.logfile.writer import LogMessage, LogWriter
from vdms_rt.wire import topics
from vdms_rt.wire import vdms_pb2 as pb

FORMATS = ("csv", "parquet", "hdf5", "tdms", "uff58", "mat", "xlsx")
PERIOD_NS = 16_683_350
START_T_NS = 1_000_000_000_000
START_UTC_NS = 1_790_000_000_000_000_000
SESSION = 0x00C0FFEE12345678
LOST_EVERY, LOST = 100_000, 60
INVALID_EVERY = 5000
HEALTH_EVERY = 60
SYNC_EVERY = 10_000
REFERENCE_HZ = 100
CIRCLES_PX = ((100, 100), (300, 100), (100, 300), (300, 300))


def x_mm(t_s: float) -> float:
    """Return where the marker is: a motion that does not repeat."""
    swing = 5 + 4 * math.sin(0.01234 * t_s) * math.sin(0.0777 * t_s)
    return swing * math.sin(2 * math.pi * t_s) + 2 * math.sin(0.61803 * t_s)


def displacement(seq: int, place: int) -> pb.Displacement:
    """Return the sample of the field number `seq`, which is on place `place` of the grid."""
    t_ns = START_T_NS + place * PERIOD_NS
    x, lost = x_mm(place * PERIOD_NS / 1e9), seq % INVALID_EVERY == INVALID_EVERY - 1
    return pb.Displacement(
        session=SESSION,
        marker="m1",
        seq=place,
        frame_seq=place // 2,
        scan=pb.BOTTOM if place % 2 == 0 else pb.TOP,
        stamp_ns=START_T_NS + place // 2 * 2 * PERIOD_NS + 25_000_000,
        t_ns=t_ns,
        sigma_t_ns=50_000,
        utc_ns=t_ns - START_T_NS + START_UTC_NS,
        setup_revision=1,
        x_mm=math.nan if lost else x,
        y_mm=math.nan if lost else -x / 7,
        rotation_mrad=math.nan if lost else x / 50,
        sigma_x_mm=0.001,
        sigma_y_mm=0.002,
        residual_mm=0.003,
        valid=not lost,
        status=pb.NOT_FOUND if lost else 0,
        circles=[
            pb.Circle(x_px=cx_px + 3 * x, y_px=cy_px - x / 3, area_px=900, contrast=120)
            for cx_px, cy_px in CIRCLES_PX
        ],
    )


def write_recording(path: Path, samples: int) -> None:
    """Write a recording of so many samples."""
    log = LogWriter(path)
    number = 0

    def add(topic: topics.Topic, utc_ns: int, data: bytes) -> None:
        nonlocal number
        number += 1
        key = topic.key.format(station="bench", marker="m1")
        log.add(LogMessage(key, topic.message, number, utc_ns, utc_ns, data))

    run = pb.Run(
        session=SESSION,
        utc_ns=START_UTC_NS,
        station="bench",
        version="bench",
        effective_config=json.dumps({"marker": [{"name": "m1"}]}),
    )
    log.add_metadata("vdms", {"station": "bench"})
    add(topics.RUN, START_UTC_NS, run.SerializeToString())
    for seq in range(samples):
        sample = displacement(seq, seq + seq // LOST_EVERY * LOST)
        add(topics.DISPLACEMENT, sample.utc_ns, sample.SerializeToString())
        if seq % HEALTH_EVERY == 0:
            health = pb.Health(session=SESSION, utc_ns=sample.utc_ns, state="measuring")
            add(topics.HEALTH, sample.utc_ns, health.SerializeToString())
        if seq % SYNC_EVERY == 0:
            log.sync()
    log.close()


def write_reference(path: Path, samples: int) -> None:
    """Write what a reference instrument would have seen of the same motion, as a .mat file."""
    import scipy.io

    seconds = (samples + samples // LOST_EVERY * LOST) * PERIOD_NS / 1e9
    time_s = np.arange(round(seconds * REFERENCE_HZ)) / REFERENCE_HZ
    x = np.fromiter((x_mm(t_s) for t_s in time_s), np.float64, len(time_s))
    scipy.io.savemat(path, {"time_s": time_s, "x_mm": x})


def commands(recording: Path, reference: Path, out: Path) -> dict[str, list[str]]:
    """Return the command line of each line of the table."""
    file, to = str(recording), str(out)
    lines = {"info": ["info", file], "recover": ["recover", file, "--out", f"{to}.mcap"]}
    for name in FORMATS:
        lines[f"export --to {name}"] = ["export", file, "--to", name, "--out", to]
    lines["derive --velocity --to parquet"] = [
        "derive", file, "--velocity", "--to", "parquet", "--out", to,
    ]  # fmt: skip
    lines["derive --modes"] = ["derive", file, "--modes"]
    lines["report, PDF"] = ["report", file, "--out", f"{to}.pdf"]
    lines["compare"] = ["compare", file, "--reference", str(reference), "--column", "x_mm"]
    return lines


def peak(command: list[str]) -> tuple[float, float, str]:
    """Run a command line of vdms-replay; return its most memory in MB, its processor time in
    seconds, and, where it failed, what it said."""
    with tempfile.TemporaryFile("w+") as told:
        process = subprocess.Popen(
            [sys.executable, "-m", "vdms_replay", *command],
            stdout=subprocess.DEVNULL,
            stderr=told,
        )
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        told.seek(0)
        said = (told.read().strip().splitlines() or ["killed"])[-1] if process.returncode else ""
    return used.ru_maxrss * 1024 / 1e6, used.ru_utime + used.ru_stime, said


def apart(work: Callable[[Path, int], None], *arguments: object) -> None:
    """Call a function in a process of its own: what a process has held counts for those that it
    starts."""
    process = multiprocessing.get_context("spawn").Process(target=work, args=arguments)
    process.start()
    process.join()
    if process.exitcode:
        raise SystemExit(f"the recording could not be written (exit status {process.exitcode})")


def rows(recording: Path, samples: int, wanted: list[str], directory: Path) -> Iterator[str]:
    reference = directory / "reference.mat"
    for name, command in commands(recording, reference, directory / "out").items():
        if wanted and not name.startswith(tuple(wanted)):
            continue
        if name == "compare":
            apart(write_reference, reference, samples)
        most_mb, spent_s, said = peak(command)
        sizes = [path.stat().st_size for path in directory.glob("out*")]
        for path in directory.glob("out*"):
            path.unlink()
        size = f"{sum(sizes) / 1e6:.1f} MB" if sizes else ""
        yield f"| `{name}` | {most_mb:.0f} MB | {spent_s:.1f} s | {said or size} |"


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m tools.bench.memory",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("verbs", nargs="*", metavar="VERB", help="(default: all)")
    parser.add_argument("--samples", type=int, default=1_000_000, metavar="N", help="(1 000 000)")
    parser.add_argument(
        "--recording",
        type=Path,
        metavar="FILE",
        help="written if it is not there, and kept; one that is there must have N samples",
    )
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        directory = Path(name)
        recording = options.recording or directory / "recording.mcap"
        if not recording.exists():
            apart(write_recording, recording, options.samples)
        size_mb = recording.stat().st_size / 1e6
        print(f"{options.samples} samples, {size_mb:.1f} MB\n")
        print("| verb | most memory | processor time | file |\n|---|---|---|---|")
        for row in rows(recording, options.samples, options.verbs, directory):
            print(row, flush=True)


if __name__ == "__main__":
    main()
