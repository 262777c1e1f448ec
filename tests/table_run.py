"""A run on the virtual table's pictures, without threads: search, reference, samples, truth."""

from collections import defaultdict

import numpy as np

from vdms_rt.capture.table import TableSource
from vdms_rt.config import Config, parse_config
from vdms_rt.measure.gate import Workspace
from vdms_rt.measure.marker import find_markers
from vdms_rt.model import Displacement, Frame, Scan, Truth
from vdms_rt.process.pictures import pictures
from vdms_rt.process.progress import Phase, Plan, Progress
from vdms_rt.process.step import begin, found, step
from vdms_rt.setup import SetUp

PERIOD_NS = 33_366_667


class Measured:
    """What came of a configuration's table: samples, truth and events by marker."""

    def __init__(
        self,
        config: Config,
        frames: int,
        *,
        claimed: Scan | None = None,
        known: bool = False,
        stored: SetUp | None = None,
    ) -> None:
        """`claimed` takes the place of the order that the source says; `known`: set by hand."""
        self.samples: dict[str, list[Displacement]] = defaultdict(list)
        self.truth: dict[tuple[str, int, Scan], Truth] = {}
        self.events: list[str] = []
        source = TableSource(config.table, [m.shape for m in config.marker], self._true)
        image = np.empty((source.info.height_px, source.info.width_px), np.uint8)
        scan = source.info.scan if claimed is None else claimed
        progress: Progress = begin(
            Plan.of(config), 1, image.shape[1], image.shape[0], stored=stored
        )
        work = Workspace()
        for n in range(frames):
            grab = source.read(image, 10)
            assert grab is not None
            t_ns = 10**9 + n * PERIOD_NS
            frame = Frame(
                n, grab.stamp_ns, t_ns, 0, 0, 0, PERIOD_NS, image, scan, grab.damage,
                source.info.exposure_ns or 0, known,
            )  # fmt: skip
            for picture in pictures(frame, config.process.sampling, progress.order):
                if progress.phase is Phase.SEARCHING:
                    seen = find_markers(image, progress.plan.shapes, scan)
                    progress, events = found(progress, seen, t_ns)
                    self.events += [e.code for e in events]
                progress, samples, events = step(progress, picture, work)
                self.events += [e.code for e in events]
                for sample in samples:
                    self.samples[sample.marker].append(sample)
        source.close()
        self.progress = progress

    def _true(self, truth: Truth) -> None:
        self.truth[truth.marker, truth.stamp_ns, truth.scan] = truth

    def errors_mm(self, marker: str = "m1") -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Errors of x, their sigmas, and the true x of the valid samples."""
        rows = []
        for s in self.samples[marker]:
            if s.valid:
                true_mm = self.truth[marker, s.stamp_ns, s.scan].mean_x_mm
                rows.append((s.x_mm - true_mm, s.sigma_x_mm, true_mm))
        error, sigma, true_x = np.array(rows).T
        assert len(rows) > 100
        return error, sigma, true_x


def table(text: str = "", extra: str = "") -> Config:
    return parse_config(
        'source = "table"\nsetup.reference_pictures = 30\n[table]\npace = "fast"\nrest_s = 1.2\n'
        f"{text}\n{extra}",
        "test",
    )
