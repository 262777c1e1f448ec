"""Finding the marker in a picture or clip for a person: its regions, a drawing, and what to do."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from vdms_rt import codec
from vdms_rt.capture.clip import ClipSource
from vdms_rt.config import Clip, Config, Marker
from vdms_rt.measure.aim import aim
from vdms_rt.measure.gate import Workspace
from vdms_rt.measure.marker import find_markers
from vdms_rt.measure.regions import regions_around
from vdms_rt.model import FoundMarker, Luma, Region, Scan, SourceError, VdmsError
from vdms_rt.report import SCAN_WORDS, aim_lines


class LookError(VdmsError):
    """The picture cannot be read or the drawing not written."""


def look(path: Path, config: Config, out: Path) -> tuple[str, bool]:
    """Return what to tell the person, and whether every marker was found.

    Writes the picture with regions and centres drawn to `out`. Raises LookError or SourceError.
    """
    image, scan = _first_picture(path, config.clip)
    height_px, width_px = image.shape
    shapes = [m.shape for m in config.marker]
    by_name = {s.name: s for s in shapes}
    found = {m.name: m for m in find_markers(image, shapes, scan)}
    missing = [s.name for s in shapes if s.name not in found]
    regions = {n: regions_around(m, by_name[n], width_px, height_px) for n, m in found.items()}
    lines = [f"# {path}: {width_px} x {height_px} px, {SCAN_WORDS[scan]}"]
    for marker in config.marker:
        if marker.name not in found:
            continue
        lines.append(f"# marker {marker.name}")
        lines += [f"# {line}" for line in _aimed(image, scan, found[marker.name], marker, config)]
        rows = ",\n".join(
            f"  [{r.x_px}, {r.y_px}, {r.width_px}, {r.height_px}]" for r in regions[marker.name]
        )
        lines += [
            "[[marker]]",
            f'name = "{marker.name}"',
            f"spacing_mm = {marker.spacing_mm:g}"
            if not marker.circles_mm
            else f"circles_mm = {[list(c) for c in marker.circles_mm]}",
            f"diameter_mm = {marker.diameter_mm:g}",
            f'colour = "{marker.colour}"',
            'find = "regions"',
            f"regions_px = [\n{rows},\n]",
        ]
    if missing:
        lines.append(
            f"# not found: {', '.join(missing)}. All circles must be in the picture, sharp, at "
            "least 10 pixels across, on their unbroken dark (or light) sheet"
        )
    _write(out, _drawn(image, found, regions))
    lines.append(f"# drawn in {out}")
    return "\n".join(lines), not missing


def _aimed(
    image: Luma, scan: Scan, found: FoundMarker, marker: Marker, config: Config
) -> list[str]:
    """Return how well the camera sees a marker, in the first picture that would be measured."""
    step = 2 if scan.interlaced and config.process.sampling != "frame" else 1
    seen = aim(
        image[::step],
        0,
        step,
        image.shape[0],
        marker.shape,
        found.centres_px,
        found.semi_axes_px,
        config.lens.pixel_aspect,
        Workspace(),
    )
    return aim_lines(seen)


def _first_picture(path: Path, clip: Clip) -> tuple[Luma, Scan]:
    if path.is_file() and path.suffix.lower() in (".png", ".pgm", ".jpg", ".jpeg", ".bmp", ".tif"):
        image = codec.picture_from(path.read_bytes())
        if image is None:
            raise LookError(f"{path}: not a picture that can be read; save it as PNG or PGM")
        scans = {"top-first": Scan.TOP_FIRST, "bottom-first": Scan.BOTTOM_FIRST}
        return image, scans.get(clip.field_order, Scan.PROGRESSIVE)
    source = ClipSource(clip.model_copy(update={"path": str(path), "pace": "fast", "loop": False}))
    try:
        info = source.info
        image = np.empty((info.height_px, info.width_px), np.uint8)
        if source.read(image, timeout_s=10.0) is None:
            raise SourceError(f"{path}: gave no picture within 10 s")
        return image, info.scan
    finally:
        source.close()


def _drawn(
    image: Luma, found: dict[str, FoundMarker], regions: dict[str, tuple[Region, ...]]
) -> np.ndarray:
    """Return the picture in colour (height, width, 3) BGR uint8, regions green, centres red."""
    colour = np.repeat(image[:, :, None], 3, axis=2)
    green, red = (0, 220, 0), (40, 40, 255)
    for name, marker in found.items():
        for r in regions[name]:
            right, bottom = r.x_px + r.width_px - 1, r.y_px + r.height_px - 1
            colour[r.y_px : bottom + 1, [r.x_px, right]] = green
            colour[[r.y_px, bottom], r.x_px : right + 1] = green
        for x_px, y_px in marker.centres_px:
            x, y = round(x_px), round(y_px)
            colour[max(0, y - 6) : y + 7, x] = red
            colour[y, max(0, x - 6) : x + 7] = red
    return colour


def _write(path: Path, image: np.ndarray) -> None:
    try:
        path.write_bytes(codec.png(image))
    except OSError as error:
        raise LookError(
            f"{path}: cannot write the drawing: {error.strerror}; name another file with --out"
        ) from None
