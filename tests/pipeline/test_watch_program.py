"""`vdms-rt watch` as a person starts it: on a terminal, in a pipe, with a CSV."""

from __future__ import annotations

import csv
import fcntl
import os
import pty
import re
import signal
import struct
import subprocess
import sys
import termios
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from loopback import DEADLINE_S, free_endpoint, publisher, say

from vdms_rt.model import Event, Severity
from vdms_rt.publish import Publisher
from vdms_rt.wire import convert, topics

WATCH = (
    "import sys; from pathlib import Path; from vdms_rt.watch import run_watch; "
    "sys.exit(run_watch(sys.argv[1], Path(sys.argv[2]) if sys.argv[2:] else None))"
)


def start(endpoint: str, *arguments: str, stdout: int = subprocess.PIPE) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-c", WATCH, endpoint, *arguments],
        stdout=stdout,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"TERM": "xterm-256color"},
    )


@contextmanager
def speaking(endpoint: str, session: int = 7, name: str = "s1") -> Iterator[Publisher]:
    """A station that says a sample each 5 ms, from a thread."""
    stop = threading.Event()
    with publisher(endpoint, name) as station:

        def speak() -> None:
            seq = 0
            while not stop.wait(0.005):
                say(station, seq, session=session)
                seq += 1

        thread = threading.Thread(target=speak)
        thread.start()
        try:
            yield station
        finally:
            stop.set()
            thread.join()


def line_with(process: subprocess.Popen[str], text: str) -> str:
    assert process.stdout is not None
    for line in process.stdout:
        if text in line:
            return line
    raise AssertionError(f"it ended without saying {text!r}")


def end(process: subprocess.Popen[str], number: signal.Signals = signal.SIGINT) -> str:
    process.send_signal(number)
    out, err = process.communicate(timeout=DEADLINE_S)
    assert (process.returncode, err) == (0, "")
    return out or ""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_in_a_pipe_it_is_plain_lines_and_a_summary(number: signal.Signals) -> None:
    endpoint = free_endpoint()
    watch = start(endpoint)
    assert line_with(watch, "waiting for") == f"waiting for {endpoint} ...\n"
    with speaking(endpoint) as station:
        assert "s1: arrived" in line_with(watch, "arrived")
        line = line_with(watch, "s1/m1  x")
        assert re.fullmatch(r"s1/m1  x +\+\d+\.0000 mm  y +-0\.5000 mm  rotation .*\n", line)
        event = Event(Severity.INFO, "state", "taking [the] reference")
        station.put(topics.EVENT, "", convert.event_bytes(event, 7))
        assert "s1: taking [the] reference" in line_with(watch, "reference")
    assert "s1: left" in line_with(watch, "left")
    out = end(watch, number)
    assert re.fullmatch(r"s1/m1: \d+ samples, 0 missed", out.splitlines()[-1])
    assert "\x1b" not in out


@pytest.mark.slow
def test_every_sample_is_in_the_csv_over_restarts_of_station_and_watch(tmp_path: Path) -> None:
    path = tmp_path / "samples.csv"
    endpoint = free_endpoint()
    watch = start(endpoint, str(path))
    with speaking(endpoint, session=1):
        line_with(watch, "s1/m1  x")
    line_with(watch, "left")
    with speaking(endpoint, session=2):
        line_with(watch, "s1/m1  x")
        watch.kill()
        watch.communicate(timeout=DEADLINE_S)
        watch = start(endpoint, str(path))
        line_with(watch, "s1/m1  x")
        line_with(watch, "s1/m1  x")
    line_with(watch, "left")
    out = end(watch)
    assert out.splitlines()[-1].endswith(f" samples written to {path}")
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    for session in ("1", "2"):
        seqs = [int(row["seq"]) for row in rows if row["session"] == session.rjust(16, "0")]
        assert seqs == list(range(len(seqs)))
        assert len(seqs) > 100
        assert [float(r["x_mm"]) for r in rows if r["session"][-1] == session] == seqs


def test_on_a_terminal_it_is_a_screen_that_comes_and_goes() -> None:
    endpoint = free_endpoint()
    near, far = pty.openpty()
    fcntl.ioctl(far, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 100, 0, 0))
    watch = start(endpoint, stdout=far)
    os.close(far)
    seen = ""

    def read_until(pattern: str) -> None:
        nonlocal seen
        while not re.search(pattern, seen, re.DOTALL):
            seen += os.read(near, 65536).decode(errors="replace")

    try:
        read_until("waiting for " + re.escape(endpoint))
        with speaking(endpoint):
            read_until("s1: arrived.*s1.*m1.*-0.5000.*x of s1/m1, mm.*[\u2801-\u28ff].*now")
        seen = ""
        read_until("gone")
        watch.send_signal(signal.SIGINT)
        _, err = watch.communicate(timeout=DEADLINE_S)
        read_until(r"\x1b\[\?1049l.*s1/m1: \d+ samples, 0 missed\r\n")
    finally:
        os.close(near)
        watch.kill()
        watch.wait()
    assert (watch.returncode, err) == (0, "")


def test_several_stations_at_several_addresses_are_one_screen_s_worth() -> None:
    first, second = free_endpoint(), free_endpoint()
    with speaking(first, name="north"), speaking(second, session=8, name="south"):
        process = subprocess.Popen(
            [sys.executable, "-m", "vdms_rt", "watch", "--connect", first, "--connect", second],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        for name in ("north/m1", "south/m1"):
            assert " x " in line_with(process, f"{name}  x")
        summary = end(process)
    assert re.search(r"^north/m1: \d+ samples, 0 missed$", summary, re.MULTILINE)
    assert re.search(r"^south/m1: \d+ samples, 0 missed$", summary, re.MULTILINE)
