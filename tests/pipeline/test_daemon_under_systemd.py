"""The whole program with a test in systemd's place: what it hears, and when it hears nothing."""

import os
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

DEADLINE_S = 60.0


class Manager:
    """Starts `vdms-rt run` as systemd does, and hears what it says on its socket."""

    def __init__(self, directory: Path, config: str) -> None:
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.settimeout(DEADLINE_S)
        self._socket.bind(str(directory / "notify"))
        file = directory / "vdms-rt.toml"
        common = f"""
[setup]
directory = "{directory}"
[publish]
enabled = false
[record]
directory = "{directory}"
"""
        file.write_text(config + common)
        self._said = directory / "journal"
        self._journal = self._said.open("w")
        about = os.fstat(self._journal.fileno())
        self.process = subprocess.Popen(
            [sys.executable, "-m", "vdms_rt", "run", "--config", str(file)],
            stderr=self._journal,
            env={
                **os.environ,
                "NOTIFY_SOCKET": str(directory / "notify"),
                "JOURNAL_STREAM": f"{about.st_dev}:{about.st_ino}",
            },
        )

    def hear(self) -> str:
        return self._socket.recv(10000).decode()

    def hear_until(self, wanted: Callable[[str], bool]) -> list[str]:
        """Return what it says up to the first word that is wanted."""
        heard = []
        while not (heard and wanted(heard[-1])):
            heard.append(self.hear())
        return heard

    def stop(self) -> int:
        self.process.send_signal(signal.SIGTERM)
        return self.process.wait(DEADLINE_S)

    @property
    def journal(self) -> list[str]:
        return self._said.read_text().splitlines()

    def close(self) -> None:
        self.process.kill()
        self.process.wait()
        self._journal.close()
        self._socket.close()


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Callable[[str], Manager]]:
    managers: list[Manager] = []

    def begin(config: str) -> Manager:
        managers.append(Manager(tmp_path, config))
        return managers[-1]

    yield begin
    for manager in managers:
        manager.close()


def test_a_run_from_ready_to_stopping(start: Callable[[str], Manager]) -> None:
    manager = start('source = "table"')
    heard = manager.hear_until(lambda said: said.startswith("STATUS=measuring"))
    assert heard[0].startswith("EXTEND_TIMEOUT_USEC=")
    assert heard[1] == "READY=1"
    assert "WATCHDOG=1" in heard
    assert " frames/s" in heard[-1]
    assert manager.stop() == 0
    rest = manager.hear_until(lambda said: said.startswith("STATUS=stopping"))
    assert rest[-2:] == ["STOPPING=1", "STATUS=stopping: stopped by SIGTERM"]
    assert any(line.startswith("<6>reference taken") for line in manager.journal)


def test_a_state_without_frames_feeds_the_watchdog(start: Callable[[str], Manager]) -> None:
    manager = start('[v4l2]\ndevice = "/dev/video77"')
    manager.hear_until(lambda said: said.startswith("STATUS=no device"))
    for _ in range(3):
        manager.hear_until(lambda said: said == "WATCHDOG=1")
    assert any(line.startswith("<3>/dev/video77 is not there") for line in manager.journal)
    # Nothing was measured, but it did what it was asked to.
    assert manager.stop() == 0


def test_a_capture_thread_that_hangs_does_not(
    start: Callable[[str], Manager], tmp_path: Path
) -> None:
    os.mkfifo(tmp_path / "record.csv")  # to open it waits for a writer, for ever
    manager = start(
        f'source = "table"\n[table.motion]\nkind = "record"\nfile = "{tmp_path}/record.csv"'
    )
    manager.hear_until(lambda said: said == "WATCHDOG=1")
    for _ in range(5):
        heard = manager.hear_until(lambda said: said.startswith("STATUS="))
        assert "WATCHDOG=1" not in heard
    # What the watchdog sends then makes it show where it hangs.
    manager.process.send_signal(signal.SIGABRT)
    assert manager.process.wait(DEADLINE_S) == -signal.SIGABRT
    assert any("capture/table.py" in line or "motion_path.py" in line for line in manager.journal)
