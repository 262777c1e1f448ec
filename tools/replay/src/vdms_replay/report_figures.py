"""The report's plots of one recording."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from scipy import signal

from vdms_replay.agreement import summit
from vdms_replay.chosen import Chosen
from vdms_replay.figures import (
    BLUE,
    DARK,
    GREEN,
    GREY,
    ORANGE,
    WIDE_IN,
    Floats,
    curve,
    new_figure,
    plain_numbers,
    styled,
    with_gaps,
)
from vdms_rt.measure.homography import to_image_px
from vdms_rt.setup import SetUp

AXIS_MM = 40.0
"""Length of the axes drawn into the set-up picture."""
LONGEST_BLOCK = 8192
MOST_FILLED = 0.2
HANN_BANDWIDTH = 1.5
"""Bins of noise in a line of the Hann window."""
LEAST_PEAK = 0.02
"""Of the largest amplitude: smaller peaks are not listed."""
PEAKS = 8
COLUMNS = 1500
"""More than a printed plot shows side by side."""
PATH_POINTS = 6000
"""Of a path; a longer one is drawn as the places it has been to."""
PLACES = 250
"""Along the longer side of such a path."""


class Lines(NamedTuple):
    """Amplitude spectra of x and y, mean over overlapping Hann windows, (n,) each."""

    frequency_hz: Floats
    x_mm: Floats
    """Amplitude of a steady sine there."""
    y_mm: Floats
    floor_mm: float
    """What the samples' stated sigma makes of it."""
    filled: int
    """Missing samples that were interpolated."""

    @property
    def resolution_hz(self) -> float:
        return float(self.frequency_hz[1])

    def peaks(self) -> list[tuple[float, float, float]]:
        """Return frequency in Hz and the amplitudes of x and y in mm of the strongest peaks."""
        both = np.hypot(self.x_mm, self.y_mm)
        tops, _ = signal.find_peaks(both)
        least = np.fmax(LEAST_PEAK * both[2:].max(), 3 * self.floor_mm)
        tops = tops[(tops > 1) & (both[tops] >= least)]
        strongest = sorted(tops[np.argsort(-both[tops], kind="stable")][:PEAKS].tolist())
        return [
            (summit(self.frequency_hz, both, k), _over(self.x_mm, k), _over(self.y_mm, k))
            for k in strongest
        ]


def _over(amplitude_mm: Floats, k: int) -> float:
    """Return the amplitude of a sine whose window is spread over the bins around k."""
    around = amplitude_mm[max(k - 2, 0) : k + 3]
    return float(np.sqrt((around**2).sum() / HANN_BANDWIDTH))


def rms(values: Floats) -> float:
    """Return the root mean square of what is a number; NaN where nothing is."""
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(known**2))) if len(known) else math.nan


def lines_of(chosen: Chosen) -> Lines | None:
    """Return the spectra of the chosen samples; None where there are too few, or too many are
    missing."""
    time_s = chosen.valid("time_s")
    if len(time_s) < 64:
        return None
    step_s = float(np.median(np.diff(time_s)))
    places = np.rint(np.cumsum(np.diff(time_s, prepend=time_s[0])) / step_s)
    every = np.arange(int(places[-1]) + 1)
    filled = len(every) - len(places)
    if filled > MOST_FILLED * len(every):
        return None
    block = min(LONGEST_BLOCK, 2 ** int(math.log2(len(every) / 2)))
    amplitudes = []
    for name in ("x_mm", "y_mm"):
        values = np.interp(every, places, chosen.valid(name))
        f, power = signal.welch(values, 1 / step_s, "hann", block, scaling="spectrum")
        amplitudes.append(np.sqrt(2 * power))
    sigma_mm = rms(chosen.valid("sigma_x_mm"))
    floor_mm = sigma_mm * math.sqrt(4 * HANN_BANDWIDTH / block)
    return Lines(f, amplitudes[0], amplitudes[1], floor_mm, filled)


def figure_of_history(chosen: Chosen) -> Figure:
    """Return x, y and rotation over time; a gap is a gap, samples without a position are marked."""
    table = chosen.table
    time_s = table["time_s"].to_numpy(np.float64)
    valid = table["valid"].to_numpy(bool)
    at_s, gaps = with_gaps(time_s)
    with styled():
        figure = new_figure(4.3)
        panels: Any = figure.subplots(3, 1, sharex=True, height_ratios=[2, 1.4, 1.1])
        for axes, name, label, colour in zip(
            panels,
            ("x_mm", "y_mm", "rotation_mrad"),
            ("x, mm", "y, mm", "rotation, mrad"),
            (BLUE, GREEN, DARK),
            strict=True,
        ):
            values = np.where(valid, table[name].to_numpy(np.float64), np.nan)
            curve(axes, at_s, np.insert(values, gaps, np.nan), colour)
            axes.set_ylabel(label)
        for begin_s, end_s in _stretches(time_s, ~valid):
            for axes in panels:
                axes.axvspan(begin_s, end_s, color="#f3d9c6", linewidth=0, zorder=0)
        panels[0].set_title("Displacement, x to the right and y upwards on the marker")
        panels[-1].set_xlabel("time since the recording's first sample, s")
        panels[-1].margins(x=0.01)
    return figure


def figure_of_path_and_lines(chosen: Chosen, lines: Lines | None) -> Figure:
    """Return the path in the marker plane, and the amplitude at each frequency."""
    x = chosen.valid("x_mm")
    y = chosen.valid("y_mm")
    with styled():
        figure = new_figure(3.0)
        if lines is None:
            path: Any = figure.subplots()
        else:
            path, amplitude = figure.subplots(1, 2, width_ratios=[1, 1.45])
            amplitude.loglog(lines.frequency_hz[1:], lines.x_mm[1:], color=BLUE, label="x")
            amplitude.loglog(
                lines.frequency_hz[1:], lines.y_mm[1:], color=GREEN, label="y", linestyle="--"
            )
            if math.isfinite(lines.floor_mm):
                amplitude.axhline(
                    lines.floor_mm, color=GREY, linewidth=0.8, linestyle=":", label="noise, stated"
                )
            plain_numbers(amplitude.xaxis)
            amplitude.set_xlabel("frequency, Hz")
            amplitude.set_ylabel("amplitude, mm")
            amplitude.set_title("Amplitude spectrum")
            amplitude.legend(loc="upper right")
        if len(x) <= PATH_POINTS:
            path.plot(x, y, color=BLUE, linewidth=0.9)
        else:
            path.add_collection(_places(x, y))
            path.autoscale_view()
        path.plot(0, 0, marker="+", color=ORANGE, markersize=9, markeredgewidth=1.2)
        path.set_aspect("equal", adjustable="datalim")
        path.set_xlabel("x, mm")
        path.set_ylabel("y, mm")
        path.set_title("Path (+ the reference pose)")
    return figure


def _places(x: Floats, y: Floats) -> PolyCollection:
    """Return the cells of a fine grid in which samples lie, those side by side as one."""
    cell = max(float(np.ptp(x)), float(np.ptp(y))) / PLACES or 1e-6
    x0, y0 = float(x.min()), float(y.min())
    been = np.zeros((PLACES + 1, PLACES + 3), np.int8)
    been[((y - y0) / cell).astype(int), ((x - x0) / cell).astype(int) + 1] = 1
    rows, left = np.nonzero(np.diff(been) > 0)
    _, right = np.nonzero(np.diff(been) < 0)
    low, begin, end = y0 + rows * cell, x0 + left * cell, x0 + right * cell
    corners = np.array([[begin, low], [end, low], [end, low + cell], [begin, low + cell]])
    return PolyCollection(
        list(corners.transpose(2, 0, 1)), facecolors=BLUE, edgecolors=BLUE, linewidths=0.3
    )


def figure_of_quality(chosen: Chosen) -> Figure:
    """Return the stated standard deviations and the circles' misfit over time."""
    at_s, gaps = with_gaps(chosen.valid("time_s"))
    with styled():
        figure = new_figure(2.5)
        axes: Any = figure.subplots()
        for name, label, colour in (
            ("residual_mm", "misfit of the circles to a rigid marker, RMS", GREY),
            ("sigma_x_mm", "stated standard deviation of x", BLUE),
            ("sigma_y_mm", "of y", GREEN),
        ):
            values = 1000 * chosen.valid(name)
            if np.isfinite(values).any():
                curve(axes, at_s, np.insert(values, gaps, np.nan), colour, label, linewidth=0.7)
        axes.set_ylim(bottom=0)
        axes.set_ylabel("µm")
        axes.set_xlabel("time since the recording's first sample, s")
        axes.margins(x=0.01)
        axes.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=3, borderaxespad=0.1)
    return figure


def figure_of_set_up(picture: bytes | None, set_up: SetUp, pixel_aspect: float) -> Figure:
    """Return the picture of the set-up (or an empty frame of its size) with each circle's region,
    its centre at rest, and each marker's axes."""
    image = None
    if picture is not None:
        image = cv2.imdecode(np.frombuffer(picture, np.uint8), cv2.IMREAD_GRAYSCALE)
    width, height = set_up.width_px, set_up.height_px
    shape = height * pixel_aspect / width
    with styled():
        figure = new_figure(min(4.6, (WIDE_IN - 0.5) * shape) + 0.35)
        axes: Any = figure.subplots()
        axes.grid(visible=False)
        extent = (-0.5, width - 0.5, height - 0.5, -0.5)
        if image is not None:
            axes.imshow(image, cmap="gray", vmin=0, vmax=255, extent=extent, interpolation="none")
        axes.set_xlim(extent[:2])
        axes.set_ylim(extent[2:])
        axes.set_aspect(pixel_aspect)
        for marker in set_up.markers:
            for region in marker.regions:
                axes.add_patch(
                    Rectangle(
                        (region.x_px - 0.5, region.y_px - 0.5),
                        region.width_px,
                        region.height_px,
                        fill=False,
                        edgecolor=ORANGE,
                        linewidth=1.0,
                    )
                )
            centres = np.array(marker.reference_px)
            axes.plot(*centres.T, linestyle="", marker="+", color=ORANGE, markersize=6)
            _draw_axes(axes, np.array(marker.homography))
            axes.annotate(
                marker.shape.name,
                (float(centres[:, 0].mean()), min(r.y_px for r in marker.regions)),
                xytext=(0, 4),
                textcoords="offset points",
                color=ORANGE,
                ha="center",
                va="bottom",
                fontweight="bold",
                bbox={"facecolor": "white", "alpha": 0.85, "edgecolor": "none", "pad": 1.2},
            )
        axes.set_xlabel("column, px")
        axes.set_ylabel("row, px")
    return figure


def _draw_axes(axes: Any, homography: Floats) -> None:
    ends = np.array([[0.0, 0.0], [AXIS_MM, 0.0], [0.0, AXIS_MM]])
    (zero, *tips) = to_image_px(homography, ends)
    for tip, name in zip(tips, "xy", strict=True):
        axes.annotate(
            "",
            xy=tuple(tip),
            xytext=tuple(zero),
            arrowprops={"arrowstyle": "-|>", "color": "#37b24d", "linewidth": 1.4},
        )
        axes.annotate(
            name,
            tuple(tip),
            xytext=(4, 4),
            textcoords="offset points",
            color="#37b24d",
            fontweight="bold",
        )


def _stretches(time_s: Floats, on: Any) -> Sequence[tuple[float, float]]:
    """Return begin and end of each run of samples that are `on`; runs closer together than the plot
    can show are one."""
    edges = np.diff(np.concatenate([[0], on.view(np.int8), [0]]).astype(np.int8))
    begins_s = time_s[np.flatnonzero(edges > 0)]
    ends_s = time_s[np.minimum(np.flatnonzero(edges < 0), len(time_s) - 1)]
    apart = begins_s[1:] - ends_s[:-1] > (time_s[-1] - time_s[0]) / COLUMNS
    begins_s = begins_s[np.concatenate([[True], apart])] if len(begins_s) else begins_s
    ends_s = ends_s[np.concatenate([apart, [True]])] if len(ends_s) else ends_s
    return list(zip(begins_s.tolist(), ends_s.tolist(), strict=True))
