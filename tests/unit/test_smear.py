"""What an exposure does to a moving circle, on pictures that share no code with what measures."""

import itertools

import numpy as np
import pytest

from tools.bench.picture import Bench, grabbed
from vdms_rt.measure.expect import Forecast, first_look
from vdms_rt.measure.gate import Workspace
from vdms_rt.measure.smear import smear
from vdms_rt.measure.smooth import CircleReading, Slow, first_slow, measure, study
from vdms_rt.measure.validity import judge, learn

EXPOSURE_S = 1 / 59.94
BENCH = Bench(distance_m=8.0, angle_deg=30.0)
NODES, WEIGHTS = (v / 2 for v in np.polynomial.legendre.leggauss(12))


def exposed(x_mm: float, velocity: float, acceleration: float, bench: Bench = BENCH) -> np.ndarray:
    """The mean picture of a marker on a parabola through x_mm in the middle of the exposure."""
    t = NODES * EXPOSURE_S
    places = x_mm + velocity * t + acceleration * t * t / 2
    return sum(w * bench.still(float(x)) for x, w in zip(places, WEIGHTS, strict=True))


def learnt_of(bench: Bench):
    rng = np.random.default_rng(1)
    rest, work = bench.still(), Workspace()
    half = (44 * np.cos(np.radians(bench.angle_deg)), 42.0)
    found = first_look(tuple(map(tuple, bench.centres_px().tolist())), (half,) * 4)
    stills = [study(grabbed(rest, 0.5, rng), 0, 1, found, first_slow(4), work) for _ in range(12)]
    return learn({0: stills}, 1)[0]


@pytest.fixture(scope="module")
def learnt():
    return learnt_of(BENCH)


@pytest.mark.parametrize("smeared", [False, True])
@pytest.mark.parametrize(
    ("velocity", "acceleration"), [(314.0, 0.0), (222.0, -6979.0), (-120.0, -9100.0), (0.0, 9870.0)]
)
def test_the_centre_is_that_of_the_mean_over_the_exposure(learnt, velocity, acceleration, smeared):
    appearance, limits = learnt
    rng, work = np.random.default_rng(2), Workspace()
    clean = exposed(2.0, velocity, acceleration)
    mean_mm = 2.0 + acceleration * EXPOSURE_S**2 / 24
    forecast = Forecast(appearance, BENCH.homography, EXPOSURE_S)
    expected = forecast.at((2.0, 0, 0), (velocity, 0, 0), (acceleration, 0, 0), smeared=smeared)
    slow = Slow(appearance.variance_grey2, appearance.edge_px, 1)
    centres, flags = [], []
    for _ in range(6):
        readings, _ = measure(grabbed(clean, 0.5, rng), 0, 1, expected, slow, work)
        flags += judge(readings, expected, limits, 0.5, BENCH.width_px, BENCH.height_px)
        centres.append(
            [
                (r.x_px + x, r.y_px + y)
                for r, (x, y) in zip(readings, expected.shift_px, strict=True)
            ]
        )
    error = np.mean(centres, axis=0) - BENCH.centres_px(mean_mm)
    # The mean lies 0.18 px beyond the middle at 9870 mm/s^2, and the weights missed a quarter.
    assert abs(error[:, 0].mean()) < 0.0015
    assert abs(error[:, 0]).max() < 0.003
    assert not any(flags)


@pytest.mark.parametrize(
    ("velocity", "acceleration"), [(314.0, 0.0), (-314.0, 0.0), (222.0, -6979.0)]
)
def test_a_long_way_seen_at_a_slant(velocity, acceleration):
    """The ellipse is narrow along its way, and the way's far half looks shorter: 0.0014 px here."""
    bench = Bench(distance_m=4.0, angle_deg=60.0)
    appearance, _ = learnt_of(bench)
    rng, work = np.random.default_rng(2), Workspace()
    clean = exposed(2.0, velocity, acceleration, bench)
    forecast = Forecast(appearance, bench.homography, EXPOSURE_S)
    expected = forecast.at((2.0, 0, 0), (velocity, 0, 0), (acceleration, 0, 0))
    assert expected.smeared
    slow = Slow(appearance.variance_grey2, appearance.edge_px, 1)
    centres = []
    for _ in range(30):
        readings, _ = measure(grabbed(clean, 0.5, rng), 0, 1, expected, slow, work)
        centres.append(
            [(r.x_px + x, r.y_px) for r, (x, _) in zip(readings, expected.shift_px, strict=True)]
        )
    error = np.mean(centres, axis=0) - bench.centres_px(2.0 + acceleration * EXPOSURE_S**2 / 24)
    assert abs(error[:, 0].mean()) < 0.0004


def test_the_tables_begin_at_rest_and_end_where_light_leads():
    for smeared in (False, True):
        rest = smear(0.0, smeared)
        assert rest.missing_along == pytest.approx(0, abs=0.01)
        assert rest.noise_along == pytest.approx(1.19 if smeared else 1.0, abs=0.02)
        ways = [smear(w, smeared) for w in np.linspace(0.5, 20, 14)]
        for first, second in itertools.pairwise(ways):
            assert second.missing_along > first.missing_along
            assert second.moment_along > first.moment_along
            assert second.noise_along > first.noise_along
    # A short way adds 1/12 of its square to the light, and half of that to the weighed edge.
    assert smear(1.0, smeared=False).moment_along == pytest.approx(1 / 24, rel=0.05)
    assert smear(8.0, smeared=True).missing_along < smear(8.0, smeared=False).missing_along / 3
    # A line across the way has nothing but the straight edge's; one along it has almost nothing.
    ellipses = [smear(4.0, False, aspect).missing_along for aspect in (0.25, 0.5, 1.0, 2.0, 4.0)]
    assert ellipses == sorted(ellipses)
    assert ellipses[0] * 1.5 < ellipses[2]
    assert ellipses[2] * 1.15 < ellipses[4]


def test_a_gate_that_does_not_reach_its_circle_gives_none(learnt):
    appearance, limits = learnt
    work = Workspace()
    forecast = Forecast(appearance, BENCH.homography, 0.0)
    image = grabbed(BENCH.still(0.0), 1.0, np.random.default_rng(3))
    slow = Slow(appearance.variance_grey2, appearance.edge_px, 1)

    def seen(off_mm: float) -> tuple[list[CircleReading], list]:
        expected = forecast.at((off_mm, 0.0, 0.0))
        readings, _ = measure(image, 0, 1, expected, slow, work)
        return readings, judge(readings, expected, limits, 1.0, BENCH.width_px, BENCH.height_px)

    near, _ = seen(15.0)
    truth = BENCH.centres_px()
    assert max(abs(r.x_px - x) for r, (x, _) in zip(near, truth, strict=True)) < 0.02
    for off_mm in (40.0, 55.0, 70.0):
        readings, flags = seen(off_mm)
        for reading, flag in zip(readings, flags, strict=True):
            on = min(np.hypot(*(truth - (reading.x_px, reading.y_px)).T))
            assert flag or on < 0.05


@pytest.mark.parametrize("angle_deg", [0.0, 60.0])
def test_a_disc_of_12_px_looks_the_same_wherever_it_lies_between_the_pixels(angle_deg):
    bench = Bench(distance_m=8.0, angle_deg=angle_deg, fill=12 / 480 * 200 / 50)
    rng, work = np.random.default_rng(4), Workspace()
    rest = bench.still()
    centres = tuple(map(tuple, bench.centres_px().tolist()))
    half = (6.6 * np.cos(np.radians(angle_deg)), 6.0)
    stills = [
        study(grabbed(rest, 1.0, rng), 0, 1, first_look(centres, (half,) * 4), first_slow(4), work)
        for _ in range(20)
    ]
    appearance, limits = learn({0: stills}, 1)[0]
    forecast = Forecast(appearance, bench.homography, 0.0)
    slow = Slow(appearance.variance_grey2, appearance.edge_px, 1)
    flagged = 0
    for x_mm in np.linspace(0, 9, 25).tolist():
        expected = forecast.at((x_mm, 0.0, 0.0))
        readings, _ = measure(grabbed(bench.still(x_mm), 1.0, rng), 0, 1, expected, slow, work)
        flags = judge(readings, expected, limits, 1.0, bench.width_px, bench.height_px)
        flagged += sum(bool(flag) for flag in flags)
    assert flagged <= 1
