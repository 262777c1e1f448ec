"""`vdms-replay derive`: evenly spaced, filtered, velocity and acceleration, modes."""

from __future__ import annotations

import argparse
import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import pandas as pd

from vdms_replay.columns import MEANINGS, UNITS, utc_column
from vdms_replay.export import add_output_options, si_name, si_unit, target_path, to_si, writing
from vdms_replay.formats import FORMATS
from vdms_replay.load import Recording, chosen_rows, iso
from vdms_replay.part import Part, add_part_arguments, read_part
from vdms_replay.source import ReplayError
from vdms_replay.verb import Verbs, make_parser, number, progress

if TYPE_CHECKING:
    from vdms_replay.signals import Stretch

Floats: TypeAlias = np.ndarray[Any, np.dtype[np.float64]]

AXES = ("x_mm", "y_mm", "rotation_mrad")
DERIVATIVES = (("velocity", 1, "per_s"), ("acceleration", 2, "per_s2"))
NEEDED = ("time_s", "utc_ns", "marker", "valid", *AXES, "sigma_x_mm")
GAP_PERIODS = 2.5
MODES_TOLD = 12


@dataclass(frozen=True, slots=True)
class Recipe:
    """What is made of the displacements, in this order."""

    rate_hz: float | None = None
    """None: the recording's own."""
    max_gap_s: float | None = None
    """Bridged by the spline; None: two and a half pictures, so that one lost picture is."""
    detrend: str = "none"
    low_hz: float | None = None
    high_hz: float | None = None
    order: int = 4
    velocity: bool = False
    acceleration: bool = False
    window: int = 11
    degree: int = 6


def add_parser(verbs: Verbs) -> None:
    parser = make_parser(
        verbs,
        "derive",
        run,
        "evenly spaced, filtered, velocity, acceleration, modes",
        "The valid samples are put on even steps by cubic splines, then detrended, filtered "
        "(Butterworth, forwards and backwards), and derived (Savitzky-Golay), in this order. Gaps "
        "stay gaps. Everything that was done is said and stands in the file.",
    )
    parser.add_argument("files", nargs="+", type=Path, metavar="FILE")
    parser.add_argument("--to", choices=tuple(FORMATS), help="write the result in this format")
    add_part_arguments(parser)
    positive = number(1e-6, 1e6, "a number above 0")
    parser.add_argument(
        "--resample", type=positive, metavar="HZ", help="(default: the recording's own rate)"
    )
    parser.add_argument(
        "--max-gap",
        type=positive,
        metavar="S",
        help=f"bridge gaps up to so long (default: {GAP_PERIODS:g} pictures)",
    )
    parser.add_argument(
        "--detrend", choices=("none", "mean", "line"), default="none", help="of each stretch"
    )
    parser.add_argument(
        "--high-pass", type=positive, metavar="HZ", help="lower edge of the band (-6 dB)"
    )
    parser.add_argument(
        "--low-pass", type=positive, metavar="HZ", help="upper edge of the band (-6 dB)"
    )
    parser.add_argument(
        "--order", type=int, choices=range(1, 11), default=4, metavar="N", help="1 to 10 (4)"
    )
    parser.add_argument("--velocity", action="store_true")
    parser.add_argument("--acceleration", action="store_true")
    parser.add_argument(
        "--window", type=int, default=11, metavar="N", help="samples of a derivative, odd (11)"
    )
    parser.add_argument("--degree", type=int, default=6, metavar="N", help="of the polynomial (6)")
    parser.add_argument(
        "--modes", action="store_true", help="list the spectrum's peaks with their damping"
    )
    parser.add_argument(
        "--resolution", type=positive, metavar="HZ", help="of the spectrum for --modes"
    )
    parser.add_argument(
        "--least-db",
        type=number(1, 200, "1 to 200 dB"),
        default=12.0,
        metavar="DB",
        help="least height of a peak (12)",
    )
    parser.add_argument(
        "--si", action="store_true", help="metres and radians instead of mm and mrad"
    )
    add_output_options(parser)


def run(arguments: argparse.Namespace) -> int:
    if arguments.to is None and not arguments.modes:
        raise ReplayError("nothing to do: give --to FORMAT, or --modes, or both")
    recipe = Recipe(
        rate_hz=arguments.resample,
        max_gap_s=arguments.max_gap,
        detrend=arguments.detrend,
        low_hz=arguments.high_pass,
        high_hz=arguments.low_pass,
        order=arguments.order,
        velocity=arguments.velocity,
        acceleration=arguments.acceleration,
        window=arguments.window,
        degree=arguments.degree,
    )
    with progress("reading", sum(_size(path) for path in arguments.files)) as advance:
        part = Part(NEEDED, arguments.marker, arguments.from_s, arguments.to_s)
        recording = read_part(*arguments.files, part=part, advance=advance)
    table = derive(recording, recipe, arguments.marker, arguments.from_s, arguments.to_s)
    if arguments.modes:
        print(modes_text(table, arguments.resolution, arguments.least_db))
    if arguments.to is not None:
        for sentence in _write(recording, table, arguments):
            print(sentence)
    for sentence in table.attrs["derived"]:
        print(sentence)
    return 0


def _size(path: Path) -> int:
    return path.stat().st_size if path.exists() else 0


def derive(
    recording: Recording,
    recipe: Recipe,
    marker: str | None = None,
    from_s: float = -math.inf,
    to_s: float = math.inf,
) -> pd.DataFrame:
    """Return one marker's series between two times on even steps, filtered and derived as `recipe`
    says.

    Of the samples it needs the columns `NEEDED`. Out come `time_s`, `utc`, `utc_ns`, `marker`,
    `valid` (True), `x_mm`, `y_mm`, `rotation_mrad`, and on request `x_velocity_mm_per_s`,
    `x_acceleration_mm_per_s2` and so on. A gap has no rows.
    `.attrs["derived"]` says in sentences what was done. Raises ReplayError.
    """
    from vdms_replay import signals

    _check(recipe)
    whole = recording.of_marker(marker, from_s, to_s)
    samples = chosen_rows(whole, whole["valid"].to_numpy(bool))
    del whole
    if len(samples) < signals.LEAST:
        raise ReplayError(
            f"the marker has {len(samples)} valid samples, and {signals.LEAST} are the least"
        )
    time_s = samples["time_s"].to_numpy()
    own_hz = signals.own_rate_hz(time_s)
    rate_hz = recipe.rate_hz or own_hz
    max_gap_s = recipe.max_gap_s or GAP_PERIODS / own_hz
    told = []
    try:
        stretches = signals.evenly(time_s, samples[list(AXES)].to_numpy(), rate_hz, max_gap_s)
        told.append(_evenly_text(time_s, own_hz, rate_hz, max_gap_s, len(stretches)))
        if recipe.detrend != "none":
            stretches = [signals.detrended(one, recipe.detrend) for one in stretches]
            told.append(f"less the {recipe.detrend} of each stretch")
        if recipe.low_hz is not None or recipe.high_hz is not None:
            stretches = signals.filtered_each(
                stretches, recipe.low_hz, recipe.high_hz, recipe.order
            )
            told.append(_filter_text(recipe))
        if lost := _left_out(time_s, stretches):
            told.append(
                f"{lost} of {len(time_s)} samples lie in stretches too short for this, and are "
                "left out; --max-gap closes gaps"
            )
    except signals.SignalError as error:
        raise ReplayError(f"{error}") from None
    columns = {"time_s": np.concatenate([one.times_s() for one in stretches])}
    values = np.concatenate([one.values for one in stretches])
    columns |= {name: values[:, n] for n, name in enumerate(AXES)}
    for kind, times, per in DERIVATIVES:
        if getattr(recipe, kind):
            found = np.concatenate(
                [signals.derived(one, times, recipe.window, recipe.degree) for one in stretches]
            )
            for n, name in enumerate(AXES):
                quantity, unit = name.split("_")
                columns[f"{quantity}_{kind}_{unit}_{per}"] = found[:, n]
            told.append(_derivative_text(kind, times, per, recipe, samples, 1 / rate_hz))
    table = _with_times(pd.DataFrame(columns), samples)
    table.attrs.update(recording.meta)
    table.attrs["derived"] = told
    table.attrs["rate_hz"] = rate_hz
    return table


def _left_out(time_s: Floats, stretches: list[Stretch]) -> int:
    """Return how many of the samples lie in none of the stretches."""
    inside = np.zeros(len(time_s), np.bool_)
    for one in stretches:
        end_s = one.start_s + len(one.values) * one.step_s
        inside |= (time_s > one.start_s - one.step_s) & (time_s < end_s)
    return int((~inside).sum())


def _check(recipe: Recipe) -> None:
    if recipe.window % 2 == 0 or not recipe.degree < recipe.window <= 10001:
        raise ReplayError("--window must be odd and greater than --degree")
    if recipe.degree < 2:
        raise ReplayError("--degree must be 2 or more")


def _with_times(table: pd.DataFrame, samples: pd.DataFrame) -> pd.DataFrame:
    """Add UTC, which runs from the first sample's on, the marker, and that all is valid."""
    first = samples.iloc[0]
    if first["utc_ns"]:
        start_ns = int(first["utc_ns"]) - round(float(first["time_s"]) * 1e9)
        utc_ns = start_ns + np.rint(table["time_s"].to_numpy() * 1e9).astype(np.int64)
    else:
        utc_ns = np.zeros(len(table), np.int64)
    table.insert(1, "utc", utc_column(utc_ns))
    table.insert(2, "utc_ns", utc_ns)
    table.insert(3, "marker", pd.Series([first["marker"]] * len(table), dtype="str"))
    table.insert(4, "valid", np.ones(len(table), np.bool_))
    return table


def _evenly_text(
    time_s: Floats,
    own_hz: float,
    rate_hz: float,
    max_gap_s: float,
    stretches: int,
) -> str:
    between_s = np.diff(time_s)
    bridged = int(((between_s > 1.5 / own_hz) & (between_s <= max_gap_s)).sum())
    text = f"on even steps at {rate_hz:.6g} Hz by cubic splines"
    if rate_hz < 0.9 * own_hz:
        text += f", low-passed to {0.4 * rate_hz:.4g} Hz before"
    text += f"; {bridged} gaps of up to {max_gap_s:.4g} s are bridged"
    return text + (f", longer ones part it into {stretches} stretches" if stretches > 1 else "")


def _filter_text(recipe: Recipe) -> str:
    edges = [f"{edge:g} Hz" for edge in (recipe.low_hz, recipe.high_hz) if edge is not None]
    kind = "band-pass" if len(edges) == 2 else "low-pass" if recipe.low_hz is None else "high-pass"
    return (
        f"{kind} {' to '.join(edges)}: Butterworth of order {recipe.order}, forwards and "
        "backwards, half the amplitude at its edges"
    )


def _derivative_text(
    kind: str, times: int, per: str, recipe: Recipe, samples: pd.DataFrame, step_s: float
) -> str:
    from vdms_replay import signals

    does = signals.response(times, recipe.window, recipe.degree, step_s)
    sigma_mm = float(np.sqrt((samples["sigma_x_mm"] ** 2).mean()))
    text = (
        f"{kind} by Savitzky-Golay of {recipe.window} samples and degree {recipe.degree}: right "
        f"within 1 % to {does.accurate_hz:.3g} Hz, -3 dB at {does.cutoff_hz:.3g} Hz"
    )
    if math.isfinite(sigma_mm):
        unit = f"mm/{per.removeprefix('per_')}"
        text += f"; the samples' sigma of {sigma_mm:.4f} mm in x "
        text += f"makes {does.noise_gain * sigma_mm:.3g} {unit}"
    return text


def modes_text(table: pd.DataFrame, resolution_hz: float | None, least_db: float) -> str:
    """Return the spectrum's peaks of each coordinate as a table for a person."""
    from vdms_replay import signals

    step_s = 1 / table.attrs["rate_hz"]
    time_s = table["time_s"].to_numpy()
    cuts = np.flatnonzero(np.diff(time_s) > 1.5 * step_s) + 1
    stretches = [
        signals.Stretch(float(time_s[rows[0]]), step_s, table[list(AXES)].to_numpy()[rows])
        for rows in np.split(np.arange(len(table)), cuts)
    ]
    lines = []
    for column, name in enumerate(AXES):
        quantity, unit = name.split("_")
        try:
            found, step_hz = signals.modes(stretches, column, resolution_hz, least_db)
        except signals.SignalError as error:
            raise ReplayError(f"--modes: {error}") from None
        lines.append(f"{quantity}: peaks of the spectrum, resolution {step_hz:.4g} Hz")
        for mode in found[:MODES_TOLD]:
            damping = (
                f"damping {100 * mode.damping:6.2f} %"
                if math.isfinite(mode.damping)
                else "damping not resolved"
            )
            lines.append(
                f"  {mode.frequency_hz:9.4f} Hz  amplitude {mode.amplitude:10.5f} {unit}  "
                f"{damping}  {mode.above_db:5.1f} dB above the median"
            )
        if not found:
            lines.append(f"  none {least_db:g} dB above the median")
    return "\n".join(lines)


def _write(recording: Recording, table: pd.DataFrame, arguments: argparse.Namespace) -> list[str]:
    si = arguments.si
    units = {**UNITS, **{name: _unit_of(name) for name in table.columns if "_per_" in name}}
    first = table.iloc[0]
    start_ns = int(first["utc_ns"]) - round(float(first["time_s"]) * 1e9) if first["utc_ns"] else 0
    meta = {
        **recording.meta,
        "derived": "; ".join(table.attrs["derived"]),
        "start": iso(start_ns),
        "units": {si_name(n) if si else n: si_unit(u) if si else u for n, u in units.items()},
        "meanings": {si_name(n) if si else n: text for n, text in MEANINGS.items()},
    }
    target = target_path(recording.paths, arguments.to, arguments.out)
    if arguments.out is None:
        target = target.with_name(f"{target.stem}-derived{target.suffix}")
    marker = str(first["marker"])
    with writing(target, arguments.to, meta, force=arguments.force) as writer:
        writer.add(marker, to_si(table) if si else table)
    return [
        f"{target}: {len(table)} values of marker {marker}",
        *(f"{target}: {note}" for note in writer.notes),
    ]


def _unit_of(name: str) -> str:
    """Return `mm/s` for `x_velocity_mm_per_s`."""
    return "/".join(name.split("_", 2)[2].split("_per_"))
