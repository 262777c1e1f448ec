"""What a person reads of a run: the status line and the summary at the end."""

from __future__ import annotations

from collections.abc import Sequence

from vdms_rt.model import Displacement, Health, State, Status

STATUS_WORDS = {
    Status.SET_UP: "set-up",
    Status.NOT_FOUND: "marker not found",
    Status.DAMAGED: "damaged frame",
    Status.FEWER_CIRCLES: "fewer circles",
    Status.RESIDUAL: "circles disagree",
    Status.SET_UP_STALE: "set-up stale",
    Status.FIELD_ORDER_UNCONFIRMED: "field order unconfirmed",
    Status.FIELD_ORDER_WRONG: "field order wrong",
    Status.CLOCK_SETTLING: "clock settling",
    Status.RELOCATED: "found again",
    Status.SATURATED: "too bright",
    Status.FIXED_LOST: "fixed marker not found",
    Status.REPEATED: "repeated frame",
    Status.NO_SIGNAL: "no signal",
}


def status_words(status: Status) -> str:
    """Return the flags in words, `ok` for none."""
    return ", ".join(word for flag, word in STATUS_WORDS.items() if flag & status) or "ok"


def status_line(health: Health, newest: Displacement | None) -> str:
    """Return one line of what goes on: state, the newest position, rate and losses."""
    parts = [f"{health.state.value:<10}"]
    if newest is not None and newest.valid:
        parts.append(f"{newest.marker}  x {newest.x_mm:+9.3f} mm  y {newest.y_mm:+9.3f} mm")
    elif newest is not None and health.state is State.MEASURING:
        parts.append(f"{newest.marker}  {status_words(newest.status)}")
    parts.append(f"{health.frame_rate_hz:5.2f} frames/s")
    lost = health.missed + health.overwritten
    parts.append(f"lost {lost}  invalid {health.invalid}")
    if health.recording:
        parts.append("recording")
    if health.record_trouble:
        parts.append("NOT RECORDING")
    return "  ".join(parts)


def not_recorded(messages: int, pixels: int) -> str:
    """Return in words how many messages are in no file, and of how many frames the pixels."""
    return f"{messages} messages" + (f", of them the pixels of {pixels} frames" if pixels else "")


def summary(health: Health, files: Sequence[str]) -> str:
    """Return the account of a finished run, a line for each figure."""
    rows = [
        ("captured", f"{health.captured} frames"),
        ("missed", f"{health.missed} frames lost before the computer had them"),
        ("damaged", f"{health.damaged} frames that the driver delivered broken"),
        ("repeated", f"{health.repeated} frames that the driver delivered twice"),
        ("no signal", f"{health.no_signal} frames without a camera's picture"),
        ("overwritten", f"{health.overwritten} frames that came faster than they were measured"),
        ("measured", f"{health.measured} samples"),
        ("invalid", f"{health.invalid} samples after the reference without a position"),
        ("not recorded", not_recorded(health.not_recorded, health.pixels_left_out)),
    ]
    always = ("captured", "missed", "measured", "invalid")
    lines = [
        f"  {name:<13}{text}" for name, text in rows if name in always or not text.startswith("0 ")
    ]
    lines += [f"  {'written' if n == 0 else '':<13}{file}" for n, file in enumerate(files)]
    return "\n".join(lines)
