"""The example of docs/analysis.md runs as it stands there."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import scipy.io
from pypdf import PdfReader
from replaying import write_recording

PAGE = Path(__file__).parents[2] / "docs" / "analysis.md"


def test_the_example_loads_plots_and_exports(tmp_path):
    write_recording(tmp_path / "recording.mcap", range(300))
    (script,) = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", script],
        cwd=tmp_path,
        env={"MPLBACKEND": "agg", "MPLCONFIGDIR": str(tmp_path), "PATH": ""},
        capture_output=True,
        text=True,
        timeout=100,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "lab: 300 samples" in done.stdout
    assert "Savitzky-Golay" in done.stdout
    assert len(PdfReader(tmp_path / "displacement.pdf").pages) == 1
    assert scipy.io.loadmat(tmp_path / "recording.mat")["m1"]["x_mm"][0, 0].shape == (300, 1)
