"""What the tests of recording share: a recorder with its thread, and readers that are not ours."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from mcap.reader import NonSeekingReader, make_reader
from mcap.records import Schema

from vdms_rt.config import Record
from vdms_rt.model import Event
from vdms_rt.record import Recorder
from vdms_rt.wire import convert, topics
from vdms_rt.wire import vdms_pb2 as pb

RERUN = Path(sys.executable).with_name("rerun")
SAMPLES = "vdms/lab/m1/displacement"
PIXELS = "vdms/lab/pixels"
EVENTS = "vdms/lab/event"
SETUPS = "vdms/lab/setup"
SESSION = 0x1234


class Told:
    """Takes a recorder's events, puts them back as the daemon does, and can be waited on."""

    def __init__(self) -> None:
        self.recorder: Recorder | None = None
        self.events: list[Event] = []
        self._changed = threading.Condition()

    def __call__(self, event: Event) -> None:
        with self._changed:
            self.events.append(event)
            self._changed.notify_all()
        if self.recorder is not None:
            self.recorder.put(topics.EVENT, EVENTS, 0, convert.event_bytes(event, SESSION))

    def codes(self) -> list[str]:
        return [event.code for event in self.events]

    def wait_for(self, code: str) -> Event:
        """Return the first event of this code, waiting for it."""
        with self._changed:
            found = self._changed.wait_for(lambda: code in self.codes(), 30.0)
            assert found, f"{code} was never told; {self.codes()} were"
            return next(event for event in self.events if event.code == code)


def recorder_for(
    directory: Path, *, live: bool = True, passing: bool = False, **settings: Any
) -> tuple[Recorder, Told]:
    """Return a recorder whose thread does not run yet. It takes pixels while there is any room."""
    settings = {"free_mb": 0} | settings
    told = Told()
    recorder = Recorder(
        Record(directory=str(directory), **settings),
        "lab",
        live,
        lambda: pb.Run(
            session=SESSION,
            version="9.9",
            station="lab",
            config_text="[station]",
            facts=[pb.Fact(name="device", value="virtual")],
        ).SerializeToString(),
        lambda reason: pb.End(
            session=SESSION, reason=reason, health=pb.Health(captured=7)
        ).SerializeToString(),
        told,
        passing=passing,
    )
    told.recorder = recorder
    return recorder, told


@contextlib.contextmanager
def running(recorder: Recorder, reason: str = "stopped by the test") -> Iterator[None]:
    """Run the recorder's thread; at the end finish the file and join it."""
    failures: list[BaseException] = []

    def body() -> None:
        try:
            recorder.run()
        except BaseException as failure:  # noqa: BLE001 - raised below, in the test
            failures.append(failure)

    thread = threading.Thread(target=body, name="record")
    thread.start()
    try:
        yield
    finally:
        recorder.finish(reason)
        thread.join(60.0)
        assert not thread.is_alive()
    if failures:
        raise failures[0]


def sample_bytes(seq: int) -> bytes:
    return pb.Displacement(session=SESSION, marker="m1", seq=seq, x_mm=seq / 8).SerializeToString()


def put_sample(recorder: Recorder, seq: int) -> bool:
    return recorder.put(topics.DISPLACEMENT, SAMPLES, 1_000_000 * seq, sample_bytes(seq))


def decode(schema: Schema, data: bytes) -> Any:
    """Return the message, decoded by the descriptors in the file and nothing of ours."""
    pool = descriptor_pool.DescriptorPool()
    for file in descriptor_pb2.FileDescriptorSet.FromString(schema.data).file:
        pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(schema.name)).FromString(data)


def read_whole(path: Path) -> list[tuple[str, int, Any]]:
    """Return (topic, sequence, message) of a complete file by mcap's own indexed reader."""
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        found = [
            (channel.topic, message.sequence, decode(schema, message.data))
            for schema, channel, message in reader.iter_messages(log_time_order=False)
        ]
        assert summary.statistics.message_count == len(found)
    with path.open("rb") as file:
        linear = NonSeekingReader(file, validate_crcs=True).iter_messages(log_time_order=False)
        assert sum(1 for _ in linear) == len(found)
    return found


def samples_in(path: Path) -> list[int]:
    """Return the seq of every displacement of a complete file, in the order of the file."""
    return [message.seq for topic, _, message in read_whole(path) if topic == SAMPLES]


def files(directory: Path) -> list[Path]:
    return sorted(directory.iterdir())


def rerun(home: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run the independent reader of rerun-sdk; `home` takes its settings."""
    return subprocess.run(
        [str(RERUN), *arguments],
        env={**os.environ, "HOME": str(home), "XDG_CONFIG_HOME": str(home)},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
