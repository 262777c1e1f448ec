"""What disturbs a disc, through the real process stage: how wrong the marker gets, and whether it
says so.

    .venv/bin/python -m tools.bench.disturbance [--trials 150] [--sampling field] [--csv FILE]

The bench's marker (8 m, 30 deg, noise of 2 grey levels) swings by 10 mm at 1 Hz. In each trial one
disc is hit, for three frames, by a disturbance that goes with it; `gradient on all` is light that
changes alike on all four. Counted are the samples of those frames. A sample is flagged when it has
a status or one of its circles has a flag; what comes without a position is lost.
"""

from __future__ import annotations

import argparse
import csv
import sys
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import Progress as Bar
from rich.table import Table

from tools.bench.picture import DISTURBANCES, Bench, Grey, disturbed, grabbed, woven
from vdms_rt.config import parse_config
from vdms_rt.measure.gate import Workspace
from vdms_rt.measure.marker import find_markers
from vdms_rt.model import Damage, Displacement, Frame, Scan
from vdms_rt.process.pictures import pictures
from vdms_rt.process.progress import Phase, Plan, Progress
from vdms_rt.process.step import begin, found, step

PERIOD_NS = 33_366_667
CYCLE = 30
"""Frames in a period of the motion: so many clean pictures are drawn."""
AMPLITUDE_MM = 10.0
STILLS = 30
TRIALS_OF_A_REFERENCE = 10
HIT_FRAMES = 3
ALL = "gradient on all"
KINDS = (*DISTURBANCES, ALL)


@dataclass(frozen=True)
class Row:
    kind: str
    trials: int
    samples: int
    rms_x_um: float
    rms_y_um: float
    worst_um: float
    """Of x and y."""
    lost_percent: float
    flagged_percent: float
    beyond_4_sigma: int
    """Errors of x or y, in all valid samples."""
    unflagged_beyond_4_sigma: int
    within_2_sigma: float
    all_used_percent: float
    """Samples with a position from all four discs, a hit one by the rest of its edge."""


class Stage:
    """The process stage with the bench's marker before it."""

    def __init__(self, bench: Bench, sampling: str, noise_grey: float, seed: int) -> None:
        self.bench, self.sampling, self.noise_grey = bench, sampling, noise_grey
        self.rng = np.random.default_rng(seed)
        self.work = Workspace()
        fields = 1 if sampling == "frame" else 2
        parts = (np.arange(CYCLE * fields) + 0.5) / (CYCLE * fields)
        self.x_mm = (AMPLITUDE_MM * np.sin(2 * np.pi * parts)).reshape(CYCLE, fields)
        self.clean = [[bench.still(float(x)) for x in frame] for frame in self.x_mm]
        self.rest = bench.still()

    def frame(self, n: int, clean: list[Grey]) -> Frame:
        scan = Scan.PROGRESSIVE if len(clean) == 1 else Scan.BOTTOM_FIRST
        whole = clean[0] if len(clean) == 1 else woven(*clean)
        image = grabbed(whole, self.noise_grey, self.rng)
        t_ns = 10**9 + n * PERIOD_NS
        return Frame(n, t_ns, t_ns, 0, 0, 0, PERIOD_NS, image, scan, Damage.NONE, 0, True)

    def measured(self, progress: Progress, frame: Frame) -> tuple[Progress, list[Displacement]]:
        samples = []
        for picture in pictures(frame, self.sampling):
            if progress.phase is Phase.SEARCHING:
                seen = find_markers(frame.image, progress.plan.shapes, frame.scan)
                progress, _ = found(progress, seen, frame.t_ns)
            progress, (sample,), _ = step(progress, picture, self.work)
            samples.append(sample)
        return progress, samples

    def at_rest(self) -> tuple[Progress, int]:
        """Take a new reference, and return the number of the next frame too."""
        config = parse_config(
            f'[setup]\nreference_pictures = {STILLS}\n[process]\nsampling = "{self.sampling}"',
            "bench",
        )
        plan = Plan.of(config)
        progress = begin(plan, 1, self.bench.width_px, self.bench.height_px)
        n = 0
        while progress.phase is not Phase.MEASURING:
            if n > 2 * STILLS:
                raise SystemExit(f"no reference after {n} stills at rest: {progress.state}")
            rest = [self.rest] * self.x_mm.shape[1]
            progress, _ = self.measured(progress, self.frame(n, rest))
            n += 1
        # The swing begins in the middle.
        return progress, -(-n // CYCLE) * CYCLE


def trials(stage: Stage, kind: str, count: int) -> Row:
    """Hit a disc `count` times, each disc in turn."""
    rng = stage.rng
    errors: list[NDArray[np.float64]] = []
    samples = lost = flagged = silent = all_used = 0
    for trial in range(count):
        if trial % TRIALS_OF_A_REFERENCE == 0:
            swinging, n = stage.at_rest()
        # The swing goes on unhit; what is hit branches off from it.
        for _ in range(int(rng.integers(3, 12))):
            swinging, _ = stage.measured(swinging, stage.frame(n, stage.clean[n % CYCLE]))
            n += 1
        progress = swinging
        circles = (0, 1, 2, 3) if kind == ALL else (trial % 4,)
        seed = int(rng.integers(2**32))
        for later in range(n, n + HIT_FRAMES):
            at = later % CYCLE
            clean = [
                disturbed(
                    picture,
                    stage.bench,
                    "gradient" if kind == ALL else kind,
                    circles,
                    np.random.default_rng(seed),
                    (float(x), 0.0, 0.0),
                )
                for picture, x in zip(stage.clean[at], stage.x_mm[at], strict=True)
            ]
            progress, seen = stage.measured(progress, stage.frame(later, clean))
            for sample, x_mm in zip(seen, stage.x_mm[at], strict=True):
                samples += 1
                told = bool(sample.status) or any(c.flags for c in sample.circles)
                flagged += told
                if not sample.valid:
                    lost += 1
                    continue
                own = np.array([sample.x_mm - x_mm, sample.y_mm])
                sigma = np.array([sample.sigma_x_mm, sample.sigma_y_mm])
                silent += not told and bool((abs(own) > 4 * sigma).any())
                all_used += not sample.status
                errors.append(np.stack([own, sigma]))
    table = np.array(errors)
    error_um, ratio = 1000 * table[:, 0], abs(table[:, 0]) / table[:, 1]
    rms = np.sqrt(np.mean(error_um**2, axis=0))
    return Row(
        kind=kind,
        trials=count,
        samples=samples,
        rms_x_um=float(rms[0]),
        rms_y_um=float(rms[1]),
        worst_um=float(abs(error_um).max()),
        lost_percent=100 * lost / samples,
        flagged_percent=100 * flagged / samples,
        beyond_4_sigma=int((ratio > 4).any(axis=1).sum()),
        unflagged_beyond_4_sigma=silent,
        within_2_sigma=float(np.mean(ratio <= 2)),
        all_used_percent=100 * all_used / samples,
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m tools.bench.disturbance",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--kind", nargs="+", choices=KINDS, default=KINDS)
    parser.add_argument("--trials", type=int, default=150)
    parser.add_argument("--distance-m", type=float, default=8.0)
    parser.add_argument("--angle-deg", type=float, default=30.0)
    parser.add_argument("--noise-grey", type=float, default=2.0)
    parser.add_argument("--sampling", choices=("frame", "field"), default="frame")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--csv", type=Path, help="write the rows to this file")
    a = parser.parse_args()
    bench = Bench(distance_m=a.distance_m, angle_deg=a.angle_deg)
    rows = []
    with Bar(console=Console(stderr=True)) as bar:
        task = bar.add_task("hitting", total=len(a.kind))
        for n, kind in enumerate(a.kind):
            stage = Stage(bench, a.sampling, a.noise_grey, a.seed + n)
            rows.append(trials(stage, kind, a.trials))
            bar.advance(task)
    if a.csv:
        with a.csv.open("w", newline="") as file:
            writer = csv.DictWriter(file, Row.__dataclass_fields__)
            writer.writeheader()
            writer.writerows(asdict(r) for r in rows)
    table = Table(title=f"One disc hit, {a.distance_m:g} m, {a.angle_deg:g} deg, {a.sampling}")
    names = ("disturbance", "samples", "rms x um", "rms y um", "worst um", "lost %", "flagged %")
    for name in (*names, "> 4 sigma", "of these silent", "in 2 sigma", "all used %"):
        table.add_column(name, justify="right")
    for r in rows:
        table.add_row(
            r.kind,
            str(r.samples),
            *(f"{v:.2f}" for v in (r.rms_x_um, r.rms_y_um, r.worst_um)),
            *(f"{v:.1f}" for v in (r.lost_percent, r.flagged_percent)),
            str(r.beyond_4_sigma),
            str(r.unflagged_beyond_4_sigma),
            f"{r.within_2_sigma:.3f}",
            f"{r.all_used_percent:.1f}",
        )
    Console(width=130, file=sys.stdout).print(table)


if __name__ == "__main__":
    main()
