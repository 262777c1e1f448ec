"""`vdms-rt run` as a process, watched from outside: what it says, publishes and records."""

import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from loopback import free_endpoint
from mcap.reader import make_reader
from rig.devices import wait_for
from rig.frames import PERIOD_FRAMES, position_mm

from vdms_rt.subscribe import subscribe
from vdms_rt.wire import vdms_pb2 as pb

DEADLINE_S = 150.0
"""How long a test waits for what must come; reached only when it fails."""

_KINDS = {
    "displacement": pb.Displacement,
    "end": pb.End,
    "event": pb.Event,
    "run": pb.Run,
}


def away_mm(samples: Sequence[pb.Displacement]) -> np.ndarray:
    """Return how far each position is from the nearest one that a field of the rig's frames shows;
    they lie up to 1 mm apart."""
    positions_mm = np.array([(s.x_mm, s.y_mm) for s in samples])
    shown_mm = np.array([(0.0, 0.0), *(position_mm(half / 2) for half in range(2 * PERIOD_FRAMES))])
    return np.linalg.norm(positions_mm[:, None] - shown_mm, axis=2).min(axis=1)


class Samples:
    """A station's displacements as they come. A context manager."""

    def __init__(self, endpoint: str) -> None:
        self._subscription = subscribe("vdms/*/*/displacement", connect=endpoint)

    def __enter__(self) -> "Samples":
        return self

    def __exit__(self, *_: object) -> None:
        self._subscription.close()

    def wait_for_valid(self, count: int, after_ns: int = 0):
        """Return the first of so many measurements that were exposed after a moment, when the last
        of them is there."""
        first = None
        while (sample := self._subscription.get(DEADLINE_S)) is not None:
            if sample.value.valid and sample.value.t_ns > after_ns:
                first = first or sample.value
                count -= 1
                if not count:
                    return first
        raise AssertionError("no displacement any more")


class Station:
    """A running station with the default marker. A context manager, which ends it."""

    def __init__(self, directory: Path, device: str, **v4l2: object) -> None:
        """`device` and `v4l2` go into that section of its configuration. Its camera has no motion
        blur, as the rig's pictures have none."""
        endpoint = free_endpoint()
        settings = "\n".join(f"{key} = {value!r}" for key, value in v4l2.items())
        config = directory / "vdms-rt.toml"
        config.write_text(
            f"""
source = "v4l2"
[station]
name = "rig"
[v4l2]
device = "{device}"
{settings}
[camera]
exposure_ms = 0.0
[setup]
directory = "{directory}"
[publish]
listen = ["{endpoint}"]
[record]
directory = "{directory / "recordings"}"
"""
        )
        self._start(directory, endpoint, "--config", str(config))

    @classmethod
    def without_configuration(cls, directory: Path) -> "Station":
        """Return one that was given no configuration, in a home of its own."""
        station = cls.__new__(cls)
        station._start(directory, "tcp/127.0.0.1:7447")
        return station

    def _start(self, directory: Path, endpoint: str, *arguments: str) -> None:
        self._endpoint = endpoint
        self._log = directory / "station.log"
        self._recordings = directory / "recordings"
        with self._log.open("w") as log:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "vdms_rt", "run", *arguments],
                stderr=log,
                cwd=directory,
                env={**os.environ, "HOME": str(directory)},
            )

    def __enter__(self) -> "Station":
        return self

    def __exit__(self, *_: object) -> None:
        if self._process.poll() is None:
            self._process.kill()
            self._process.wait()

    @property
    def pid(self) -> int:
        """Of its process, which runs."""
        assert self._process.poll() is None, self.said
        return self._process.pid

    @property
    def said(self) -> str:
        return self._log.read_text()

    def wait_until_said(self, words: str, times: int = 1) -> None:
        """Wait for words on its standard error, the so-manieth time; fails when it ends before."""

        def heard() -> bool:
            assert self._process.poll() is None, self.said
            return self.said.count(words) >= times

        try:
            wait_for(heard, repr(words), DEADLINE_S)
        except AssertionError as error:
            raise AssertionError(f"{error}; it said:\n{self.said}") from None

    def samples(self) -> Samples:
        """Return its displacements from now on."""
        return Samples(self._endpoint)

    def wait_for_frames(self, count: int) -> None:
        """Wait, by the health that it publishes, until it has captured so many frames more, and
        measured both fields of so many."""
        first = None
        with subscribe("vdms/rig/health", connect=self._endpoint) as healths:
            while (sample := healths.get(DEADLINE_S)) is not None:
                now = sample.value
                first = first or now
                measured = now.measured - first.measured
                if now.captured - first.captured >= count and measured >= 2 * count:
                    return
        raise AssertionError(f"no health any more; it said:\n{self.said}")

    def terminate(self) -> int:
        """Send SIGTERM, as systemd does, and return the exit status."""
        self._process.send_signal(signal.SIGTERM)
        return self._process.wait(DEADLINE_S)

    def recorded(self, topic: str) -> list:
        """Return a topic's messages from its only recording, which must be whole."""
        (path,) = self._recordings.iterdir()
        assert path.suffix == ".mcap"
        with path.open("rb") as file:
            reader = make_reader(file, validate_crcs=True)
            assert reader.get_summary() is not None
            return [
                _KINDS[topic].FromString(message.data)
                for _, channel, message in reader.iter_messages(log_time_order=False)
                if channel.topic.endswith(f"/{topic}")
            ]
