"""Playing: cues in order and at their moments, steered, and received like a live station's."""

from __future__ import annotations

import itertools
import json
import threading
import time

import pytest
import zenoh
from loopback import DEADLINE_S, free_endpoint
from pydantic import ValidationError
from replaying import PERIOD_NS, SESSION, START_UTC_NS, t_ns_of, write_recording, x_mm_of

from vdms_replay.ahead import Ahead
from vdms_replay.cli import run
from vdms_replay.keys import KEYS, split
from vdms_replay.play import moment
from vdms_replay.player import Player, lateness
from vdms_replay.source import ReplayError
from vdms_replay.stage import SUFFIX, Stage
from vdms_replay.track import Programme
from vdms_rt.config import Publish, Station
from vdms_rt.model import Displacement, Event, Health
from vdms_rt.subscribe import Missed, Sample, subscribe
from vdms_rt.wire import topics
from vdms_rt.wire.session import SESSION as ZENOH


def nothing(_):
    """Progress of no interest."""


@pytest.fixture
def programme(tmp_path):
    found = Programme([write_recording(tmp_path / "a.mcap", range(240), pixels=True)], nothing)
    yield found
    found.close()


class Heard:
    """What a player said; can be waited on."""

    def __init__(self):
        self.cues = []
        self._changed = threading.Condition()

    def __call__(self, cue, take):
        with self._changed:
            self.cues.append((cue, take))
            self._changed.notify_all()

    def wait(self, enough):
        with self._changed:
            assert self._changed.wait_for(lambda: enough(self.samples()), DEADLINE_S)

    def samples(self):
        return [(cue, take) for cue, take in self.cues if cue.topic is topics.DISPLACEMENT]

    def seqs(self):
        return [cue.value.seq for cue, _ in self.samples()]


def playing(player):
    thread = threading.Thread(target=player.run, name="player")
    thread.start()
    return thread


def ended(thread):
    thread.join(DEADLINE_S)
    return not thread.is_alive()


def test_cues_come_at_the_samples_own_times_and_nothing_else_holds_them_up(programme):
    cues = list(programme.cues(programme.start_ns))
    samples = [cue for cue in cues if cue.topic is topics.DISPLACEMENT]
    assert [cue.value.seq for cue in samples] == list(range(240))
    assert [cue.at_ns - START_UTC_NS for cue in samples] == [n * PERIOD_NS for n in range(240)]
    assert all(a.at_ns <= b.at_ns for a, b in itertools.pairwise(cues))
    assert {cue.topic.name for cue in cues} == {"displacement", "health", "event"}
    assert programme.stations == {"lab": ("m1",)}
    assert programme.seconds == pytest.approx(239 * PERIOD_NS / 1e9)


@pytest.mark.parametrize("seq", [1, 59, 60, 100, 239])
def test_cues_from_a_moment_on(programme, seq):
    from_ns = programme.start_ns + seq * PERIOD_NS
    found = [c.value.seq for c in programme.cues(from_ns) if c.topic is topics.DISPLACEMENT]
    assert found == list(range(seq, 240))


def test_the_set_up_in_force_comes_first_after_a_seek(tmp_path):
    from vdms_rt.logfile.writer import LogMessage, LogWriter
    from vdms_rt.wire import vdms_pb2 as pb

    log = LogWriter(tmp_path / "a.mcap")
    for number in range(100):
        for topic, value in (
            (topics.SETUP, pb.SetUp(session=1, revision=number)),
            (topics.DISPLACEMENT, pb.Displacement(session=1, seq=number, t_ns=number * 10**9 + 1)),
        ):
            if topic is topics.DISPLACEMENT or number in (0, 20, 70):
                key = topic.key.format(station="lab", marker="m1")
                at_ns = number * 10**9
                data = value.SerializeToString()
                log.add(LogMessage(key, topic.message, 0, at_ns, at_ns, data))
        log.sync()
    log.close()
    found = Programme([tmp_path / "a.mcap"], nothing)
    first, second, *_ = found.cues(found.start_ns + 50 * 10**9)
    assert (first.topic, first.value.revision) == (topics.SETUP, 20)
    assert second.value.seq == 50
    found.close()


def test_two_stations_run_on_one_clock(tmp_path):
    later_ns = 5 * PERIOD_NS + PERIOD_NS // 2
    paths = [
        write_recording(tmp_path / "a.mcap", range(20), station="a"),
        write_recording(
            tmp_path / "b.mcap",
            range(20),
            station="b",
            session=9,
            utc_offset_ns=START_UTC_NS - t_ns_of(0) + later_ns,
        ),
    ]
    found = Programme(paths, nothing)
    order = [(c.station, c.value.seq) for c in found.cues(0) if c.topic is topics.DISPLACEMENT]
    expected = [(n * PERIOD_NS, "a", n) for n in range(20)]
    expected += [(n * PERIOD_NS + later_ns, "b", n) for n in range(20)]
    assert order == [(station, n) for _, station, n in sorted(expected)]
    found.close()


def test_a_player_says_everything_once_and_in_order(programme):
    heard = Heard()
    player = Player(programme, heard, speed=20)
    player.run()
    assert heard.seqs() == list(range(240))
    assert len({take for _, take in heard.cues}) == 1
    assert player.standing().ended
    assert lateness(player)["count"] == len(heard.cues)
    assert min(player.lateness_ns) >= 0


def test_the_pace_is_that_of_the_samples(programme):
    """Nothing is early: correctness of the pace, whatever the computer's load."""
    told_ns = []
    player = Player(programme, lambda cue, _: told_ns.append((cue.at_ns, time.monotonic_ns())))
    player.set_speed(4)
    began_ns = time.monotonic_ns()
    player.run()
    for at_ns, said_ns in told_ns:
        assert said_ns - began_ns >= (at_ns - programme.start_ns) / 4


def test_a_part_alone(programme):
    heard = Heard()
    begin = programme.start_ns
    Player(
        programme,
        heard,
        speed=50,
        from_ns=begin + 50 * PERIOD_NS,
        to_ns=begin + 80 * PERIOD_NS,
    ).run()
    assert heard.seqs() == list(range(50, 81))


def test_a_loop_is_a_new_take_each_time(programme):
    heard = Heard()
    player = Player(programme, heard, speed=100, loop=True)
    thread = playing(player)
    heard.wait(lambda samples: len(samples) >= 500)
    player.quit()
    assert ended(thread)
    assert heard.seqs()[:480] == [*range(240)] * 2
    takes = [take for _, take in heard.samples()]
    assert len(set(takes[:240])) == len(set(takes[240:480])) == 1
    assert takes[0] != takes[240]


def test_pause_seek_speed_and_resume(programme):
    heard = Heard()
    player = Player(programme, heard, paused=True)
    thread = playing(player)
    player.seek(2.0)
    at = player.standing()
    assert (at.position_s, at.paused, heard.cues) == (2.0, True, [])
    player.skip(0.5)
    assert player.standing().position_s == pytest.approx(2.5)
    player.skip(-100)
    assert player.standing().position_s == 0
    player.seek(3.0)
    player.set_speed(1e6)
    assert player.standing().speed == 100
    player.pause(False)
    assert ended(thread)
    assert heard.seqs() == [n for n in range(240) if n * PERIOD_NS >= 3e9]


def test_a_seek_while_playing_begins_a_new_take(programme):
    heard = Heard()
    player = Player(programme, heard, speed=0.1)
    thread = playing(player)
    heard.wait(lambda samples: len(samples) >= 2)
    player.seek(3.9)
    player.set_speed(100)
    assert ended(thread)
    seqs = heard.seqs()
    cut = seqs.index(next(n for n in range(240) if n * PERIOD_NS >= 3.9e9))
    assert seqs[:cut] == list(range(cut))
    assert seqs[cut:] == list(range(seqs[cut], 240))
    takes = [take for _, take in heard.samples()]
    assert set(takes[:cut]).isdisjoint(takes[cut:])


def test_reading_ahead_raises_where_the_fault_is_and_ends():
    def items():
        yield 1
        raise ValueError("torn")

    with Ahead(items(), 10) as ahead:
        assert next(ahead) == 1
        with pytest.raises(ValueError, match="torn"):
            next(ahead)
        assert list(ahead) == []
    with Ahead(iter(range(10**9)), 2) as endless:
        assert [next(endless) for _ in range(5)] == [0, 1, 2, 3, 4]


def test_keys_of_a_terminal():
    assert split(b" q\x1b[D\x1b[1~+\x1b") == [b" ", b"q", b"\x1b[D", b"\x1b[1~", b"+", b"\x1b"]
    assert all(split(key) == [key] for key in KEYS)


def test_moments_by_seconds_and_by_utc(programme):
    start = programme.start_ns
    assert moment(None, "--to", programme, 5) == 5
    assert moment("1.5", "--to", programme, 0) == start + 1_500_000_000
    assert moment("2026-09-21T14:13:22.5Z", "--to", programme, 0) == 1_790_000_002_500_000_000
    assert moment("2026-09-21T14:13:22.5", "--to", programme, 0) == 1_790_000_002_500_000_000
    for text, match in (("soon", "neither seconds"), ("99", "outside of the recording")):
        with pytest.raises(ReplayError, match=match):
            moment(text, "--to", programme, 0)


def test_no_live_station_can_have_the_name_of_a_replayed_one():
    with pytest.raises(ValidationError):
        Station(name=f"lab{SUFFIX}")
    assert Station(name="lab").name == "lab"


def test_a_receiver_gets_a_replay_like_a_live_station(tmp_path):
    paths = [
        write_recording(tmp_path / "a.mcap", range(120), station="a", markers=("m1", "m2")),
        write_recording(tmp_path / "b.mcap", range(120), station="b", session=9),
    ]
    programme = Programme(paths, nothing)
    endpoint = free_endpoint()
    got, missed, events, health = {}, [], [], []
    with Stage(programme, Publish(listen=(endpoint,)), 20) as stage:
        player = Player(programme, stage.say, speed=20, loop=True)
        thread = playing(player)
        keys = ("vdms/*/*/displacement", "vdms/*/health", "vdms/*/event")
        with subscribe(keys, endpoint, notices=True) as items:
            until_s = time.monotonic() + DEADLINE_S
            while time.monotonic() < until_s and (
                len(got) < 6 or min(len(values) for values in got.values()) < 120 or not health
            ):
                item = items.get(1.0)
                if isinstance(item, Missed):
                    missed.append(item)
                elif isinstance(item, Sample) and isinstance(item.value, Displacement):
                    of = item.station, item.marker, item.value.session
                    got.setdefault(of, []).append(item.value)
                elif isinstance(item, Sample) and isinstance(item.value, Event):
                    events.append(item.value)
                elif isinstance(item, Sample) and isinstance(item.value, Health):
                    health.append(item.value)
        player.quit()
        assert ended(thread)
    programme.close()
    assert {(station, marker) for station, marker, _ in got} == {
        ("a@replay", "m1"),
        ("a@replay", "m2"),
        ("b@replay", "m1"),
    }
    assert all(session not in (SESSION, 9) for _, _, session in got)
    assert missed == []
    whole = [values for values in got.values() if len(values) == 120]
    assert whole
    for values in whole:
        assert [d.seq for d in values] == list(range(120))
        assert [d.t_ns for d in values] == [t_ns_of(n) for n in range(120)]
        assert [d.x_mm for d in values] == [x_mm_of(n) for n in range(120)]
    assert any(event.text == "a frame was missed" for event in events)
    assert all(one.recording == "" for one in health)


def test_programs_on_this_computer_steer_it_by_queryable(programme):
    endpoint = free_endpoint()
    heard = Heard()
    player = Player(programme, heard, paused=True)
    config = zenoh.Config()
    for name, value in {**ZENOH, "mode": "client", "connect/endpoints": [endpoint]}.items():
        config.insert_json5(name, json.dumps(value))
    with (
        Stage(programme, Publish(listen=(endpoint,)), 1) as stage,
        stage.controlled_by(player),
        zenoh.open(config) as session,
    ):
        thread = playing(player)

        def ask(verb):
            replies = list(session.get(f"vdms/lab@replay/control/replay/{verb}"))
            assert len(replies) == 1
            return json.loads(replies[0].ok.payload.to_string())

        assert ask("status")["paused"] is True
        assert ask("seek?value=3.5")["position_s"] == 3.5
        assert ask("speed?value=50")["speed"] == 50
        refused = ask("skip?value=far")
        assert (refused["done"], refused["text"]) == (False, "give the number as ?value=12.5")
        assert ask("resume")["paused"] is False
        assert ended(thread)
        assert ask("status")["ended"] is True
    assert heard.seqs() == [n for n in range(240) if n * PERIOD_NS >= 3.5e9]


def test_bad_orders_are_refused_in_a_sentence(tmp_path, capsys):
    path = write_recording(tmp_path / "a.mcap", range(60))
    for arguments, match in (
        (["--from", "0.9", "--to", "0.1"], "--from is not before --to"),
        (["--listen", "tcp/x:1", "--connect", "tcp/x:2"], "exclude each other"),
        (["--listen", "nonsense"], "--listen: "),
        (["--from", "100"], "outside of the recording"),
    ):
        assert run(["play", str(path), *arguments]) == 1
        error = capsys.readouterr().err
        assert match in error
        assert error.count("\n") == 1
    with pytest.raises(SystemExit):
        run(["play", str(path), "--speed", "1000"])
    assert "a number from 0.1 to 100" in capsys.readouterr().err


def test_the_verb_plays_and_tells_how_late_it_was(tmp_path, capsys):
    path = write_recording(tmp_path / "a.mcap", range(60))
    assert run(["play", str(path), "--speed", "20", "--listen", free_endpoint()]) == 0
    out = capsys.readouterr().out
    assert "lab@replay: 0.98 s, listening on tcp/127.0.0.1:" in out
    assert "62 messages published; late by" in out
