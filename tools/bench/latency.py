"""How old a sample is when another program has it: from the buffer in hand to the callback.

Four processes on this computer. A station: the product's ring, process stage, recorder and
publisher, fed with drawn interlaced frames, 29.97 a second, so 59.94 samples a second, on the CPU
that the product gives to capture and process of a grabber; a reader
with `vdms_rt.subscribe(on_sample=...)`; and beside them, in the same run, a bare zenoh `put` and a
bare zenoh subscriber with messages of the same size at the same rate. All stamps are of one
monotonic clock. `measuring` is the time from the moment the process stage has the frame to the
finished sample (for the second field of a frame that includes the first one's). The ratio is
(total - measuring) / bare, of the medians. `with values` ends not when the callback begins but when
it has read the sample's values, which no bare subscriber has.

    python -m tools.bench.latency [--minutes 10] [--loads idle busy] [--fifo] [--json]

`busy` is with a process on each core that does nothing but count. `--fifo` gives all four processes
the real-time priority that the service has; it needs root.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np
import zenoh
from numpy.typing import NDArray

from tools.bench.speed import Scene, machine
from vdms_rt.config import parse_config
from vdms_rt.find import Search
from vdms_rt.model import Damage, Displacement, Frame, Scan
from vdms_rt.outlet import Outlet
from vdms_rt.process.loop import Processor
from vdms_rt.publish import Publisher
from vdms_rt.realtime import claimed_cpu, stay_on
from vdms_rt.record import Recorder
from vdms_rt.ring import Lease, Ring
from vdms_rt.subscribe import Sample, subscribe
from vdms_rt.wire import vdms_pb2 as pb
from vdms_rt.wire.session import SESSION

PERIOD_NS = 33_366_667
BARE_PERIOD_NS = PERIOD_NS // 2 + 16_683
"""A thousandth longer than the samples', so that it meets them in every phase every 17 s: what one
phase makes of the two would otherwise be the figure of a whole run."""
SAMPLE_RATE_HZ = 60.0
SETTLE_S = 5.0
"""Not counted: the reference, the readers' history, caches."""
PAYLOAD_BYTES = 185
"""Of a displacement with four circles."""
FIFO_PRIORITY = 10
PARTS = (50.0, 99.0, 99.9, 100.0)
PORTS = {"station": 17451, "bare": 17452}

Stamps = NDArray[np.int64]


class StampedRing(Ring):
    """Notes when a reader has a frame."""

    def __init__(self, slots: int) -> None:
        super().__init__(slots, live=True)
        self.taken_ns: dict[int, int] = {}

    def take(self, timeout_s: float) -> Lease | None:
        lease = super().take(timeout_s)
        if lease is not None:
            self.taken_ns[lease.frame.seq] = time.monotonic_ns()
        return lease


class StampedOutlet(Outlet):
    """Notes when a sample is finished, and what it weighs."""

    def __init__(self) -> None:
        super().__init__("bench", ("m1",), 1, live=True, patches="regions")
        self.measured: list[tuple[int, int, int, int]] = []
        """(seq, frame, in hand, finished)."""

    def displacement(self, sample: Displacement) -> None:
        now_ns = time.monotonic_ns()
        self.measured.append((sample.seq, sample.frame_seq, sample.stamp_ns, now_ns))
        super().displacement(sample)


def station(out: Path, ended: threading.Event, ready: Callable[[], None]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        config = parse_config(
            f'[publish]\nlisten = ["tcp/127.0.0.1:{PORTS["station"]}"]\n'
            f'[setup]\nreference_pictures = 10\n[record]\ndirectory = "{folder}"',
            "bench",
        )
        scene = Scene.drawn(cycle_frames=30)
        cv2.setNumThreads(1)
        ready()
        ring, outlet = StampedRing(64), StampedOutlet()
        search = Search([m.shape for m in config.marker])
        outlet.recorder = Recorder(
            config.record,
            "bench",
            True,
            lambda: pb.Run().SerializeToString(),
            lambda _: pb.End().SerializeToString(),
            outlet.event,
        )
        processor = Processor(config, 1, None, ring, search, outlet)
        with (
            claimed_cpu() as cpu,
            Publisher(
                config.publish, "bench", ["m1"], sample_rate_hz=SAMPLE_RATE_HZ
            ) as outlet.publisher,
        ):

            def together(body: Callable[[], None]) -> None:
                if cpu is not None:
                    stay_on(cpu)
                body()

            bodies = {
                "find": lambda: search.run(ended),
                "record": outlet.recorder.run,
                "process": lambda: together(lambda: processor.run(ended)),
                "capture": lambda: together(lambda: feed(ring, scene, ended)),
            }
            threads = {
                name: threading.Thread(target=body, name=name) for name, body in bodies.items()
            }
            for thread in threads.values():
                thread.start()
            threads["capture"].join()
            ring.close()
            threads["process"].join()
            outlet.recorder.finish("over")
            for thread in threads.values():
                thread.join()
    frames = np.array([(*m, ring.taken_ns[m[1]]) for m in outlet.measured], dtype=np.int64)
    np.save(out, frames)


def feed(ring: Ring, scene: Scene, ended: threading.Event) -> None:
    """Put a frame into the ring at each period; its stamp is the moment it is all there."""
    ring.fit(*scene.stills[0].shape)
    due_ns = time.monotonic_ns()
    n = 0
    while not ended.wait(max(0.0, (due_ns - time.monotonic_ns()) / 1e9)):
        stills = len(scene.stills)
        images = scene.stills if n < 2 * stills else scene.interlaced
        slot = ring.begin(0)
        if slot is not None:
            slot.image[:] = images[n % len(images)]
            now_ns = time.monotonic_ns()
            frame = Frame(
                n, now_ns, now_ns, 1000, 0, 0, PERIOD_NS, slot.view, Scan.BOTTOM_FIRST, Damage.NONE
            )
            ring.commit(slot, frame)
        n += 1
        due_ns += PERIOD_NS


def reader(out: Path, ended: threading.Event, ready: Callable[[], None]) -> None:
    came: list[tuple[int, int, int]] = []
    ready()

    def on_sample(sample: Sample) -> None:
        now_ns = time.monotonic_ns()
        if isinstance(sample.value, Displacement):
            came.append((sample.value.seq, now_ns, time.monotonic_ns()))

    with subscribe(
        "vdms/*/*/displacement", f"tcp/127.0.0.1:{PORTS['station']}", on_sample=on_sample
    ):
        ended.wait()
    np.save(out, np.array(came, dtype=np.int64))


def session(mode: str, where: str) -> zenoh.Session:
    config = zenoh.Config()
    settings = {"mode": mode, where: [bare_endpoint()], "connect/timeout_ms": 60_000}
    for name, value in {**SESSION, **settings}.items():
        config.insert_json5(name, json.dumps(value))
    return zenoh.open(config)


def bare_endpoint() -> str:
    return f"tcp/127.0.0.1:{PORTS['bare']}"


def bare_put(out: Path, ended: threading.Event, ready: Callable[[], None]) -> None:
    put: list[tuple[int, int]] = []
    ready()
    with session("peer", "listen/endpoints") as own, own.declare_publisher("bare") as publisher:
        due_ns = time.monotonic_ns() + BARE_PERIOD_NS
        while not ended.wait(max(0.0, (due_ns - time.monotonic_ns()) / 1e9)):
            data = len(put).to_bytes(8, "big").ljust(PAYLOAD_BYTES, b"x")
            now_ns = time.monotonic_ns()
            publisher.put(data)
            put.append((len(put), now_ns))
            due_ns += BARE_PERIOD_NS
    np.save(out, np.array(put, dtype=np.int64))


def bare_reader(out: Path, ended: threading.Event, ready: Callable[[], None]) -> None:
    came: list[tuple[int, int]] = []

    def on_sample(sample: zenoh.Sample) -> None:
        now_ns = time.monotonic_ns()
        came.append((int.from_bytes(sample.payload.to_bytes()[:8], "big"), now_ns))

    ready()
    with (
        session("client", "connect/endpoints") as own,
        own.declare_subscriber("bare", on_sample),
    ):
        ended.wait()
    np.save(out, np.array(came, dtype=np.int64))


ROLES: dict[str, Callable[[Path, threading.Event, Callable[[], None]], None]] = {
    "station": station,
    "reader": reader,
    "bare_put": bare_put,
    "bare_reader": bare_reader,
}


def run_role(role: str, out: Path, fifo: bool) -> None:
    ended = threading.Event()

    def ready() -> None:
        if fifo:  # threads that come later inherit it
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(FIFO_PRIORITY))
        print("up", flush=True)

    signal.signal(signal.SIGTERM, lambda *_: ended.set())
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    ROLES[role](out, ended, ready)


def run(load: str, minutes: float, folder: Path, fifo: bool) -> dict[str, list[float]]:
    """Return for total, measuring, the rest and bare zenoh the parts of `PARTS`, microseconds."""
    burning = [
        multiprocessing.get_context("spawn").Process(target=count, daemon=True)
        for _ in range(os.cpu_count() or 1 if load == "busy" else 0)
    ]
    for process in burning:
        process.start()
    files = {role: folder / f"{load}-{role}.npy" for role in ROLES}
    children: list[subprocess.Popen[bytes]] = []
    try:
        for role, file in files.items():
            command = [sys.executable, "-m", __spec__.name, "--role", role, str(file)]
            child = subprocess.Popen([*command, *["--fifo"] * fifo], stdout=subprocess.PIPE)
            children.append(child)
            with child.stdout as said:
                if not said.readline():
                    raise SystemExit(f"{role} did not start")
        time.sleep(SETTLE_S + 60 * minutes)
    finally:
        for child in reversed(children):
            child.terminate()
        for process in burning:
            process.kill()
    ended = [child.wait(60) for child in children]
    if any(ended):
        raise SystemExit("a part of the bench failed")
    return table({role: np.load(file) for role, file in files.items()})


def table(stamps: dict[str, Stamps]) -> dict[str, list[float]]:
    frames = stamps["station"]
    # The bare reader starts last.
    since_ns = stamps["bare_reader"][0, 1] + SETTLE_S * 1e9
    said = {int(seq): (hand, taken, done) for seq, _, hand, done, taken in frames}
    came = [
        (*said[int(seq)], at, read)
        for seq, at, read in stamps["reader"]
        if said[int(seq)][0] > since_ns
    ]
    hand, taken, done, at, read = np.array(came, dtype=np.int64).T
    put = dict(stamps["bare_put"].tolist())
    bare = np.array([at - put[n] for n, at in stamps["bare_reader"] if put[n] > since_ns])
    spent = {
        "total": at - hand,
        "measuring": done - taken,
        "the rest": (at - hand) - (done - taken),
        "with values": (read - hand) - (done - taken),
        "bare zenoh": bare,
    }
    return {
        name: [float(np.percentile(ns, p)) / 1e3 for p in PARTS] + [float(len(ns))]
        for name, ns in spent.items()
    }


def count() -> None:
    n = 0
    while True:
        n += 1


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--minutes", type=float, default=10.0, help="for each load (10)")
    parser.add_argument("--loads", nargs="+", choices=("idle", "busy"), default=["idle", "busy"])
    parser.add_argument("--fifo", action="store_true", help="with real-time priority")
    parser.add_argument("--json", action="store_true", help="print JSON instead of the table")
    parser.add_argument("--role", nargs=2, metavar=("ROLE", "FILE"), help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    if options.role:
        run_role(options.role[0], Path(options.role[1]), options.fifo)
        return
    with tempfile.TemporaryDirectory() as folder:
        results = {
            load: run(load, options.minutes, Path(folder), options.fifo) for load in options.loads
        }
    ratios = {load: r["the rest"][0] / r["bare zenoh"][0] for load, r in results.items()}
    if options.json:
        about = {"machine": machine(), "minutes": options.minutes, "parts": PARTS}
        print(json.dumps(about | {"us": results, "ratio": ratios}, indent=1))
        return
    print(", ".join(f"{name} {value}" for name, value in machine().items()))
    print(f"{options.minutes:g} min each, 59.94 samples/s, microseconds\n")
    print(f"{'':20}{'p50':>10}{'p99':>10}{'p99.9':>10}{'max':>10}{'samples':>10}")
    for load, result in results.items():
        for name, row in result.items():
            print(f"{load + ', ' + name:20}" + "".join(f"{value:10.0f}" for value in row))
        print(f"{load + ', ratio':20}{ratios[load]:10.2f}\n")


if __name__ == "__main__":
    main()
