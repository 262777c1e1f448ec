"""The product as a system service: installed, plugged in, killed, hung, misconfigured, upgraded and
removed, with systemd as PID 1, udev, and a USB grabber that shows the marker.

The tests build on one another, in this order.
"""

import os
import pwd
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from rig import service
from rig.devices import Grabber, run, wait_for
from rig.service import CONFIG, GRABBER, RECORDINGS, SET_UP, SOFTWARE

pytestmark = [pytest.mark.rig, pytest.mark.systemd, pytest.mark.timeout(400)]

MOST_EXPOSED = 2.0
"""The highest score of `systemd-analyze security`; 10 is no protection at all."""


@pytest.fixture(scope="module")
def installed() -> str:
    """Return what `make install` prints on a computer without a grabber."""
    software = Path("/opt/vdms-rt")
    software.mkdir(exist_ok=True)
    run("mount", "--bind", str(SOFTWARE), str(software))
    return service.make("install")


@pytest.fixture(scope="module")
def grabber(installed: str, tmp_path_factory: pytest.TempPathFactory) -> Grabber:
    """An emulated EasyCAP that sees the marker at rest."""
    grabber = Grabber("usbtv", "EASY01", tmp_path_factory.mktemp("grabber"))
    grabber.set("hold", True)
    yield grabber
    grabber.close()


def test_the_installer_says_what_to_do_next(installed: str) -> None:
    assert "Plug in the grabber" in installed.splitlines()[-1]
    assert "vdms-rt watch" in installed.splitlines()[-1]
    assert CONFIG.read_text() == Path("config/vdms-rt.toml").read_text()
    assert "video" in run("id", "--name", "--groups", "vdms-rt")
    run("systemd-analyze", "verify", "vdms-rt.service", "vdms-rt@second.service")
    # Anybody may use the command.
    version = run("runuser", "-u", "nobody", "--", "/usr/local/bin/vdms-rt", "--version")
    assert version.startswith("vdms-rt ")
    assert service.show("ActiveState") == "inactive"


def test_the_service_is_little_exposed(installed: str, capsys: pytest.CaptureFixture[str]) -> None:
    said = run("systemd-analyze", "security", "--no-pager", "vdms-rt.service")
    with capsys.disabled():
        sys.stdout.write(f"\n{said.splitlines()[-1]}\n")
    (score,) = re.findall(r"Overall exposure level for vdms-rt.service: ([0-9.]+)", said)
    assert float(score) <= MOST_EXPOSED


def test_first_light(grabber: Grabber) -> None:
    """Plugged in, it measures, and nobody has edited a file."""
    node = grabber.plug().node
    assert wait_for(GRABBER.exists, "the grabber's name")
    assert str(GRABBER.resolve()) == node
    service.wait_until("active")
    status = service.wait_until_measuring()
    assert re.search(r"m1  x +[+-]\d+\.\d{3} mm .* \d+\.\d\d frames/s", status), status
    assert f'Status: "{status[:9]}' in run("systemctl", "status", "--no-pager", "vdms-rt")

    pid = service.pid()
    assert pwd.getpwuid(Path(f"/proc/{pid}").stat().st_uid).pw_name == "vdms-rt"
    assert os.sched_getscheduler(pid) == os.SCHED_FIFO
    # Capture and process stay together on one CPU, and nothing else has to.
    allowed = os.sched_getaffinity(0)
    cpus = [os.sched_getaffinity(int(task.name)) for task in Path(f"/proc/{pid}/task").iterdir()]
    assert cpus.count({max(allowed)}) == 2
    assert cpus.count(allowed) == len(cpus) - 2
    (locked_kb,) = re.findall(r"VmLck:\s+(\d+) kB", Path(f"/proc/{pid}/status").read_text())
    assert int(locked_kb) > 10_000
    assert list(RECORDINGS.glob("station_*.mcap.part"))
    assert SET_UP.exists()

    said = service.journal()
    assert any("frames come from" in line for line in said)
    assert any(line.startswith("reference taken") for line in said)
    # Neither priorities nor times are left in the text.
    assert not [line for line in said if re.match(r"<\d>|\d\d:\d\d:\d\d", line)]
    assert service.show("NRestarts") == "0"


def test_the_same_process_goes_on_after_a_pulled_cable(grabber: Grabber) -> None:
    pid = service.pid()
    grabber.unplug()
    wait_for(lambda: "measuring" not in service.show("StatusText"), "a word of it", 60)
    grabber.plug()
    service.wait_until_measuring()
    assert service.pid() == pid
    assert service.journal("@0", "--priority=err") != []


def test_the_sandbox_lets_it_reset_the_grabber(grabber: Grabber) -> None:
    pid, begun = service.pid(), service.now()
    grabber.set("wedge", True)
    reset = "it is reset over USB"
    wait_for(
        lambda: any(reset in line for line in service.journal(begun)), reset, service.DEADLINE_S
    )
    service.wait_until_measuring()
    assert service.pid() == pid


def test_what_was_killed_comes_back(grabber: Grabber, capsys: pytest.CaptureFixture[str]) -> None:
    pid, begun = service.pid(), service.now()
    killed_s = time.monotonic()
    os.kill(pid, signal.SIGKILL)
    wait_for(lambda: service.pid() not in (0, pid), "a new process", service.DEADLINE_S)
    new_s = time.monotonic() - killed_s
    service.wait_until("active")
    # The emulated cable does not always outlive who is killed in the middle of a transfer.
    if not grabber.device():
        grabber.plug()
    service.wait_until_measuring()
    measuring_s = time.monotonic() - killed_s
    with capsys.disabled():
        sys.stdout.write(
            f"\nkilled: a new process {new_s:.1f} s, measuring {measuring_s:.1f} s later\n"
        )
    assert service.show("NRestarts") == "1"
    said = service.journal(begun)
    # Nothing of the recording was lost, nor of the set-up.
    assert any(re.search(r"\.mcap: repaired, \d+ messages", line) for line in said)
    assert any("the stored set-up, revision" in line and "holds" in line for line in said)
    assert list(RECORDINGS.glob("station_*.mcap"))


def test_what_hangs_is_ended_by_the_watchdog(
    grabber: Grabber, capsys: pytest.CaptureFixture[str]
) -> None:
    # From here on without frames, which keep the virtual machine so busy that all takes long.
    if grabber.device():
        grabber.unplug()
    pid, begun = service.pid(), service.now()
    hung_s = time.monotonic()
    os.kill(pid, signal.SIGSTOP)
    wait_for(lambda: service.pid() not in (0, pid), "a new process", service.DEADLINE_S)
    with capsys.disabled():
        sys.stdout.write(f"\nhung: a new process {time.monotonic() - hung_s:.1f} s later\n")
    service.wait_until("active")
    assert service.show("NRestarts") == "2"
    wait_for(lambda: service.show("StatusText").startswith("no device"), "its state", 60)
    assert any("Watchdog timeout" in line for line in service.journal(begun))


def test_a_wrong_configuration_is_one_line_and_no_restart(installed: str) -> None:
    right, begun = CONFIG.read_text(), service.now()
    CONFIG.write_text(right.replace("ring_slots = 64", "ring_slots = 6"))
    run("systemctl", "stop", "vdms-rt")
    subprocess.run(["systemctl", "start", "vdms-rt"], check=False, timeout=service.DEADLINE_S)
    service.wait_until("failed")
    assert service.show("ExecMainStatus") == "78"
    assert service.show("NRestarts") == "0"
    # The last words of the run before, and one of this one.
    *_, line = said = service.journal(begun, "--identifier=vdms-rt")
    fault = "process.ring_slots = 6: input should be greater than or equal to 64"
    assert line == f"{CONFIG}: {fault}"
    assert len([line for line in said if str(CONFIG) in line]) == 1
    CONFIG.write_text(right)


def test_an_upgrade_keeps_the_configuration_and_restarts(installed: str) -> None:
    # Corrected, it starts.
    run("systemctl", "start", "vdms-rt")
    CONFIG.write_text(CONFIG.read_text().replace('name = "station"', 'name = "tower"'))
    said = service.make("install")
    assert f"{CONFIG} stays as it is" in said
    assert said.splitlines()[-1] == "vdms-rt: the service runs; look at it with: vdms-rt watch"
    assert service.show("ActiveState") == "active"
    wait_for(lambda: list(RECORDINGS.glob("tower_*.mcap.part")), "a recording", service.DEADLINE_S)


def test_removed_it_leaves_what_was_measured(installed: str) -> None:
    # The software itself goes first: to remove its 7000 files takes the guest minutes.
    run("systemctl", "stop", "vdms-rt")
    run("umount", "/opt/vdms-rt")
    Path("/opt/vdms-rt/0123456789ab/bin").mkdir(parents=True)
    recordings = {path.name.removesuffix(".part") for path in RECORDINGS.iterdir()}
    said = service.make("uninstall")
    assert "/var/log/vdms-rt stays" in said
    assert service.show("LoadState") == "not-found"
    assert {path.name for path in RECORDINGS.iterdir()} == recordings
    assert CONFIG.exists()
    assert SET_UP.exists()
    assert not Path("/usr/local/bin/vdms-rt").exists()
    assert not Path("/opt/vdms-rt").exists()
