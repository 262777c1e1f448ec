"""Figures 3.3 and 3.4 of Lee, Cho and Sim (2015), from the bench's pictures.

    .venv/bin/python -m tools.bench.figures paper.csv figures

draws figure 3.4 again from a CSV of `tools.bench.accuracy`. Both figures are for noise of 2 grey
levels, or what is nearest to it among the results. Each is written as PNG and as PDF.
"""

from __future__ import annotations

import argparse
import csv
import itertools
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import get_type_hints

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, NullFormatter

from tools.bench.cases import Setting
from tools.bench.measuring import Result, Series, record
from tools.bench.picture import Bench

STYLE = {
    "font.size": 8,
    "axes.titlesize": 8,
    "axes.labelsize": 8,
    "legend.fontsize": 7,
    "lines.linewidth": 1.0,
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "grid.linewidth": 0.4,
    "grid.color": "0.85",
    "savefig.dpi": 200,
    "pdf.fonttype": 42,
}
OTSU, SMOOTH, BOUND = "#c44e52", "#1f5fa8", "0.35"
METHODS = (("otsu", OTSU, "Otsu mean (paper)"), ("smooth", SMOOTH, "smooth weight"))
WIDTH_IN = 7.1
BENCH = Bench(distance_m=8.0, angle_deg=30.0)
SHOWN_S = 2.0
MARKS = "osD^v"


def draw(folder: Path, results: Sequence[Result], seed: int = 1) -> None:
    """Write figure 3.3, measured for it, and figure 3.4, of `results`, to a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    _save(time_histories(seed), folder / "figure-3.3")
    if any(r.set == "paper" for r in results):
        _save(errors(results), folder / "figure-3.4")


def _save(figure: Figure, path: Path) -> None:
    with mpl.rc_context(STYLE):
        figure.savefig(path.with_suffix(f"{path.suffix}.png"))
        figure.savefig(path.with_suffix(f"{path.suffix}.pdf"), metadata={"CreationDate": None})


def time_histories(seed: int = 1) -> Figure:
    """Return figure 3.3: displacement measured and true over time, and the error below it, for 10,
    1 and 0.1 mm at 8 m and 30 deg."""
    with mpl.rc_context(STYLE):
        figure = Figure((WIDTH_IN, 3.6), layout="constrained")
        axes = figure.subplots(2, 3, sharex=True, height_ratios=(3, 2))
        for right in axes[1, 1:]:
            right.sharey(axes[1, 0])
        for column, amplitude in enumerate((10.0, 1.0, 0.1)):
            setting = Setting(
                "figure 3.3",
                BENCH,
                amplitude_mm=amplitude,
                methods=("otsu", "smooth"),
                samples=int(SHOWN_S * 30),
                seed=seed,
            )
            recorded = record(setting)
            _history(axes[0, column], axes[1, column], recorded, setting)
            axes[0, column].set_title(f"{amplitude:g} mm, 1 Hz")
        axes[0, 0].set_ylabel("displacement (mm)")
        axes[1, 0].set_ylabel("error (\N{MICRO SIGN}m)")
        figure.align_ylabels(axes[:, 0])
        handles = [
            Line2D([], [], color="0.2", label="true position, mean over the exposure"),
            Line2D(
                [], [], color=OTSU, marker="o", mfc="none", ms=3, ls="", label="Otsu mean (paper)"
            ),
            Line2D([], [], color=SMOOTH, marker=".", ms=4, ls="", label="smooth weight"),
        ]
        where = f"{BENCH.distance_m:g} m, {BENCH.angle_deg:g} deg, {_noise(setting.noises_grey[0])}"
        _legend(figure, handles, where)
    return figure


def _history(
    above: Axes, below: Axes, recorded: dict[tuple[float, str], Series], setting: Setting
) -> None:
    (noise,) = setting.noises_grey
    for method, colour, style in (
        ("otsu", OTSU, {"marker": "o", "ms": 3, "mfc": "none", "mew": 0.7}),
        ("smooth", SMOOTH, {"marker": ".", "ms": 4}),
    ):
        series = recorded[noise, method]
        t_s = np.array(series.t_s) - series.t_s[0]
        true, x = np.array(series.true_mm), np.array([s.x_mm for s in series.samples])
        if method == "otsu":
            t_fine = np.linspace(0, t_s[-1], 600)
            start = series.t_s[0]
            line = setting.swing_mm * np.sin(2 * np.pi * setting.frequency_hz * (t_fine + start))
            above.plot(t_fine, line, color="0.2", zorder=1)
        above.plot(t_s, x, ls="", color=colour, **style)
        below.plot(t_s, 1000 * (x - true), ls="-", lw=0.5, color=colour, **style)
    below.axhline(0, color="0.2", lw=0.6, zorder=0)
    below.set_xlabel("time (s)")
    below.set_xlim(0, SHOWN_S)
    for axes in (above, below):
        axes.grid(visible=True)


def _noise(noise_grey: float) -> str:
    return f"noise of {noise_grey:g} grey levels"


def _legend(figure: Figure, handles: list[Line2D], title: str) -> None:
    figure.legend(
        handles=handles,
        title=title,
        title_fontsize=8,
        loc="outside upper center",
        ncols=len(handles),
        columnspacing=1.2,
        handlelength=1.6,
        handletextpad=0.5,
        frameon=False,
    )


def errors(results: Sequence[Result]) -> Figure:
    """Return figure 3.4: the error of Eq. 3.1 over angle and distance, for each amplitude and
    sampling, beside the bound."""
    rows = [r for r in results if r.set == "paper" and r.amplitude_mm]
    noise = min({r.noise_grey for r in rows}, key=lambda n: abs(n - 2))
    rows = [r for r in rows if r.noise_grey == noise]
    amplitudes = sorted({r.amplitude_mm for r in rows}, reverse=True)
    samplings = sorted({r.sampling for r in rows}, reverse=True)
    distances = sorted({r.distance_m for r in rows})
    with mpl.rc_context(STYLE):
        figure = Figure((WIDTH_IN, 0.9 + 2.2 * len(samplings)), layout="constrained")
        axes = figure.subplots(
            len(samplings), len(amplitudes), sharex=True, sharey="row", squeeze=False
        )
        for (i, sampling), (j, amplitude) in itertools.product(
            enumerate(samplings), enumerate(amplitudes)
        ):
            own = [r for r in rows if (r.sampling, r.amplitude_mm) == (sampling, amplitude)]
            _over_angle(axes[i, j], own, distances)
            kind = "whole frames" if sampling == "frame" else "fields"
            axes[i, j].set_title(f"{amplitude:g} mm, {kind}")
            if i == len(samplings) - 1:
                axes[i, j].set_xlabel("angle (deg)")
            if j == 0:
                axes[i, j].set_ylabel("error, Eq. 3.1 (%)")
        handles = [
            *(
                Line2D([], [], color="0.2", marker=m, ms=3.5, ls="", label=f"{d:g} m")
                for m, d in zip(itertools.cycle(MARKS), distances, strict=False)
            ),
            *(
                Line2D([], [], color=colour, label=label)
                for method, colour, label in METHODS
                if any(r.method == method for r in rows)
            ),
            Line2D(
                [],
                [],
                color=BOUND,
                ls="--",
                label="Cram\N{LATIN SMALL LETTER E WITH ACUTE}r-Rao bound",
            ),
        ]
        _legend(figure, handles, f"1 Hz, {_noise(noise)}")
    return figure


def _over_angle(axes: Axes, rows: Sequence[Result], distances: Sequence[float]) -> None:
    angles = sorted({r.angle_deg for r in rows})
    for method, colour, _ in METHODS:
        for k, (distance, mark) in enumerate(zip(distances, itertools.cycle(MARKS), strict=False)):
            own = sorted(
                (r for r in rows if r.method == method and r.distance_m == distance),
                key=lambda r: r.angle_deg,
            )
            # Side by side, so that equal distances do not hide each other.
            aside = 1.1 * (k - (len(distances) - 1) / 2)
            axes.plot(
                [r.angle_deg + aside for r in own],
                [r.error_percent for r in own],
                color=colour,
                marker=mark,
                ms=3,
                lw=0.4,
                mew=0,
                alpha=0.85,
            )
    least = [np.median([r.bound_percent for r in rows if r.angle_deg == a]) for a in angles]
    axes.plot(angles, least, color=BOUND, ls="--", lw=1.2, zorder=4)
    axes.set_yscale("log")
    axes.set_xticks(angles)
    axes.yaxis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.grid(visible=True, which="major")


def read_csv(path: Path) -> list[Result]:
    """Return the results in a CSV of the bench."""
    kinds = get_type_hints(Result)
    with path.open(newline="", encoding="utf-8") as file:
        return [
            Result(**{f.name: kinds[f.name](row[f.name]) for f in fields(Result)})
            for row in csv.DictReader(file)
        ]


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m tools.bench.figures",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("csv", type=Path)
    parser.add_argument("folder", type=Path)
    options = parser.parse_args()
    try:
        results = read_csv(options.csv)
    except (OSError, KeyError, ValueError) as error:
        parser.error(f"{options.csv} is no CSV of tools.bench.accuracy: {error}")
    draw(options.folder, results)


if __name__ == "__main__":
    main()
