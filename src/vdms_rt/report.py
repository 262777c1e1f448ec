"""What a set-up means, in short lines for a person."""

from __future__ import annotations

import textwrap

from vdms_rt.model import Aim, Scan
from vdms_rt.setup import SetUp

WIDTH = 79
"""Columns of a line; the first line of a log entry has its time before it."""
LABEL = 12
SCAN_WORDS = {
    Scan.PROGRESSIVE: "progressive",
    Scan.TOP_FIRST: "top field first",
    Scan.BOTTOM_FIRST: "bottom field first",
    Scan.TOP: "top fields",
    Scan.BOTTOM: "bottom fields",
}
SATURATED_PERCENT = 0.5
"""From here on a disc has lost part of its edge, and the noise that is seen is not all of it."""


def set_up_report(set_up: SetUp) -> str:
    """Return the set-up in words and figures, a line or two each."""
    lines = [
        f"set-up {set_up.revision}: {set_up.width_px} x {set_up.height_px} px, "
        f"{SCAN_WORDS[set_up.scan]}, method {set_up.method}"
    ]
    for marker in set_up.markers:
        role = ": its motion is taken off the others" if marker.shape.fixed else ""
        lines.append(f"marker {marker.shape.name}{role}")
        if marker.aim is not None:
            lines += aim_lines(marker.aim)
    return "\n".join(lines)


def aim_lines(aim: Aim) -> list[str]:
    """Return how the camera sees a marker and what to do about it, in lines of 79 columns."""
    rows = [
        ("scale", f"{aim.scale_x_px_per_mm:.3f} px/mm across, {aim.scale_y_px_per_mm:.3f} up"),
        ("angle", _angle(aim)),
        ("roll", _roll(aim.roll_deg)),
        ("focus", f"{aim.focus}: edges {aim.edge_x_px:.2f} x {aim.edge_y_px:.2f} px wide"),
        (
            "exposure",
            f"black {aim.black_grey:.0f}, white {aim.white_grey:.0f}, "
            f"contrast {aim.contrast_grey:.0f} grey levels, {_saturated(aim.saturated_percent)}",
        ),
        ("noise", f"{aim.noise_grey:.1f} grey levels"),
        (
            "resolution",
            f"{'at best ' if aim.saturated_percent > SATURATED_PERCENT else ''}"
            f"{_length(aim.sigma_x_mm)} in x, {_length(aim.sigma_y_mm)} in y "
            "(one sigma of a sample)",
        ),
        (
            "room",
            f"{aim.left_mm:.0f} mm left, {aim.right_mm:.0f} right, {aim.up_mm:.0f} up, "
            f"{aim.down_mm:.0f} down",
        ),
    ]
    rows += [("to do" if n == 0 else "", text) for n, text in enumerate(aim.advice)]
    return [line for label, text in rows for line in _wrapped(label, text)]


def _angle(aim: Aim) -> str:
    if aim.angle_deg <= aim.angle_error_deg:
        return f"straight on, within {aim.angle_deg + aim.angle_error_deg:.0f} deg"
    side = "one side"
    if aim.side_known:
        side = "right side" if aim.turn_deg > 0 else "left side"
    return (
        f"{aim.angle_deg:.1f} +- {aim.angle_error_deg:.1f} deg "
        f"({abs(aim.turn_deg):.1f} about the vertical, {side} farther)"
    )


def _roll(roll_deg: float) -> str:
    if abs(roll_deg) < 0.05:
        return "0.0 deg"
    way = "counter-clockwise" if roll_deg > 0 else "clockwise"
    return f"{abs(roll_deg):.1f} deg {way}"


def _saturated(percent: float) -> str:
    return f"{percent:.1f} % saturated" if percent else "none saturated"


def _length(mm: float) -> str:
    return f"{mm * 1000:.1f} um" if mm < 0.1 else f"{mm:.2f} mm"


def _wrapped(label: str, text: str) -> list[str]:
    return textwrap.wrap(
        text,
        WIDTH,
        initial_indent=f"  {label:<{LABEL}}",
        subsequent_indent=" " * (2 + LABEL),
    )
