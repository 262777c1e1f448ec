"""A cable between two computers that is pulled and plugged, and programs that are killed."""

from __future__ import annotations

import contextlib
import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from hosts import ROOT, Host, Hosts, needs_root, running, two_hosts
from reading import Reader

from vdms_rt.logfile.reader import LogReader, StoredMessage
from vdms_rt.wire import vdms_pb2 as pb

pytestmark = [needs_root, pytest.mark.slow, pytest.mark.timeout(400)]

PORT = 7447
TESTS = ROOT / "tests"


@pytest.fixture
def hosts() -> Iterator[Hosts]:
    with two_hosts() as pair:
        yield pair


@contextlib.contextmanager
def station(host: Host, session: int, recover_s: float = 60.0) -> Iterator[subprocess.Popen[str]]:
    process = host.start(
        TESTS / "station_loop.py",
        f"tcp/{host.address}:{PORT}",
        session,
        recover_s,
        stdout=subprocess.PIPE,
    )
    assert process.stdout is not None
    try:
        assert process.stdout.readline() == "up\n"
        yield process
    finally:
        process.kill()
        process.wait()
        process.stdout.close()


@contextlib.contextmanager
def reader(hosts: Hosts) -> Iterator[Reader]:
    listening = Reader(
        hosts.laptop.start(
            TESTS / "reader_loop.py",
            f"tcp/{hosts.station.address}:{PORT}",
            stdout=subprocess.PIPE,
        )
    )
    try:
        yield listening
    finally:
        listening.end()


def cut(hosts: Hosts, listening: Reader, session: int, seconds: float) -> None:
    """Pull the cable for so long, and wait until the reader has caught up."""
    hosts.pull()
    time.sleep(seconds)  # the length of the fault itself
    hosts.plug()
    listening.wait(session, listening.newest(session) + round(60 * (seconds + 1)))


@pytest.mark.parametrize(
    ("seconds", "times"),
    [
        (5, 1),
        pytest.param(5, 3, marks=pytest.mark.soak),
        pytest.param(30, 3, marks=pytest.mark.soak),
    ],
)
def test_a_pulled_cable_costs_no_sample(hosts: Hosts, seconds: float, times: int) -> None:
    with station(hosts.station, 7), reader(hosts) as listening:
        listening.wait(7, 60)
        for _ in range(times):
            cut(hosts, listening, 7, seconds)
        seen = listening.end()
    assert seen.samples == {7: list(range(len(seen.samples[7])))}
    assert seen.missed == []
    assert seen.words == ["arrived"] + ["left", "arrived"] * times


@pytest.mark.parametrize(
    ("seconds", "recover_s"), [(6, 2.0), pytest.param(90, 60.0, marks=pytest.mark.soak)]
)
def test_what_a_longer_cut_cost_is_told_exactly(
    hosts: Hosts, seconds: float, recover_s: float
) -> None:
    with station(hosts.station, 7, recover_s), reader(hosts) as listening:
        listening.wait(7, 60)
        cut(hosts, listening, 7, seconds)
        seen = listening.end()
    ((session, first, last, on_the_way),) = seen.missed
    got = seen.samples[7]
    assert session == 7
    assert on_the_way == last - first + 1
    assert got == [*range(first), *range(last + 1, got[-1] + 1)]
    # All that the station kept has come.
    assert last - first + 1 < 60 * (seconds - recover_s + 5)


def test_a_station_that_is_killed_comes_back_as_another_session(hosts: Hosts) -> None:
    with reader(hosts) as listening:
        for session in (11, 12, 13):
            with station(hosts.station, session):
                listening.wait(session, 100)
        seen = listening.end()
    assert list(seen.samples) == [11, 12, 13]
    for numbers in seen.samples.values():
        assert numbers == list(range(len(numbers)))
    assert seen.missed == []


@pytest.mark.parametrize("times", [5, pytest.param(50, marks=pytest.mark.soak)])
@pytest.mark.timeout(600)
def test_a_late_reader_gets_what_was_before_it(hosts: Hosts, times: int) -> None:
    with station(hosts.station, 7):
        started_s = time.monotonic()
        for _ in range(times):
            with reader(hosts) as listening:
                listening.wait(7, 30)
                listening.wait(7, listening.newest(7) + 30)
                said = 60 * (time.monotonic() - started_s)
                seen = listening.end()
            got = seen.samples[7]
            assert got == list(range(got[0], got[-1] + 1))
            # The station keeps a minute.
            assert got[0] <= max(said - 3600, 0)
            assert seen.missed == []


def test_a_stopped_reader_holds_up_nobody_else(hosts: Hosts) -> None:
    with station(hosts.station, 7), reader(hosts) as stopped, reader(hosts) as other:
        for listening in (stopped, other):
            listening.wait(7, 60)
        stopped.process.send_signal(signal.SIGSTOP)
        other.wait(7, other.newest(7) + 600)
        stopped.process.send_signal(signal.SIGCONT)
        stopped.wait(7, other.newest(7))
        seen = [listening.end() for listening in (stopped, other)]
    for one in seen:
        assert one.samples == {7: list(range(len(one.samples[7])))}
        assert one.missed == []


def test_a_stopped_reader_costs_a_whole_station_nothing(hosts: Hosts, tmp_path: Path) -> None:
    with (
        running(hosts.station, tmp_path, "") as recordings,
        reader(hosts) as stopped,
        reader(hosts) as other,
    ):
        while not other.seen.samples or not stopped.seen.samples:
            time.sleep(0.01)
        ((session, _),) = other.seen.samples.items()
        for listening in (stopped, other):
            listening.wait(session, 60)
        stopped.process.send_signal(signal.SIGSTOP)
        other.wait(session, other.newest(session) + 600)
        stopped.process.send_signal(signal.SIGCONT)
        stopped.wait(session, other.newest(session))
        seen = [listening.end() for listening in (stopped, other)]
    with LogReader(next(recordings.iterdir())) as log:
        stored = [r for r in log if isinstance(r, StoredMessage)]
    recorded = [
        pb.Displacement.FromString(m.message.data).seq
        for m in stored
        if m.channel.topic.endswith("/displacement")
    ]
    ends = [pb.End.FromString(m.message.data) for m in stored if m.channel.topic.endswith("/end")]
    (end,) = ends
    assert (end.health.overwritten, end.health.not_recorded, end.health.unsent) == (0, 0, 0)
    assert recorded == list(range(recorded[0], recorded[-1] + 1))
    for one in seen:
        got = one.samples[session]
        assert got == recorded[: len(got)]
        assert one.missed == []
