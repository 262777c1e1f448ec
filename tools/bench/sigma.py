"""Times and uncertainties from end to end, on the virtual table: `python -m tools.bench.sigma`.

The table's pictures and stamps (fields, up to 1 or 5 ms late, a quartz 50 ppm off, 1 % of the
frames lost without a gap in the sequence) go through the capture stage's clock and `process.step`,
each record with a set-up of its own. An error is that of a sample as it says: x and y at `t_ns`,
against the table's mean over the exposure at that time. Three tables:

- whether sigma is true: the part of the errors within two sigma, the rms of error over sigma, and
  the rms of both; of x, along the motion of 10 mm at 1 Hz, and of y, across it;
- the time after a minute, and what it costs: error of `t_ns` beside a constant delay, lost frames
  counted, Eq. 3.1 of Lee, Cho and Sim (2015), and a two-sided refit of the record's times;
- a still marker: the line at half the rate of the fields, 29.97 Hz, over the noise floor, as it is
  left by the fields' references.
"""

from __future__ import annotations

import argparse
import itertools
import multiprocessing
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track
from rich.table import Table

from vdms_rt.capture.clock import FrameClock, mid_exposure_ns
from vdms_rt.capture.motion_path import MotionPath
from vdms_rt.capture.refit import refit
from vdms_rt.capture.table import TableSource
from vdms_rt.config import Config, parse_config
from vdms_rt.measure.gate import Workspace
from vdms_rt.measure.marker import find_markers
from vdms_rt.model import Displacement, Frame, Scan, SourceEnded, Truth
from vdms_rt.process.pictures import pictures
from vdms_rt.process.progress import Phase, Plan
from vdms_rt.process.step import begin, found, step

Floats: TypeAlias = NDArray[np.float64]

REST_S = 3.0
AGES_S = (0.0, 2.0, 4.0, 8.0, 1e9)
MINUTE_S = 60.0
AXES = ("x", "y")


@dataclass(frozen=True, slots=True)
class Case:
    """One record."""

    seconds: float
    noise_grey: float = 2.0
    angle_deg: float = 0.0
    jitter_ms: float = 1.0
    seed: int = 1
    motion: str = "harmonic"
    exposure_ms: float = 0.0

    @property
    def config(self) -> Config:
        return parse_config(
            f"""
            source = "table"
            [table]
            pace = "fast"
            rest_s = {REST_S}
            frames = {round(self.seconds * 30000 / 1001)}
            noise_grey = {self.noise_grey}
            angle_deg = {self.angle_deg}
            exposure_ms = {self.exposure_ms}
            stamp_jitter_ms = {self.jitter_ms}
            clock_error_ppm = 50.0
            lost_frames = 0.01
            seed = {self.seed}
            [table.motion]
            kind = "{self.motion}"
            """,
            "bench",
        )


@dataclass(frozen=True, slots=True)
class Run:
    """What came of a record. Rows are its valid samples."""

    case: Case
    age_s: Floats
    """Since the first stamp, (n,)."""
    error_mm: Floats
    """Of x and y at `t_ns`, (n, 2)."""
    picture_error_mm: Floats
    """The same against the picture's own truth: without the time's share."""
    sigma_mm: Floats
    """As the samples say, (n, 2)."""
    true_mm: Floats
    """(n, 2)"""
    seq: NDArray[np.int64]
    time_error_ns: Floats
    """(n,)"""
    sigma_t_ns: Floats
    refit_error_ns: Floats
    """Of each frame's time by a two-sided refit of the whole record, (frames,)."""
    lost: int
    """Frames between the first and the last that never came,"""
    counted: int
    """those that the clock counted, and"""
    wrong_index: int
    """frames that have another number than the table says."""


def run(case: Case) -> Run:
    """Take a record through clock and process stage."""
    config = case.config
    path = MotionPath(config.table.motion, config.table.rest_s)
    truth: dict[Scan, Truth] = {}

    def tell(told: Truth) -> None:
        truth[told.scan] = told

    source = TableSource(config.table, [m.shape for m in config.marker], tell)
    info = source.info
    exposure_ns = info.exposure_ns or 0
    clock = FrameClock(info, exposure_ns)
    image = np.empty((info.height_px, info.width_px), np.uint8)
    progress = begin(Plan.of(config), 1, info.width_px, info.height_px)
    work = Workspace()
    rows: list[tuple[float, ...]] = []
    frames: list[tuple[int, int, int, int]] = []
    first: tuple[int, int] | None = None
    while True:
        try:
            grab = source.read(image, 10)
        except SourceEnded:
            break
        assert grab is not None
        tick = clock.tick(grab.stamp_ns, grab.sequence, grab.scan)
        whole = truth[info.scan]
        first = first or (grab.stamp_ns, whole.frame)
        frames.append((grab.stamp_ns, tick.index, whole.frame - first[1], whole.t_ns))
        frame = Frame(
            seq=tick.index,
            stamp_ns=grab.stamp_ns,
            t_ns=tick.t_ns,
            sigma_t_ns=tick.sigma_t_ns,
            utc_ns=0,
            segment=tick.segment,
            period_ns=round(clock.period_ns),
            image=image,
            scan=grab.scan,
            damage=grab.damage,
            exposure_ns=exposure_ns,
            order_known=info.scan_known,
        )
        for picture in pictures(frame, config.process.sampling, progress.order):
            if progress.phase is Phase.SEARCHING:
                progress, _ = found(
                    progress, find_markers(image, progress.plan.shapes, grab.scan), tick.t_ns
                )
            progress, (sample,), _ = step(progress, picture, work)
            if sample.valid:
                age_s = (grab.stamp_ns - first[0]) / 1e9
                rows.append(_row(sample, truth[sample.scan], age_s, config, path))
    source.close()
    values = np.array(rows)
    stamps_ns, indices, true_frames, true_ns = np.array(frames, dtype=np.int64).T
    middle_ns = mid_exposure_ns(info, exposure_ns, 0, info.scan)
    refitted_ns = refit(stamps_ns, indices, info.frame_period_s, middle_ns)
    return Run(
        case=case,
        age_s=values[:, 0],
        error_mm=values[:, 1:3],
        picture_error_mm=values[:, 3:5],
        sigma_mm=values[:, 5:7],
        true_mm=values[:, 7:9],
        time_error_ns=values[:, 9],
        sigma_t_ns=values[:, 10],
        seq=values[:, 11].astype(np.int64),
        refit_error_ns=(refitted_ns - true_ns).astype(np.float64),
        lost=int(true_frames[-1]) + 1 - len(true_frames),
        counted=clock.figures.missed,
        wrong_index=int(np.count_nonzero(indices != true_frames)),
    )


def _row(
    sample: Displacement, truth: Truth, age_s: float, config: Config, path: MotionPath
) -> tuple[float, ...]:
    """Return age_s, errors at the sample's time, errors of the picture, sigmas, truth, time error,
    its sigma and seq."""
    late_ns = sample.t_ns - truth.t_ns
    table = config.table
    period_s = float((1 - table.clock_error_ppm / 1e6) / table.frame_rate_hz)
    half = period_s / 2 if sample.scan is Scan.TOP else 0.0
    end_s = truth.frame * period_s + half
    begin_s = end_s - table.exposure_ms / 1e3
    x_mm, y_mm = path.mean(begin_s + late_ns / 1e9, end_s + late_ns / 1e9).tolist()
    return (
        age_s,
        sample.x_mm - x_mm,
        sample.y_mm - y_mm,
        sample.x_mm - truth.mean_x_mm,
        sample.y_mm - truth.mean_y_mm,
        sample.sigma_x_mm,
        sample.sigma_y_mm,
        x_mm,
        y_mm,
        late_ns,
        sample.sigma_t_ns,
        sample.seq,
    )


def inside_percent(error_mm: Floats, sigma_mm: Floats) -> float:
    """Return how many errors in a hundred lie within two sigma; 95.4 for normal ones."""
    return 100 * float(np.mean(np.abs(error_mm) <= 2 * sigma_mm))


def rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def line_over_floor(run_: Run) -> Floats:
    """Return the power at half the rate of the fields over the mean power of the upper half of the
    periodogram, for x and y, (2,); 1 on the average where there is no line.

    The samples of lost frames are left out, which changes nothing for a line at that frequency.
    """
    turns = np.where(run_.seq % 2, -1.0, 1.0)
    about_mm = run_.error_mm - run_.error_mm.mean(axis=0)
    line = (turns @ about_mm) ** 2 / len(turns)
    floor = np.abs(np.fft.rfft(about_mm, axis=0)) ** 2 / len(turns)
    return np.asarray(line / floor[len(floor) // 2 : -2].mean(axis=0))


def coverage_table(runs: Sequence[Run]) -> Table:
    """Return whether sigma is true, over all and by noise, angle, lateness and age."""
    table = Table(title=f"Is sigma true? {len(runs)} records, each with its own reference")
    table.add_column("samples of")
    for name in ("n", "x in\n2 sigma", "rms of\nx/sigma", "x error\num", "its sigma\num"):
        table.add_column(name, justify="right")
    for name in ("y in\n2 sigma", "rms of\ny/sigma", "x of the picture\nin 2 sigma"):
        table.add_column(name, justify="right")
    for name in ("time error\nus", "its sigma\nus"):
        table.add_column(name, justify="right")

    def add(name: str, of: Sequence[Run], ages: tuple[float, float] = (0.0, 1e9)) -> None:
        masks = [(r.age_s >= ages[0]) & (r.age_s < ages[1]) for r in of]

        def rows(field: str) -> Floats:
            return np.concatenate([getattr(r, field)[m] for r, m in zip(of, masks, strict=True)])

        error, sigma = rows("error_mm"), rows("sigma_mm")
        (x, y), (sigma_x, sigma_y) = error.T, sigma.T
        table.add_row(
            name,
            str(len(x)),
            f"{inside_percent(x, sigma_x):.1f} %",
            f"{rms(x / sigma_x):.2f}",
            f"{1e3 * rms(x):.2f}",
            f"{1e3 * rms(sigma_x):.2f}",
            f"{inside_percent(y, sigma_y):.1f} %",
            f"{rms(y / sigma_y):.2f}",
            f"{inside_percent(rows('picture_error_mm')[:, 0], sigma_x):.1f} %",
            *(f"{rms(rows(field)) / 1e3:.1f}" for field in ("time_error_ns", "sigma_t_ns")),
        )

    add("all", runs)
    kinds = (
        ("noise_grey", "noise {:g} grey levels"),
        ("angle_deg", "angle {:g} deg"),
        ("jitter_ms", "stamps up to {:g} ms late"),
    )
    for field, words in kinds:
        for value in sorted({getattr(r.case, field) for r in runs}):
            add(words.format(value), [r for r in runs if getattr(r.case, field) == value])
    last_s = max(float(r.age_s.max()) for r in runs)
    for ages in itertools.pairwise(AGES_S):
        if ages[0] < last_s - 0.5:
            add(f"{ages[0]:g} to {min(ages[1], last_s):.0f} s old", runs, ages)
    return table


def time_table(runs: Sequence[Run], since_s: float = MINUTE_S) -> Table:
    """Return the time from an age on and what it costs, one row for each record."""
    title = f"After {since_s:g} s: stamps up to 5 ms late, 50 ppm, 1 % lost; 10 mm at 1 Hz"
    table = Table(title=title)
    names = ("seed", "time error us\nbeside a delay", "delay us", "lost", "counted", "wrong index")
    for name in (*names, "Eq. 3.1 %", "refit us"):
        table.add_column(name, justify="right")
    for r in runs:
        late = r.age_s >= since_s
        table.add_row(
            str(r.case.seed),
            f"{r.time_error_ns[late].std() / 1e3:.1f}",
            f"{r.time_error_ns[late].mean() / 1e3:+.1f}",
            str(r.lost),
            str(r.counted),
            str(r.wrong_index),
            f"{eq_3_1_percent(r, late):.4f}",
            f"{r.refit_error_ns.std() / 1e3:.1f}",
        )
    return table


def eq_3_1_percent(r: Run, which: NDArray[np.bool_]) -> float:
    """Return Eq. 3.1 of Lee, Cho and Sim for x, against the table at the samples' times."""
    return 100 * float(r.error_mm[which, 0].std() / r.true_mm[which, 0].std())


def still_table(runs: Sequence[Run]) -> Table:
    """Return the line of a still marker at half the rate of the fields, a row for each record."""
    table = Table(title="A still marker: power at 29.97 Hz over the noise floor (1 without a line)")
    for name in ("seed", "samples", "x", "y", "x: amplitude um", "noise um"):
        table.add_column(name, justify="right")
    lines = []
    for r in runs:
        lines.append(line_over_floor(r))
        amplitude_mm = abs(float(np.mean(np.where(r.seq % 2, -1.0, 1.0) * r.error_mm[:, 0])))
        table.add_row(
            str(r.case.seed),
            str(len(r.seq)),
            *(f"{value:.2f}" for value in lines[-1]),
            f"{1e3 * amplitude_mm:.3f}",
            f"{1e3 * r.error_mm[:, 0].std():.3f}",
        )
    table.add_row("mean", "", *(f"{value:.2f}" for value in np.mean(lines, axis=0)), "", "")
    return table


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m tools.bench.sigma",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    several = {"type": float, "nargs": "+"}
    parser.add_argument("--noise-grey", default=(1.0, 2.0, 4.0), **several)
    parser.add_argument("--angle-deg", default=(0.0, 30.0, 60.0), **several)
    parser.add_argument("--jitter-ms", default=(1.0, 5.0), **several)
    parser.add_argument("--seeds", type=int, default=4, help="records of each kind")
    parser.add_argument("--seconds", type=float, default=13.5, help="length of these records")
    parser.add_argument("--minute-seconds", type=float, default=90.0, help="of those of the time")
    parser.add_argument("--still-seconds", type=float, default=71.5, help="of those at rest")
    parser.add_argument("--exposure-ms", type=float, default=0.0)
    parser.add_argument("--only", choices=("sigma", "time", "still"), help="one of the tables")
    parser.add_argument("--processes", type=int, default=multiprocessing.cpu_count())
    a = parser.parse_args()
    seeds = range(1, a.seeds + 1)
    grid = itertools.product(a.noise_grey, a.angle_deg, a.jitter_ms, seeds)
    tables = {
        "sigma": (coverage_table, [Case(a.seconds, *values) for values in grid]),
        "time": (time_table, [Case(a.minute_seconds, jitter_ms=5.0, seed=n) for n in seeds]),
        "still": (still_table, [Case(a.still_seconds, seed=n, motion="still") for n in seeds]),
    }
    # Another seed for every record: each has noise, lateness and losses of its own.
    for name, (show, cases) in tables.items():
        if a.only in (None, name):
            own = [replace(c, seed=n, exposure_ms=a.exposure_ms) for n, c in enumerate(cases, 1)]
            with multiprocessing.Pool(a.processes) as pool:
                runs = list(
                    track(
                        pool.imap(run, own),
                        total=len(own),
                        description=name,
                        console=Console(stderr=True),
                    )
                )
            Console(width=150).print(show(runs))


if __name__ == "__main__":
    main()
