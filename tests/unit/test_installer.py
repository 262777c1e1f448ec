"""What the installer says when it cannot go on; what it does, the rig shows."""

import os
import subprocess
from pathlib import Path

import pytest

INSTALLER = Path(__file__).parents[2] / "systemd" / "install.sh"


def install(*arguments: str, **settings: str) -> str:
    """Return what the installer complains of; fails when it does not."""
    done = subprocess.run(
        [INSTALLER, *arguments],
        env={**os.environ, **settings},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 1, done.stdout + done.stderr
    return done.stderr


def test_an_unknown_word() -> None:
    assert "unknown: sofware" in install("sofware")


def test_a_python_that_is_not_there() -> None:
    said = install("wheels", PYTHON="/nowhere/python3")
    assert said == (
        "vdms-rt: there is no /nowhere/python3; install it with: apt install python3 python3-venv\n"
    )


@pytest.mark.skipif(os.getuid() == 0, reason="root may install")
def test_somebody_who_is_not_root() -> None:
    assert install() == "vdms-rt: only root can install it; use: sudo make install\n"


@pytest.mark.skipif(os.getuid() != 0, reason="comes after the check for root")
def test_a_folder_of_packages_that_is_not_there(tmp_path: Path) -> None:
    said = install("software", WHEELS=str(tmp_path / "wheels"))
    assert f"WHEELS={tmp_path}/wheels is not a folder; fill one with `make wheels`" in said
