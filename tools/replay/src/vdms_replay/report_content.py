"""What a report says: a list of blocks, which the PDF and the HTML page lay out each in its way."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from matplotlib.figure import Figure

import vdms_replay
from vdms_replay import compare
from vdms_replay.chosen import NEEDED as CHOOSING
from vdms_replay.chosen import Chosen, exposure_of
from vdms_replay.figures import figure_of_comparison
from vdms_replay.load import Recording, iso
from vdms_replay.report_figures import (
    Lines,
    figure_of_history,
    figure_of_path_and_lines,
    figure_of_quality,
    figure_of_set_up,
    lines_of,
    rms,
)
from vdms_replay.summary import MarkerSummary
from vdms_rt.wire import vdms_pb2 as pb

if TYPE_CHECKING:
    from vdms_replay.comparison import Comparison

NEEDED = (
    *CHOOSING, "rotation_mrad", "sigma_x_mm", "sigma_y_mm", "residual_mm", "seq", "sigma_t_ns",
)  # fmt: skip
"""Columns of the samples."""
GAPS_TOLD = 15
EVENTS_TOLD = 25
QUIET = 5.0
"""Times the stated standard deviation: a marker that scatters by more does not rest."""
METHODS = {
    "smooth": "smooth-weight centroids, homography, rigid motion of the circles",
    "otsu": "Lee, Cho and Sim (2015): Otsu centroids, homography",
}


@dataclass(frozen=True, slots=True)
class Heading:
    text: str


@dataclass(frozen=True, slots=True)
class Words:
    text: str


@dataclass(frozen=True, slots=True)
class Facts:
    """Names and what stands beside them."""

    rows: Sequence[tuple[str, str]]


@dataclass(frozen=True, slots=True)
class Table:
    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    """Cells; every column but the first holds numbers."""


@dataclass(frozen=True, slots=True)
class Lettering:
    """Lines of a fixed pitch."""

    text: str


@dataclass(frozen=True, slots=True)
class Drawing:
    figure: Figure
    caption: str


Block: TypeAlias = Heading | Words | Facts | Table | Lettering | Drawing


@dataclass(frozen=True, slots=True)
class Report:
    title: str
    subtitle: str
    blocks: Sequence[Block]


def report_of(
    recording: Recording,
    chosen: Chosen,
    comparison: Comparison | None,
    title: str = "",
    note: str = "",
) -> Report:
    """Return what there is to say of one marker in a recording."""
    summary = MarkerSummary(chosen.marker)
    summary.take(chosen.table)
    lines = lines_of(chosen)
    about = recording.about
    blocks: list[Block] = []
    if note:
        blocks.append(Words(note))
    blocks.append(Facts(_heads(recording, chosen, summary)))
    if chosen.left_out:
        blocks.append(
            Words(
                f"{chosen.left_out} valid samples were taken against another reference; their zero "
                "is another, and they are left out of everything below."
            )
        )
    blocks += [
        Table(("", "largest", "at s", "smallest", "at s", "peak to peak", "mean", "RMS about it"),
              _peaks(summary)),
        *_picture(recording, chosen),
        Heading("Time history"),
        Drawing(
            figure_of_history(chosen),
            "Shaded: samples without a position. An empty stretch: no sample at all.",
        ),
        Heading("Path and frequencies"),
        Drawing(figure_of_path_and_lines(chosen, lines), _about_lines(lines)),
    ]  # fmt: skip
    if lines is not None and (peaks := lines.peaks()):
        rows = [(f"{f:.3f} Hz", f"{x:.4f}", f"{y:.4f}") for f, x, y in peaks]
        blocks.append(Table(("frequency", "x, mm", "y, mm"), rows))
    if comparison is not None:
        blocks += _comparison(comparison)
    blocks += [
        Heading("Quality and uncertainty"),
        Drawing(figure_of_quality(chosen), ""),
        Facts(_quality(recording, chosen, summary)),
        Words(UNCERTAINTY),
        *_gaps(summary),
        *_set_up_text(recording, chosen),
        *_happened(recording),
    ]
    begin = _time(chosen.first["utc_ns"])
    subtitle = f"Station {about.station}, marker {chosen.marker}" + (f", {begin}" if begin else "")
    return Report(title or "Displacement measurement", subtitle, blocks)


UNCERTAINTY = (
    "The stated standard deviations (k = 1) follow from the noise of the picture, the errors of "
    "the reference and, through the velocity, the error of each sample's time. Not in them: the "
    "scale of the printed marker, an angle between the marker's plane and the direction of motion, "
    "what the lens bends beyond its configuration, and a constant delay of the camera."
)


def _heads(recording: Recording, chosen: Chosen, summary: MarkerSummary) -> list[tuple[str, str]]:
    about = recording.about
    begin, end = _time(chosen.first["utc_ns"]), _time(chosen.last["utc_ns"])
    seconds = summary.last_s - summary.first_s
    exposed = {
        "field": "each field by itself",
        "frame": "whole interlaced frames",
        "progressive": "whole frames",
    }[chosen.exposed]
    exposure_ms = 1000 * exposure_of(about.config)
    light = f"exposure {exposure_ms:.3g} ms" if exposure_ms else "exposure negligible"
    method = about.config.get("process", {}).get("method", "")
    rows = [
        ("Recording", ", ".join(path.name for path in recording.paths)),
        ("Measured", f"{begin} to {end}" if begin else "at a time that is not known"),
        ("Length", f"{seconds:.2f} s, {summary.valid} valid samples of {summary.samples}"),
        ("Sampling", f"{exposed}, {summary.rate_hz:.3f} Hz, {light}"),
        ("Camera", next((f.value for f in about.run.facts if f.name == "source"), "not known")),
        ("Method", METHODS.get(method, method)),
    ]  # fmt: skip
    if chosen.own is not None:
        shape = chosen.own.shape
        rows.append(
            (
                "Marker",
                f"{len(shape.circles_mm)} circles of {shape.diameter_mm:g} mm, "
                + ("white on black" if shape.white_on_black else "black on white"),
            )
        )
    rows.append(("Recorded by", f"vdms-rt {about.run.version}"))
    ends = "; ".join(dict.fromkeys(end.reason for end in about.ends))
    rows.append(("Ended", ends or "without an end: cut off"))
    rows += [(f.name.capitalize(), f.value) for f in about.run.facts if "again" in f.name]
    return rows


def _peaks(summary: MarkerSummary) -> list[tuple[str, ...]]:
    rows: list[tuple[str, ...]] = []
    for name, label in (("x_mm", "x, mm"), ("y_mm", "y, mm"), ("rotation_mrad", "rotation, mrad")):
        axis = summary.axes[name]
        rows.append(
            (
                label,
                f"{axis.highest:+.4f}",
                f"{axis.highest_s:.3f}",
                f"{axis.lowest:+.4f}",
                f"{axis.lowest_s:.3f}",
                f"{axis.highest - axis.lowest:.4f}",
                f"{axis.mean:+.4f}",
                f"{axis.deviation:.4f}",
            )
        )
    return rows


def _about_lines(lines: Lines | None) -> str:
    if lines is None:
        return "Too few samples for a spectrum, or too many are missing."
    text = (
        f"Spectrum: mean over Hann windows, resolution {lines.resolution_hz:.3g} Hz; the height of "
        "a peak is the amplitude of a steady sine; one that does not last all the time shows less."
    )
    if lines.filled:
        text += f" {lines.filled} missing samples were interpolated for it."
    return text


def _quality(recording: Recording, chosen: Chosen, summary: MarkerSummary) -> list[tuple[str, str]]:
    health = recording.health
    residual_mm = rms(chosen.valid("residual_mm"))
    time_us = rms(chosen.valid("sigma_t_ns").astype(np.float64)) / 1000
    part = 100 * summary.valid / summary.samples
    rows = [
        ("Valid", f"{summary.valid} of {summary.samples} samples, {part:.2f} %"),
        *_counted("Without a position", summary.invalid),
        *_counted("Valid with a reservation", summary.flagged),
        ("Missing", _missing(summary)),
    ]
    if math.isfinite(summary.sigma_x_mm):
        rows.append(
            (
                "Standard deviation, stated",
                f"x {1000 * summary.sigma_x_mm:.2f} µm, y {1000 * summary.sigma_y_mm:.2f} µm "
                "(RMS over the recording)",
            )
        )
    if summary.quiet.x_mm < QUIET * summary.sigma_x_mm:
        rows.append(
            (
                "Scatter at rest",
                f"x {1000 * summary.quiet.x_mm:.2f} µm, y {1000 * summary.quiet.y_mm:.2f} µm "
                f"in the second from {summary.quiet.time_s:.2f} s on",
            )
        )
    if math.isfinite(residual_mm):
        rows.append(("Misfit of the circles", f"{1000 * residual_mm:.2f} µm RMS"))
    rows += [
        ("Standard deviation of time", f"{time_us:.1f} µs RMS, a constant delay aside"),
    ]
    if len(health):
        last = health.iloc[-1]
        rows.append(
            (
                "Frame clock",
                f"stamps scatter by {last['clock_jitter_us']:.1f} µs, frames come "
                f"{last['clock_rate_ppm']:+.1f} ppm fast; UTC {last['utc_state']}",
            )
        )
        lost = {name: int(last[name]) for name in ("missed", "damaged", "overwritten")}
        rows.append(
            ("Frames", f"{int(last['captured'])} captured, "
                       + ", ".join(f"{count} {name}" for name, count in lost.items()))
        )  # fmt: skip
    rows += [("Not readable", text) for one in recording.damage for text in one.sentences()]
    return rows


def _missing(summary: MarkerSummary) -> str:
    if not summary.gap_count:
        return "none"
    return f"{summary.lost} samples in {summary.gap_count} gap{'s' * (summary.gap_count > 1)}"


def _counted(name: str, counts: dict[str, int]) -> list[tuple[str, str]]:
    if not counts:
        return []
    told = sorted(counts.items(), key=lambda item: -item[1])
    return [(name, ", ".join(f"{count} {reason}" for reason, count in told))]


def _gaps(summary: MarkerSummary) -> list[Block]:
    if not summary.gap_count:
        return []
    longest = sorted(summary.gaps, key=lambda gap: -gap.count)[:GAPS_TOLD]
    rows = [
        (f"{gap.time_s:.3f} s", f"{gap.count}", f"{gap.seconds:.3f}")
        for gap in sorted(longest, key=lambda gap: gap.time_s)
    ]
    left = summary.gap_count - len(rows)
    blocks: list[Block] = [Heading("Gaps"), Table(("after", "samples missing", "s"), rows)]
    if left:
        blocks.append(Words(f"The longest {len(rows)}; {left} more are shorter."))
    return blocks


def _comparison(one: Comparison) -> list[Block]:
    ref = one.reference
    blocks: list[Block] = [
        Heading("Comparison with the reference"),
        Words(
            f"{ref.path.name}, column {ref.column} in {ref.unit}, {ref.series.rate_hz:.6g} Hz. The "
            "reference is taken at the camera's times, as its mean over each exposure."
        ),
        Drawing(
            figure_of_comparison(one),
            "Amplitudes in the table of frequencies are means over all that was compared; a motion "
            "that does not last all the time shows less.",
        ),
        Facts([(name[:1].upper() + name[1:], _in_print(text)) for name, text in compare.rows(one)]),
    ]
    if one.spectrum is not None and one.spectrum.lines:
        blocks.append(
            Table(
                (
                    "frequency",
                    "amplitude, mm",
                    "error, %",
                    "phase error, °",
                    "late, ms",
                    "coherence",
                ),
                [
                    (
                        f"{f.frequency_hz:.3f} Hz",
                        f"{f.reference_mm:.4f}",
                        f"{100 * (f.gain - 1):+.4f}",
                        f"{f.phase_deg:+.4f}",
                        f"{f.delay_ms:+.4f}",
                        f"{f.coherence:.6f}",
                    )
                    for f in one.spectrum.lines
                ],
            )
        )
    blocks += [Words(f"Note: {sentence}.") for sentence in compare.hints(one)]
    return blocks


def _in_print(text: str) -> str:
    """Return a terminal's text with the signs that print has."""
    for plain, sign in (("+-", "±"), (" um", " µm"), (" us", " µs")):
        text = text.replace(plain, sign)
    return text


def _picture(recording: Recording, chosen: Chosen) -> list[Block]:
    set_up = chosen.set_up
    if set_up is None:
        return [Words("The recording holds no set-up that can be read.")]
    picture = recording.about.attachments.get("reference.png")
    aspect = float(recording.about.config.get("lens", {}).get("pixel_aspect", 1.0))
    caption = "Regions (boxes), centres at rest (+) and the marker's axes."
    if picture is None:
        caption += " The recording holds no picture of the set-up."
    return [Drawing(figure_of_set_up(picture, set_up, aspect), caption)]


def _set_up_text(recording: Recording, chosen: Chosen) -> list[Block]:
    last = chosen.last
    said = recording.about.set_ups.get((last["session"], int(last["setup_revision"])))
    return [] if said is None else [Heading("Set-up"), Lettering(said.report)]


def _happened(recording: Recording) -> list[Block]:
    events = [e for e in recording.about.events if e.severity != pb.Event.INFO]
    if not events:
        return [Heading("Events"), Words("No warning and no error.")]
    alike: dict[str, list[pb.Event]] = {}
    for event in events:
        alike.setdefault(event.code, []).append(event)
    rows = []
    for same in list(alike.values())[:EVENTS_TOLD]:
        text = same[0].text
        if len(same) > 1:
            text += f" (and {len(same) - 1} more of the kind, the last at {_time(same[-1].utc_ns)})"
        rows.append((_time(same[0].utc_ns) or "at a time not known", text))
    return [Heading("Warnings and errors"), Facts(rows)]


def _time(utc_ns: int) -> str:
    """Return a UTC time to the millisecond, or nothing where it is not known."""
    return iso(int(utc_ns))[:23].replace("T", " ") + " UTC" if utc_ns else ""


def made() -> str:
    """Return who made a report, and when."""
    now = datetime.now(UTC)
    return f"vdms-replay {vdms_replay.__version__}, {now:%Y-%m-%d %H:%M} UTC"
