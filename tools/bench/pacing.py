"""How late `vdms-replay play` says what it plays, and how late it arrives at a subscriber.

python -m tools.bench.pacing RECORDING [--speed N ...]

Late is from the moment at which a message is due, by its own time and the speed, until it is handed
to the network; arrived, until another process has the sample. On a busy computer run it with
`chrt -f 10`, or it shows the others' load.
"""

from __future__ import annotations

import argparse
import multiprocessing
import socket
import time
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vdms_replay.player import Player, lateness
from vdms_replay.source import by_station
from vdms_replay.stage import Stage
from vdms_replay.track import Cue, Programme
from vdms_rt.config import Publish
from vdms_rt.model import Displacement
from vdms_rt.subscribe import subscribe
from vdms_rt.wire import topics

SILENCE_S = 3.0
LINKING_S = 2.0
"""For the subscriber to find the station."""


def listen(endpoint: str, answer: Connection) -> None:
    """Send (session, marker, seq, monotonic ns) of every sample until none comes any more."""
    got: list[tuple[int, str, int, int]] = []
    with subscribe("vdms/*/*/displacement", endpoint) as samples:
        answer.send("ready")
        while (sample := samples.get(SILENCE_S if got else 60.0)) is not None:
            if isinstance(sample.value, Displacement):
                d = sample.value
                got.append((d.session, d.marker, d.seq, sample.received_ns))
    answer.send(got)


def measure(paths: list[Path], speed: float) -> str:
    """Play once and return a row of the table."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    programme = Programme(paths, lambda _: None)
    due_ns: dict[tuple[int, str, int], int] = {}
    here, there = multiprocessing.Pipe()
    listener = multiprocessing.get_context("spawn").Process(target=listen, args=(endpoint, there))
    listener.start()
    here.recv()
    with Stage(programme, Publish(listen=(endpoint,)), speed) as stage:

        def say(cue: Cue, take: int) -> None:
            said_ns = time.monotonic_ns()
            stage.say(cue, take)
            if cue.topic is topics.DISPLACEMENT:
                d = cue.value
                due_ns[d.session, d.marker, d.seq] = said_ns - player.lateness_ns[-1]

        player = Player(programme, say, speed=speed)
        time.sleep(LINKING_S)
        player.run()
        got = here.recv()
    listener.join()
    programme.close()
    arrived_ms = [
        (at_ns - due_ns[session, marker, seq]) / 1e6 for session, marker, seq, at_ns in got
    ]
    late = lateness(player)
    own = [late["median_ms"], late["p99_ms"], late["most_ms"]]
    return row(speed, late["count"], own, np.array(arrived_ms))


def row(speed: float, count: int, own_ms: list[float], arrived_ms: NDArray[np.float64]) -> str:
    median, high = np.percentile(arrived_ms, [50, 99])
    figures = [*own_ms, median, high, arrived_ms.max()]
    return f"| {speed:g} | {count} | " + " | ".join(f"{ms:.3f}" for ms in figures) + " |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("files", nargs="+", type=Path, metavar="RECORDING")
    parser.add_argument("--speed", nargs="+", type=float, default=[1.0, 10.0, 100.0], metavar="N")
    arguments = parser.parse_args()
    paths = [path for files in by_station(arguments.files).values() for path in files]
    print("| speed | messages | late: median ms | 99 % | most | arrived: median | 99 % | most |")
    print("|---|---|---|---|---|---|---|---|")
    for speed in arguments.speed:
        print(measure(paths, speed), flush=True)


if __name__ == "__main__":
    main()
