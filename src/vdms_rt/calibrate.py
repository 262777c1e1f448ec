"""What a recording tells of the lens, of the table's axis and of the scale, for a person to paste
into the configuration."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from google.protobuf.message import DecodeError

from vdms_rt.logfile.reader import LogFileError, LogReader, StoredMessage
from vdms_rt.measure.axis import StrokeError, StrokeResult, measure_stroke
from vdms_rt.measure.bundle import LensError
from vdms_rt.measure.homography import GeometryError
from vdms_rt.measure.lensfit import LensEstimate, estimate_lens
from vdms_rt.model import CircleFlag, Displacement, Status, VdmsError
from vdms_rt.setup import MarkerSetUp, SetUp, SetUpError, set_up_from_json
from vdms_rt.wire import vdms_pb2 as pb
from vdms_rt.wire.convert import displacement_from

MOST_DISTORTION = 0.2
"""What the configuration takes for k1 and k2."""
LARGEST_SCALE_ERROR = 1e-3
"""Beyond which the print is worth a look."""
LARGEST_STRAYING = 0.01
"""Of a stroke from its axis, as a part of its length."""
UNSEEN = CircleFlag.LOST | CircleFlag.BORDER | CircleFlag.CONTRAST
"""Flags of a circle that says nothing of the lens. The others may be the lens's own doing."""
NO_POSITION = (
    Status.SET_UP | Status.DAMAGED | Status.REPEATED | Status.NO_SIGNAL | Status.SET_UP_STALE
)


class CalibrateError(VdmsError):
    """The recording does not hold what was asked of it."""


@dataclass(slots=True)
class _Recording:
    """What of a recording is used here."""

    path: Path
    ours: bool = False
    config: dict[str, Any] = field(default_factory=dict)
    """Values in force, as they were recorded."""
    set_ups: dict[tuple[int, int], SetUp] = field(default_factory=dict)
    """By session and revision."""
    samples: dict[str, list[Displacement]] = field(default_factory=dict)
    """By marker, in the order of time."""


@dataclass(frozen=True, slots=True)
class _Run:
    """The samples of one marker that belong to one reference."""

    marker: str
    set_up: SetUp
    own: MarkerSetUp
    samples: list[Displacement]


def lens_from_recording(
    path: Path, marker: str | None = None, pixel_aspect: float | None = None
) -> str:
    """Return what the marker's circles tell of the lens, with a section [lens] to paste.

    The circles of a recording are as they were seen, whatever lens was configured then. Without
    `pixel_aspect` that of the recorded configuration holds; without `marker` the only one that is
    not fixed. Raises CalibrateError, or LensError where the marker did not move enough.
    """
    recording = _read(path)
    name = _marker(recording, marker)
    run = _longest(recording, name, recording.samples[name])
    recorded = recording.config.get("lens", {}).get("pixel_aspect", 1.1)
    circles = len(run.own.shape.circles_mm)
    centres_px = np.array(
        [
            [(math.nan, math.nan) if c.flags & UNSEEN else (c.x_px, c.y_px) for c in d.circles]
            for d in run.samples
            if len(d.circles) == circles
        ]
    ).reshape(-1, circles, 2)
    try:
        estimate = estimate_lens(
            run.own.shape,
            centres_px,
            run.set_up.width_px,
            run.set_up.height_px,
            pixel_aspect or float(recorded),
        )
    except (LensError, GeometryError) as error:
        raise CalibrateError(f"{path}: marker {name}: {error}") from None
    if estimate.shortfall:
        raise CalibrateError(f"{path}: marker {name}: {estimate.shortfall}")
    lens = estimate.lens
    if max(abs(lens.k1), abs(lens.k2)) > MOST_DISTORTION:
        raise CalibrateError(
            f"{path}: marker {name}: k1 = {lens.k1:.3g}, k2 = {lens.k2:.3g} is more than any "
            "usable lens bends; was the camera moved, or the marker out of its own plane?"
        )
    return _lens_text(path, name, estimate)


def stroke_from_recording(
    path: Path,
    marker: str | None,
    stroke_mm: float,
    from_s: float = 0.0,
    to_s: float = math.inf,
) -> str:
    """Return what a slow stroke of the known length `stroke_mm` tells of axis and scale, with the
    lines to paste.

    `from_s` and `to_s` cut the stroke out, in seconds from the marker's first sample. Raises
    CalibrateError.
    """
    recording = _read(path)
    name = _marker(recording, marker)
    samples = recording.samples[name]
    first_ns = samples[0].t_ns
    inside = [d for d in samples if from_s <= (d.t_ns - first_ns) / 1e9 <= to_s]
    if not inside:
        raise CalibrateError(
            f"{path}: no sample of marker {name} lies between {from_s:g} and {to_s:g} s; it has "
            f"samples from 0 to {(samples[-1].t_ns - first_ns) / 1e9:.1f} s"
        )
    run = _longest(recording, name, [d for d in inside if d.valid])
    t_ns = np.array([d.t_ns for d in run.samples], dtype=np.int64)
    xy_mm = np.array([(d.x_mm, d.y_mm) for d in run.samples])
    try:
        result = measure_stroke(t_ns, xy_mm, stroke_mm)
    except StrokeError as error:
        raise CalibrateError(f"{path}: marker {name}: {error}") from None
    markers = recording.config.get("marker", [])
    recorded = [float(m.get("axis_deg", 0.0)) for m in markers if m.get("name") == name]
    seconds = float(t_ns[-1] - t_ns[0]) / 1e9
    head = f"# {path}: marker {name}, {len(t_ns)} samples in {seconds:.1f} s, {result.rests} rests"
    return _stroke_text(head, name, result, stroke_mm, recorded[0] if recorded else 0.0)


def _read(path: Path) -> _Recording:
    recording = _Recording(path)
    try:
        with LogReader(path) as reader:
            for record in reader:
                if isinstance(record, StoredMessage) and record.schema is not None:
                    _take(recording, record.schema.name, record.message.data)
    except LogFileError as error:
        raise CalibrateError(f"{error}; name a recording of vdms-rt, an .mcap file") from None
    except DecodeError:
        raise CalibrateError(
            f"{path}: holds a message that cannot be decoded; was it recorded by a newer version "
            "of vdms-rt?"
        ) from None
    if not recording.ours:
        raise CalibrateError(f"{path}: an MCAP, but not one that vdms-rt recorded")
    if not recording.samples:
        raise CalibrateError(f"{path}: holds no displacement; record while a marker is seen")
    for samples in recording.samples.values():
        samples.sort(key=lambda d: d.t_ns)
    return recording


def _take(recording: _Recording, type_: str, data: bytes) -> None:
    recording.ours = recording.ours or type_.startswith("vdms.")
    if type_ == "vdms.Displacement":
        sample = displacement_from(data)
        recording.samples.setdefault(sample.marker, []).append(sample)
    elif type_ == "vdms.SetUp":
        message = pb.SetUp.FromString(data)
        try:
            set_up = set_up_from_json(message.json)
        except SetUpError as error:
            raise CalibrateError(f"{recording.path}: {error}; record anew") from None
        recording.set_ups[message.session, message.revision] = set_up
    elif type_ == "vdms.Run":
        text = pb.Run.FromString(data).effective_config
        recording.config = json.loads(text) if text else {}


def _marker(recording: _Recording, asked: str | None) -> str:
    names = sorted(recording.samples)
    if asked is not None:
        if asked in names:
            return asked
        raise CalibrateError(f"{recording.path}: has no marker {asked}; it has {', '.join(names)}")
    fixed = {m.shape.name for s in recording.set_ups.values() for m in s.markers if m.shape.fixed}
    moving = [name for name in names if name not in fixed] or names
    if len(moving) > 1:
        raise CalibrateError(
            f"{recording.path}: has the markers {', '.join(moving)}; choose one with --marker"
        )
    return moving[0]


def _longest(recording: _Recording, marker: str, samples: Iterable[Displacement]) -> _Run:
    """Return the most samples that belong to one reference: its zero and the camera's place."""
    runs: dict[object, _Run] = {}
    for sample in samples:
        set_up = recording.set_ups.get((sample.session, sample.setup_revision))
        if set_up is None or sample.status & NO_POSITION:
            continue
        own = next((m for m in set_up.markers if m.shape.name == marker), None)
        if own is not None:
            key = (sample.session, own.homography)
            runs.setdefault(key, _Run(marker, set_up, own, [])).samples.append(sample)
    if not runs:
        raise CalibrateError(
            f"{recording.path}: marker {marker} has no valid sample; wait for the state measuring "
            "before the marker is moved"
        )
    return max(runs.values(), key=lambda run: len(run.samples))


def _lens_text(path: Path, marker: str, e: LensEstimate) -> str:
    lens = e.lens
    sure = f"k1 {lens.k1:.5f} +- {e.sigma_k1:.5f}"
    if lens.k2:
        sure += f", k2 {lens.k2:.5f} +- {e.sigma_k2:.5f}"
    if e.sigma_centre_px:
        sure += f", centre +- {e.sigma_centre_px:.2g} px"
    lines = [
        f"# {path}: marker {marker}, {e.pictures} pictures in {e.places} places, circles seen up "
        f"to {100 * e.reach:.0f} % of the way to the picture's corner",
        f"# {sure}: the corner is displaced by {100 * (lens.k1 + lens.k2):.2f} +- "
        f"{100 * e.sigma_corner:.2g} % of its radius",
        f"# residual of the circles: {e.residual_before_mm:.4f} mm rms without the lens, "
        f"{e.residual_after_mm:.4f} mm with it",
        f"# effect on a displacement: up to {e.effect_mm:.4f} mm in a motion of up to "
        f"{e.travel_mm:.1f} mm",
    ]
    if not e.bends:
        lines.append("# that is not told from a lens that bends nothing: leave this section out")
    lines += ["[lens]", f"k1 = {lens.k1:.5f}", f"k2 = {lens.k2:.5f}"]
    if e.sigma_centre_px:
        lines.append(f"centre_px = [{lens.centre_px[0]:.2f}, {lens.centre_px[1]:.2f}]")
    lines.append(f"pixel_aspect = {lens.pixel_aspect:g}")
    return "\n".join(lines)


def _stroke_text(
    head: str, marker: str, r: StrokeResult, stroke_mm: float, recorded_deg: float
) -> str:
    lines = [
        head,
        f"# axis: {r.angle_deg:.4f} +- {r.sigma_angle_deg:.4f} deg from the recorded x towards y; "
        f"the marker strayed {r.straightness_mm:.4f} mm rms from it",
        f"# stroke: {r.length_mm:.4f} +- {r.sigma_length_mm:.4f} mm measured, {stroke_mm:g} mm in "
        f"truth: scale {r.scale:.5f} +- {r.sigma_scale:.5f} (true over measured)",
    ]
    if r.straightness_mm > LARGEST_STRAYING * r.length_mm:
        lines.append("# that is not straight: cut the stroke out with --from-s and --to-s")
    if abs(r.scale - 1) > max(LARGEST_SCALE_ERROR, 3 * r.sigma_scale):
        lines.append(
            f"# the scale is {100 * abs(r.scale - 1):.2f} % off: measure the print; one of another "
            f"size is put right by spacing_mm and diameter_mm (or circles_mm) times {r.scale:.5f}"
        )
    axis_deg = (recorded_deg + r.angle_deg + 180) % 360 - 180
    if recorded_deg:
        lines.append(f"# the recording was made with axis_deg = {recorded_deg:g}, to which it adds")
    lines += ["[[marker]]", f'name = "{marker}"', f"axis_deg = {axis_deg:.4f}"]
    return "\n".join(lines)
