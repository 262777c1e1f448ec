"""The process stage on the virtual table's pictures, without threads: its numbers and its flags."""

import numpy as np
import pytest
from table_run import PERIOD_NS, Measured, table

from vdms_rt.capture.table import TableSource
from vdms_rt.measure.gate import Workspace
from vdms_rt.measure.marker import find_markers
from vdms_rt.model import Frame, Scan, Status
from vdms_rt.process.pictures import pictures
from vdms_rt.process.progress import Plan
from vdms_rt.process.step import begin, found, step


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
