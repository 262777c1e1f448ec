"""One setting of the accuracy bench, measured: from pictures to figures."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from math import ceil, nan, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tools.bench.aruco import Corners, Tags
from tools.bench.bound import bound, error_percent
from tools.bench.cases import Setting
from tools.bench.film import Film, film_of
from tools.bench.picture import Grey, exposure_nodes
from tools.bench.stage import PERIOD_NS, STILLS, Stage, field_offsets_s, flagged
from vdms_rt.model import Status

PERIOD_S = PERIOD_NS / 1e9
REST_FRAMES = STILLS + 5
RISE_S = 1.0
"""The swing grows to its amplitude in this time, in which nothing is counted."""


@dataclass(frozen=True)
class Result:
    """One row of the table. Errors are of x, against its mean over the exposure."""

    set: str
    method: str
    sampling: str
    distance_m: float
    angle_deg: float
    frequency_hz: float
    amplitude_mm: float
    velocity_mm_s: float
    axis_deg: float
    tilt_deg: float
    exposure_ms: float
    sigma_t_us: float
    noise_grey: float
    samples: int
    error_percent: float
    """Eq. 3.1; NaN at rest."""
    bound_percent: float
    exposure_loss_percent: float
    """Of the amplitude, by the mean over the exposure: 1 - sinc."""
    std_um: float
    bound_um: float
    over_bound: float
    std_y_um: float
    over_bound_y: float
    mean_um: float
    line_um: float
    """Amplitude of the line at half the fields' rate; NaN for frames."""
    line_floor_um: float
    """What noise alone would leave of it."""
    within_2_sigma: float
    """Part of the errors of x and y; NaN where the method gives no sigma."""
    flagged_percent: float
    """Samples flagged, though nothing is wrong with the picture."""
    lost_percent: float
    seed: int


class Sample(NamedTuple):
    """What a method says of one picture; NaN where it says nothing."""

    x_mm: float
    y_mm: float
    sigma_x_mm: float
    sigma_y_mm: float
    flagged: bool


@dataclass
class Series:
    """Samples in the order of time."""

    t_s: list[float] = field(default_factory=list)
    true_mm: list[float] = field(default_factory=list)
    """Mean of the place on the way over the exposure."""
    samples: list[Sample] = field(default_factory=list)


Show = Callable[[int, NDArray[np.uint8], int], list[Sample]]
"""From frame number, image and lateness in ns to a sample for each of its pictures; none while the
reference is being taken."""


def measure(setting: Setting) -> list[Result]:
    """Return a row for each noise and method."""
    return [
        _result(setting, noise, method, series)
        for (noise, method), series in record(setting).items()
    ]


def record(setting: Setting) -> dict[tuple[float, str], Series]:
    """Return what each method made of the marker at rest and then in motion, at each noise. All of
    them see the same motion and the same noise but for its strength."""
    film = film_of(
        Tags(setting.bench) if "aruco" in setting.methods else setting.bench, setting.way
    )
    rng = np.random.Generator(np.random.SFC64(_seed(setting)))
    offsets_s = field_offsets_s(setting.sampling)
    keys = [(noise, method) for noise in setting.noises_grey for method in setting.methods]
    shows = {key: _shower(setting, film, key[1]) for key in keys}
    recorded = {key: Series() for key in keys}
    image = film.blank()
    unit = np.empty(film.pixels, np.float32)
    exposure_s = setting.exposure_ms / 1000
    nodes = (
        1 if not exposure_s else 4 + ceil(3 * setting.velocity_mm_s * exposure_s * film.px_per_mm)
    )
    within_s, shares = exposure_nodes(exposure_s, nodes)
    # The first exposure that lies in the steady swing as a whole.
    begin = REST_FRAMES + ceil(RISE_S / PERIOD_S) + 1
    end = begin + ceil(setting.samples / len(offsets_s))
    for n in range(end):
        late_ns = round(rng.normal(0, 1000 * setting.sigma_t_us)) if setting.sigma_t_us else 0
        t_s = (n - REST_FRAMES) * PERIOD_S + np.array(offsets_s)
        places = [_place_mm(setting, t + within_s) for t in t_s]
        # A film's frame begins with the top field, which is the later one.
        clean = film.clean(places[::-1], shares)
        rng.standard_normal(out=unit, dtype=np.float32)
        true_mm = [float(shares @ _place_mm(setting, t + within_s + late_ns / 1e9)) for t in t_s]
        for noise in setting.noises_grey:
            film.grab(image, clean, unit, noise)
            for method in setting.methods:
                samples = shows[noise, method](n, image, late_ns)
                if n < begin:
                    continue
                if len(samples) < len(t_s):
                    raise SystemExit(f"{method} took no reference from the marker at rest")
                series = recorded[noise, method]
                series.t_s += t_s.tolist()
                series.true_mm += true_mm
                series.samples += samples
    return recorded


def _seed(setting: Setting) -> list[int]:
    bench = setting.bench
    figures = (
        *(bench.distance_m, bench.angle_deg, bench.roll_deg, bench.width_px, bench.fill),
        *(bench.white_grey, setting.amplitude_mm, setting.frequency_hz, setting.exposure_ms),
        *(setting.axis_deg, setting.tilt_deg, len(setting.sampling)),
    )
    return [setting.seed, *(round(1000 * f) for f in figures)]


def _place_mm(setting: Setting, t_s: Grey) -> Grey:
    """Return where on its way the marker is, `t_s` after the swing began."""
    risen = np.clip(t_s / RISE_S, 0, 1)
    grown = risen * risen * (3 - 2 * risen)
    place: Grey = setting.swing_mm * grown * np.sin(2 * np.pi * setting.frequency_hz * t_s)
    return place


def _shower(setting: Setting, film: Film, method: str) -> Show:
    if method == "aruco":
        tags = Corners(Tags(setting.bench), film.windows, STILLS)

        def corners(_n: int, image: NDArray[np.uint8], _late_ns: int) -> list[Sample]:
            seen = tags.show(image)
            return [Sample(*(seen or (nan, nan)), nan, nan, False)] if tags.measuring else []

        return corners
    stage = Stage(
        setting.bench,
        film,
        method,
        setting.sampling,
        setting.axis_deg,
        setting.exposure_ms / 1000,
    )
    sigma_t_ns = round(1000 * setting.sigma_t_us)

    def show(n: int, image: NDArray[np.uint8], late_ns: int) -> list[Sample]:
        return [
            Sample(
                s.x_mm if s.valid else nan,
                s.y_mm if s.valid else nan,
                s.sigma_x_mm,
                s.sigma_y_mm,
                flagged(s),
            )
            for s in stage.show(n, image, late_ns, sigma_t_ns)
            if not s.status & Status.SET_UP
        ]

    return show


def _result(setting: Setting, noise_grey: float, method: str, series: Series) -> Result:
    true = np.array(series.true_mm)
    x, y, sigma_x, sigma_y, told = np.array(series.samples).T
    seen = np.isfinite(x)
    error, sigma = np.stack([x - true, y])[:, seen], np.stack([sigma_x, sigma_y])[:, seen]
    true = true[seen]
    std_x, std_y = np.std(error, axis=1).tolist()
    least_x, least_y = _bound(setting, noise_grey)
    line = line_floor = nan
    if setting.sampling == "field":
        turns = np.where(np.arange(len(seen)) % 2, 1.0, -1.0)[seen]
        line = abs(float(np.mean(turns * (error[0] - error[0].mean()))))
        line_floor = std_x / sqrt(len(turns))
    moved = float(np.std(true))
    return Result(
        set=setting.name,
        method=method,
        sampling=setting.sampling,
        distance_m=setting.bench.distance_m,
        angle_deg=setting.bench.angle_deg,
        frequency_hz=setting.frequency_hz,
        amplitude_mm=setting.swing_mm,
        velocity_mm_s=round(setting.velocity_mm_s, 3),
        axis_deg=setting.axis_deg,
        tilt_deg=setting.tilt_deg,
        exposure_ms=round(setting.exposure_ms, 3),
        sigma_t_us=setting.sigma_t_us,
        noise_grey=noise_grey,
        samples=int(seen.sum()),
        error_percent=100 * std_x / moved if moved else nan,
        bound_percent=error_percent(least_x, setting.swing_mm) if moved else nan,
        exposure_loss_percent=100
        * (1 - float(np.sinc(setting.frequency_hz * setting.exposure_ms / 1000))),
        std_um=1000 * std_x,
        bound_um=1000 * least_x,
        over_bound=std_x / least_x,
        std_y_um=1000 * std_y,
        over_bound_y=std_y / least_y,
        mean_um=1000 * float(error[0].mean()),
        line_um=1000 * line,
        line_floor_um=1000 * line_floor,
        within_2_sigma=float(np.mean(abs(error) <= 2 * sigma)) if method == "smooth" else nan,
        flagged_percent=100 * float(told.mean()),
        lost_percent=100 * float(1 - seen.mean()),
        seed=setting.seed,
    )


def _bound(setting: Setting, noise_grey: float) -> tuple[float, float]:
    """Return the least standard deviations of x and y in millimetres, along and across the axis, of
    one picture: the whole one, or the mean of the two fields' variances."""
    parts = [slice(None)] if setting.sampling == "frame" else [slice(0, None, 2), slice(1, None, 2)]
    covariance = np.mean([bound(setting.bench, noise_grey, part) for part in parts], axis=0)
    axis = np.radians(setting.axis_deg)
    turn = np.array([[np.cos(axis), np.sin(axis)], [-np.sin(axis), np.cos(axis)]])
    along, across = np.sqrt(np.diag(turn @ covariance[:2, :2] @ turn.T)).tolist()
    return along, across
