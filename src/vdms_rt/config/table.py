"""The virtual shaking table."""

from __future__ import annotations

from fractions import Fraction
from typing import Literal

from pydantic import Field, model_validator

from vdms_rt.config.base import Name, Pair, Rate, Section


class Motion(Section):
    """What the virtual table does after its rest."""

    kind: Literal["still", "harmonic", "sweep", "step", "record"] = "harmonic"
    amplitude_mm: float = Field(default=10.0, ge=0, le=1000)
    frequency_hz: float = Field(default=1.0, gt=0, le=60)
    """Of the harmonic; where the sweep begins."""
    end_frequency_hz: float = Field(default=5.0, gt=0, le=60)
    """Where the sweep arrives after sweep_s, on a logarithmic course, and goes on."""
    sweep_s: float = Field(default=60.0, gt=0, le=3600)
    direction_deg: float = Field(default=0.0, ge=-180, le=180)
    """In the marker plane, from x towards y."""
    file: str = ""
    """CSV of an earthquake record: columns time_s, x_mm and, if there is one, y_mm."""

    @model_validator(mode="after")
    def _consistent(self) -> Motion:
        if self.kind == "record" and not self.file:
            raise ValueError('kind = "record" needs file, a CSV with the columns time_s and x_mm')
        return self


class TableSheet(Section):
    """A marker that hangs in the virtual laboratory."""

    marker: Name = "m1"
    at_mm: Pair = (0.0, 0.0)
    """Where its zero hangs, in the plane of the table's motion."""
    moves: bool = True


class Table(Section):
    """The virtual shaking table: laboratory, camera and grabber in one."""

    distance_m: float = Field(default=8.0, ge=0.2, le=200)
    angle_deg: float = Field(default=0.0, ge=-75, le=75)
    """Between the line of sight and the normal of the marker plane, about the vertical; positive:
    the right side is the farther one."""
    roll_deg: float = Field(default=0.0, ge=-45, le=45)
    """How far the picture is turned, counter-clockwise."""
    fill: float = Field(default=0.65, gt=0.02, le=1.0)
    """Height of the first sheet (its circles' extent + half a diameter on each side) as a part
    of the picture's height, at angle 0: this sets the zoom. Without a sheet the first marker
    counts."""
    pixel_aspect: float = Field(default=1.1, ge=0.5, le=2.0)
    """Pixels per unit length along a row over pixels along a column."""
    width_px: int = Field(default=720, ge=64, le=1920)
    height_px: int = Field(default=480, ge=64, le=1080)
    frame_rate_hz: Rate = Fraction(30000, 1001)
    scan: Literal["progressive", "top-first", "bottom-first"] = "bottom-first"
    exposure_ms: float = Field(default=0.0, ge=0, le=40)
    """Of each field; it ends as the field's readout begins."""
    black_grey: float = Field(default=30.0, ge=0, le=255)
    white_grey: float = Field(default=200.0, ge=0, le=400)
    blur_x_px: float = Field(default=0.85, ge=0, le=5)
    blur_y_px: float = Field(default=0.6, ge=0, le=5)
    noise_grey: float = Field(default=2.0, ge=0, le=30)
    light_gradient: float = Field(default=0.1, ge=0, le=1)
    """How much brighter the right side of the picture is lit than the left, as a part of the
    mean."""
    distortion: float = Field(default=0.0, ge=-0.2, le=0.2)
    """Radial displacement in the picture's corner as a part of its radius; negative is barrel."""
    stamp_jitter_ms: float = Field(default=0.0, ge=0, le=20)
    """Peak of the driver's lateness, uniform from 0."""
    clock_error_ppm: float = Field(default=0.0, ge=-500, le=500)
    """Positive when frames come faster than frame_rate_hz by the computer's clock."""
    lost_frames: float = Field(default=0.0, ge=0, le=0.5)
    """Part of the frames that never arrive."""
    sequence_counts_lost: bool = False
    clutter: bool = True
    rest_s: float = Field(default=4.0, ge=0, le=600)
    motion: Motion = Motion()
    shake_mm: float = Field(default=0.0, ge=0, le=50)
    """Amplitude in x of the camera's own movement, as seen in the marker plane; in y it is half
    as much at 1.5 times the frequency. It begins with the table's motion."""
    shake_hz: float = Field(default=0.7, gt=0, le=30)
    sheet: tuple[TableSheet, ...] = (TableSheet(),)
    pace: Literal["realtime", "fast"] = "realtime"
    frames: int = Field(default=0, ge=0)
    """Ends after it has given so many; 0 goes on."""
    seed: int = Field(default=1, ge=0)
    """Of noise, jitter, losses and the laboratory."""

    @model_validator(mode="after")
    def _consistent(self) -> Table:
        markers = [sheet.marker for sheet in self.sheet]
        if doubles := sorted({m for m in markers if markers.count(m) > 1}):
            raise ValueError(f"sheet hangs marker {', '.join(doubles)} twice; hang each once")
        period_ms = 1000 / self.frame_rate_hz
        for name in ("exposure_ms", "stamp_jitter_ms"):
            value_ms = getattr(self, name)
            if value_ms >= period_ms:
                raise ValueError(
                    f"{name} = {value_ms:g} must be shorter than the frame period, "
                    f"{float(period_ms):.4g} ms at frame_rate_hz"
                )
        return self
