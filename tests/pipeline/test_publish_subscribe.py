"""Real zenoh sessions over real sockets on the loopback."""

from __future__ import annotations

import json
import logging
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator

import pytest
import zenoh
from loopback import (
    DEADLINE_S,
    cable,
    displacement,
    free_endpoint,
    missed,
    publisher,
    receive,
    say,
)
from zenoh import ext

from vdms_rt.config import Publish
from vdms_rt.model import Event, Health, Severity, State, Truth
from vdms_rt.publish import Publisher, PublishError
from vdms_rt.subscribe import (
    Arrived,
    Left,
    Listener,
    Missed,
    Notice,
    Sample,
    SubscribeError,
    Unreadable,
    subscribe,
)
from vdms_rt.wire import convert, topics
from vdms_rt.wire import vdms_pb2 as pb
from vdms_rt.wire.session import SESSION

KEY = "vdms/s1/m1/displacement"


@pytest.fixture(autouse=True)
def no_thread_survives() -> Iterator[None]:
    before = set(threading.enumerate())
    yield
    assert set(threading.enumerate()) <= before


@pytest.fixture
def endpoint() -> str:
    return free_endpoint()


def session(mode: str, **settings: object) -> zenoh.Session:
    config = zenoh.Config()
    for name, value in ({"mode": mode} | SESSION | settings).items():
        config.insert_json5(name, json.dumps(value))
    return zenoh.open(config)


def router(endpoint: str) -> zenoh.Session:
    return session("router", **{"listen/endpoints": [endpoint]})


def client(endpoint: str) -> zenoh.Session:
    return session(
        "client", **{"connect/endpoints": [endpoint], "connect/timeout_ms": int(DEADLINE_S * 1000)}
    )


def await_links(station: Publisher, count: int) -> None:
    until_s = time.monotonic() + DEADLINE_S
    while station.links < count:
        assert time.monotonic() < until_s, "nobody linked to the station"
        time.sleep(0.01)


def health(state: State) -> bytes:
    numbers = dict.fromkeys(Health.__dataclass_fields__, 0)
    words = dict.fromkeys(("device", "recording", "record_trouble", "utc_state"), "")
    values = numbers | words | {"session": 7, "state": state}
    return convert.health_message(Health(**values)).SerializeToString()  # type: ignore[arg-type]


# --- order, values, history -------------------------------------------------------------------


def test_every_sample_comes_in_order_with_its_values(endpoint: str) -> None:
    with publisher(endpoint) as station, subscribe(connect=endpoint) as samples:
        await_links(station, 1)
        for seq in range(300):
            say(station, seq)
            say(station, seq, marker="m2")
        got = [next(samples) for _ in range(600)]
    for marker in ("m1", "m2"):
        of_marker = [s.value for s in got if s.marker == marker]
        assert of_marker == [displacement(seq, marker=marker) for seq in range(300)]
    assert {(s.station, s.topic) for s in got} == {("s1", "displacement")}
    assert all(s.received_ns > 0 for s in got)


def test_a_late_reader_gets_the_history_and_no_gap_while_samples_keep_coming(
    endpoint: str,
) -> None:
    stop = threading.Event()
    with publisher(endpoint) as station:
        say(station, *range(1000))

        def go_on() -> None:
            seq = 1000
            while not stop.wait(0.002):
                say(station, seq)
                seq += 1

        thread = threading.Thread(target=go_on)
        thread.start()
        try:
            for last in range(1010, 1130, 10):
                with subscribe(connect=endpoint, notices=True) as items:
                    samples, notices = receive(items, last)
                assert [s.seq for s in samples] == list(range(last + 1))
                assert notices == [Arrived("s1")]
        finally:
            stop.set()
            thread.join()


def test_history_is_as_long_as_configured(endpoint: str) -> None:
    config = Publish(listen=(endpoint,), recover_s=2.0)
    with Publisher(config, "s1", ["m1"], sample_rate_hz=60.0) as station:
        say(station, *range(1000))
        with subscribe(connect=endpoint) as items:
            samples, _ = receive(items, 999)
    assert [s.seq for s in samples] == list(range(1000 - 121, 1000))


def test_several_keys_and_no_doubles_where_they_overlap(endpoint: str) -> None:
    keys = ("vdms/*/*/displacement", "vdms/*/m1/*", "vdms/*/health")
    with publisher(endpoint) as station, subscribe(keys, endpoint) as samples:
        station.put(topics.HEALTH, "", health(State.MEASURING))
        assert next(samples).topic == "health"
        say(station, *range(50))
        got, _ = receive(samples, 49)
    assert [s.seq for s in got] == list(range(50))


def test_a_late_reader_gets_the_last_health_and_every_set_up_and_event(endpoint: str) -> None:
    event = Event(Severity.WARNING, "frames-missed", "3 frames missed", 5, 6, (("count", "3"),))
    with publisher(endpoint) as station:
        for state in (State.STARTING, State.SEARCHING, State.MEASURING):
            station.put(topics.HEALTH, "", health(state))
        for revision in (1, 2):
            station.put(topics.SETUP, "", pb.SetUp(revision=revision).SerializeToString())
        station.put(topics.EVENT, "", convert.event_bytes(event, 7))
        with subscribe("vdms/**", endpoint) as samples:
            got = [next(samples) for _ in range(4)]
    assert all((s.station, s.marker) == ("s1", "") for s in got)
    by_topic = {s.topic: s.value for s in got}
    assert isinstance(by_topic["health"], Health)
    assert by_topic["health"].state == State.MEASURING
    assert [s.value.revision for s in got if isinstance(s.value, pb.SetUp)] == [1, 2]
    assert by_topic["event"] == event


def test_topics_that_are_not_recovered_come_too(endpoint: str) -> None:
    truth = Truth("m1", 3, displacement(3).scan, 3, 4, 1.0, 2.0, 3.0, 4.0, 5.0)
    with publisher(endpoint) as station, subscribe("vdms/*/*/truth", endpoint) as samples:
        await_links(station, 1)
        while (sample := samples.get(0.05)) is None:
            station.put(topics.TRUTH, "m1", convert.truth_bytes(truth))
    assert (sample.marker, sample.topic, sample.value) == ("m1", "truth", truth)


# --- gaps, cuts, restarts ---------------------------------------------------------------------


def test_a_frame_that_the_station_lost_is_told_with_its_range(endpoint: str) -> None:
    with publisher(endpoint) as station, subscribe(connect=endpoint, notices=True) as items:
        say(station, 0, 1, 5, 6, 8)
        samples, notices = receive(items, 8)
    assert [s.seq for s in samples] == [0, 1, 5, 6, 8]
    assert missed(notices) == [
        Missed("s1", "m1", 7, first_seq=2, last_seq=4, on_the_way=0),
        Missed("s1", "m1", 7, first_seq=7, last_seq=7, on_the_way=0),
    ]
    assert missed(notices)[0].count == 3


def test_a_pulled_cable_costs_nothing(endpoint: str) -> None:
    with (
        publisher(endpoint) as station,
        cable(endpoint) as line,
        subscribe(connect=line.endpoint, notices=True) as items,
    ):
        seq = 0
        for _ in range(3):
            say(station, *range(seq, seq + 50))
            samples, _ = receive(items, seq + 49)
            assert [s.seq for s in samples] == list(range(seq, seq + 50))
            line.pull()
            assert items.get(DEADLINE_S) == Left("s1")
            say(station, *range(seq + 50, seq + 500))
            assert items.waiting_for == (line.endpoint,)
            line.plug()
            samples, notices = receive(items, seq + 499)
            assert [s.seq for s in samples] == list(range(seq + 50, seq + 500))
            assert notices == [Arrived("s1")]
            seq += 500


def test_the_last_health_is_not_told_again_after_a_cut(endpoint: str) -> None:
    with (
        publisher(endpoint) as station,
        cable(endpoint) as line,
        subscribe("vdms/*/health", line.endpoint, notices=True) as items,
    ):
        station.put(topics.HEALTH, "", health(State.SEARCHING))
        got = [items.get(DEADLINE_S) for _ in range(2)]
        line.pull()
        got.append(items.get(DEADLINE_S))
        line.plug()
        got.append(items.get(DEADLINE_S))
        station.put(topics.HEALTH, "", health(State.MEASURING))
        got.append(items.get(DEADLINE_S))
    states = [i.value.state for i in got if isinstance(i, Sample) and isinstance(i.value, Health)]
    assert states == [State.SEARCHING, State.MEASURING]
    assert [i for i in got if not isinstance(i, Sample)] == [
        Arrived("s1"),
        Left("s1"),
        Arrived("s1"),
    ]


def test_what_a_cut_outlasted_is_told_exactly(endpoint: str) -> None:
    config = Publish(listen=(endpoint,), recover_s=1.0)
    with (
        Publisher(config, "s1", ["m1"], sample_rate_hz=60.0) as station,
        cable(endpoint) as line,
        subscribe(connect=line.endpoint, notices=True) as items,
    ):
        say(station, *range(10))
        receive(items, 9)
        line.pull()
        assert items.get(DEADLINE_S) == Left("s1")
        say(station, *range(10, 20), *range(22, 500))
        line.plug()
        samples, notices = receive(items, 499)
    assert [s.seq for s in samples] == list(range(500 - 61, 500))
    assert missed(notices) == [
        Missed("s1", "m1", 7, first_seq=10, last_seq=438, on_the_way=439 - 10 - 2)
    ]


def test_a_slow_program_is_told_what_did_not_fit(
    endpoint: str, caplog: pytest.LogCaptureFixture
) -> None:
    told: list[Notice] = []
    got: list[int] = []
    said = 0
    with (
        publisher(endpoint) as station,
        subscribe(connect=endpoint, queue=10, on_notice=told.append) as slow,
    ):
        while not missed(told):
            say(station, *range(said, said + 100))
            said += 100
            got.append(next(slow).value.seq)
    gone = [seq for m in missed(told) for seq in range(m.first_seq, m.last_seq + 1)]
    assert sorted(got + gone) == list(range(got[-1] + 1))
    assert all(m.on_the_way == m.count for m in missed(told))
    assert not caplog.records


def test_the_simple_loop_logs_what_was_missed(
    endpoint: str, caplog: pytest.LogCaptureFixture
) -> None:
    with publisher(endpoint) as station, subscribe(connect=endpoint) as samples:
        say(station, 0, 3)
        receive(samples, 3)
    assert caplog.record_tuples == [
        (
            "vdms_rt.subscribe",
            logging.WARNING,
            "s1/m1: missed 2 samples, seq 1 to 2, lost by the station",
        )
    ]


def test_bytes_that_are_no_sample_are_told_and_survived(endpoint: str) -> None:
    with publisher(endpoint) as station, subscribe(connect=endpoint, notices=True) as items:
        station.put(topics.DISPLACEMENT, "m1", b"\xff\xff\xff")
        say(station, 1)
        samples, notices = receive(items, 1)
    assert [s.seq for s in samples] == [1]
    [unreadable] = [n for n in notices if isinstance(n, Unreadable)]
    assert unreadable.key == KEY


STATION = """
import itertools, sys, time
from loopback import publisher, say
session = int(sys.argv[2])
with publisher(sys.argv[1]) as station:
    for seq in itertools.count():
        say(station, seq, session=session)
        if seq == 0:
            print("up", flush=True)
        time.sleep(0.002)
"""


def station_process(endpoint: str, number: int) -> subprocess.Popen[str]:
    process = subprocess.Popen(
        [sys.executable, "-c", STATION, endpoint, str(number)],
        stdout=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "up\n"
    return process


def end(process: subprocess.Popen[str], number: signal.Signals = signal.SIGKILL) -> None:
    process.send_signal(number)
    process.communicate(timeout=DEADLINE_S)


@pytest.mark.slow
def test_a_station_that_is_killed_and_started_again_goes_on_as_a_new_session(
    endpoint: str,
) -> None:
    seen: dict[int, list[int]] = {}
    notices: list[Notice] = []
    with subscribe(connect=endpoint, notices=True) as items:
        for number in (11, 12, 13):
            process = station_process(endpoint, number)
            while len(seen.get(number, ())) < 100:
                item = items.get(DEADLINE_S)
                assert item is not None
                if isinstance(item, Sample):
                    seen.setdefault(item.value.session, []).append(item.value.seq)
                else:
                    notices.append(item)
            end(process)
    for seqs in seen.values():
        assert seqs == list(range(len(seqs)))
    assert list(seen) == [11, 12, 13]
    assert [type(n) for n in notices[:5]] == [Arrived, Left, Arrived, Left, Arrived]


@pytest.mark.slow
def test_a_stopped_reader_holds_up_nobody(endpoint: str) -> None:
    reader = (
        "import sys\nfrom vdms_rt.subscribe import subscribe\n"
        "for sample in subscribe(connect=sys.argv[1]):\n"
        "    print(sample.value.seq, flush=True)\n"
        "    if sample.value.seq == 20000: break\n"
    )
    with publisher(endpoint, recover_s=600.0) as station, subscribe(connect=endpoint) as other:
        say(station, 0)
        stopped = subprocess.Popen(
            [sys.executable, "-c", reader, endpoint], stdout=subprocess.PIPE, text=True
        )
        assert stopped.stdout is not None
        assert stopped.stdout.readline() == "0\n"
        stopped.send_signal(signal.SIGSTOP)
        say(station, *range(1, 20001))
        samples, notices = receive(other, 20000)
        stopped.send_signal(signal.SIGCONT)
        printed = stopped.communicate(timeout=DEADLINE_S)[0].split()
    assert [s.seq for s in samples] == list(range(20001))
    assert [int(p) for p in printed] == list(range(1, 20001))
    assert stopped.returncode == 0
    assert notices == []


# --- many stations, routers -------------------------------------------------------------------


def test_several_stations_at_their_own_addresses(endpoint: str) -> None:
    second = free_endpoint()
    with (
        publisher(endpoint, "north") as north,
        publisher(second, "south") as south,
        subscribe(connect=[endpoint, second], notices=True) as items,
    ):
        say(north, *range(50))
        say(south, *range(50), session=8)
        seen: dict[str, list[int]] = {"north": [], "south": []}
        arrived = set()
        while any(len(seqs) < 50 for seqs in seen.values()):
            item = items.get(DEADLINE_S)
            assert item is not None
            if isinstance(item, Sample):
                seen[item.station].append(item.value.seq)
            else:
                arrived.add(item)
    assert seen == {"north": list(range(50)), "south": list(range(50))}
    assert arrived == {Arrived("north"), Arrived("south")}


def test_two_ways_to_the_same_station_give_no_doubles(endpoint: str) -> None:
    with (
        publisher(endpoint) as station,
        cable(endpoint) as line,
        subscribe(connect=[endpoint, line.endpoint]) as items,
    ):
        await_links(station, 2)
        say(station, *range(200))
        samples, _ = receive(items, 199)
        assert items.get(0.5) is None
    assert [s.seq for s in samples] == list(range(200))


def test_stations_behind_a_router_that_comes_goes_and_returns(endpoint: str) -> None:
    config = Publish(mode="client", connect=(endpoint,))
    with (
        Publisher(config, "north", ["m1"], sample_rate_hz=60.0) as north,
        Publisher(config, "south", ["m1"], sample_rate_hz=60.0) as south,
        subscribe("vdms/north/*/displacement", endpoint, notices=True) as items,
        subscribe("vdms/south/*/displacement", endpoint, notices=True) as others,
    ):
        assert north.state == f"waiting for {endpoint}"
        seq = 0
        for _ in range(3):
            say(north, *range(seq, seq + 100))
            say(south, *range(seq, seq + 100))
            assert items.waiting_for == (endpoint,)
            with router(endpoint):
                for received, station in ((items, "north"), (others, "south")):
                    samples, notices = receive(received, seq + 99)
                    assert [s.seq for s in samples] == list(range(seq, seq + 100))
                    assert notices == [Arrived(station)]
                assert north.state == f"connected to {endpoint}"
            assert items.get(DEADLINE_S) == Left("north")
            assert others.get(DEADLINE_S) == Left("south")
            seq += 100
        assert north.unsent == 0


# --- who may ----------------------------------------------------------------------------------


def test_a_reader_cannot_put_on_a_stations_keys(endpoint: str) -> None:
    forged = convert.displacement_bytes(displacement(3, session=666))
    with (
        publisher(endpoint) as station,
        subscribe("vdms/**", endpoint, notices=True) as items,
        client(endpoint) as forger,
    ):
        say(station, 0)
        _, before = receive(items, 0)
        forger.put(KEY, forged)
        forger.put("vdms/s1/health", health(State.LOST))
        with (
            forger.declare_publisher(KEY) as plain,
            ext.declare_advanced_publisher(
                forger,
                KEY,
                cache=ext.CacheConfig(max_samples=10),
                publisher_detection=True,
                sample_miss_detection=ext.MissDetectionConfig(
                    heartbeat=0.1, sporadic_heartbeat=None
                ),
            ) as advanced,
            forger.declare_queryable("vdms/**/@adv/**", lambda query: query.reply(KEY, forged)),
            forger.liveliness().declare_token("vdms/forged/alive"),
        ):
            plain.put(forged)
            advanced.put(forged)
            # The forger's link carries messages in order: what it reads now, it read after the
            # station had all that it put.
            with subscribe("vdms/**", endpoint) as late:
                say(station, *range(1, 20))
                history, _ = receive(late, 19)
            samples, notices = receive(items, 19)
            assert items.get(1.0) is None
    assert [s.seq for s in history] == list(range(20))
    assert {s.session for s in history} == {7}
    assert [s.seq for s in samples] == list(range(1, 20))
    assert {s.session for s in samples} == {7}
    assert before + notices == [Arrived("s1")]


def test_zenoh_s_own_advanced_subscriber_finds_the_publishers_and_their_history(
    endpoint: str,
) -> None:
    with publisher(endpoint) as station, client(endpoint) as reader:
        say(station, *range(10))
        with ext.declare_advanced_subscriber(
            reader,
            "vdms/s1/*/displacement",
            history=ext.HistoryConfig(detect_late_publishers=True),
            recovery=ext.RecoveryConfig(heartbeat=True, periodic_queries=None),
        ) as samples:
            with samples.detect_publishers(history=True) as found:
                keys = {str(found.recv().key_expr).split("/@adv/")[0] for _ in range(2)}
            seqs = [
                convert.displacement_from(samples.recv().payload.to_bytes()).seq for _ in range(10)
            ]
    assert keys == {"vdms/s1/m1/displacement", "vdms/s1/m2/displacement"}
    assert seqs == list(range(10))


# --- sentences --------------------------------------------------------------------------------


def test_a_port_in_use_is_one_sentence(endpoint: str) -> None:
    with publisher(endpoint), pytest.raises(PublishError) as fault:
        publisher(endpoint).__enter__()
    assert str(fault.value) == (
        f"publish: {endpoint} is in use; is another vdms-rt running? "
        "Stop it, or set publish.listen to another port"
    )


def test_an_address_of_another_computer_is_one_sentence() -> None:
    with pytest.raises(PublishError, match=r"tcp/192\.0\.2\.1:7447 is not an address of this"):
        publisher("tcp/192.0.2.1:7447").__enter__()


@pytest.mark.parametrize(
    "text", ["nonsense", "tcp/127.0.0.1", "tcp/127.0.0.1:99999", "foo/127.0.0.1:7447", "tcp/:", ""]
)
def test_text_that_is_no_address_is_one_sentence(text: str) -> None:
    wrong = f'"{text}" is not an address; write protocol/host:port, for example'
    with pytest.raises(PublishError, match=wrong):
        publisher(text).__enter__()
    with pytest.raises(PublishError, match=f"publish.connect: {wrong}"):
        Publisher(
            Publish(mode="client", connect=(text,)), "s1", ["m1"], sample_rate_hz=60.0
        ).__enter__()
    with pytest.raises(SubscribeError, match=wrong):
        subscribe(connect=text)


def test_a_name_that_nobody_knows_is_one_sentence() -> None:
    with pytest.raises(PublishError) as fault:
        publisher("tcp/nowhere.invalid:7447").__enter__()
    assert str(fault.value).startswith("publish: cannot open tcp/nowhere.invalid:7447: ")
    assert str(fault.value).endswith("; correct publish.listen or publish.connect")
    assert ".rs" not in str(fault.value)


def test_a_key_that_is_none_is_one_sentence() -> None:
    with pytest.raises(SubscribeError, match='"vdms//x" is not a key'):
        subscribe("vdms//x")


def test_after_the_end_a_put_is_refused_and_counted(endpoint: str) -> None:
    with publisher(endpoint) as station:
        say(station, 0)
        assert station.unsent == 0
        assert station.state == f"listening on {endpoint}"
    assert not station.put(topics.DISPLACEMENT, "m1", b"")
    assert station.unsent == 1


# --- forms ------------------------------------------------------------------------------------


def test_get_comes_back_without_a_station(endpoint: str) -> None:
    with subscribe(connect=endpoint) as samples:
        assert samples.get(0.0) is None
        assert samples.get(0.05) is None
        assert samples.waiting_for == (endpoint,)


def test_close_ends_a_loop_in_another_thread(endpoint: str) -> None:
    samples = subscribe(connect=endpoint)
    loop = threading.Thread(target=lambda: list(samples))
    loop.start()
    samples.close()
    samples.close()
    loop.join(DEADLINE_S)
    assert not loop.is_alive()
    assert samples.get() is None


def test_a_subscription_that_is_let_go_ends(endpoint: str) -> None:
    with publisher(endpoint) as station:
        samples = subscribe(connect=endpoint)
        await_links(station, 1)
        [thread] = [t for t in threading.enumerate() if t.name == f"subscribe {endpoint}"]
        del samples
        thread.join(DEADLINE_S)
        assert not thread.is_alive()


def test_callbacks(endpoint: str) -> None:
    got: list[int] = []
    told: list[Notice] = []
    done = threading.Event()

    def on_sample(sample: Sample) -> None:
        got.append(sample.value.seq)
        if len(got) == 50:
            done.set()

    with (
        publisher(endpoint) as station,
        subscribe(connect=endpoint, on_sample=on_sample, on_notice=told.append) as listener,
    ):
        say(station, *range(40), *range(50, 60))
        assert done.wait(DEADLINE_S)
        assert listener.waiting_for == ()
        assert not listener.wait(0.0)
    assert listener.wait(0.0)
    assert got == [*range(40), *range(50, 60)]
    assert missed(told) == [Missed("s1", "m1", 7, 40, 49, on_the_way=0)]


def test_a_callback_that_hangs_holds_up_nobody_and_is_told_what_did_not_fit(
    endpoint: str,
) -> None:
    got: list[int] = []
    told: list[Notice] = []
    go_on, done = threading.Event(), threading.Event()

    def on_sample(sample: Sample) -> None:
        got.append(sample.value.seq)
        go_on.wait(DEADLINE_S)
        if got[-1] >= 2000:
            done.set()

    with (
        publisher(endpoint) as station,
        subscribe(connect=endpoint, queue=100, on_sample=on_sample, on_notice=told.append),
        subscribe(connect=endpoint, notices=True) as other,
    ):
        say(station, *range(2000))
        samples, notices = receive(other, 1999)
        assert [s.seq for s in samples] == list(range(2000))
        assert missed(notices) == []
        go_on.set()
        for seq in range(2000, 2500):
            say(station, seq)
            if done.wait(0.05):
                break
        assert done.is_set()
    gone = [seq for m in missed(told) for seq in range(m.first_seq, m.last_seq + 1)]
    assert gone
    assert got == sorted(got)
    assert sorted(got + gone) == list(range(got[-1] + 1))


def test_a_callback_may_close_its_listener(endpoint: str) -> None:
    got: list[int] = []
    box: list[Listener] = []

    def on_sample(sample: Sample) -> None:
        got.append(sample.value.seq)
        if got[-1] == 3:
            box[0].close()

    with publisher(endpoint) as station:
        box.append(subscribe(connect=endpoint, on_sample=on_sample))
        say(station, *range(10))
        assert box[0].wait(DEADLINE_S)
        box[0].close()
    assert got == [0, 1, 2, 3]


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_callback_that_fails_ends_the_listener(endpoint: str) -> None:
    def on_sample(sample: Sample) -> None:
        raise ZeroDivisionError

    with publisher(endpoint) as station, subscribe(connect=endpoint, on_sample=on_sample) as ear:
        say(station, 0)
        assert ear.wait(DEADLINE_S)


# --- programs ---------------------------------------------------------------------------------

LOOP = """
import sys
from vdms_rt.subscribe import subscribe

for sample in subscribe("vdms/*/*/displacement", connect=sys.argv[1]):
    d = sample.value
    print(sample.station, sample.marker, d.seq, d.x_mm, flush=True)
    if d.seq == 9:
        {end}
"""

CALLBACK = """
import sys, threading
from vdms_rt.subscribe import subscribe

done = threading.Event()
def on_sample(sample):
    d = sample.value
    print(sample.station, sample.marker, d.seq, d.x_mm, flush=True)
    if d.seq == 9:
        done.set()

listener = subscribe("vdms/*/*/displacement", sys.argv[1], on_sample=on_sample)
done.wait()
{end}
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("program", "end", "status"),
    [
        (LOOP, "break", 0),
        (LOOP, "sys.exit(3)", 3),
        (LOOP, "raise ValueError('mine')", 1),
        (CALLBACK, "", 0),
        (CALLBACK, "listener.close()", 0),
        (CALLBACK, "sys.exit(3)", 3),
    ],
)
def test_a_short_program_ends_by_itself(endpoint: str, program: str, end: str, status: int) -> None:
    with publisher(endpoint) as station:
        say(station, *range(10))
        run = subprocess.run(
            [sys.executable, "-c", program.format(end=end), endpoint],
            capture_output=True,
            text=True,
            timeout=DEADLINE_S,
            check=False,
        )
    assert run.stdout.splitlines() == [f"s1 m1 {seq} {seq}.0" for seq in range(10)]
    assert run.returncode == status
    assert ("mine" in run.stderr) == (status == 1)


@pytest.mark.slow
@pytest.mark.parametrize("up", [True, False])
def test_ctrl_c_ends_the_loop_whether_or_not_there_is_a_station(endpoint: str, up: bool) -> None:
    program = (
        "import sys\nfrom vdms_rt.subscribe import subscribe\n"
        "try:\n"
        "    samples = subscribe(connect=sys.argv[1])\n"
        "    print('up', flush=True)\n"
        "    for sample in samples: print('up', flush=True)\n"
        "except KeyboardInterrupt: print('interrupted')\n"
    )
    with publisher(endpoint if up else free_endpoint()) as station:
        say(station, 0)
        process = subprocess.Popen(
            [sys.executable, "-c", program, endpoint], stdout=subprocess.PIPE, text=True
        )
        assert process.stdout is not None
        for _ in range(2 if up else 1):
            assert process.stdout.readline() == "up\n"
        process.send_signal(signal.SIGINT)
        out, _ = process.communicate(timeout=DEADLINE_S)
    assert out.split()[-1] == "interrupted"
    assert process.returncode == 0
