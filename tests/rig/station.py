"""`vdms-rt run` as a process, watched from outside: what it says, publishes and records."""

import signal
import subprocess
import sys
from pathlib import Path

from loopback import free_endpoint
from mcap.reader import make_reader
from rig.devices import wait_for

from vdms_rt.subscribe import subscribe
from vdms_rt.wire import vdms_pb2 as pb

DEADLINE_S = 90.0
"""How long a test waits for what must come; reached only when it fails."""

_KINDS = {"displacement": pb.Displacement, "end": pb.End, "run": pb.Run}


class Station:
    """A running station with the default marker, whose camera has no motion blur, as the rig's
    pictures have none. A context manager, which ends it."""

    def __init__(self, directory: Path, device: str, **v4l2: object) -> None:
        """`device` and `v4l2` go into that section of its configuration."""
        self._endpoint = free_endpoint()
        self._log = directory / "station.log"
        self._recordings = directory / "recordings"
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
listen = ["{self._endpoint}"]
[record]
directory = "{self._recordings}"
"""
        )
        with self._log.open("w") as log:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "vdms_rt", "run", "--config", str(config)], stderr=log
            )

    def __enter__(self) -> "Station":
        return self

    def __exit__(self, *_: object) -> None:
        if self._process.poll() is None:
            self._process.kill()
            self._process.wait()

    @property
    def said(self) -> str:
        return self._log.read_text()

    def wait_until_said(self, words: str) -> None:
        """Wait for words on its standard error; fails when it ends before."""

        def heard() -> bool:
            assert self._process.poll() is None, self.said
            return words in self.said

        wait_for(heard, repr(words), DEADLINE_S)

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
