"""Times and uncertainties from end to end on the virtual table; all is `tools.bench.sigma`."""

from __future__ import annotations

import numpy as np
import pytest

from tools.bench.film import Film, Way
from tools.bench.picture import Bench, grabbed
from tools.bench.sigma import (
    Case,
    coverage_table,
    eq_3_1_percent,
    inside_percent,
    line_over_floor,
    rms,
    run,
    still_table,
    time_table,
)
from tools.bench.stage import PERIOD_NS, Stage


def test_sigma_is_true_in_motion_and_from_the_start() -> None:
    runs = [
        run(Case(6.5, noise, angle, jitter, seed))
        for seed, (noise, angle, jitter) in enumerate(
            [(1, 0, 1), (2, 30, 5), (4, 60, 1), (2, 60, 5)], 1
        )
    ]
    error, sigma = (np.concatenate([getattr(r, f) for r in runs]) for f in ("error_mm", "sigma_mm"))
    assert len(error) > 600
    for n in range(2):
        assert inside_percent(error[:, n], sigma[:, n]) > 85
        assert 0.6 < rms(error[:, n] / sigma[:, n]) < 1.4
    time_error, sigma_t = (
        np.concatenate([getattr(r, f) for r in runs]) for f in ("time_error_ns", "sigma_t_ns")
    )
    assert 0.4 < rms(time_error / sigma_t) < 1.6
    assert all(r.counted == r.lost and r.wrong_index == 0 for r in runs)
    assert len(coverage_table(runs).rows) == 12


def test_the_first_picture_of_a_sudden_start_has_the_times_share() -> None:
    bench = Bench(distance_m=8.0, angle_deg=30.0)
    stage = Stage(bench, Film(bench, Way(6.0)), "smooth", "frame")
    rng = np.random.default_rng(1)
    stills = [grabbed(bench.still(), 2.0, rng) for _ in range(8)]
    n = 0
    while not stage.measuring:
        stage.show(n, stills[n % len(stills)])
        n += 1
    sigma_t_ns = 200_000
    (still,) = stage.show(n, stills[0], sigma_t_ns=sigma_t_ns)
    (start,) = stage.show(n + 1, grabbed(bench.still(5.0), 2.0, rng), sigma_t_ns=sigma_t_ns)
    assert still.valid
    assert start.valid
    assert start.x_mm == pytest.approx(5.0, abs=0.02)
    velocity_mm_s = 5.0 / (PERIOD_NS / 1e9)
    assert start.sigma_x_mm > 0.9 * velocity_mm_s * sigma_t_ns / 1e9
    assert still.sigma_x_mm < start.sigma_x_mm / 5


def test_times_and_what_they_cost() -> None:
    """Five seconds in; a minute is the bench."""
    record = run(Case(9.5, jitter_ms=5.0, seed=3))
    late = record.age_s > 5
    assert record.time_error_ns[late].std() < 100e3
    assert record.refit_error_ns.std() < 50e3
    assert record.counted == record.lost > 0
    assert eq_3_1_percent(record, late) < 0.08
    assert len(time_table([record], since_s=5.0).rows) == 1


@pytest.mark.parametrize("seed", [1, 2])
def test_the_line_of_a_still_marker_is_its_references_own_noise(seed: int) -> None:
    record = run(Case(8.5, seed=seed, motion="still"))
    assert len(record.seq) > 300
    # Of 60 stills each, the fields' references leave no more than their own noise of it.
    most = 1 + len(record.seq) / 120
    assert (line_over_floor(record) < 9 * most).all()
    assert len(still_table([record]).rows) == 2


def test_a_line_is_seen_where_there_is_one() -> None:
    record = run(Case(5.5, motion="still"))
    turns = np.where(record.seq % 2, -1.0, 1.0)
    record.error_mm[:, 0] += 0.001 * turns
    assert line_over_floor(record)[0] > 50
