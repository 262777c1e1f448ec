"""The real process stage, with one marker before it, as the benches use it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from tools.bench.film import Film
from tools.bench.picture import Bench
from vdms_rt.config import parse_config
from vdms_rt.measure.gate import Workspace
from vdms_rt.model import Damage, Displacement, Frame, Scan
from vdms_rt.process.pictures import pictures
from vdms_rt.process.progress import Phase, Plan
from vdms_rt.process.step import begin, step

PERIOD_NS = 33_366_667
STILLS = 60
REGION_PX = 10.0
"""Of a region beyond what its circle reaches, where the neighbours leave so much."""


class Stage:
    """One run of the process stage. Its regions are drawn by hand: each around all that its circle
    reaches, half way to the neighbours at most."""

    def __init__(
        self,
        bench: Bench,
        film: Film,
        method: str,
        sampling: str,
        axis_deg: float = 0.0,
        exposure_s: float = 0.0,
    ) -> None:
        circles = [[float(x), float(y)] for x, y in bench.circles_mm]
        regions = [list(r) for r in regions_px(film.extent_px, bench.width_px, bench.height_px)]
        config = parse_config(
            f"[[marker]]\ncircles_mm = {circles}\ndiameter_mm = {2 * bench.radius_mm}\n"
            f'find = "regions"\nregions_px = {regions}\naxis_deg = {axis_deg}\n'
            f"[setup]\nreference_pictures = {STILLS}\n"
            f'[process]\nmethod = "{method}"\nsampling = "{sampling}"',
            "bench",
        )
        self.progress = begin(Plan.of(config), 1, bench.width_px, bench.height_px)
        self.sampling = sampling
        self._exposure_ns = round(exposure_s * 1e9)
        self._work = Workspace()

    @property
    def measuring(self) -> bool:
        return self.progress.phase is Phase.MEASURING

    def show(
        self, n: int, image: NDArray[np.uint8], late_ns: int = 0, sigma_t_ns: int = 0
    ) -> list[Displacement]:
        """Return the samples of frame `n`, whose time is off by `late_ns`."""
        t_ns = frame_ns(n) + late_ns
        frame = Frame(
            seq=n,
            stamp_ns=t_ns,
            t_ns=t_ns,
            sigma_t_ns=sigma_t_ns,
            utc_ns=0,
            segment=0,
            period_ns=PERIOD_NS,
            image=image,
            scan=Scan.PROGRESSIVE if self.sampling == "frame" else Scan.BOTTOM_FIRST,
            damage=Damage.NONE,
            exposure_ns=self._exposure_ns,
            order_known=True,
        )
        samples = []
        for picture in pictures(frame, self.sampling):
            self.progress, (sample,), _ = step(self.progress, picture, self._work)
            samples.append(sample)
        return samples


def frame_ns(n: int) -> int:
    """Return the middle of frame n."""
    return 10**9 + n * PERIOD_NS


def field_offsets_s(sampling: str) -> tuple[float, ...]:
    """Return when the pictures of a frame are exposed, from its middle; the bottom field first."""
    quarter_s = PERIOD_NS / 4e9
    return (0.0,) if sampling == "frame" else (-quarter_s, quarter_s)


def flagged(sample: Displacement) -> bool:
    """Return whether a sample or one of its circles says that something is wrong."""
    return bool(sample.status) or any(c.flags for c in sample.circles)


def regions_px(
    extents_px: NDArray[np.float64], width_px: int, height_px: int
) -> Sequence[tuple[int, int, int, int]]:
    """Return left, top, width and height of the regions around `extents_px`, (4, 4)."""
    regions = []
    for i, own in enumerate(extents_px):
        room = np.full(4, REGION_PX)
        for j, other in enumerate(extents_px):
            gaps = np.array(
                [own[0] - other[2], own[1] - other[3], other[0] - own[2], other[1] - own[3]]
            )
            side = int(np.argmax(gaps))
            if i != j:
                room[side] = min(room[side], gaps[side] / 2)
        left, top = np.maximum(np.ceil(own[:2] - room[:2]), 0).astype(int).tolist()
        right, bottom = np.floor(own[2:] + room[2:]).astype(int).tolist()
        right, bottom = min(right, width_px - 1), min(bottom, height_px - 1)
        regions.append((left, top, right - left + 1, bottom - top + 1))
    return regions
