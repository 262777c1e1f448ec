"""Who may do what at a station, from its own computer and from another one."""

from __future__ import annotations

import json
import re
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
from hosts import Host, Hosts, needs_root, running, two_hosts

from vdms_rt import keys

pytestmark = [needs_root, pytest.mark.slow, pytest.mark.timeout(400)]

DEADLINE_S = 60.0
FORGE = """
import json, sys, zenoh
from vdms_rt.wire.session import SESSION
from loopback import displacement
from vdms_rt.wire import convert
config = zenoh.Config()
settings = {"mode": "client", "connect/endpoints": [sys.argv[1]], "connect/timeout_ms": 20000}
for name, value in {**SESSION, **settings}.items():
    config.insert_json5(name, json.dumps(value))
with zenoh.open(config) as session:
    forged = convert.displacement_bytes(displacement(10**9, session=666))
    for key in ("vdms/lab/m1/displacement", "vdms/lab/health", "vdms/lab/event"):
        session.put(key, forged)
    def answer(query):
        query.reply(query.key_expr, b"")
    with session.declare_queryable("vdms/lab/control/*", answer), \\
         session.liveliness().declare_token("vdms/forged/alive"):
        # What comes back now was sent after the station had all of that.
        list(session.get("vdms/lab/m1/displacement/@adv/**", timeout=20))
        print("forged")
        sys.stdin.read()
"""


@pytest.fixture(scope="module")
def hosts() -> Iterator[Hosts]:
    with two_hosts() as pair:
        yield pair


@pytest.fixture(scope="module")
def secrets(tmp_path_factory: pytest.TempPathFactory, hosts: Hosts) -> Path:
    """Return a folder with the station's keys, one for ann, and bob's password; and another's."""
    folder = tmp_path_factory.mktemp("secrets")
    for name in ("keys", "other"):
        keys.make_server(folder / name, [hosts.station.address])
        keys.make_client(folder / name, "ann")
    keys.make_password(folder / "keys", "bob", "swordfish")
    return folder


@pytest.fixture(scope="module")
def plain(hosts: Hosts, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    with running(hosts.station, tmp_path_factory.mktemp("plain"), "") as recordings:
        yield recordings


@pytest.fixture(scope="module")
def guarded(
    hosts: Hosts, secrets: Path, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Path]:
    sections = f"""
[publish]
listen = ["tcp/0.0.0.0:8447"]
[control]
listen = ["tls/0.0.0.0:8448"]
keys = "{secrets / "keys"}"
password_listen = ["tcp/0.0.0.0:8449"]
users = "{secrets / "keys" / "users.txt"}"
"""
    with running(hosts.station, tmp_path_factory.mktemp("guarded"), sections) as recordings:
        yield recordings


def ctl(host: Host, *arguments: object) -> subprocess.CompletedProcess[str]:
    return host.run("-m", "vdms_rt", "ctl", *arguments, timeout_s=DEADLINE_S)


def listening(host: Host) -> set[str]:
    """Return every address at which something on a host takes connections or datagrams."""
    shown = subprocess.run(
        ["ip", "netns", "exec", host.name, "ss", "-Hlntu"],
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    return {"{0}/{4}".format(*line.split()) for line in shown.splitlines()}


def readable(hosts: Hosts, endpoint: str) -> subprocess.CompletedProcess[str]:
    program = (
        "import sys\nfrom vdms_rt.subscribe import subscribe\n"
        "with subscribe('vdms/lab/**', sys.argv[1]) as samples:\n"
        "    seen = {}\n"
        "    while not {'displacement', 'event', 'health', 'setup'} <= seen.keys():\n"
        "        sample = samples.get(30)\n"
        "        assert sample is not None, seen\n"
        "        seen[sample.topic] = sample\n"
        "    print(*sorted(seen))\n"
    )
    return hosts.laptop.run("-c", program, endpoint)


def test_a_station_tells_everyone_and_is_told_by_its_own_computer_alone(
    hosts: Hosts, plain: Path
) -> None:
    there = f"tcp/{hosts.station.address}:7447"
    telemetry = readable(hosts, there)
    assert telemetry.returncode == 0, telemetry.stderr
    for request in (["status"], ["zero"], ["preview", "--out", plain / "x.jpg"]):
        refused = ctl(hosts.laptop, "--connect", there, *request)
        assert refused.returncode == 1
        assert refused.stderr == (
            f"vdms-rt: {there}: station lab takes no requests from here: only from its own "
            "computer, or with keys or a password where its [control] allows them\n"
        )
    assert not (plain / "x.jpg").exists()
    assert "measuring" in ctl(hosts.station, "status").stdout


GUESS = """
import json, sys, zenoh
from vdms_rt.wire.session import SESSION
config = zenoh.Config()
settings = {"mode": "client", "connect/endpoints": [sys.argv[1]], "connect/timeout_ms": 20000}
for name, value in {**SESSION, **settings}.items():
    config.insert_json5(name, json.dumps(value))
anything = {"accept_replies": zenoh.ReplyKeyExpr.ANY, "timeout": 20}
with zenoh.open(config) as session:
    for key in ("**", "vdms/**", "vdms/lab/**", "vdms/lab/control/*", "vdms/*/control/zero"):
        assert not list(session.get(key, target=zenoh.QueryTarget.ALL, **anything)), key
    kept = session.get("vdms/lab/m1/displacement/@adv/**", **anything)
    print(len([reply for reply in kept if reply.ok is not None]))
"""


def test_a_reader_gets_around_it_by_no_other_key(hosts: Hosts, plain: Path) -> None:
    there = f"tcp/{hosts.station.address}:7447"
    guessed = hosts.laptop.run("-c", GUESS, there)
    assert guessed.returncode == 0, guessed.stderr
    assert int(guessed.stdout) > 0


def test_nothing_else_listens(hosts: Hosts, plain: Path) -> None:
    assert listening(hosts.station) == {"tcp/0.0.0.0:7447"}


"""
"""


def test_a_reader_deceives_nobody(hosts: Hosts, plain: Path) -> None:
    there = f"tcp/{hosts.station.address}:7447"
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with hosts.laptop.start("-c", FORGE, there, **pipes) as forger:
        assert forger.stdout is not None
        assert forger.stdin is not None
        try:
            assert forger.stdout.readline() == "forged\n"
            answer = ctl(hosts.station, "status")
            seen = hosts.station.run("-c", LISTEN, "tcp/127.0.0.1:7447")
        finally:
            forger.stdin.close()
    assert "measuring" in answer.stdout
    assert seen.returncode == 0, seen.stderr
    assert int(seen.stdout) > 100


LISTEN = """
import sys
from vdms_rt.subscribe import Sample, subscribe
count = 0
with subscribe("vdms/**", sys.argv[1], notices=True) as items:
    while (item := items.get(20)) is not None and count < 200:
        assert item.station == "lab", item
        if isinstance(item, Sample) and item.topic == "displacement":
            assert item.value.session != 666
            count += 1
print(count)
"""


ASK = """
import json, sys
from pathlib import Path
from vdms_rt.control.client import Controller, ControlError, Credentials
from vdms_rt.wire.control_pb2 import RecordRequest
for connect, keys, user, password, note in json.loads(sys.argv[1]):
    credentials = Credentials(keys and Path(keys), user, password)
    try:
        with Controller(connect, credentials=credentials) as station:
            answer = station.ask("record", action=RecordRequest.MARK, text=note)
        print(answer.text)
    except ControlError as error:
        print(error)
"""


def ask(host: Host, *asked: tuple[str, Path | None, str, str, str]) -> list[str]:
    """Try to put notes (address, keys, user, password, note) into the log; return the answers."""
    tried = host.run("-c", ASK, json.dumps(asked, default=str))
    assert tried.returncode == 0, tried.stderr
    return tried.stdout.splitlines()


def test_only_who_has_credentials_controls_from_elsewhere(
    hosts: Hosts, guarded: Path, secrets: Path
) -> None:
    at = hosts.station.address
    tcp, tls, password = f"tcp/{at}:8447", f"tls/{at}:8448", f"tcp/{at}:8449"
    ann = secrets / "keys" / "clients" / "ann"
    answers = ask(
        hosts.laptop,
        (tls, ann, "", "", "allowed to ann"),
        (password, None, "bob", "swordfish", "allowed to bob"),
        (tcp, None, "", "", "forbidden"),
        (tcp, None, "bob", "swordfish", "forbidden"),
        (tls, secrets / "other" / "clients" / "ann", "", "", "forbidden"),
        (password, None, "", "", "forbidden"),
        (password, None, "bob", "herring", "forbidden"),
        (password, None, "eve", "swordfish", "forbidden"),
    )
    for answer, who in zip(answers, ("ann", "bob"), strict=False):
        assert re.fullmatch(rf"marked at seq \d+: allowed to {who}", answer)
    refusals = ["station lab takes no requests from here", *["no connection within 5 s"] * 5]
    for answer, refusal in zip(answers[2:], refusals, strict=True):
        assert refusal in answer
    # A note by the station's own computer ends what was told to it before.
    assert "the end" in ask(hosts.station, ("tcp/127.0.0.1:8447", None, "", "", "the end"))[0]
    told = commands(hosts, "the end")
    ways = ("with the certificate of ann", "with a password", "on this computer")
    assert len(told) == 3
    for line, way in zip(told, ways, strict=True):
        assert way in line


EVENTS = """
import sys
from vdms_rt.subscribe import subscribe
with subscribe("vdms/*/event", sys.argv[1]) as events:
    while (event := events.get(20)) is not None:
        if event.value.code.startswith("command"):
            print(event.value.text)
            if sys.argv[2] in event.value.text:
                break
"""


def commands(hosts: Hosts, last: str) -> list[str]:
    """Return the commands that the guarded station was given, up to one with this text."""
    told = hosts.station.run("-c", EVENTS, "tcp/127.0.0.1:8447", last).stdout.splitlines()
    assert last in told[-1]
    return told


def test_only_the_ports_that_were_asked_for_listen(hosts: Hosts, guarded: Path) -> None:
    open_ports = {address.rsplit(":", 1)[1] for address in listening(hosts.station)}
    assert open_ports - {"7447"} == {"8447", "8448", "8449"}
