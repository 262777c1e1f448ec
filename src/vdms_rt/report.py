"""What a set-up means, on a page for a person."""

from __future__ import annotations

import numpy as np

from vdms_rt.measure.homography import scale_px_per_mm
from vdms_rt.setup import MarkerSetUp, SetUp


def set_up_report(set_up: SetUp) -> str:
    """Return the set-up in words and figures, one line each."""
    lines = [
        f"set-up revision {set_up.revision}, {set_up.width_px} x {set_up.height_px} px, "
        f"{set_up.scan.name.lower().replace('_', ' ')}, method {set_up.method}, "
        f"reference from {set_up.stills} pictures"
    ]
    for marker in set_up.markers:
        lines += [f"marker {marker.shape.name}:", *_marker_lines(marker, set_up)]
    return "\n".join(lines)


def _marker_lines(marker: MarkerSetUp, set_up: SetUp) -> list[str]:
    h = np.array(marker.homography)
    scale_x, scale_y = scale_px_per_mm(h)
    centres = np.array(marker.reference_px)
    contrast = [c for field in marker.fields for c in field.contrast]
    left, top = centres.min(axis=0)
    right = set_up.width_px - 1 - centres.max(axis=0)[0]
    bottom = set_up.height_px - 1 - centres.max(axis=0)[1]
    return [
        f"  scale       {scale_x:.3f} px/mm across, {scale_y:.3f} px/mm up",
        f"  contrast    {min(contrast):.0f} to {max(contrast):.0f} grey levels",
        f"  noise       {marker.noise_px * 1000:.1f} thousandths of a pixel for one circle, "
        f"{marker.noise_px / scale_x / len(centres) ** 0.5 * 1000:.1f} micrometres for the marker",
        f"  room        {left:.0f} px left, {right:.0f} right, {top:.0f} above, {bottom:.0f} below",
    ]
