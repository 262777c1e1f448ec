"""Plots for print: vectors, units on every axis, readable without colour."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
from numpy.typing import NDArray

from vdms_replay.source import ReplayError

if TYPE_CHECKING:
    from vdms_replay.comparison import Comparison

Floats: TypeAlias = NDArray[np.float64]

BLUE, ORANGE, GREEN, GREY = "#0b4f8a", "#c04f00", "#2e7d32", "#8a8a8a"
DARK = "#202020"
WIDE_IN = 6.9
"""Between the margins of an A4 page."""
POINTS = 3000
"""Of a curve; a longer one is drawn as the band from its least to its largest value."""
FORMATS = (".pdf", ".svg", ".png")
STYLE: Any = {
    "font.family": "DejaVu Sans",
    "font.size": 8,
    "axes.titlesize": 8.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.labelsize": 8,
    "axes.linewidth": 0.6,
    "axes.edgecolor": DARK,
    "axes.labelcolor": DARK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.formatter.useoffset": False,
    "axes.unicode_minus": True,
    "grid.color": "#dcdcdc",
    "grid.linewidth": 0.5,
    "lines.linewidth": 0.9,
    "xtick.labelsize": 7.5,
    "ytick.labelsize": 7.5,
    "legend.fontsize": 7.5,
    "legend.frameon": False,
    "pdf.fonttype": 42,
    "svg.fonttype": "path",
    "figure.constrained_layout.use": True,
}


def new_figure(height_in: float, width_in: float = WIDE_IN) -> Figure:
    """Return an empty figure in the house's style; draw into it within `styled`."""
    figure = Figure(figsize=(width_in, height_in))
    FigureCanvasAgg(figure)
    return figure


def styled() -> Any:
    """Return a context in which figures get the house's style."""
    return mpl.rc_context(STYLE)


def save_figure(figure: Figure, path: Path) -> None:
    """Write a figure in the format of the path's suffix. Raises ReplayError."""
    if path.suffix.lower() not in FORMATS:
        raise ReplayError(
            f"{path}: a plot is a {', '.join(FORMATS[:-1])} or {FORMATS[-1]} file, "
            f"not {path.suffix or 'one without a suffix'}"
        )
    try:
        with styled():
            figure.savefig(path, dpi=200)
    except OSError as error:
        raise ReplayError(
            f"{path}: cannot be written: {(error.strerror or str(error)).lower()}"
        ) from None


def curve(axes: Axes, t: Floats, y: Floats, colour: str, label: str | None = None, **how: Any
) -> None:  # fmt: skip
    """Draw y over t; a long one as the band that its values fill. NaN leaves a gap."""
    if len(t) <= POINTS:
        axes.plot(t, y, color=colour, label=label, **how)
        return
    edges = np.linspace(0, len(t), POINTS // 2 + 1).astype(int)
    with np.errstate(all="ignore"):
        low = np.fmin.reduceat(y, edges[:-1])
        high = np.fmax.reduceat(y, edges[:-1])
    at = t[edges[:-1]]
    axes.fill_between(
        at, low, high, color=colour, linewidth=0.4, edgecolor=colour, label=label, step=None
    )


def with_gaps(time_s: Floats) -> tuple[Floats, NDArray[np.int64]]:
    """Return times with one more in each gap, and where it was put in."""
    steps = np.diff(time_s)
    if not len(steps):
        return time_s, np.zeros(0, np.int64)
    gaps = np.flatnonzero(steps > 1.5 * np.median(steps)).astype(np.int64) + 1
    return np.insert(time_s, gaps, time_s[gaps - 1]), gaps


def density(axes: Axes, f: Floats, values: Floats, colour: str, label: str, **how: Any) -> None:
    """Draw the square root of a spectral density, without its value at 0 Hz."""
    axes.loglog(f[1:], np.sqrt(np.maximum(values[1:], 1e-30)), color=colour, label=label, **how)


def plain_numbers(axis: Axis) -> None:
    """Number a logarithmic axis as people write it: 0.1, 0.2, 0.5, 1; over three decades and more
    only 0.1, 1, since the others would run into each other. Its curves are drawn before."""
    begin, end = axis.get_view_interval()
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if end < 1000 * begin else (1.0,)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def figure_of_comparison(one: Comparison) -> Figure:
    """Return both series, their difference, and what both hold at each frequency."""
    g = one.agreement
    with styled():
        figure = new_figure(6.2 if one.spectrum is not None else 4.0)
        rows = [2.0, 1.4, 2.0, 1.0] if one.spectrum is not None else [2.0, 1.4]
        panels: Any = figure.subplots(len(rows), 1, height_ratios=rows)
        both, rest = panels[:2]
        at_s, gaps = with_gaps(g.time_s)
        reference_mm, camera_mm, difference_um = (
            np.insert(values, gaps, np.nan)
            for values in (g.reference_mm, g.camera_mm, 1000 * g.difference_mm)
        )
        curve(
            both, at_s, reference_mm, GREY, "reference, as the camera would see it", linewidth=2.2
        )
        curve(both, at_s, camera_mm, BLUE, "camera")
        both.set_ylabel("displacement, mm")
        _legend_above(both, 2)
        both.set_title(f"{one.path.stem}, marker {one.chosen.marker}")
        curve(rest, at_s, difference_um, ORANGE)
        rest.set_ylabel("difference, µm")
        rest.set_xlabel("time since the first sample, s")
        rest.set_title(
            f"Camera - reference: {1000 * g.rmse_mm:.2f} µm RMS, Eq. 3.1: {g.error_percent:.4f} %"
        )
        rest.sharex(both)
        if one.spectrum is not None:
            s = one.spectrum
            amplitude, together = panels[2:]
            density(amplitude, s.frequency_hz, s.reference_mm2_per_hz, GREY, "reference",
                    linewidth=2.2)  # fmt: skip
            density(amplitude, s.frequency_hz, s.camera_mm2_per_hz, BLUE, "camera")
            density(amplitude, s.frequency_hz, s.error_mm2_per_hz, ORANGE, "difference",
                    linestyle="--")  # fmt: skip
            amplitude.set_ylabel("density, mm/√Hz")
            _legend_above(amplitude, 3)
            amplitude.set_title("Amplitude spectral density")
            together.semilogx(s.frequency_hz[1:], s.coherence[1:], color=DARK)
            together.set_ylim(0, 1.05)
            together.set_ylabel("coherence")
            together.set_xlabel("frequency, Hz")
            together.sharex(amplitude)
            plain_numbers(together.xaxis)
    return figure


MARKS = "os^Dvp*"


def figure_of_cases(found: Sequence[Comparison]) -> Figure:
    """Return the error over the distance, for each angle, and over the angle, for each distance:
    the paper's Figure 3.4."""
    where = [(one.distance_m, one.angle_deg, one.agreement.error_percent) for one in found]
    with styled():
        figure = new_figure(3.4)
        panels: Any = figure.subplots(1, 2, sharey=True)
        for axes, along, across, name, unit in (
            (panels[0], 0, 1, "distance, m", "°"),
            (panels[1], 1, 0, "angle to the marker's normal, °", " m"),
        ):
            for number, value in enumerate(sorted({case[across] for case in where})):
                line = sorted((case[along], case[2]) for case in where if case[across] == value)
                axes.semilogy(
                    [x for x, _ in line],
                    [error for _, error in line],
                    marker=MARKS[number % len(MARKS)],
                    markersize=4,
                    label=f"{value:g}{unit}",
                )
            axes.set_xlabel(name)
            axes.margins(x=0.08)
            axes.legend(loc="best", ncols=2)
        panels[0].set_ylabel("error of Eq. 3.1, %")
        panels[0].set_title("Error over distance, for each angle")
        panels[1].set_title("Error over angle, for each distance")
        _whole_decades(panels[0], [case[2] for case in where])
        plain_numbers(panels[0].yaxis)
    return figure


def _legend_above(axes: Axes, columns: int) -> None:
    """Put the legend over the panel's right end, on the line of its title."""
    axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=columns, borderaxespad=0.1)


def _whole_decades(axes: Axes, values: Sequence[float]) -> None:
    low, high = min(values), max(values)
    if low > 0:
        axes.set_ylim(10 ** math.floor(math.log10(low)), 10 ** math.ceil(math.log10(high * 1.01)))
