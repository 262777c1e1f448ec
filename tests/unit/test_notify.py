"""What systemd hears on the socket that it names, and what the journal gets to read."""

import logging
import re
import secrets
import socket
import sys
from pathlib import Path

import pytest

from vdms_rt.console import Console, fault_text
from vdms_rt.model import ConfigError
from vdms_rt.notify import Notifier


def listen(address: str) -> socket.socket:
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    listener.settimeout(5)
    listener.bind(address)
    return listener


@pytest.mark.parametrize("kind", ["path", "abstract"])
def test_it_speaks_the_protocol(kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    name = str(tmp_path / "notify") if kind == "path" else f"@vdms-{secrets.token_hex(8)}"
    monkeypatch.setenv("NOTIFY_SOCKET", name)
    with listen(name.replace("@", "\0")) as listener:
        with Notifier() as notifier:
            notifier.busy(90)
            notifier.ready()
            notifier.status("measuring  29.97 frames/s")
            notifier.progress()
            notifier.stopping()
        assert [listener.recv(1000).decode() for _ in range(5)] == [
            "EXTEND_TIMEOUT_USEC=90000000",
            "READY=1",
            "STATUS=measuring  29.97 frames/s",
            "WATCHDOG=1",
            "STOPPING=1",
        ]


@pytest.mark.parametrize("address", ["", "/nowhere/at/all"])
def test_nobody_need_listen(address: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NOTIFY_SOCKET", address)
    with Notifier() as notifier:
        notifier.ready()


def said_in(path: Path, journal: str, monkeypatch: pytest.MonkeyPatch) -> tuple[str, str]:
    """Return what log records and a fault become on standard error when that is a file;
    `journal` is JOURNAL_STREAM, `here` for what says that the file is the journal."""
    with path.open("w") as file, monkeypatch.context() as patch:
        about = path.stat()
        here = f"{about.st_dev}:{about.st_ino}"
        patch.setenv("JOURNAL_STREAM", here if journal == "here" else journal)
        patch.setattr(sys, "stderr", file)
        console = Console()
        for text, level in (
            ("frames come", logging.INFO),
            ("no marker", logging.WARNING),
            ("two\nlines", logging.ERROR),
        ):
            console.handle(logging.LogRecord("vdms_rt", level, "", 0, text, None, None))
        return path.read_text(), fault_text(ConfigError("a\nb"))


def test_lines_for_the_journal_carry_their_priority_and_no_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log, fault = said_in(tmp_path / "stderr", "here", monkeypatch)
    assert log == "<6>frames come\n<4>no marker\n<3>two\n<3>lines\n"
    assert fault == "<3>a\n<3>b"


# A desktop hands the JOURNAL_STREAM of its own service down to every terminal.
@pytest.mark.parametrize("journal", ["", "1:1"])
def test_elsewhere_they_carry_the_time(
    journal: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log, fault = said_in(tmp_path / "stderr", journal, monkeypatch)
    assert re.match(r"\d\d:\d\d:\d\d frames come\n\d\d:\d\d:\d\d no marker\n", log)
    assert fault == "vdms-rt: a\nvdms-rt: b"
