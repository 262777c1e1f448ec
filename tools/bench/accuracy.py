"""The experiment of Lee, Cho and Sim (2015) through the real process stage, beside the bound.

    .venv/bin/python -m tools.bench.accuracy                    all cases (hours)
    .venv/bin/python -m tools.bench.accuracy --noise-grey 2 --amplitude-mm 10 --method smooth

Every case shows the bench's marker at rest for the reference, then in harmonic motion. Its
pictures come from `tools.bench.picture`, which shares no code with what measures them. Set-up
samples are left out. The error is that of Eq. 3.1, in per cent, against the true position at the
picture's time. Beside it stand the standard deviation over the Cramer-Rao bound of the same
picture (at rest, variance sigma^2 + 1/12), the part of the errors within two sigma, and the samples
that were flagged although nothing was wrong.
"""

from __future__ import annotations

import argparse
import csv
import itertools
import multiprocessing
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

from tools.bench.bound import bound, error_percent
from tools.bench.picture import ANGLES_DEG, DISTANCES_M, Bench, grabbed, woven
from vdms_rt.config import parse_config
from vdms_rt.measure.gate import Workspace
from vdms_rt.measure.marker import find_markers
from vdms_rt.model import Damage, Displacement, Frame, Luma, Scan, Status
from vdms_rt.process.pictures import pictures
from vdms_rt.process.progress import Phase, Plan
from vdms_rt.process.step import begin, found, step

PERIOD_NS = 33_366_667
CYCLE = 100
"""Frames after which the motion repeats: so many clean pictures are drawn for a case."""
STILLS = 30


@dataclass(frozen=True)
class Case:
    distance_m: float
    angle_deg: float
    amplitude_mm: float
    noise_grey: float
    method: str
    sampling: str
    frequency_hz: float
    samples: int
    seed: int


@dataclass(frozen=True)
class Result:
    case: Case
    samples: int
    error_percent: float
    bound_percent: float
    over_bound: float
    within_2_sigma: float
    flagged_percent: float


def measure(case: Case) -> Result:
    """Run one case through `process.step`."""
    bench = Bench(distance_m=case.distance_m, angle_deg=case.angle_deg)
    rng = np.random.default_rng([case.seed, int(case.distance_m), int(case.angle_deg)])
    circles = [[float(x), float(y)] for x, y in bench.circles_mm]
    config = parse_config(
        f"[[marker]]\ncircles_mm = {circles}\n"
        f"[setup]\nreference_pictures = {STILLS}\n"
        f'[process]\nmethod = "{case.method}"\nsampling = "{case.sampling}"',
        "bench",
    )
    progress = begin(Plan.of(config), 1, bench.width_px, bench.height_px)
    work = Workspace()
    errors: list[tuple[float, float]] = []
    flagged = 0
    motion: list[float] = []
    for n, (image, truth_mm) in enumerate(_frames(bench, case, rng)):
        scan = Scan.PROGRESSIVE if case.sampling == "frame" else Scan.BOTTOM_FIRST
        t_ns = 10**9 + n * PERIOD_NS
        frame = Frame(n, t_ns, t_ns, 0, 0, 0, PERIOD_NS, image, scan, Damage.NONE, 0, True)
        for picture, true_mm in zip(pictures(frame, case.sampling), truth_mm, strict=True):
            if progress.phase is Phase.SEARCHING:
                seen = find_markers(image, progress.plan.shapes, scan)
                progress, _ = found(progress, seen, t_ns)
            progress, (sample,), _ = step(progress, picture, work)
            if sample.status & Status.SET_UP:
                continue
            motion.append(true_mm)
            flagged += _flagged(sample)
            if sample.valid:
                errors.append((sample.x_mm - true_mm, sample.sigma_x_mm))
        if len(motion) >= case.samples:
            break
    error, sigma = np.array(errors).T
    rows = slice(None) if case.sampling == "frame" else slice(0, None, 2)
    least_mm = bound(bench, case.noise_grey, rows)[0]
    return Result(
        case=case,
        samples=len(errors),
        error_percent=100 * float(np.std(error) / np.std(motion)),
        bound_percent=error_percent(least_mm, case.amplitude_mm),
        over_bound=float(np.std(error)) / least_mm,
        within_2_sigma=float(np.mean(np.abs(error) <= 2 * sigma))
        if case.method == "smooth"
        else np.nan,
        flagged_percent=100 * flagged / len(motion),
    )


def _flagged(sample: Displacement) -> bool:
    return bool(sample.status) or any(c.flags for c in sample.circles)


def _frames(
    bench: Bench, case: Case, rng: np.random.Generator
) -> Iterator[tuple[Luma, tuple[float, ...]]]:
    """The marker at rest for the stills and a few more, then its motion, with the truth of each
    picture of the frame."""
    fields = 1 if case.sampling == "frame" else 2
    rest = bench.still()
    for _ in range(STILLS + 5):
        yield grabbed(rest, case.noise_grey, rng), (0.0,) * fields
    # A whole number of periods in the cycle, the nearest to the frequency.
    periods = max(1, round(case.frequency_hz * CYCLE * PERIOD_NS / 1e9))
    phase = 2 * np.pi * periods * (np.arange(CYCLE * fields) / (CYCLE * fields))
    places = case.amplitude_mm * np.sin(phase)
    clean = [bench.still(x_mm=float(x)) for x in places]
    if fields == 2:
        clean = [
            woven(a, b, bottom_first=True) for a, b in zip(clean[::2], clean[1::2], strict=True)
        ]
    while True:
        for n, picture in enumerate(clean):
            truth = tuple(float(x) for x in places[n * fields : (n + 1) * fields])
            yield grabbed(picture, case.noise_grey, rng), truth


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m tools.bench.accuracy",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    several = {"type": float, "nargs": "+"}
    parser.add_argument("--distance-m", default=DISTANCES_M, **several)
    parser.add_argument("--angle-deg", default=ANGLES_DEG, **several)
    parser.add_argument("--amplitude-mm", default=(10.0, 1.0, 0.1), **several)
    parser.add_argument("--noise-grey", default=(1.0, 2.0, 4.0), **several)
    parser.add_argument("--frequency-hz", default=(1.0,), **several)
    parser.add_argument("--method", nargs="+", default=("otsu", "smooth"))
    parser.add_argument("--sampling", nargs="+", default=("frame", "field"))
    parser.add_argument("--samples", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--csv", type=Path, help="write every row to this file")
    parser.add_argument("--processes", type=int, default=multiprocessing.cpu_count())
    a = parser.parse_args()
    cases = [
        Case(*values, a.samples, a.seed)
        for values in itertools.product(
            a.distance_m,
            a.angle_deg,
            a.amplitude_mm,
            a.noise_grey,
            a.method,
            a.sampling,
            a.frequency_hz,
        )
    ]
    results = []
    with multiprocessing.Pool(a.processes) as pool:
        done = pool.imap(measure, cases)
        results = list(
            track(done, total=len(cases), description="measuring", console=Console(stderr=True))
        )
    if a.csv:
        with a.csv.open("w", newline="") as file:
            _write(file, results)
    _show(results)


def _write(file: object, results: list[Result]) -> None:
    writer = csv.writer(file)  # type: ignore[arg-type]
    names = [n for n in Result.__dataclass_fields__ if n != "case"]
    writer.writerow([*Case.__dataclass_fields__, *names])
    for r in results:
        own = [getattr(r.case, n) for n in Case.__dataclass_fields__]
        writer.writerow([*own, *(getattr(r, n) for n in names)])


def _show(results: list[Result]) -> None:
    """One line for each setting, over all distances and angles: the worst, and the median."""
    table = Table(title="Eq. 3.1 in %, over all distances and angles")
    for name in ("method", "sampling", "f Hz", "A mm", "noise", "cases", "worst", "bound there"):
        table.add_column(name, justify="right")
    for name in ("std / bound: median", "worst", "in 2 sigma", "flagged %"):
        table.add_column(name, justify="right")
    groups: dict[tuple[object, ...], list[Result]] = {}
    for r in results:
        c = r.case
        key = (c.method, c.sampling, c.frequency_hz, c.amplitude_mm, c.noise_grey)
        groups.setdefault(key, []).append(r)
    for key, rows in groups.items():
        worst = max(rows, key=lambda r: r.error_percent)
        ratios = [r.over_bound for r in rows]
        table.add_row(
            *map(str, key),
            str(len(rows)),
            f"{worst.error_percent:.4f}",
            f"{worst.bound_percent:.4f}",
            f"{np.median(ratios):.3f}",
            f"{max(ratios):.3f}",
            f"{np.mean([r.within_2_sigma for r in rows]):.3f}",
            f"{np.mean([r.flagged_percent for r in rows]):.3f}",
        )
    Console(width=130, file=sys.stdout).print(table)


if __name__ == "__main__":
    main()
