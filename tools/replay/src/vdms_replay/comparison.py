"""One recording beside one reference: what is read, put together, and found."""

from __future__ import annotations

import argparse
import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from vdms_replay.part import Part, read_part, seconds
from vdms_replay.source import ReplayError
from vdms_replay.verb import number, progress

if TYPE_CHECKING:
    from vdms_replay.agreement import Agreement, Spectrum
    from vdms_replay.align import Alignment, Camera, Wanted
    from vdms_replay.chosen import Chosen
    from vdms_replay.load import Recording
    from vdms_replay.reference import Reference

UNITS = ("m", "cm", "mm", "um", "nm", "in", "mil")


@dataclass(frozen=True, slots=True)
class Comparison:
    """One recording beside its reference."""

    path: Path
    reference: Reference
    chosen: Chosen
    camera: Camera
    wanted: Wanted
    alignment: Alignment
    agreement: Agreement
    spectrum: Spectrum | None
    paper_error_percent: float | None
    distance_m: float
    """NaN where nobody says it."""
    angle_deg: float


def add_reference_arguments(parser: argparse.ArgumentParser, *, several: bool) -> None:
    """Add what tells of a reference and how it is put to a recording."""
    group = parser.add_argument_group("the reference")
    group.add_argument(
        "--reference",
        type=Path,
        nargs="+" if several else None,
        required=several,
        metavar="REF",
        help="the instrument's file: .csv, .txt, .mat, .uff or .unv (58), .tdms",
    )
    group.add_argument("--column", metavar="NAME", help="the series, where there are several")
    group.add_argument(
        "--units", choices=UNITS, help="of the series, where the file does not say it"
    )
    group.add_argument(
        "--rate", type=positive, metavar="HZ",
        help="sampling rate, where the file has no times, or times of few digits",
    )  # fmt: skip
    group = parser.add_argument_group("putting both together")
    group.add_argument(
        "--offset", type=number(-1e12, 1e12, "a number of seconds"), metavar="S",
        help="what the reference's clock shows at the recording's zero, about",
    )  # fmt: skip
    group.add_argument(
        "--within", type=seconds, default=0.5, metavar="S",
        help="how far from --offset to look (default: 0.5; 0 takes it as it is)",
    )  # fmt: skip
    group.add_argument(
        "--find-clock-rate", action="store_true", help="the two clocks run differently fast"
    )
    group.add_argument(
        "--find-sign", action="store_true", help="the reference may count the other way"
    )
    group.add_argument(
        "--find-axis", action="store_true", help="find the reference's axis in the marker plane"
    )
    group.add_argument(
        "--axis-deg", type=number(-180, 180, "an angle of -180 to 180 degrees"), default=0.0,
        metavar="DEG", help="the reference's axis, from x towards y (default: 0, x; 90: y)",
    )  # fmt: skip
    group.add_argument(
        "--exposure-ms", type=number(0, 1000, "milliseconds, 0 to 1000"), metavar="MS",
        help="of the camera, where the recorded configuration is wrong",
    )  # fmt: skip


def compare(
    path: Path,
    reference: Path,
    arguments: argparse.Namespace,
    distance_m: float = math.nan,
    angle_deg: float = math.nan,
) -> Comparison:
    """Return a recording beside a reference file. Raises ReplayError with a sentence."""
    from vdms_replay.chosen import NEEDED

    part = Part(NEEDED, arguments.marker, arguments.from_s, arguments.to_s)
    with progress(f"reading {path.name}", path.stat().st_size if path.is_file() else 0) as advance:
        recording = read_part(path, part=part, advance=advance)
    return compared(recording, reference, arguments, distance_m, angle_deg)


def compared(
    recording: Recording,
    reference: Path,
    arguments: argparse.Namespace,
    distance_m: float = math.nan,
    angle_deg: float = math.nan,
) -> Comparison:
    """Return a recording that was read beside a reference file, as the arguments of
    `add_reference_arguments` want it. Raises ReplayError with a sentence."""
    from vdms_replay.agreement import agreement, paper_error_percent, spectrum
    from vdms_replay.align import AlignError, Wanted, align
    from vdms_replay.chosen import camera_of, choose
    from vdms_replay.reference import read_reference

    ref = read_reference(reference, arguments.column, arguments.units, arguments.rate)
    chosen = choose(recording, arguments.marker, arguments.from_s, arguments.to_s)
    exposure_s = None if arguments.exposure_ms is None else arguments.exposure_ms / 1000
    camera = camera_of(recording, chosen, exposure_s)
    wanted = Wanted(
        clock_rate=arguments.find_clock_rate,
        sign=arguments.find_sign,
        axis=arguments.find_axis,
        axis_deg=arguments.axis_deg,
        offset_s=arguments.offset,
        within_s=arguments.within,
    )
    (path, *_) = recording.paths
    try:
        alignment = align(camera, ref.series, wanted)
    except AlignError as error:
        raise ReplayError(f"{path} and {reference}: {error}") from None
    found = agreement(camera, ref.series, alignment)
    table = recording.about.config.get("table", {})
    virtual = recording.about.config.get("source") == "table"
    if math.isnan(distance_m) and virtual:
        distance_m = float(table.get("distance_m", math.nan))
    if math.isnan(angle_deg) and virtual:
        angle_deg = float(table.get("angle_deg", math.nan))
    return Comparison(
        path=path,
        reference=ref,
        chosen=chosen,
        camera=camera,
        wanted=wanted,
        alignment=alignment,
        agreement=found,
        spectrum=spectrum(camera, ref.series, alignment, found),
        paper_error_percent=(
            paper_error_percent(camera, ref.series, alignment)
            if getattr(arguments, "paper", False)
            else None
        ),
        distance_m=distance_m,
        angle_deg=angle_deg,
    )


positive = number(1e-9, 1e9, "a number above 0")
