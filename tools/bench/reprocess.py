"""How fast recorded pixels are measured again, and where the time goes.

    .venv/bin/python -m tools.bench.reprocess [RECORDING] [--seconds 120]

Without a RECORDING the virtual table is recorded first: NTSC fields, 720 x 480, 10 mm at 1 Hz, at
full pace. The profile is of one core, in processor time, each stage with those before it taken off;
the best of three runs, as another program on the machine only ever adds. Then the whole verb on one
core and on all, by the clock.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from vdms_replay.pieces import AsItWas, Terms
from vdms_replay.remeasure import CHECKPOINT, PIXELS, SET_UP, Change, Piece, remeasure
from vdms_replay.reprocess import reprocess
from vdms_replay.source import Source, open_log
from vdms_rt.logfile.reader import StoredMessage
from vdms_rt.wire import vdms_pb2 as pb
from vdms_rt.wire.convert import paste_pixels

RUNS = 3
FRAME_RATE_HZ = 30000 / 1001
CONFIG = """
source = "table"
[table]
pace = "fast"
frames = {frames}
[setup]
load = false
store = false
[publish]
enabled = false
[record]
directory = "{directory}"
"""


def recorded(directory: Path, seconds: float) -> Path:
    """Record the virtual table and return the file."""
    config = directory / "table.toml"
    config.write_text(
        CONFIG.format(frames=round(seconds * FRAME_RATE_HZ), directory=directory / "recordings")
    )
    command = [sys.executable, "-m", "vdms_rt", "run", "--config", str(config)]
    subprocess.run(command, check=True, stderr=subprocess.DEVNULL)
    (path,) = (directory / "recordings").iterdir()
    return path


def messages(path: Path) -> Iterator[tuple[str, bytes]]:
    with open_log(path) as reader:
        for record in reader:
            if isinstance(record, StoredMessage) and record.schema is not None:
                yield record.schema.name, record.message.data


def read(path: Path) -> None:
    for _ in messages(path):
        pass


def decode(path: Path) -> None:
    image = np.zeros((0, 0), np.uint8)
    for type_, data in messages(path):
        if type_ == PIXELS:
            pixels = pb.Pixels.FromString(data)
            if image.shape != (pixels.height_px, pixels.width_px):
                image = np.zeros((pixels.height_px, pixels.width_px), np.uint8)
            paste_pixels(pixels, image)


def measure(path: Path, session: int) -> None:
    pieces = AsItWas(Terms(session, "auto", Change(), None))

    def work() -> Iterator[object]:
        for type_, data in messages(path):
            if type_ in (PIXELS, CHECKPOINT, SET_UP):
                yield from pieces.take(type_, data)
        yield from pieces.end()

    for piece in work():
        assert isinstance(piece, Piece)
        remeasure(piece)


def least_cpu_s(body: Callable[[], object]) -> float:
    """Return the processor time of the best run."""
    spent = []
    for _ in range(RUNS):
        begin_s = time.process_time()
        body()
        spent.append(time.process_time() - begin_s)
    return min(spent)


@contextmanager
def on_one_core() -> Iterator[None]:
    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(cores)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, cores)


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m tools.bench.reprocess",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("recording", nargs="?", type=Path)
    parser.add_argument("--seconds", type=float, default=120.0, help="to record (120)")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        directory = Path(name)
        path = options.recording or recorded(directory, options.seconds)
        show(path, directory / "again.mcap")


def show(path: Path, out: Path) -> None:
    session = next(
        item.value.session
        for item in Source([path]).items(("vdms.Run",))
        if isinstance(getattr(item, "value", None), pb.Run)
    )

    def whole(jobs: int) -> Callable[[], object]:
        return lambda: reprocess(path, out=out, jobs=jobs, force=True)

    account = reprocess(path, out=out, jobs=1, force=True)
    frames, seconds = account.frames, account.recorded_s
    size_mb = path.stat().st_size / 1e6
    print(f"{frames} frames, {seconds:.1f} s, {size_mb:.1f} MB")
    print(f"{account.same} of {account.samples} samples the same bit for bit\n")
    with on_one_core():
        totals_s = [
            least_cpu_s(lambda: read(path)),
            least_cpu_s(lambda: decode(path)),
            least_cpu_s(lambda: measure(path, session)),
            least_cpu_s(whole(1)),
        ]
    names = (
        "read, check, decompress",
        "decode, put the picture together",
        "measure",
        "write, hold against the record",
    )
    print(f"{'one core, processor time':36}{'us a frame':>12}{'part':>8}")
    before_s = 0.0
    for text, total_s in zip(names, totals_s, strict=True):
        own_s, before_s = total_s - before_s, total_s
        print(f"{text:36}{1e6 * own_s / frames:12.1f}{100 * own_s / totals_s[-1]:7.1f}%")
    print(f"{'all':36}{1e6 * before_s / frames:12.1f}{seconds / before_s:7.1f} x real time\n")
    cores = len(os.sched_getaffinity(0))
    for jobs in sorted({1, cores}):
        took_s = min(reprocess(path, out=out, jobs=jobs, force=True).took_s for _ in range(RUNS))
        many = "process" if jobs == 1 else "processes"
        print(f"the whole verb, {jobs} {many}: {took_s:.2f} s, {seconds / took_s:.1f} x real time")


if __name__ == "__main__":
    main()
