"""`vdms-replay info`: what a recording holds, on one page."""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import textwrap
from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np

from vdms_replay.columns import Clock, Samples
from vdms_replay.load import NOT_PIXELS, PIXELS, ROWS_AT_ONCE, About, Once, iso, metadata
from vdms_replay.source import Entry, PathLike, Source, by_station
from vdms_replay.summary import MarkerSummary, known
from vdms_replay.verb import Verbs, make_parser, progress
from vdms_rt.measure.homography import scale_px_per_mm
from vdms_rt.model import VdmsError
from vdms_rt.wire import vdms_pb2 as pb

LINES_TOLD = 12
"""Of gaps and of events: the page is for a person; --json tells all."""
COUNTERS = (
    "captured", "missed", "damaged", "overwritten", "measured", "invalid", "not_recorded",
    "pixels_left_out",
)  # fmt: skip
SEVERITIES = {0: "info", 1: "warning", 2: "error"}


def add_parser(verbs: Verbs) -> None:
    parser = make_parser(
        verbs,
        "info",
        run,
        "say what a recording holds",
        "When, how long, station and device; for each marker its rate, gaps, invalid samples by "
        "reason, peaks and noise; set-up, warnings and what could not be read. The files of one "
        "station are one recording.",
    )
    parser.add_argument("files", nargs="+", type=Path, metavar="FILE")
    parser.add_argument("--json", action="store_true", help="everything, for a program")


def run(arguments: argparse.Namespace) -> int:
    stations = by_station(arguments.files)
    told = []
    for paths in stations.values():
        source = Source(paths)
        with progress("reading", source.size_bytes) as advance:
            told.append(survey(source, advance))
    if arguments.json:
        print(json.dumps(told, indent=1, ensure_ascii=False, allow_nan=False))
    else:
        text = "\n\n".join(page(one) for one in told)
        print(folded(text) if sys.stdout.isatty() else text)
    return 0


def info(*files: PathLike) -> dict[str, Any]:
    """Return what the files of one station hold, as plain values. Raises ReplayError."""
    return survey(Source(files), None)


def survey(source: Source, advance: Callable[[int], None] | None) -> dict[str, Any]:
    """Return what a recording holds as plain values, read once in bounded memory."""
    about, clock, once = About(), Clock(), Once()
    markers: dict[str, MarkerSummary] = {}
    samples = Samples(clock)
    health: pb.Health | None = None
    pixels = 0
    for item in source.items((*NOT_PIXELS, PIXELS), advance):
        if isinstance(item, Entry) and isinstance(item.value, pb.Pixels):
            pixels += 1
            continue
        about.take(item)
        if not isinstance(item, Entry):
            continue
        match item.value:
            case pb.Displacement() as sample:
                if once.is_new(sample):
                    samples.add(sample)
                if len(samples) >= ROWS_AT_ONCE:
                    _sum_up(markers, samples)
            case pb.Health() as newest:
                health = newest
    if len(samples):
        _sum_up(markers, samples)
    return {
        **metadata(about, source.paths, list(source.damage.values())),
        "start": iso(clock.start_ns or 0) if clock.utc else "",
        "seconds": max((m.last_s for m in markers.values()), default=0.0),
        "sizes_bytes": {path.name: path.stat().st_size for path in source.paths},
        "markers": {name: summary.values() for name, summary in markers.items()},
        "doubled_samples": once.doubled,
        "pixel_frames": pixels,
        "geometry": _geometry(about),
        "events": [_event(event) for event in about.events],
        "counters": _counters(about, health),
        "clock": _clock(about, health),
    }


def _sum_up(markers: dict[str, MarkerSummary], samples: Samples) -> None:
    table = samples.take()
    for name, part in table.groupby("marker", sort=False):
        markers.setdefault(str(name), MarkerSummary(str(name))).take(part)


def _geometry(about: About) -> list[dict[str, Any]]:
    """Return scale and noise of every set-up that this version understands."""
    told = []
    for recorded in about.set_ups.values():
        try:
            set_up = recorded.set_up()
        except VdmsError:
            continue
        for marker in set_up.markers:
            scales = scale_px_per_mm(np.array(marker.homography))
            noise_mm = [
                marker.noise_px / scale / len(marker.shape.circles_mm) ** 0.5 for scale in scales
            ]
            told.append(
                {
                    "session": recorded.session,
                    "revision": recorded.revision,
                    "marker": marker.shape.name,
                    "scale_x_px_per_mm": scales[0],
                    "scale_y_px_per_mm": scales[1],
                    "noise_px": marker.noise_px,
                    "resolution_x_mm": noise_mm[0],
                    "resolution_y_mm": noise_mm[1],
                }
            )
    return told


def _event(event: pb.Event) -> dict[str, Any]:
    return {
        "utc": iso(event.utc_ns),
        "severity": SEVERITIES.get(event.severity, str(event.severity)),
        "code": event.code,
        "text": event.text,
    }


def _last_health(about: About, health: pb.Health | None) -> pb.Health | None:
    return about.ends[-1].health if about.ends else health


def _clock(about: About, health: pb.Health | None) -> dict[str, Any]:
    last = _last_health(about, health)
    if last is None:
        return {}
    return {
        "utc_state": last.utc_state or "unknown",
        "jitter_us": known(last.clock_jitter_us),
        "sigma_us": known(last.clock_sigma_us),
        "rate_ppm": known(last.clock_rate_ppm),
    }


def _counters(about: About, health: pb.Health | None) -> dict[str, int]:
    last = _last_health(about, health)
    if last is None:
        return {}
    return {name: int(getattr(last, name)) for name in COUNTERS}


def page(told: dict[str, Any]) -> str:
    """Return `survey`'s values as a page for a person."""
    lines = [f"{told['station'] or 'unknown station'}: {_when(told)}"]
    for name, size in told["sizes_bytes"].items():
        lines.append(_line("file", f"{name}, {size / 1e6:.1f} MB"))
    lines.append(_line("recorded", f"by {told['recorded_by'] or 'an unknown version'}"))
    device = [f"{name} {value}" for name, value in told["device"].items()]
    lines.append(_line("device", ", ".join(device) or "unknown"))
    ends = told["ends"]
    lines.append(_line("ended", ends[-1] if ends else "without an end: killed, or still recording"))
    if told["pixel_frames"]:
        lines.append(_line("pixels", f"of {told['pixel_frames']} frames"))
    for name, marker in told["markers"].items():
        lines += ["", f"marker {name}", *_marker_lines(marker)]
        lines += [
            _line(
                "set-up",
                f"revision {one['revision']}: {one['scale_x_px_per_mm']:.3f} px/mm across, "
                f"{one['scale_y_px_per_mm']:.3f} up; noise of a circle {one['noise_px']:.4f} px, "
                f"resolution x {one['resolution_x_mm']:.4f} mm, "
                f"y {one['resolution_y_mm']:.4f} mm",
            )
            for one in told["geometry"]
            if one["marker"] == name
        ]
    if not told["markers"]:
        lines += ["", "no displacement"]
    lines += _trouble(told)
    return "\n".join(lines)


def _when(told: dict[str, Any]) -> str:
    start = told["start"] or told["recorded_at"]
    when = f"{start[:10]} {start[11:23]} UTC" if start else "at an unknown time"
    seconds = told["seconds"]
    long = f", {seconds / 3600:.2f} h" if seconds > 3600 else ""
    return f"{when}, {seconds:.2f} s{long}"


def _marker_lines(marker: dict[str, Any]) -> list[str]:
    rate = marker["rate_hz"]
    at = f" at {rate:.3f} Hz" if rate else ""
    lines = [_line("samples", f"{marker['samples']}{at}, {marker['valid']} valid")]
    for word, reasons in (("invalid", marker["invalid"]), ("flagged", marker["flagged"])):
        if reasons:
            text = ", ".join(f"{count} {reason}" for reason, count in reasons.items())
            lines.append(_line(word, text))
    lines.append(_line("gaps", _gap_text(marker)))
    for name, axis in marker["axes"].items():
        quantity, _, unit = name.partition("_")
        if axis["mean"] is not None:
            lines.append(
                _line(
                    quantity,
                    f"{axis['lowest']:+.4f} {unit} at {axis['lowest_at_s']:.3f} s to "
                    f"{axis['highest']:+.4f} {unit} at {axis['highest_at_s']:.3f} s, "
                    f"mean {axis['mean']:+.4f}, standard deviation {axis['deviation']:.4f}",
                )
            )
    quiet = marker["quietest_second"]
    if marker["sigma_x_mm"] is not None:
        noise = f"stated sigma x {marker['sigma_x_mm']:.4f} mm, y {marker['sigma_y_mm']:.4f} mm"
        if quiet["x_mm"] is not None:
            noise += (
                f"; quietest second, at {quiet['at_s']:.1f} s: "
                f"x {quiet['x_mm']:.4f} mm, y {quiet['y_mm']:.4f} mm"
            )
        lines.append(_line("noise", noise))
    return lines


def _gap_text(marker: dict[str, Any]) -> str:
    if not marker["gap_count"]:
        return "none"
    ranges = [
        f"seq {gap['first_seq']} to {gap['last_seq']} at {gap['time_s']:.2f} s"
        for gap in marker["gaps"][:LINES_TOLD]
    ]
    if marker["gap_count"] > LINES_TOLD:
        ranges.append(f"{marker['gap_count'] - LINES_TOLD} more")
    return f"{marker['gap_count']}, {marker['lost']} samples lost: {'; '.join(ranges)}"


def _trouble(told: dict[str, Any]) -> list[str]:
    counters = told["counters"]
    lines = [""]
    if counters:
        text = ", ".join(
            f"{name.replace('_', ' ')} {count}"
            for name, count in counters.items()
            if count or name != "pixels_left_out"
        )
        lines.append(_line("frames", text))
    lines.append(_line("clock", _clock_text(told["clock"])))
    severities = Counter(event["severity"] for event in told["events"])
    lines.append(
        _line(
            "events", ", ".join(f"{n} {severity}" for severity, n in severities.items()) or "none"
        )
    )
    loud = [event for event in told["events"] if event["severity"] != "info"]
    lines += [
        _line(event["severity"], f"{event['utc'][11:19]} {event['text']}")
        for event in loud[:LINES_TOLD]
    ]
    if len(loud) > LINES_TOLD:
        lines.append(_line("", f"{len(loud) - LINES_TOLD} more; --json tells all"))
    if told["doubled_samples"]:
        lines.append(_line("doubled", f"{told['doubled_samples']} samples, counted once"))
    lines += _each("repaired", told["repairs"])
    lines += _each("damage", told["not_readable"])
    return lines


def _clock_text(clock: dict[str, Any]) -> str:
    if not clock:
        return "unknown"
    text = f"UTC {clock['utc_state']}"
    if None not in clock.values():
        text += (
            f"; stamps jitter by {clock['jitter_us']:.0f} us, frame clock known to "
            f"{clock['sigma_us']:.0f} us, {clock['rate_ppm']:+.1f} ppm"
        )
    return text


def _each(word: str, sentences: Iterable[str]) -> list[str]:
    return [_line(word, sentence) for sentence in sentences]


def folded(text: str) -> str:
    """Return the page with its long lines folded at the terminal's width, under their texts."""
    width = max(shutil.get_terminal_size().columns, 40)
    return "\n".join(
        textwrap.fill(line, width, subsequent_indent=" " * 12, break_on_hyphens=False)
        for line in text.splitlines()
    )


def _line(word: str, text: str) -> str:
    return f"  {word:<10}{text}"
