"""The virtual shaking table: laboratory, camera and grabber in one, with the truth beside it."""

from __future__ import annotations

import math
import statistics
import time
from collections import deque
from collections.abc import Callable, Sequence
from fractions import Fraction
from typing import NamedTuple, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from vdms_rt.capture.motion_path import MotionPath, gauss_legendre
from vdms_rt.capture.scene import Pose, Scene
from vdms_rt.config import Table
from vdms_rt.model import (
    Grab,
    Luma,
    MarkerShape,
    Scan,
    SourceEnded,
    SourceInfo,
    StampEvent,
    Truth,
)

Floats: TypeAlias = NDArray[np.float64]

BUFFERS = 32
"""Frames that wait for a late reader, as many as V4L2 can hold (VIDEO_MAX_FRAME); the driver loses
those after them."""
_SCANS = {
    "progressive": Scan.PROGRESSIVE,
    "top-first": Scan.TOP_FIRST,
    "bottom-first": Scan.BOTTOM_FIRST,
}


class Exposure(NamedTuple):
    """When some rows of a frame collect their light, in seconds since the table's start."""

    scan: Scan
    first_row: int
    row_step: int
    begin_s: float
    end_s: float

    @property
    def middle_s(self) -> float:
        return (self.begin_s + self.end_s) / 2


class TableSource:
    """A `Source` that renders what a camera before a shaking table would deliver.

    Frame n is read out from start + n T' on, T' being the frame period by the computer's clock,
    field k of an interlaced one from start + (n + k/2) T' on, and its exposure ends as its readout
    begins. The driver stamps the end of the frame, late by its jitter. Picture n, its jitter and
    its loss depend on the configuration and n alone.
    """

    def __init__(
        self, config: Table, shapes: Sequence[MarkerShape], on_truth: Callable[[Truth], None]
    ) -> None:
        """Raises SourceError for a record or a geometry that cannot be."""
        self._config = config
        self._on_truth = on_truth
        self._path = MotionPath(config.motion, config.rest_s)
        self._scene = Scene(config, shapes, self._path.reach_mm)
        self._scan = _SCANS[config.scan]
        fast = Fraction(config.clock_error_ppm) / 10**6
        self._period_ns: Fraction = (1 - fast) * 10**9 / config.frame_rate_hz
        self._start_ns = 0
        self._next_index = 0
        self._waiting: deque[int] = deque()
        self._delivered = 0
        self._rendered: tuple[int, list[Exposure]] | None = None
        self._frame: Luma = np.zeros((config.height_px, config.width_px), np.uint8)
        self._noise_of_bits = _normal_quantiles() * np.float32(config.noise_grey)

    @property
    def info(self) -> SourceInfo:
        c = self._config
        return SourceInfo(
            kind="table",
            name="virtual shaking table",
            width_px=c.width_px,
            height_px=c.height_px,
            frame_period_s=1 / c.frame_rate_hz,
            scan=self._scan,
            live=c.pace == "realtime",
            stamp_event=StampEvent.END_OF_FRAME,
            sequence_counts_lost=c.sequence_counts_lost,
            scan_known=not self._scan.interlaced,
            exposure_ns=round(c.exposure_ms * 1e6),
            facts=(
                ("distance_m", f"{c.distance_m:g}"),
                ("angle_deg", f"{c.angle_deg:g}"),
                ("px_per_mm", f"{self._scene.camera.scale:.4g}"),
                ("motion", c.motion.kind),
                ("sheets", ", ".join(sheet.marker for sheet in c.sheet)),
            ),
        )

    def read(self, out: Luma, timeout_s: float) -> Grab | None:
        deadline_ns = time.monotonic_ns() + round(timeout_s * 1e9)
        if not self._start_ns:
            self._start_ns = time.monotonic_ns()
        if self._config.frames and self._delivered >= self._config.frames:
            raise SourceEnded(
                f"the virtual table has given its {self._delivered} frames of table.frames"
            )
        index = self._oldest()
        if self._rendered is None or self._rendered[0] != index:
            self._rendered = (index, self._render(index))
        stamp_ns = self._stamp_ns(index)
        if self._config.pace == "realtime":
            wait_ns = min(stamp_ns, deadline_ns) - time.monotonic_ns()
            if wait_ns > 0:
                time.sleep(wait_ns / 1e9)
            if time.monotonic_ns() < stamp_ns:
                return None
        np.copyto(out, self._frame)
        exposures = self._rendered[1]
        self._rendered = None
        self._waiting.popleft()
        sequence = index if self._config.sequence_counts_lost else self._delivered
        self._delivered += 1
        self._tell(index, stamp_ns, exposures)
        return Grab(stamp_ns=stamp_ns, sequence=sequence, scan=self._scan)

    def close(self) -> None:
        """The table holds nothing that needs giving back."""

    def _oldest(self) -> int:
        """Return the frame to deliver next, after the driver has filled its buffers till now."""
        late = self._config.pace == "realtime"
        now_ns = time.monotonic_ns()
        while not self._waiting or (late and self._end_ns(self._next_index) <= now_ns):
            if len(self._waiting) == BUFFERS:
                self._next_index = math.ceil((now_ns - self._start_ns) / self._period_ns) - 1
                break
            if self._luck(self._next_index)[0] >= self._config.lost_frames:
                self._waiting.append(self._next_index)
            self._next_index += 1
        return self._waiting[0]

    def _end_ns(self, index: int) -> int:
        return self._start_ns + round((index + 1) * self._period_ns)

    def _stamp_ns(self, index: int) -> int:
        late_ms = self._luck(index)[1] * self._config.stamp_jitter_ms
        return self._end_ns(index) + round(late_ms * 1e6)

    def _luck(self, index: int) -> tuple[float, float]:
        """Return two random numbers in 0..1: does frame `index` arrive, and how late."""
        first, second = _random(self._config.seed, 0, index).random_raw(2)
        return float(first) / 2**64, float(second) / 2**64

    def _exposures(self, index: int) -> list[Exposure]:
        exposure_s = self._config.exposure_ms / 1000
        period_s = float(self._period_ns) / 1e9
        first_s = float(index * self._period_ns) / 1e9
        if not self._scan.interlaced:
            return [Exposure(Scan.PROGRESSIVE, 0, 1, first_s - exposure_s, first_s)]
        order = (Scan.TOP, Scan.BOTTOM)
        if self._scan is Scan.BOTTOM_FIRST:
            order = (Scan.BOTTOM, Scan.TOP)
        return [
            Exposure(scan, int(scan is Scan.BOTTOM), 2, end_s - exposure_s, end_s)
            for scan, end_s in zip(order, (first_s, first_s + period_s / 2), strict=True)
        ]

    def _render(self, index: int) -> list[Exposure]:
        exposures = self._exposures(index)
        for exposure in exposures:
            self._scene.render(self._poses(exposure), exposure.first_row, exposure.row_step)
        if self._config.noise_grey > 0:
            noise = cv2.LUT(self._bits(index), self._noise_of_bits)
            cv2.add(self._scene.picture, noise, dst=self._frame, dtype=cv2.CV_8U)
        else:
            self._frame[:] = np.clip(np.rint(self._scene.picture), 0, 255)
        return exposures

    def _bits(self, index: int) -> NDArray[np.uint16]:
        """Return 16 random bits for each pixel."""
        words = _random(self._config.seed, 1, index).random_raw(-(-self._frame.size // 4))
        return words.view(np.uint16)[: self._frame.size].reshape(self._frame.shape)

    def _poses(self, exposure: Exposure) -> list[Pose]:
        """Return the moments whose weighted sum stands for the exposure (Gauss-Legendre)."""
        count = 1
        if exposure.end_s > exposure.begin_s:
            span_s = np.linspace(exposure.begin_s, exposure.end_s, 9)
            steps_mm = np.diff(self._path.at(span_s) + self._shake_mm(span_s), axis=0)
            count = self._scene.moments(float(np.abs(steps_mm).sum()))
        nodes, weights = gauss_legendre(count)
        times_s = exposure.middle_s + (exposure.end_s - exposure.begin_s) / 2 * nodes
        at_mm, shake_mm = self._path.at(times_s), self._shake_mm(times_s)
        return [
            Pose(float(w), (float(a[0]), float(a[1])), (float(s[0]), float(s[1])))
            for w, a, s in zip(weights, at_mm, shake_mm, strict=True)
        ]

    def _shake_mm(self, times_s: Floats) -> Floats:
        """Return how far the plane's zero seems to move because the camera does, (n, 2)."""
        cycles = self._config.shake_hz * np.maximum(times_s - self._config.rest_s, 0.0)
        along = np.stack([np.sin(2 * np.pi * cycles), 0.5 * np.sin(3 * np.pi * cycles)], axis=1)
        return np.asarray(self._config.shake_mm * along)

    def _tell(self, index: int, stamp_ns: int, exposures: list[Exposure]) -> None:
        middles = [e.middle_s for e in exposures]
        at_mm = self._path.at(np.array(middles))
        mean_mm = np.array([self._path.mean(e.begin_s, e.end_s) for e in exposures])
        scans = [e.scan for e in exposures]
        if self._scan.interlaced:
            scans.append(self._scan)
            middles.append(sum(middles) / 2)
            at_mm = np.vstack([at_mm, at_mm.mean(axis=0)])
            mean_mm = np.vstack([mean_mm, mean_mm.mean(axis=0)])
        for sheet in self._config.sheet:
            for scan, middle_s, at, mean in zip(scans, middles, at_mm, mean_mm, strict=True):
                self._on_truth(
                    Truth(
                        marker=sheet.marker,
                        frame=index,
                        scan=scan,
                        stamp_ns=stamp_ns,
                        t_ns=self._start_ns + round(middle_s * 1e9),
                        x_mm=float(at[0]) * sheet.moves,
                        y_mm=float(at[1]) * sheet.moves,
                        rotation_mrad=0.0,
                        mean_x_mm=float(mean[0]) * sheet.moves,
                        mean_y_mm=float(mean[1]) * sheet.moves,
                    )
                )


def _random(seed: int, purpose: int, index: int) -> np.random.SFC64:
    return np.random.SFC64(np.random.SeedSequence(seed, spawn_key=(purpose, index)))


def _normal_quantiles() -> NDArray[np.float32]:
    """Return what turns 16 even bits into the normal distribution, to 4.2 standard deviations,
    (65536,); its own standard deviation is 1."""
    inverse = statistics.NormalDist().inv_cdf
    values = np.array([inverse((n + 0.5) / 65536) for n in range(65536)])
    return np.asarray(values / values.std(), dtype=np.float32)
