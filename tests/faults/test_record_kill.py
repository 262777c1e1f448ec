"""A recording process that is killed at any moment leaves all but its last second."""

from __future__ import annotations

import random
import subprocess
import sys
import time
from itertools import pairwise
from pathlib import Path

import pytest
from logbook import files, rerun, samples_in

from vdms_rt.logfile.repair import repair_directory

WRITER = Path(__file__).parents[1] / "kill_writer.py"
MOST_LOST_NS = 1_000_000_000
STALL_NS = 20_000_000
"""Between two samples, 5 ms apart: longer ones are the machine's, in which nothing happens."""


def killed_after(seconds, directory):
    """Return when each seq was put, by a writer that was killed after `seconds` of recording, and
    when it was killed."""
    with subprocess.Popen(
        [sys.executable, str(WRITER), str(directory)], stdout=subprocess.PIPE
    ) as writer:
        first = writer.stdout.readline()
        time.sleep(seconds)
        killed_ns = time.monotonic_ns()
        writer.kill()
        lines = [first, *writer.stdout.read().splitlines(keepends=True)]
    said = [line.split() for line in lines if line.endswith(b"\n")]
    return {int(seq): int(put_ns) for seq, put_ns in said}, killed_ns


def check_round(directory, seconds):
    put_ns, killed_ns = killed_after(seconds, directory)
    parts = [path for path in files(directory) if path.name.endswith(".part")]
    repaired = repair_directory(directory)
    assert len(repaired) == len(parts) <= 1
    assert all(path.suffix == ".mcap" for path in files(directory))
    found = [seq for path in files(directory) for seq in samples_in(path)]
    assert found == list(range(len(found)))
    lost = [ns for seq, ns in put_ns.items() if seq >= len(found)]
    gaps_ns = [after - before for before, after in pairwise([*lost, killed_ns])]
    assert sum(min(gap, STALL_NS) for gap in gaps_ns) <= MOST_LOST_NS
    return repaired, sum(gaps_ns) / 1e9


def test_a_killed_recording_is_repaired_and_read_by_others(tmp_path):
    chance = random.Random(7)
    for number in range(2):
        directory = tmp_path / str(number)
        repairs, _ = check_round(directory, chance.uniform(0.6, 1.6))
        for repaired in repairs:
            if repaired.path.exists():
                check = rerun(tmp_path, "mcap", "check", str(repaired.path))
                assert check.returncode == 0, check.stdout + check.stderr


@pytest.mark.slow
@pytest.mark.parametrize(
    "kills", [20, pytest.param(200, marks=[pytest.mark.soak, pytest.mark.timeout(3000)])]
)
def test_kills_lose_at_most_a_second_each(tmp_path, kills, capsys):
    chance = random.Random(kills)
    lost_s = sorted(
        check_round(tmp_path / str(number), chance.uniform(0.05, 2.5))[1] for number in range(kills)
    )
    with capsys.disabled():
        sys.stdout.write(
            f"\nlost by the clock: median {lost_s[kills // 2]:.2f} s, at most {lost_s[-1]:.2f} s\n"
        )
