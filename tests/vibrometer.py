"""A laser vibrometer beside the virtual table: its series at its own rate, by its own clock."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vdms_replay import read
from vdms_rt.capture.motion_path import MotionPath
from vdms_rt.config import Table
from vdms_rt.model import NTSC_FRAME_PERIOD_S


@dataclass(frozen=True)
class Vibrometer:
    """Its clock shows offset_s + (1 + ppm / 10^6) t at the recording's time t."""

    offset_s: float = 1.234
    ppm: float = 50.0
    noise_mm: float = 0.5e-3
    rate_hz: float = 6000.0
    seed: int = 5

    def watch(self, recording: Path) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return its times and readings in mm while a virtual table was recorded, from half a
        second before to half a second after."""
        found = read(recording)
        table = Table.model_validate_json(_section(found.about.config["table"]))
        seen = found.truth.iloc[0]
        exposure_s = table.exposure_ms / 1000
        start_s = seen["time_s"] + exposure_s / 2 - seen["frame"] * float(NTSC_FRAME_PERIOD_S)
        begin_s = found.truth["time_s"].iloc[0] - 0.5
        count = int((found.truth["time_s"].iloc[-1] + 0.5 - begin_s) * self.rate_hz)
        rate = 1 + self.ppm * 1e-6
        clock_s = self.offset_s + rate * begin_s + np.arange(count) / self.rate_hz
        time_s = (clock_s - self.offset_s) / rate
        x_mm = MotionPath(table.motion, table.rest_s).at(time_s - start_s)[:, 0]
        noise_mm = np.random.default_rng(self.seed).normal(0.0, self.noise_mm, count)
        return clock_s, x_mm + noise_mm

    def write_csv(self, recording: Path, path: Path) -> Path:
        """Write what it saw as time_s,x_mm and return the path."""
        rows = np.column_stack(self.watch(recording))
        np.savetxt(path, rows, "%.7f,%.6f", header="time_s,x_mm", comments="")
        return path


def _section(values: dict[str, object]) -> str:
    import json

    return json.dumps(values)
