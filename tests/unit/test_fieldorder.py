import math

import numpy as np
import pytest

from vdms_rt.measure.fieldorder import OrderEvidence, with_field
from vdms_rt.model import Scan

PERIOD_S = 1001 / 30000


def watched(
    order: Scan,
    amplitude_mm: float,
    frequency_hz: float,
    frames: int = 60,
    sigma_mm: float = 0.002,
    lost: frozenset[int] = frozenset(),
    seed: int = 1,
) -> OrderEvidence:
    rng = np.random.default_rng(seed)
    evidence = OrderEvidence()
    fields = (Scan.TOP, Scan.BOTTOM) if order is Scan.TOP_FIRST else (Scan.BOTTOM, Scan.TOP)
    for n in range(frames):
        for k, scan in enumerate(fields):
            if 2 * n + k in lost:
                continue
            t_s = (n + k / 2) * PERIOD_S
            x_mm = amplitude_mm * math.sin(2 * math.pi * frequency_hz * t_s)
            at = (x_mm + rng.normal(0, sigma_mm), 0.3 * x_mm + rng.normal(0, sigma_mm))
            evidence = with_field(evidence, n, scan, at, sigma_mm)
    return evidence


@pytest.mark.parametrize("order", [Scan.TOP_FIRST, Scan.BOTTOM_FIRST])
@pytest.mark.parametrize("frequency_hz", [0.5, 1, 2, 5, 8])
def test_motion_proves_the_order(order: Scan, frequency_hz: float) -> None:
    assert watched(order, 10, frequency_hz).order is order
    assert "10^" in watched(order, 10, frequency_hz).how_sure


def test_small_motion_takes_longer_and_is_still_right() -> None:
    for seed in range(20):
        assert watched(Scan.TOP_FIRST, 0.5, 1, frames=300, seed=seed).order is Scan.TOP_FIRST


def test_a_marker_at_rest_proves_nothing() -> None:
    for seed in range(50):
        assert watched(Scan.TOP_FIRST, 0, 1, frames=2000, seed=seed).order is None


def test_lost_fields_do_not_mislead() -> None:
    rng = np.random.default_rng(3)
    lost = frozenset(rng.choice(600, 60, replace=False).tolist())
    assert watched(Scan.BOTTOM_FIRST, 10, 1, 300, lost=lost).order is Scan.BOTTOM_FIRST


def test_a_device_that_changes_its_order_is_noticed() -> None:
    evidence = watched(Scan.TOP_FIRST, 10, 1, 300)
    for n in range(300, 600):
        for k, scan in enumerate((Scan.BOTTOM, Scan.TOP)):
            x_mm = 10 * math.sin(2 * math.pi * (n + k / 2) * PERIOD_S)
            evidence = with_field(evidence, n, scan, (x_mm, 0.0), 0.002)
    assert evidence.order is Scan.BOTTOM_FIRST
