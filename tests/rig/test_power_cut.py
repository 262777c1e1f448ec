"""A computer whose power is cut while it records on ext4: its last two seconds, and nothing else.

Each round boots the virtual machine, records, and resets it without any warning; then this machine
completes the disk's journal, takes the files out and looks at them.
"""

from __future__ import annotations

import hashlib
import os
import random
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import pytest
from logbook import PIXELS, files, read_whole, samples_in

from vdms_rt.logfile.repair import repair_directory

pytestmark = [pytest.mark.rig, pytest.mark.power]

HERE = Path(__file__).parent
MOST_LOST_NS = 2_000_000_000
STALL_NS = 200_000_000
"""Between two samples, 40 ms apart: longer ones are the machine's, in which nothing happens."""
GUEST_DIED = 125


def run(*command: object) -> str:
    done = subprocess.run(
        [*map(str, command)], capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


class Disk:
    """A disk with ext4 and a file on it that nobody touches."""

    def __init__(self, directory: Path) -> None:
        self.image = directory / "disk.img"
        self._content = directory / "content"
        self._content.mkdir()
        self.keepsake = os.urandom(3_000_000)
        (self._content / "keepsake").write_bytes(self.keepsake)
        with self.image.open("wb") as file:
            file.truncate(512 << 20)
        run("mkfs.ext4", "-q", "-d", self._content, self.image)

    def take_out(self, to: Path) -> Path:
        """Complete the journal, prove that the file system is whole, and copy all files."""
        # 1: something was mended, which is the journal.
        done = subprocess.run(["e2fsck", "-p", str(self.image)], capture_output=True, check=False)
        assert done.returncode in (0, 1), done.stdout
        run("e2fsck", "-f", "-n", self.image)
        to.mkdir()
        run("debugfs", "-R", f"rdump / {to}", self.image)
        assert (to / "keepsake").read_bytes() == self.keepsake
        return to / "recordings"


def record_until_cut(disk: Disk, seconds: float) -> tuple[dict[int, int], int, list[str]]:
    """Return when each seq was put, when the power went, and what was repaired before."""
    station = [sys.executable, HERE / "power_station.py", "/dev/vda", f"{seconds:.3f}"]
    boot = [HERE / "vm.sh", "-t", "240", "-d", disk.image, "--", "env", f"PYTHONPATH={HERE.parent}"]
    done = subprocess.run(
        [*map(str, boot), *map(str, station)],
        capture_output=True,
        text=True,
        timeout=280,
        check=False,
    )
    assert done.returncode == GUEST_DIED, done.stdout[-2000:] + done.stderr
    lines = [line.split(" ", 1) for line in done.stdout.splitlines()]
    put = dict(map(int, what.split()) for word, what in lines if word == "put")
    (cut_ns,) = [int(what) for word, what in lines if word == "cut"]
    return put, cut_ns, [what for word, what in lines if word == "repaired"]


def digests(directory: Path) -> dict[str, str]:
    return {
        path.name: hashlib.sha256(path.read_bytes()).hexdigest()
        for path in files(directory)
        if path.suffix == ".mcap"
    }


@pytest.mark.parametrize(
    "cuts",
    [
        pytest.param(3, marks=pytest.mark.timeout(900)),
        pytest.param(20, marks=[pytest.mark.soak, pytest.mark.timeout(6000)]),
    ],
)
def test_a_power_cut_costs_at_most_two_seconds(
    tmp_path: Path, cuts: int, capsys: pytest.CaptureFixture[str]
) -> None:
    disk = Disk(tmp_path)
    chance = random.Random(cuts)
    before: dict[str, str] = {}
    left: list[str] = []
    old: set[str] = set()
    for number in range(cuts):
        put_ns, cut_ns, repaired = record_until_cut(disk, chance.uniform(2.0, 6.0))
        names = [said.split(":")[0] for said in repaired if ": repaired, " in said]
        assert [name.rsplit("/", 1)[1] for name in names] == left
        directory = disk.take_out(tmp_path / str(number))

        # What was whole before is untouched, and what the last cut left is whole now.
        now = digests(directory)
        assert now.items() >= before.items()
        assert set(left) <= set(now)
        before = now

        left = [p.stem for p in files(directory) if p.suffix == ".part" and p.stat().st_size]
        assert len(left) <= 1
        new = [path for path in files(directory) if path.name not in old]
        repair_directory(directory)
        assert all(path.suffix == ".mcap" for path in files(directory))
        recorded = [path.with_name(path.name.removesuffix(".part")) for path in new]
        found = [seq for path in recorded for seq in samples_in(path)]
        assert found == list(range(len(found)))
        pixels = [m.frame_seq for path in recorded for t, _, m in read_whole(path) if t == PIXELS]
        assert pixels == list(range(len(pixels)))
        lost = [ns for seq, ns in put_ns.items() if seq >= len(found)]
        gaps_ns = [after - before for before, after in pairwise([*lost, cut_ns])]
        lost_ns = sum(min(gap, STALL_NS) for gap in gaps_ns)
        with capsys.disabled():
            sys.stdout.write(
                f"\ncut {number + 1}: {len(put_ns)} put, {len(found)} found, "
                f"the last {lost_ns / 1e9:.2f} s lost"
            )
        assert lost_ns <= MOST_LOST_NS
        old = {path.name for path in files(directory)}
