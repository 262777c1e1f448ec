"""The installed service, as a test and a person see it: systemctl, the journal, its files."""

import subprocess
import time
from pathlib import Path

from rig.devices import REPOSITORY, run, wait_for

SOFTWARE = REPOSITORY / ".rig" / "software"
"""/opt/vdms-rt, made by the product's installer on the host: unpacking and compiling all that takes
two minutes in the guest. The guest's installer finds it complete, and goes on from there."""

CONFIG = Path("/etc/vdms-rt/vdms-rt.toml")
RECORDINGS = Path("/var/log/vdms-rt/recordings")
SET_UP = Path("/var/lib/vdms-rt/set-up.json")
GRABBER = Path("/dev/vdms-grabber")

DEADLINE_S = 150.0
"""How long a test waits for what must come; reached only when it fails."""


def make(target: str) -> str:
    """Run make in the repository as root, and return what it printed."""
    done = subprocess.run(
        ["make", "--no-print-directory", "-C", str(REPOSITORY), target],
        capture_output=True,
        text=True,
        timeout=DEADLINE_S,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def show(what: str) -> str:
    """Return one of the unit's properties."""
    return run("systemctl", "show", "vdms-rt", "--value", "--property", what).strip()


def pid() -> int:
    return int(show("MainPID"))


def wait_until(state: str) -> None:
    """Wait until the unit is `active`, `failed` ..."""
    wait_for(lambda: show("ActiveState") == state, f"{state}\n{everything()}", DEADLINE_S)


def wait_until_measuring() -> str:
    """Wait until `systemctl status` shows a position, and return its status line."""

    def status() -> str:
        text = show("StatusText")
        measuring = text.startswith("measuring") and " mm " in text
        return text if measuring and " 0.00 frames" not in text else ""

    try:
        return wait_for(status, "measuring", DEADLINE_S)
    except AssertionError as error:
        raise AssertionError(f"{error}\n{everything()}") from None


def now() -> str:
    """Return the time, for `journal`."""
    return f"@{time.time():.6f}"


def journal(since: str = "@0", *options: str) -> list[str]:
    """Return the service's journal since a time: what a person reads, without the time."""
    run("journalctl", "--sync")
    which = [] if "--identifier=vdms-rt" in options else ["--unit=vdms-rt"]
    said = run("journalctl", "--quiet", "--output=cat", f"--since={since}", *which, *options)
    return said.splitlines()


def everything() -> str:
    """Return status and journal, for the person who looks at a failed test."""
    status = subprocess.run(
        ["systemctl", "status", "--no-pager", "--lines=0", "vdms-rt"],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    return "\n".join([status.stdout, *journal()[-60:]])
