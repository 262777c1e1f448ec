"""What disturbs a disc, through the real process stage: how wrong the marker gets, and whether it
says so. `python -m tools.bench.accuracy --set disturbed` runs it.

The bench's marker (8 m, 30 deg, noise of 2 grey levels) swings by 10 mm at 1 Hz. In each trial one
disc is hit, for three frames, by a disturbance that goes with it; `gradient on all` is light that
changes alike on all four. Counted are the samples of those frames. A sample is flagged when it has
a status or one of its circles has a flag; what comes without a position is lost.
"""

from __future__ import annotations

import itertools
import multiprocessing
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from rich import box
from rich.console import Console
from rich.progress import track
from rich.table import Table

from tools.bench.film import Film, Picture, Way, film_of
from tools.bench.picture import DISTURBANCES, Bench, Grey, disturbed
from tools.bench.stage import PERIOD_NS, Stage, field_offsets_s, flagged
from vdms_rt.model import Displacement

BENCH = Bench(distance_m=8.0, angle_deg=30.0)
AMPLITUDE_MM = 10.0
NOISE_GREY = 2.0
TRIALS_OF_A_REFERENCE = 10
HIT_FRAMES = 3
ALL = "gradient on all"
KINDS = (*DISTURBANCES, ALL)


@dataclass(frozen=True)
class Row:
    """One line of the table."""

    kind: str
    sampling: str
    trials: int
    samples: int
    rms_x_um: float
    rms_y_um: float
    worst_um: float
    """Of x and y."""
    lost_percent: float
    flagged_percent: float
    all_used_percent: float
    """Samples with a position from all four discs, a hit one by the rest of its edge."""
    beyond_4_sigma: int
    """Samples with an error of x or y beyond four of its sigmas."""
    silent_beyond_4_sigma: int
    """Those among them that are not flagged."""
    within_2_sigma: float
    seed: int


class Swing:
    """The marker before the process stage: at rest for the reference, then in harmonic motion."""

    def __init__(self, sampling: str, rng: np.random.Generator, film: Film) -> None:
        self.film, self.rng, self.sampling = film, rng, sampling
        self.stage = Stage(BENCH, film, "smooth", sampling)
        self._image = film.blank()
        self.n = 0
        while not self.stage.measuring:
            if self.n > 100:
                raise SystemExit(f"no reference from {self.n} frames of the marker at rest")
            self.show(self.stage, self.clean([0.0] * len(field_offsets_s(sampling))))
        self.begin = self.n

    def places_mm(self) -> list[float]:
        """Return where the marker is in each picture of the next frame, the first one first."""
        t_s = (self.n - self.begin) * PERIOD_NS / 1e9 + np.array(field_offsets_s(self.sampling))
        return (AMPLITUDE_MM * np.sin(2 * np.pi * t_s)).tolist()

    def clean(self, places_mm: list[float]) -> Picture:
        # A film's frame begins with the top field, which is the later one.
        return self.film.clean([np.array([p]) for p in places_mm[::-1]], np.ones(1))

    def show(self, stage: Stage, clean: Picture) -> list[Displacement]:
        """Return the samples of the next frame."""
        unit = self.rng.standard_normal(self.film.pixels, dtype=np.float32)
        self.film.grab(self._image, clean, unit, NOISE_GREY)
        samples = stage.show(self.n, self._image)
        self.n += 1
        return samples

    def hit(
        self, kind: str, circles: tuple[int, ...], places_mm: list[float], seed: int
    ) -> Picture:
        """Return the next frame's clean picture with a disturbance, the same one for a seed."""
        fields = []
        for place in places_mm[::-1]:
            drawn = self.film.shown(self.clean([place] * len(places_mm)))
            for circle in circles:
                drawn[circle] = disturbed(
                    drawn[circle],
                    BENCH,
                    kind,
                    (circle,),
                    np.random.default_rng(seed),
                    (place, 0.0, 0.0),
                    self.film.windows[circle],
                )
            picture = np.empty(self.film.pixels, np.float32)
            self.film.fill(picture, drawn)
            fields.append(picture)
        if len(fields) == 2:
            fields[0][self.film.top_pixels :] = fields[1][self.film.top_pixels :]
        return fields[0]


def trials(kind: str, sampling: str, count: int, seed: int) -> Row:
    """Hit a disc `count` times, each disc in turn."""
    rng = np.random.default_rng([seed, KINDS.index(kind), len(sampling)])
    film = film_of(BENCH, Way(AMPLITUDE_MM))
    errors: list[NDArray[np.float64]] = []
    samples = lost = told = all_used = silent = 0
    for trial in range(count):
        if trial % TRIALS_OF_A_REFERENCE == 0:
            swing = Swing(sampling, rng, film)
        for _ in range(int(rng.integers(3, 12))):
            swing.show(swing.stage, swing.clean(swing.places_mm()))
        # What is hit branches off from the swing, which goes on unhit.
        stage, n = copy(swing.stage), swing.n
        circles = tuple(range(4)) if kind == ALL else (trial % 4,)
        drawn_from = int(rng.integers(2**32))
        for _ in range(HIT_FRAMES):
            places = swing.places_mm()
            picture = swing.hit(kind.removesuffix(" on all"), circles, places, drawn_from)
            for sample, x_mm in zip(swing.show(stage, picture), places, strict=True):
                samples += 1
                told += flagged(sample)
                all_used += not sample.status
                if not sample.valid:
                    lost += 1
                    continue
                error = np.array([sample.x_mm - x_mm, sample.y_mm])
                sigma = np.array([sample.sigma_x_mm, sample.sigma_y_mm])
                silent += not flagged(sample) and bool((abs(error) > 4 * sigma).any())
                errors.append(np.stack([error, sigma]))
        swing.n = n
    error_um, sigma_um = 1000 * np.array(errors).transpose(1, 0, 2)
    return Row(
        kind=kind,
        sampling=sampling,
        trials=count,
        samples=samples,
        rms_x_um=_rms(error_um[:, 0]),
        rms_y_um=_rms(error_um[:, 1]),
        worst_um=float(abs(error_um).max()),
        lost_percent=100 * lost / samples,
        flagged_percent=100 * told / samples,
        all_used_percent=100 * all_used / samples,
        beyond_4_sigma=int((abs(error_um) > 4 * sigma_um).any(axis=1).sum()),
        silent_beyond_4_sigma=silent,
        within_2_sigma=float(np.mean(abs(error_um) <= 2 * sigma_um)),
        seed=seed,
    )


def _rms(values: Grey) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _row(asked: tuple[str, str, int, int]) -> Row:
    return trials(*asked)


def measured(samplings: Sequence[str], count: int, seed: int, jobs: int) -> list[Row]:
    """Return a row for each kind of disturbance and sampling, by so many processes."""
    asked = [(kind, s, count, seed) for s, kind in itertools.product(samplings, KINDS)]
    with multiprocessing.get_context("spawn").Pool(jobs) as pool:
        rows = pool.imap(_row, asked)
        return list(track(rows, "disturbing", len(asked), console=Console(stderr=True)))


def table_of(rows: Sequence[Row]) -> Table:
    table = Table(
        title=f"One disc hit: {BENCH.distance_m:g} m, {BENCH.angle_deg:g} deg, "
        f"{AMPLITUDE_MM:g} mm at 1 Hz, noise {NOISE_GREY:g}",
        box=box.SIMPLE,
    )
    names = ("sampling", "samples", "rms x um", "rms y um", "worst um", "lost %", "flagged %")
    for name in ("disturbance", *names, "all used %", "> 4 sigma", "silent", "in 2 sigma"):
        table.add_column(name, justify="right")
    for r in rows:
        table.add_row(
            *(r.kind, r.sampling, str(r.samples)),
            *(f"{v:.2f}" for v in (r.rms_x_um, r.rms_y_um, r.worst_um)),
            *(f"{v:.1f}" for v in (r.lost_percent, r.flagged_percent, r.all_used_percent)),
            *(str(r.beyond_4_sigma), str(r.silent_beyond_4_sigma), f"{r.within_2_sigma:.3f}"),
        )
    return table
