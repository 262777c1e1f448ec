"""Where frames come from: grabber, clip, recording."""

from __future__ import annotations

from fractions import Fraction
from typing import Literal

from pydantic import Field

from vdms_rt.config.base import Rate, Section


class V4l2(Section):
    device: str = "auto"
    input: int = Field(default=0, ge=0, le=31)
    standard: Literal[
        "auto", "ntsc", "ntsc-m", "ntsc-m-jp", "ntsc-m-kr", "ntsc-443", "pal", "pal-m", "pal-60"
    ] = "auto"
    pixel_format: Literal["auto", "YUYV", "UYVY", "GREY", "MJPG"] = "auto"
    width_px: int = Field(default=720, ge=16, le=4096)
    height_px: int = Field(default=0, ge=0, le=4096)
    """0: what the standard has."""
    brightness: int | None = None
    contrast: int | None = None
    saturation: int | None = None
    hue: int | None = None
    gain: int | None = None
    """The device's own numbers; None leaves them as they are."""
    automatic: Literal["off", "leave"] = "off"
    """Automatic gain, brightness and exposure."""
    buffers: int = Field(default=8, ge=2, le=32)
    field_order: Literal["auto", "progressive", "top-first", "bottom-first"] = "auto"


class Clip(Section):
    path: str = ""
    rate_hz: Rate = Fraction(30000, 1001)
    field_order: Literal["progressive", "top-first", "bottom-first"] = "progressive"
    pace: Literal["realtime", "fast"] = "realtime"
    loop: bool = False


class Log(Section):
    path: str = ""
    pace: Literal["realtime", "fast"] = "fast"
