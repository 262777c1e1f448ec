"""The experiment of Lee, Cho and Sim (2015) through the real process stage, beside the bound.

    .venv/bin/python -m tools.bench.accuracy --csv paper.csv --figures figures
    .venv/bin/python -m tools.bench.accuracy --set fields special aruco --jobs 1
    .venv/bin/python -m tools.bench.accuracy --method smooth --noise-grey 2 --amplitude-mm 10

Every case shows the bench's marker at rest for the reference, then in harmonic motion. Its
pictures come from `tools.bench.picture`, which shares no code with what measures them. Set-up
samples are left out. The error is that of Eq. 3.1, in per cent, against the mean position over the
exposure. Beside it stand the standard deviation over the Cramer-Rao bound of the same picture (at
rest, variance sigma^2 + 1/12, known shape), the part of the errors within two sigma, and the
samples that were flagged although nothing was wrong.

Sets: paper (5 distances x 5 angles x 3 amplitudes x 3 noises, otsu and smooth, frame and field),
fields (1 to 5 Hz, sharp and exposed for 1/60 s, and at rest), special (little contrast, 640 x 480,
a rolled camera, small discs), causes (one cause of error at a time), aruco (corners of ArUco tags),
disturbed (a disc hit by glare, specks, a wire, a shadow, a gradient, a cut), all. Figures 3.3 and
3.4 belong to the set paper. The CSV has one row for each case, whose columns are the fields of
`tools.bench.measuring.Result`.
"""

from __future__ import annotations

import argparse
import csv
import multiprocessing
import os
import sys
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from rich import box
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Table

from tools.bench import disturbance, figures
from tools.bench.cases import SETS, Choice, Setting
from tools.bench.measuring import Result, measure

DISTURBED = "disturbed"


def measured(settings: Sequence[Setting], jobs: int) -> list[Result]:
    """Return the results of all settings, in their order, measured by so many processes."""
    console = Console(stderr=True)
    columns = (TextColumn("measuring"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    results: list[Result] = []
    # The parent's libraries have their threads already; a new interpreter obeys the limit.
    os.environ["OPENBLAS_NUM_THREADS"] = "1"
    with (
        multiprocessing.get_context("spawn").Pool(jobs) as pool,
        Progress(*columns, TimeRemainingColumn(), console=console) as bar,
    ):
        for rows in bar.track(pool.imap(measure, settings), total=len(settings)):
            results += rows
    return results


def write_csv(path: Path, rows: Iterable[Any]) -> None:
    """Write dataclasses of one kind as rows; numbers to six digits."""
    listed = [{k: _short(v) for k, v in asdict(row).items()} for row in rows]
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(listed[0]))
        writer.writeheader()
        writer.writerows(listed)


def _short(value: object) -> object:
    return f"{value:.6g}" if isinstance(value, float) else value


def table_of(results: Sequence[Result]) -> Table:
    """Return one line for each setting, over all distances and angles: the worst error beside its
    bound, the median and the worst of the ratio. `loss` is what the exposure takes off the
    amplitude."""
    table = Table(
        title="Eq. 3.1 in %, over all distances and angles; std of x over its bound", box=box.SIMPLE
    )
    for name in ("set", "method", "sampling"):
        table.add_column(name, no_wrap=True)
    names = ("f Hz", "A mm", "v mm/s", "exp ms", "loss %", "noise", "cases", "worst %", "bound %")
    for name in (*names, "median", "worst", "in 2 sigma", "flagged %", "lost %"):
        table.add_column(name, justify="right")
    groups: dict[tuple[object, ...], list[Result]] = {}
    for r in results:
        key = (r.set, r.method, r.sampling, r.frequency_hz, r.amplitude_mm)
        light = (r.velocity_mm_s, r.exposure_ms, r.exposure_loss_percent, r.noise_grey)
        groups.setdefault((*key, *light), []).append(r)
    for (name, method, sampling, *numbers), rows in groups.items():
        worst = max(
            rows, key=lambda r: r.over_bound if np.isnan(r.error_percent) else r.error_percent
        )
        ratios = [r.over_bound for r in rows]
        table.add_row(
            str(name),
            str(method),
            str(sampling),
            *(f"{v:.3g}" for v in numbers),
            str(len(rows)),
            f"{worst.error_percent:.4f}",
            f"{worst.bound_percent:.4f}",
            f"{np.median(ratios):.3f}",
            f"{max(ratios):.3f}",
            f"{np.mean([r.within_2_sigma for r in rows]):.3f}",
            f"{np.mean([r.flagged_percent for r in rows]):.3f}",
            f"{np.mean([r.lost_percent for r in rows]):.3f}",
        )
    return table


def parser() -> argparse.ArgumentParser:
    made = argparse.ArgumentParser(
        prog="python -m tools.bench.accuracy",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    made.add_argument("--set", nargs="+", choices=(*SETS, DISTURBED, "all"), default=["paper"])
    several = {"type": float, "nargs": "+", "help": "instead of the set's own"}
    made.add_argument("--distance-m", **several)
    made.add_argument("--angle-deg", **several)
    made.add_argument("--amplitude-mm", **several)
    made.add_argument("--frequency-hz", **several)
    made.add_argument("--noise-grey", **several)
    made.add_argument("--method", nargs="+", choices=("otsu", "smooth"))
    made.add_argument("--sampling", nargs="+", choices=("frame", "field"))
    made.add_argument("--samples", type=int, default=2000, help="of each case (2000)")
    made.add_argument("--trials", type=int, default=150, help="of each disturbance (150)")
    made.add_argument("--seed", type=int, default=1)
    made.add_argument("--jobs", type=int, default=os.cpu_count(), help="processes (all cores)")
    made.add_argument("--csv", type=Path, help="write every row to this file")
    made.add_argument("--figures", type=Path, help="write figures 3.3 and 3.4 to this folder")
    return made


def _fault(options: argparse.Namespace) -> str:
    """Return a sentence for what is wrong with the options, or nothing."""
    if options.samples < 2 or options.trials < 1 or options.jobs < 1:
        return "--samples must be at least 2, --trials and --jobs at least 1"
    for name in ("distance_m", "amplitude_mm", "frequency_hz", "noise_grey"):
        if any(value <= 0 for value in getattr(options, name) or ()):
            return f"--{name.replace('_', '-')} must be above 0"
    if any(not 0 <= angle < 90 for angle in options.angle_deg or ()):
        return "--angle-deg must be from 0 to below 90"
    if options.csv and not options.csv.parent.is_dir():
        return f"--csv: there is no folder {options.csv.parent}; make it first"
    return ""


def main(arguments: Sequence[str] | None = None) -> None:
    options = parser().parse_args(arguments)
    if fault := _fault(options):
        parser().error(fault)
    wanted = [*SETS, DISTURBED] if "all" in options.set else options.set
    choice = Choice(
        distances_m=options.distance_m,
        angles_deg=options.angle_deg,
        amplitudes_mm=options.amplitude_mm,
        frequencies_hz=options.frequency_hz,
        noises_grey=options.noise_grey,
        methods=options.method,
        samplings=options.sampling,
        samples=options.samples,
        seed=options.seed,
    )
    settings = [s for name in wanted if name in SETS for s in SETS[name](choice)]
    console = Console(width=165, file=sys.stdout)
    if settings:
        results = measured(settings, options.jobs)
        if options.csv:
            write_csv(options.csv, results)
        console.print(table_of(results))
        if options.figures:
            figures.draw(options.figures, results, options.seed)
    if DISTURBED in wanted:
        rows = disturbance.measured(
            (choice.samplings or ("frame",)), options.trials, options.seed, options.jobs
        )
        if options.csv:
            write_csv(options.csv.with_stem(f"{options.csv.stem}-{DISTURBED}"), rows)
        console.print(disturbance.table_of(rows))


if __name__ == "__main__":
    main()
