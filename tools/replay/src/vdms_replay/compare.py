"""`compare`: a recording beside a reference instrument, a laser vibrometer say."""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from vdms_replay.comparison import Comparison, add_reference_arguments, compare, positive
from vdms_replay.part import add_part_arguments
from vdms_replay.source import ReplayError
from vdms_replay.verb import Verbs, make_parser, number

LIKELY_GAIN = 0.7
"""A clock rate that takes the error below this part is worth a word."""
CASES_PLOT = "error-over-distance-and-angle.pdf"


def add_parser(verbs: Verbs) -> None:
    parser = make_parser(
        verbs,
        "compare",
        run,
        "put a recording beside a reference instrument",
        "Find where the reference's clock stands against the recording's, take the reference at "
        "the camera's times as the camera would see it (its mean over each exposure), and say how "
        "far the two agree. Several files, each with its own reference or all with one, also make "
        "a plot of the error over distance and angle.",
    )
    parser.add_argument("file", type=Path, nargs="+", metavar="FILE")
    add_part_arguments(parser)
    add_reference_arguments(parser, several=True)
    parser.add_argument(
        "--paper",
        action="store_true",
        help="also the paper's own way: both series at the union of their times, by linear "
        "interpolation",
    )
    parser.add_argument("--json", action="store_true", help="print JSON instead of the page")
    parser.add_argument(
        "--plot", type=Path, metavar="OUT", help="draw it: .pdf, .svg or .png; of several files "
        f"the error over distance and angle (default: {CASES_PLOT})",
    )  # fmt: skip
    parser.add_argument(
        "--distance-m", type=positive, nargs="+", metavar="M",
        help="of the camera in each file, where the recording does not say it",
    )  # fmt: skip
    parser.add_argument(
        "--angle-deg", type=number(-90, 90, "an angle of -90 to 90 degrees"), nargs="+",
        metavar="DEG", help="between line of sight and the marker's normal in each file",
    )  # fmt: skip


def run(arguments: argparse.Namespace) -> int:
    count = len(arguments.file)
    references = _for_each(arguments.reference, count, "--reference")
    distances = _for_each(arguments.distance_m or [math.nan], count, "--distance-m")
    angles = _for_each(arguments.angle_deg or [math.nan], count, "--angle-deg")
    found = [
        compare(path, reference, arguments, distance_m, angle_deg)
        for path, reference, distance_m, angle_deg in zip(
            arguments.file, references, distances, angles, strict=True
        )
    ]
    plot = arguments.plot or (Path(CASES_PLOT) if count > 1 else None)
    if plot is not None:
        _draw(found, plot)
    if arguments.json:
        plain = [as_json(one) for one in found]
        print(json.dumps(plain[0] if count == 1 else plain, indent=1, allow_nan=False))
    elif count == 1:
        print(page(found[0]))
    else:
        print(cases_page(found))
    if plot is not None and not arguments.json:
        print(f"\ndrawn into {plot}")
    return 0


def rows(one: Comparison) -> list[tuple[str, str]]:
    """Return the figures of a comparison, (name, figure with its unit) each."""
    a, g = one.alignment, one.agreement
    found = [
        ("offset", f"the reference shows {a.offset_s:.6f} s at the recording's zero, "
                   + (f"+- {1e6 * a.sigma_offset_s:.1f} us" if a.sigma_offset_s else "as given")),
        ("clock rate", f"the reference runs {1e6 * a.rate:+.2f} +- {1e6 * a.sigma_rate:.2f} ppm "
                       "against the recording" if one.wanted.clock_rate else "taken as equal"),
        ("axis", f"{a.axis_deg:.3f} deg from x towards y"
                 + (", the reference counts the other way" if a.sign < 0 else "")),
        ("camera", _exposed(one)),
        ("compared", f"{g.samples} of {len(one.camera.time_s)} valid samples, {g.seconds:.2f} s"),
        ("Eq. 3.1", f"{g.error_percent:.4f} %: std(reference - camera) / std(reference)"),
    ]  # fmt: skip
    if one.paper_error_percent is not None:
        found.append(
            ("the paper's way", f"{one.paper_error_percent:.4f} %: both on the union of their "
                                "times by linear interpolation")
        )  # fmt: skip
    found += [
        ("RMS difference", f"{1000 * g.rmse_mm:.2f} um"),
        ("largest difference", f"{1000 * g.worst_mm:+.2f} um at {g.worst_at_s:.3f} s"),
        ("peak to peak", f"{g.peak_to_peak_mm:.4f} mm by the reference, "
                         f"{1000 * g.peak_to_peak_error_mm:+.2f} um by the camera"),
        ("gain", f"{g.gain:.6f} +- {g.sigma_gain:.6f} (camera over reference)"),
        ("drift", f"{1000 * g.drift_mm_per_min:+.2f} +- "
                  f"{1000 * g.sigma_drift_mm_per_min:.2f} um/min"),
        ("zeros", f"differ by {g.zero_mm:+.4f} mm, taken off above"),
    ]  # fmt: skip
    return found


def hints(one: Comparison) -> list[str]:
    """Return what a person should know of the fit, a sentence each."""
    a = one.alignment
    told = []
    if not math.isnan(a.other_offset_s):
        told.append(
            f"the offset {a.other_offset_s:.3f} s fits almost as well (its error is "
            f"{a.other_residual / a.residual:.2f} times as large): the motion repeats; say where "
            "the offset is with --offset"
        )
    if a.gain_of_rate < LIKELY_GAIN:
        told.append(
            f"clocks that differ by {1e6 * a.rate_if_found:+.1f} ppm would take the error to "
            f"{100 * a.gain_of_rate:.0f} % of that: --find-clock-rate"
        )
    if a.mirrored:
        told.append("the two move against each other: --find-sign")
    if one.chosen.left_out:
        told.append(
            f"{one.chosen.left_out} samples against another reference picture are left out: their "
            "zero is another"
        )
    if one.spectrum is None:
        told.append("too few samples for frequencies, or too many are missing")
    elif one.spectrum.filled:
        told.append(f"{one.spectrum.filled} missing samples are interpolated for the frequencies")
    return told


def page(one: Comparison) -> str:
    """Return the page for a person."""
    ref = one.reference
    lines = [
        f"{one.path.name}, marker {one.chosen.marker}",
        f"beside {ref.path.name}, column {ref.column} in {ref.unit}, "
        f"{len(ref.series)} values at {ref.series.rate_hz:.6g} Hz",
        "",
        *(f"  {name:<19}{text}" for name, text in rows(one)),
    ]
    if one.spectrum is not None and one.spectrum.lines:
        lines += [
            "",
            "  amplitudes are means over all that was compared",
            f"  {'Hz':>9} {'amplitude mm':>13} {'error %':>9} {'phase deg':>10} {'late ms':>9} "
            f"{'coherence':>10}",
        ]
        lines += [
            f"  {f.frequency_hz:9.3f} {f.reference_mm:13.4f} {100 * (f.gain - 1):+9.4f} "
            f"{f.phase_deg:+10.4f} {f.delay_ms:+9.4f} {f.coherence:10.6f}"
            for f in one.spectrum.lines
        ]
    told = hints(one)
    if told:
        lines += ["", *(f"  note: {sentence}" for sentence in told)]
    return "\n".join(lines)


def cases_page(found: Sequence[Comparison]) -> str:
    """Return a line for each of several recordings."""
    paper = any(one.paper_error_percent is not None for one in found)
    wide = max(len(one.path.name) for one in found)
    lines = [
        f"{'recording':<{wide}} {'m':>7} {'deg':>6} {'Eq. 3.1 %':>10}"
        + (f" {'paper %':>9}" if paper else "")
        + f" {'RMS um':>9} {'offset s':>14} {'ppm':>8} {'samples':>8}"
    ]
    for one in found:
        g, a = one.agreement, one.alignment
        lines.append(
            f"{one.path.name:<{wide}} {one.distance_m:7.2f} {one.angle_deg:6.1f} "
            f"{g.error_percent:10.4f}"
            + (f" {one.paper_error_percent:9.4f}" if paper else "")
            + f" {1000 * g.rmse_mm:9.2f} {a.offset_s:14.6f} {1e6 * a.rate:8.2f} {g.samples:8d}"
        )
    for one in found:
        lines += [f"note: {one.path.name}: {sentence}" for sentence in hints(one)]
    return "\n".join(lines)


def as_json(one: Comparison) -> dict[str, Any]:
    """Return the figures as plain values that JSON can hold; units are in the names."""
    a, g, ref = one.alignment, one.agreement, one.reference
    lines = one.spectrum.lines if one.spectrum is not None else ()
    plain = {
        "file": str(one.path),
        "marker": one.chosen.marker,
        "distance_m": one.distance_m,
        "angle_deg": one.angle_deg,
        "reference": str(ref.path),
        "column": ref.column,
        "unit": ref.unit,
        "reference_rate_hz": ref.series.rate_hz,
        "offset_s": a.offset_s,
        "sigma_offset_s": a.sigma_offset_s,
        "clock_rate_ppm": 1e6 * a.rate,
        "sigma_clock_rate_ppm": 1e6 * a.sigma_rate,
        "sign": a.sign,
        "axis_deg": a.axis_deg,
        "other_offset_s": a.other_offset_s,
        "exposure_ms": 1000 * one.camera.exposure_s,
        "sampling": one.chosen.exposed,
        "samples": g.samples,
        "seconds": g.seconds,
        "error_percent": g.error_percent,
        "paper_error_percent": one.paper_error_percent,
        "rms_difference_mm": g.rmse_mm,
        "largest_difference_mm": g.worst_mm,
        "largest_difference_at_s": g.worst_at_s,
        "peak_to_peak_mm": g.peak_to_peak_mm,
        "peak_to_peak_error_mm": g.peak_to_peak_error_mm,
        "gain": g.gain,
        "sigma_gain": g.sigma_gain,
        "drift_mm_per_min": g.drift_mm_per_min,
        "sigma_drift_mm_per_min": g.sigma_drift_mm_per_min,
        "zero_difference_mm": g.zero_mm,
        "frequencies": [
            {
                "frequency_hz": f.frequency_hz,
                "reference_mm": f.reference_mm,
                "amplitude_error_percent": 100 * (f.gain - 1),
                "phase_error_deg": f.phase_deg,
                "delay_ms": f.delay_ms,
                "coherence": f.coherence,
            }
            for f in lines
        ],
        "notes": hints(one),
    }
    return {
        name: None if isinstance(value, float) and not math.isfinite(value) else value
        for name, value in plain.items()
    }


def _exposed(one: Comparison) -> str:
    seen = {
        "field": "each field by itself",
        "frame": "whole interlaced frames: the reference is the mean over both fields",
        "progressive": "whole frames",
    }[one.chosen.exposed]
    exposure_ms = 1000 * one.camera.exposure_s
    light = f"exposure {exposure_ms:.3g} ms" if exposure_ms else "exposure negligible"
    return f"{seen}, {light}"


def _draw(found: Sequence[Comparison], path: Path) -> None:
    from vdms_replay.figures import figure_of_cases, figure_of_comparison, save_figure

    if len(found) == 1:
        (one,) = found
        save_figure(figure_of_comparison(one), path)
        return
    cases = [one for one in found if math.isfinite(one.distance_m) and math.isfinite(one.angle_deg)]
    if len(cases) < len(found):
        missing = next(one for one in found if one not in cases)
        raise ReplayError(
            f"{missing.path}: does not say the camera's distance and angle; give them, one for "
            "each file, with --distance-m and --angle-deg"
        )
    save_figure(figure_of_cases(cases), path)


def _for_each(values: list[Any], count: int, option: str) -> list[Any]:
    if len(values) == 1:
        return values * count
    if len(values) != count:
        raise ReplayError(
            f"{option}: {len(values)} given for {count} files; give one, or one for each file in "
            "their order"
        )
    return values
