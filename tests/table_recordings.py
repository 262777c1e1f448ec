"""Recordings of the virtual table at full pace, made by the whole program."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path


def record(directory: Path, table: str = "", extra: str = "", record: str = "") -> list[Path]:
    """Return the files of a run on the virtual table: `table`, `record` are lines of those
    sections, `extra` other sections."""
    directory.mkdir(parents=True, exist_ok=True)
    config = directory / "vdms.toml"
    config.write_text(
        f"""
source = "table"
[station]
name = "lab"
[table]
pace = "fast"
rest_s = 1.2
frames = 240
{table}
[setup]
load = false
store = false
reference_pictures = 15
[publish]
enabled = false
[record]
directory = "{directory / "recordings"}"
{record}
{extra}
"""
    )
    done = subprocess.run(
        [sys.executable, "-m", "vdms_rt", "run", "--config", str(config)],
        capture_output=True,
        text=True,
        timeout=110,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return sorted((directory / "recordings").iterdir())
