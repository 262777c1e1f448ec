"""The process stage on the virtual table's pictures, without threads: its numbers and its flags."""

from collections import defaultdict

import numpy as np
import pytest

from vdms_rt.capture.table import TableSource
from vdms_rt.config import Config, parse_config
from vdms_rt.measure.gate import Workspace
from vdms_rt.measure.marker import find_markers
from vdms_rt.model import Displacement, Frame, Scan, Status, Truth
from vdms_rt.process.pictures import pictures
from vdms_rt.process.progress import Phase, Plan, Progress
from vdms_rt.process.step import begin, found, step

PERIOD_NS = 33_366_667


class Measured:
    """What came of a configuration's table: samples, truth and events by marker."""

    def __init__(
        self, config: Config, frames: int, *, claimed: Scan | None = None, known: bool = False
    ) -> None:
        """`claimed` takes the place of the order that the source says; `known`: set by hand."""
        self.samples: dict[str, list[Displacement]] = defaultdict(list)
        self.truth: dict[tuple[str, int, Scan], Truth] = {}
        self.events: list[str] = []
        source = TableSource(config.table, [m.shape for m in config.marker], self._true)
        image = np.empty((source.info.height_px, source.info.width_px), np.uint8)
        scan = source.info.scan if claimed is None else claimed
        progress: Progress = begin(Plan.of(config), 1, image.shape[1], image.shape[0])
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
        f'source = "table"\n[table]\npace = "fast"\nrest_s = 1.2\n{text}\n{extra}', "test"
    )


@pytest.mark.parametrize("angle_deg", [0, 60])
def test_fields_reach_the_noise_and_know_it(angle_deg: int) -> None:
    measured = Measured(table(f"angle_deg = {angle_deg}"), 160)
    error, sigma, true_x = measured.errors_mm()
    # Eq. 3.1: the bound for a field at this angle is 0.0146 % times sqrt 2 at the worst.
    assert np.std(error) / np.std(true_x) < 0.0003
    assert 0.9 < np.mean(np.abs(error) <= 2 * sigma) <= 1.0
    assert measured.events == ["marker-found", "reference", "field-order"]
    flagged = [s for s in measured.samples["m1"] if any(c.flags for c in s.circles)]
    assert len(flagged) <= 1


def test_the_order_that_the_driver_claims_is_corrected_by_motion() -> None:
    measured = Measured(table(), 160, claimed=Scan.TOP_FIRST)
    assert measured.progress.order is Scan.BOTTOM_FIRST
    assert measured.progress.set_up is not None
    assert measured.progress.set_up.order_proved
    last = measured.samples["m1"][-60:]
    assert not any(s.status for s in last)
    assert [s.scan for s in last[:2]] == [Scan.BOTTOM, Scan.TOP]
    unconfirmed = [s for s in measured.samples["m1"] if s.status & Status.FIELD_ORDER_UNCONFIRMED]
    assert unconfirmed


def test_an_order_that_was_set_wrong_is_noticed() -> None:
    measured = Measured(table(), 160, claimed=Scan.TOP_FIRST, known=True)
    assert "field-order-wrong" in measured.events
    last = measured.samples["m1"][-60:]
    assert all(s.status & Status.FIELD_ORDER_WRONG and not s.valid for s in last)


def test_a_fixed_marker_takes_the_cameras_shake_off() -> None:
    markers = """
[[table.sheet]]
marker = "m1"
[[table.sheet]]
marker = "ground"
at_mm = [180.0, 0.0]
moves = false
[[marker]]
name = "m1"
[[marker]]
name = "ground"
spacing_mm = 60.0
diameter_mm = 25.0
"""
    shake = "fill = 0.5\nshake_mm = 3.0"
    shaken = Measured(table(shake, markers), 160)
    error, _, true_x = shaken.errors_mm()
    assert np.std(error) / np.std(true_x) > 0.1
    steadied = Measured(table(shake, markers + "fixed = true\n"), 160)
    error, sigma, true_x = steadied.errors_mm()
    assert np.std(error) / np.std(true_x) < 0.001
    assert np.std(error) < 1.5 * np.mean(sigma)
    assert max(abs(s.x_mm) for s in steadied.samples["ground"] if s.valid) > 1


@pytest.mark.parametrize(
    ("method", "bend", "amplitude_mm", "gain"), [("otsu", 0.05, 10, 1.5), ("smooth", 0.01, 30, 5)]
)
def test_the_lens_of_the_configuration_is_taken_out(
    method: str, bend: float, amplitude_mm: float, gain: float
) -> None:
    bent = f"scan = 'progressive'\ndistortion = {-bend}\n"
    rest = f"[table.motion]\namplitude_mm = {amplitude_mm}\n[process]\nmethod = '{method}'\n"
    error, _, true_x = Measured(table(bent, rest), 160).errors_mm()
    before = np.std(error) / np.std(true_x)
    error, _, true_x = Measured(table(bent, rest + f"[lens]\nk1 = {-bend}\n"), 160).errors_mm()
    assert np.std(error) / np.std(true_x) < before / gain


def test_a_marker_that_was_covered_and_moved_is_found_again() -> None:
    config = table("scan = 'progressive'")
    source = TableSource(config.table, [m.shape for m in config.marker], lambda truth: None)
    image = np.empty((480, 720), np.uint8)
    progress = begin(Plan.of(config), 1, 720, 480)
    work = Workspace()
    statuses = []
    for n in range(100):
        source.read(image, 10)
        shown = image if not 45 <= n < 65 else np.full_like(image, 60)
        if n >= 65:
            shown = np.roll(image, 60, axis=1)
        t_ns = 10**9 + n * PERIOD_NS
        frame = Frame(n, t_ns, t_ns, 0, 0, 0, PERIOD_NS, shown, Scan.PROGRESSIVE, 0)
        (picture,) = pictures(frame, "auto")
        if progress.searched:
            progress, _ = found(
                progress, find_markers(shown, progress.plan.shapes, frame.scan), t_ns
            )
        progress, (sample,), _ = step(progress, picture, work)
        statuses.append(sample.status)
    source.close()
    assert all(s & Status.NOT_FOUND for s in statuses[45:65])
    assert Status.RELOCATED in [s & Status.RELOCATED for s in statuses[65:70]]
    assert statuses[-20:] == [Status.OK] * 20
