"""A recording of ours opened by programs that know nothing of us: fields and pictures."""

from __future__ import annotations

import base64
import json
import shutil
import subprocess
from pathlib import Path

import pytest
from logbook import rerun
from replaying import PNG, t_ns_of, write_recording, x_mm_of

MCAP_CORE = Path(__file__).parent / "mcap_core"


@pytest.fixture
def recording(tmp_path):
    return write_recording(tmp_path / "a.mcap", range(120), pixels=True, truth=True)


def test_rerun_shows_typed_fields_and_the_picture(recording, tmp_path):
    check = rerun(tmp_path, "mcap", "check", "--full", str(recording))
    assert check.returncode == 0, check.stdout + check.stderr
    converted = tmp_path / "a.rrd"
    done = rerun(tmp_path, "mcap", "convert", str(recording), "-o", str(converted))
    assert done.returncode == 0, done.stderr
    entity = "/vdms/lab/picture"
    shown = rerun(tmp_path, "rrd", "print", "-v", "--entity", entity, str(converted)).stdout
    assert f"{entity}@EncodedImage:blob" in shown
    entity = "/vdms/lab/m1/displacement"
    shown = rerun(tmp_path, "rrd", "print", "-vvv", "--entity", entity, str(converted)).stdout
    assert '"x_mm": non-null Float64' in shown
    assert "marker: m1, seq: 119, frame_seq: 59, scan: {name: TOP, value: 3}" in shown


def test_mcap_core_reads_fields_pixels_and_the_picture(recording):
    node = shutil.which("node")
    if node is None or not (MCAP_CORE / "node_modules").is_dir():
        pytest.skip("needs Node.js and, once, `npm ci` in tests/replay/mcap_core")
    done = subprocess.run(
        [node, str(MCAP_CORE / "read.js"), str(recording), "vdms/lab/m1/displacement"],
        capture_output=True,
        text=True,
        timeout=100,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["messages"] == {
        "vdms.Run": 1,
        "foxglove.CompressedImage": 1,
        "vdms.Displacement": 120,
        "vdms.Truth": 120,
        "vdms.Pixels": 60,
        "vdms.Health": 2,
        "vdms.Event": 1,
        "vdms.End": 1,
    }
    assert found["samples"] == [[str(n), str(t_ns_of(n)), x_mm_of(n), True, 4] for n in range(120)]
    assert found["pictures"] == [["png", base64.b64encode(PNG).decode()]]
    assert (found["patches"], found["patch_bytes"]) == (60, 60)
    assert found["attachment"] == ["reference.png", "image/png", len(PNG)]
    assert found["metadata"] == {"station": "lab", "version": "9.9"}
