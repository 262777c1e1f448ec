"""The frame clock against simulated drivers: `python -m tools.bench.clock [--seeds N]`.

Every driver stamps a camera whose quartz is off, late and with frames lost without a gap in its
sequence. The table says how far the clock's times are from the truth after the first minute, beside
a constant delay and with that delay; how many of them lie within two of its own standard
deviations; whether it counted every lost frame; what a two-sided refit leaves of the whole record;
and what one tick costs. A second table says the same of the first half minute, by age: error, and
error over sigma, which is 1 where sigma is true.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from vdms_rt.capture.clock import FrameClock, mid_exposure_ns
from vdms_rt.capture.refit import refit
from vdms_rt.model import NTSC_FRAME_PERIOD_S, Scan, SourceInfo, StampEvent

Floats: TypeAlias = NDArray[np.float64]
Times: TypeAlias = NDArray[np.int64]
Lateness: TypeAlias = Callable[[np.random.Generator, int], Floats]

START_NS = 10**12
EXPOSURE_NS = 16_683_000


def grabber(**changes: object) -> SourceInfo:
    """Return an NTSC grabber whose driver stamps the end of a frame and counts no lost ones."""
    values: dict[str, object] = {
        "kind": "v4l2",
        "name": "grabber",
        "width_px": 720,
        "height_px": 480,
        "frame_period_s": NTSC_FRAME_PERIOD_S,
        "scan": Scan.TOP_FIRST,
        "live": True,
        "stamp_event": StampEvent.END_OF_FRAME,
        "sequence_counts_lost": False,
    }
    return SourceInfo(**(values | changes))  # type: ignore[arg-type]


@dataclass(frozen=True, slots=True)
class Driver:
    """How a simulated driver stamps."""

    lateness_ns: Lateness
    rate_ppm: float = 50.0
    lost: float = 0.01
    period_s: Fraction = NTSC_FRAME_PERIOD_S


@dataclass(frozen=True, slots=True)
class Record:
    """What a driver delivered, and when it was."""

    frames: Times
    """Index of each delivered frame."""
    true_ns: Times
    """When each would have been stamped without delay."""
    stamps_ns: Times
    lost: int


@dataclass(frozen=True, slots=True)
class Ticks:
    """What a clock made of a record."""

    clock: FrameClock
    index: Times
    error_ns: Floats
    """Of the middle of the exposure."""
    sigma_ns: Floats
    segment: Times
    tick_us: float


def uniform(peak_ms: float) -> Lateness:
    return lambda random, n: random.uniform(0, peak_ms * 1e6, n)


def with_outliers(peak_ms: float) -> Lateness:
    """One stamp in fifty is later by another 10 to 22 ms."""

    def draw(random: np.random.Generator, n: int) -> Floats:
        held_up = random.uniform(size=n) < 0.02
        return random.uniform(0, peak_ms * 1e6, n) + held_up * random.uniform(1e7, 2.2e7, n)

    return draw


def exponential(mean_ms: float) -> Lateness:
    return lambda random, n: random.exponential(mean_ms * 1e6, n)


def normal(sigma_ms: float) -> Lateness:
    """No sharp lower edge: five sigma late on the average."""
    return lambda random, n: np.maximum(0, random.normal(5 * sigma_ms, sigma_ms, n)) * 1e6


def waves(mean_ms: float) -> Lateness:
    """Load comes and goes in seconds: late stamps follow late ones."""

    def draw(random: np.random.Generator, n: int) -> Floats:
        load = np.zeros(n)
        for i, push in enumerate(random.normal(size=n - 1)):
            load[i + 1] = 0.98 * load[i] + 0.2 * push
        return random.uniform(0, mean_ms * 1e6, n) * np.exp(load)

    return draw


def bus(step_ms: float) -> Lateness:
    """Stamped at the end of a transfer of so many milliseconds on a bus with its own clock."""

    def draw(random: np.random.Generator, n: int) -> Floats:
        ends = START_NS + np.arange(n) * float(NTSC_FRAME_PERIOD_S * 10**9)
        step_ns = step_ms * 1e6
        return np.ceil(ends / step_ns) * step_ns - ends + random.uniform(0, 2e4, n)

    return draw


DRIVERS = {
    "5 ms uniform": Driver(uniform(5)),
    "5 ms uniform, 200 ppm": Driver(uniform(5), rate_ppm=200),
    "5 ms uniform, outliers": Driver(with_outliers(5)),
    "5 ms uniform, 20 % lost": Driver(uniform(5), lost=0.2),
    "1 ms uniform": Driver(uniform(1)),
    "0.05 ms uniform": Driver(uniform(0.05)),
    "load in waves, 0.5 ms": Driver(waves(0.5)),
    "0.3 ms exponential": Driver(exponential(0.3)),
    "8 ms bus transfers": Driver(bus(8), rate_ppm=0),
    "1 ms normal": Driver(normal(1)),
}


def simulate(driver: Driver, frames: int, seed: int) -> Record:
    """Return a record of so many frame periods; the first and the last frame are not lost. No stamp
    comes before the one before it."""
    random = np.random.default_rng(seed)
    period_ns = driver.period_s * 10**9 * (1 - Fraction(driver.rate_ppm) / 10**6)
    true_ns = np.array([START_NS + int(n * period_ns) for n in range(frames)])
    late_ns = driver.lateness_ns(random, frames).astype(np.int64)
    stamps_ns = np.maximum.accumulate(true_ns + late_ns)
    kept = random.uniform(size=frames) >= driver.lost
    kept[0] = kept[-1] = True
    return Record(np.flatnonzero(kept), true_ns[kept], stamps_ns[kept], int(np.sum(~kept)))


def follow(record: Record, info: SourceInfo, sequence: Times | None = None) -> Ticks:
    """Return what a new clock says to a record, whose driver counts only what it delivers unless a
    `sequence` is given."""
    clock = FrameClock(info, EXPOSURE_NS)
    counted = range(len(record.frames)) if sequence is None else sequence.tolist()
    stamps_ns = record.stamps_ns.tolist()
    begin = time.thread_time()
    ticks = [clock.tick(s, n) for s, n in zip(stamps_ns, counted, strict=True)]
    spent_s = time.thread_time() - begin
    middle_ns = record.true_ns + mid_exposure_ns(info, EXPOSURE_NS, 0, info.scan)
    return Ticks(
        clock=clock,
        index=np.array([t.index for t in ticks]),
        error_ns=(np.array([t.t_ns for t in ticks]) - middle_ns).astype(np.float64),
        sigma_ns=np.array([t.sigma_t_ns for t in ticks], dtype=np.float64),
        segment=np.array([t.segment for t in ticks]),
        tick_us=spent_s / len(ticks) * 1e6,
    )


NORMAL = DRIVERS["1 ms normal"].lateness_ns
AGES = {
    "0.3 to 1 s": slice(8, 30),
    "1 to 2 s": slice(30, 60),
    "2 to 5 s": slice(60, 150),
    "5 to 15 s": slice(150, 450),
    "15 to 30 s": slice(450, 900),
}
"""Images since the first."""


def rows(driver: Driver, seeds: int, seconds: float) -> tuple[str, str]:
    """Return a line of either table: after the first minute, and by age before."""
    info = grabber(frame_period_s=driver.period_s)
    frames, minute = (round(t / driver.period_s) for t in (seconds, 60))
    spread, delay, inside, inside_all, refitted, cost = [], [], [], [], [], []
    young: list[list[tuple[float, ...]]] = []
    counted = 0
    for seed in range(seeds):
        record = simulate(driver, frames, seed)
        ticks = follow(record, info)
        late = record.frames >= minute
        error_ns = ticks.error_ns[late]
        spread.append(float(error_ns.std()))
        delay.append(float(error_ns.mean()))
        about_ns = ticks.error_ns - (delay[-1] if driver.lateness_ns is NORMAL else 0)
        good = np.abs(about_ns) <= 2 * ticks.sigma_ns
        inside.append(float(good[late].mean()))
        inside_all.append(float(good.mean()))
        z = about_ns / ticks.sigma_ns
        young.append([(np.mean(about_ns[a] ** 2), np.mean(z[a] ** 2)) for a in AGES.values()])
        two_sided = refit(record.stamps_ns, record.frames, driver.period_s) - record.true_ns
        refitted.append(float(two_sided.std()))
        cost.append(ticks.tick_us)
        counted += bool((ticks.index == record.frames).all()) and (
            ticks.clock.figures.missed == record.lost
        )
    rms = math.sqrt(float(np.mean(np.square(spread))))
    settled = (
        f"{rms / 1e3:7.1f} {max(spread) / 1e3:7.1f} {np.mean(delay) / 1e3:8.0f} "
        f"{100 * np.mean(inside):6.1f} {100 * np.mean(inside_all):6.1f} {counted:5d}/{seeds:<3d} "
        f"{math.sqrt(float(np.mean(np.square(refitted)))) / 1e3:7.1f} "
        f"{max(refitted) / 1e3:7.1f} {np.median(cost):6.1f}"
    )
    by_age = np.sqrt(np.mean(young, axis=0))
    return settled, " ".join(f"{error / 1e3:8.1f} {z:5.2f}" for error, z in by_age)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=20, help="records for each driver")
    parser.add_argument("--seconds", type=float, default=120.0, help="length of a record")
    chosen = parser.parse_args()
    print(
        f"{chosen.seeds} records of {chosen.seconds:g} s for each driver; "
        "its quartz is 50 ppm off and 1 % of the frames are lost, unless it is said"
    )
    print(
        f"{'':26s} after 60 s, us: beside a         within 2 sigma  frames    refit, us      cost\n"
        f"{'stamps late by':26s} constant  worst    delay   % late  % all counted     rms   worst"
        "  us/tick"
    )
    ages = []
    for name, driver in DRIVERS.items():
        settled, by_age = rows(driver, chosen.seeds, chosen.seconds)
        print(f"{name:26s} {settled}", flush=True)
        ages.append(f"{name:26s} {by_age}")
    print("\nby age: rms of the error in us, and of error over sigma")
    print(f"{'':26s} " + " ".join(f"{age:>14s}" for age in AGES))
    print("\n".join(ages))


if __name__ == "__main__":
    main()
