"""A station, the page's server and a browser, for the tests of the page."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest
from loopback import free_endpoint
from playwright.sync_api import Browser, Page, expect, sync_playwright

DEADLINE_S = 60.0
"""How long a test waits for what must come; reached only when it fails."""
MOVING = Path("config/demo.toml")
REST_S = {True: 8.0, False: 600.0}
"""Until the table moves: a busy computer takes a while to find the markers and the reference."""
SWITCHES = [
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]

expect.set_options(timeout=DEADLINE_S * 1000)


def chromium() -> str:
    """Return the path of a Chromium; without one a test is skipped, or fails where it must run."""
    for name in ("chromium", "chromium-browser", "google-chrome"):
        if path := shutil.which(name):
            return path
    why = "the page cannot be tested without a browser: apt install chromium"
    if os.environ.get("CI"):
        pytest.fail(why)
    pytest.skip(why)


@contextlib.contextmanager
def browser() -> Iterator[Browser]:
    path = chromium()
    with sync_playwright() as playwright:
        running = playwright.chromium.launch(
            executable_path=path, args=SWITCHES, timeout=DEADLINE_S * 1000
        )
        try:
            yield running
        finally:
            running.close()


@dataclass
class Program:
    """`vdms-rt` with these arguments, as a process."""

    arguments: list[str]
    log: Path
    process: subprocess.Popen[str] | None = field(default=None, init=False)

    def start(self) -> None:
        with self.log.open("a") as log:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "vdms_rt", *self.arguments],
                stdout=subprocess.PIPE,
                stderr=log,
                text=True,
            )

    def stop(self, number: signal.Signals = signal.SIGTERM) -> None:
        assert self.process is not None
        self.process.send_signal(number)
        self.process.communicate(timeout=DEADLINE_S)


@dataclass
class Station(Program):
    endpoint: str

    def wait(self) -> None:
        """Until it listens."""
        assert self.process is not None
        host, port = self.endpoint.removeprefix("tcp/").rsplit(":", 1)
        until_s = time.monotonic() + DEADLINE_S
        while True:
            with contextlib.suppress(OSError), socket.create_connection((host, int(port)), 1.0):
                return
            assert self.process.poll() is None, self.log.read_text()
            assert time.monotonic() < until_s, self.log.read_text()
            time.sleep(0.1)


@contextlib.contextmanager
def station(directory: Path, *, moving: bool) -> Iterator[Station]:
    """The demo, its table in motion or at rest for good."""
    endpoint = free_endpoint()
    text = MOVING.read_text().replace("tcp/127.0.0.1:7447", endpoint)
    text = text.replace("demo-recordings", str(directory / "recordings"))
    assert "rest_s = 4.0\n" in text
    text = text.replace("rest_s = 4.0\n", f"rest_s = {REST_S[moving]}\n")
    config = directory / "station.toml"
    config.write_text(text)
    running = Station(
        ["run", "--config", str(config)], log=directory / "station.log", endpoint=endpoint
    )
    running.start()
    try:
        running.wait()
        yield running
    finally:
        if running.process is not None and running.process.poll() is None:
            running.stop()


@dataclass
class Server(Program):
    url: str = ""

    def start(self) -> None:
        super().start()
        assert self.process is not None
        assert self.process.stdout is not None
        told = self.process.stdout.readline()
        assert told.startswith("page: http://"), self.log.read_text()
        self.url = told.removeprefix("page: ").strip()


@contextlib.contextmanager
def server(directory: Path, *endpoints: str, options: tuple[str, ...] = ()) -> Iterator[Server]:
    """The page's server, at a free port that stays its own."""
    port = free_endpoint().rsplit(":", 1)[1]
    connect = [word for endpoint in endpoints for word in ("--connect", endpoint)]
    running = Server(["view", *connect, "--port", port, *options], log=directory / "view.log")
    running.start()
    try:
        yield running
    finally:
        if running.process is not None and running.process.poll() is None:
            running.stop()


@contextlib.contextmanager
def opened(
    chrome: Browser, url: str, *, width: int = 1280, height: int = 720, scheme: str = "light"
) -> Iterator[Page]:
    """The page in a window of its own; whatever the browser complains of fails the test."""
    context = chrome.new_context(
        viewport={"width": width, "height": height},
        color_scheme="dark" if scheme == "dark" else "light",
    )
    context.set_default_timeout(DEADLINE_S * 1000)
    page = context.new_page()
    faults: list[str] = []
    page.on("pageerror", lambda error: faults.append(error.stack or str(error)))
    page.on(
        "console",
        lambda message: faults.append(message.text) if "Security Policy" in message.text else None,
    )
    page.goto(url)
    try:
        yield page
    finally:
        context.close()
    assert faults == [], faults
