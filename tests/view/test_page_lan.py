"""The page on the network: who may look, and who may control."""

from __future__ import annotations

import contextlib
import subprocess
from collections.abc import Iterator

import pytest
from hosts import Host, Hosts, needs_root, two_hosts

pytestmark = [needs_root, pytest.mark.slow, pytest.mark.timeout(300)]

PORT = 8080
TOKEN = "letmecontrol"
ASK = """
import sys, urllib.error, urllib.request
url, token = sys.argv[1:]
headers = {"Content-Type": "application/json"}
if token:
    headers["Authorization"] = f"Bearer {token}"
print(urllib.request.urlopen(url).status)
for verb in ("status", "find"):
    try:
        urllib.request.urlopen(urllib.request.Request(f"{url}ask/demo/{verb}", b"{}", headers))
    except urllib.error.HTTPError as error:
        print(error.code, error.read().decode())
"""
NOBODY = 502
"""No station runs in these tests: a request that is let through finds none."""


@pytest.fixture(scope="module")
def hosts() -> Iterator[Hosts]:
    with two_hosts() as pair:
        yield pair


@contextlib.contextmanager
def view(host: Host, *options: str) -> Iterator[str]:
    """The page's server on a host; gives what it says when it has started."""
    arguments = ("-m", "vdms_rt", "view", "--port", str(PORT), *options)
    process = host.start(*arguments, stdout=subprocess.PIPE)
    assert process.stdout is not None
    try:
        yield process.stdout.readline()
    finally:
        process.terminate()
        process.communicate(timeout=60)


def asked(host: Host, address: str, token: str = "") -> list[str]:
    """Return what came back of the page, of a question, and of a command."""
    done = host.run("-c", ASK, f"http://{address}:{PORT}/", token)
    return done.stdout.splitlines() or [done.stderr.splitlines()[-1]]


def test_by_default_it_is_for_this_computer_alone(hosts: Hosts) -> None:
    with view(hosts.station) as told:
        assert told == f"page: http://127.0.0.1:{PORT}/\n"
        page, status, find = asked(hosts.station, "127.0.0.1")
        assert (page, status[:3], find[:3]) == ("200", str(NOBODY), str(NOBODY))
        (refused,) = asked(hosts.laptop, hosts.station.address)
        assert "Connection refused" in refused


def test_without_a_token_the_network_looks_and_this_computer_controls(hosts: Hosts) -> None:
    with view(hosts.station, "--host", "0.0.0.0"):
        page, status, find = asked(hosts.laptop, hosts.station.address)
        assert (page, status[:3], find[:3]) == ("200", str(NOBODY), "403")
        assert "looking only" in find
        assert asked(hosts.laptop, hosts.station.address, TOKEN)[2][:3] == "403"
        assert asked(hosts.station, "127.0.0.1")[2][:3] == str(NOBODY)


def test_with_a_token_who_has_it_controls(hosts: Hosts) -> None:
    with view(hosts.station, "--host", "0.0.0.0", "--token", TOKEN) as told:
        assert told.endswith(f"#token={TOKEN}\n")
        assert asked(hosts.laptop, hosts.station.address, TOKEN)[2][:3] == str(NOBODY)
        for wrong in ("", "letmecontro", TOKEN + "l", "ü"):
            find = asked(hosts.laptop, hosts.station.address, wrong)[2]
            assert find[:3] == "403", wrong
            assert "token" in find
        assert asked(hosts.station, "127.0.0.1")[2][:3] == "403"
