"""Two computers on one cable: network namespaces and a veth pair. Needs root and iproute2."""

from __future__ import annotations

import contextlib
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent

DEADLINE_S = 60.0

needs_root = pytest.mark.skipif(
    os.geteuid() != 0 or shutil.which("ip") is None,
    reason="network namespaces need root and iproute2",
)


@dataclass(frozen=True)
class Host:
    """One of the two computers."""

    name: str
    address: str
    device: str

    def start(self, *arguments: object, **options: object) -> subprocess.Popen[str]:
        """Start a Python program on it."""
        environment = os.environ | {"PYTHONPATH": f"{ROOT / 'src'}:{ROOT / 'tests'}"}
        return subprocess.Popen(
            ["ip", "netns", "exec", self.name, sys.executable, *map(str, arguments)],
            text=True,
            env=environment,
            **options,  # type: ignore[call-overload]
        )

    def run(self, *arguments: object, timeout_s: float = 60) -> subprocess.CompletedProcess[str]:
        """Run a Python program on it to its end."""
        with self.start(
            *arguments, stdout=subprocess.PIPE, stderr=subprocess.PIPE, stdin=subprocess.DEVNULL
        ) as process:
            try:
                out, err = process.communicate(timeout=timeout_s)
            except subprocess.TimeoutExpired:
                process.kill()
                raise
        return subprocess.CompletedProcess(process.args, process.returncode, out, err)


@dataclass(frozen=True)
class Hosts:
    """A station and a laptop, and the cable between them."""

    station: Host
    laptop: Host

    def pull(self) -> None:
        """Take the link down, at the laptop's end."""
        _ip("-n", self.laptop.name, "link", "set", self.laptop.device, "down")

    def plug(self) -> None:
        _ip("-n", self.laptop.name, "link", "set", self.laptop.device, "up")


@contextlib.contextmanager
def two_hosts() -> Iterator[Hosts]:
    tag = f"{os.getpid() % 100000}"
    subnet = f"10.{200 + os.getpid() % 50}.{os.getpid() // 50 % 250}"
    station = Host(f"vdms-s{tag}", f"{subnet}.1", f"vs{tag}")
    laptop = Host(f"vdms-l{tag}", f"{subnet}.2", f"vl{tag}")
    both = (station, laptop)
    with contextlib.ExitStack() as stack:
        for host in both:
            _ip("netns", "add", host.name)
            stack.callback(_ip, "netns", "del", host.name)
        _ip(
            *("link", "add", station.device, "netns", station.name, "type", "veth"),
            *("peer", "name", laptop.device, "netns", laptop.name),
        )
        for host in both:
            _ip("-n", host.name, "address", "add", f"{host.address}/24", "dev", host.device)
            for device in ("lo", host.device):
                _ip("-n", host.name, "link", "set", device, "up")
        yield Hosts(station, laptop)


@contextlib.contextmanager
def running(host: Host, folder: Path, sections: str) -> Iterator[Path]:
    """A whole station on a host; gives the folder of its recordings, whole after it has ended."""
    config = folder / "vdms.toml"
    config.write_text(f"""
source = "table"
station.name = "lab"
setup.directory = "{folder}"
[table.motion]
kind = "still"
[record]
directory = "{folder / "recordings"}"
{sections}
""")
    with (folder / "log").open("w") as log:
        station = host.start("-m", "vdms_rt", "run", "--config", config, stderr=log)
        try:
            until_s = time.monotonic() + DEADLINE_S
            while "reference taken" not in (folder / "log").read_text():
                assert time.monotonic() < until_s, (folder / "log").read_text()
                assert station.poll() is None, (folder / "log").read_text()
                time.sleep(0.05)
            yield folder / "recordings"
        finally:
            station.terminate()
            station.wait(DEADLINE_S)


def _ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True, capture_output=True, text=True)
