"""What measuring a recording again came to, beside what the recording says."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path

from vdms_rt.wire import vdms_pb2 as pb

SAME_MM = 1e-9
"""What another machine's arithmetic may make of the same pixels."""


@dataclass(slots=True)
class Account:
    """What measuring again came to."""

    out: Path
    jobs: int
    changed: bool
    other_version: bool = False
    """The checkpoints are of a version from which this one cannot go on."""
    frames: int = 0
    recorded_s: float = 0.0
    """Time that the frames span in the recording."""
    took_s: float = 0.0
    samples: int = 0
    same: int = 0
    """Samples with the very bytes of the recording."""
    other: int = 0
    """Samples that the recording has, with other bytes."""
    status_other: int = 0
    """Of those, samples that are valid in only one of the two."""
    worst_mm: float = 0.0
    """Largest difference of a coordinate that is valid in both."""
    square_sum_mm2: float = 0.0
    compared: int = 0
    unknown: int = 0
    """Frames of which nothing says where measuring stood."""
    without_pixels: int = 0
    """Valid samples of the recording whose pixels it does not hold."""
    elsewhere: list[str] = field(default_factory=list)
    """What was otherwise where it was recorded."""
    damage: list[str] = field(default_factory=list)

    def sentences(self) -> list[str]:
        """Return what a person should know, a sentence each."""
        speed = self.recorded_s / self.took_s if self.took_s > 0 else math.nan
        told = [
            f"measured {self.frames} frames again in {self.took_s:.2f} s, {speed:.1f} x real time, "
            f"{self.jobs} process{'es' if self.jobs > 1 else ''}",
            self._agreement(),
        ]
        if self.other_version:
            told.append(
                "its checkpoints are of another version of vdms-rt; it was measured from its "
                "reference on"
            )
        if self.without_pixels:
            told.append(
                f"{self.without_pixels} valid samples of the recording have no pixels there, and "
                "are not in the new one"
            )
        if self.unknown:
            told.append(f"{self.unknown} frames come before the first checkpoint, and are left out")
        return [*told, *self.damage, f"written into {self.out}"]

    def _agreement(self) -> str:
        if self.changed:
            if not self.compared:
                return f"{self.samples} samples; the recording has none at the same times"
            rms_mm = math.sqrt(self.square_sum_mm2 / (2 * self.compared))
            return (
                f"{self.samples} samples; they differ from the recorded ones by "
                f"{1000 * rms_mm:.3f} um RMS, {1000 * self.worst_mm:.3f} um at most"
            )
        if not self.other:
            return f"{self.same} samples, all the same as recorded, bit for bit"
        where = "; ".join(self.elsewhere) or "on the same machine and with the same libraries"
        told = (
            f"{self.same} samples are the same as recorded, bit for bit, {self.other} differ by at "
            f"most {self.worst_mm:.2g} mm"
        )
        if self.status_other:
            told += f", {self.status_other} of them are valid in only one of the two"
        if self.worst_mm > SAME_MM or self.status_other:
            told += (
                f", which is more than the {SAME_MM:g} mm that another machine explains: pixels or "
                "checkpoints are missing, or the version of vdms-rt is another"
            )
        return f"{told} (recorded: {where})"

    def compare(self, recorded: bytes, again: bytes) -> None:
        """Count a sample that was measured again beside the recorded one; both are serialised."""
        if recorded == again:
            self.same += 1
            self.compared += 1
            return
        self.other += 1
        was, now = pb.Displacement.FromString(recorded), pb.Displacement.FromString(again)
        if was.valid != now.valid:
            self.status_other += 1
        if was.valid and now.valid:
            off_mm = (now.x_mm - was.x_mm, now.y_mm - was.y_mm)
            self.compared += 1
            self.square_sum_mm2 += off_mm[0] ** 2 + off_mm[1] ** 2
            self.worst_mm = max(self.worst_mm, *map(abs, off_mm))
