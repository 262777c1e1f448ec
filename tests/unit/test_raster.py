"""The rows of a field pull a circle's centre; what is known of that follows it and its size."""

import numpy as np
import pytest

from tools.bench.picture import Bench, grabbed
from vdms_rt.measure.expect import Forecast, first_look
from vdms_rt.measure.gate import Workspace
from vdms_rt.measure.raster import raster
from vdms_rt.measure.smooth import Slow, first_slow, measure, study
from vdms_rt.measure.validity import learn

BENCH = Bench(distance_m=4.0, angle_deg=30.0)
NOISE_GREY = 0.7


@pytest.fixture(scope="module")
def learnt():
    rng, work, rest = np.random.default_rng(1), Workspace(), BENCH.still()
    found = first_look(tuple(map(tuple, BENCH.centres_px().tolist())), ((38.0, 42.0),) * 4)
    return learn(
        {
            offset: [
                study(grabbed(rest, 1.0, rng)[offset::2], offset, 2, found, first_slow(4), work)
                for _ in range(30)
            ]
            for offset in (0, 1)
        },
        2,
    )


@pytest.mark.parametrize("x_mm", [-10.0, -5.0, 0.0, 10.0])
@pytest.mark.parametrize("offset", [0, 1])
def test_a_field_is_as_true_as_a_frame_wherever_the_marker_goes(learnt, x_mm, offset):
    appearance, _ = learnt[offset]
    rng, work, clean = np.random.default_rng(2), Workspace(), BENCH.still(x_mm)
    expected = Forecast(appearance, BENCH.homography, 0.0).at((x_mm, 0.0, 0.0))
    slow = Slow(appearance.variance_grey2, appearance.edge_px, 1)
    centres = []
    for _ in range(8):
        image = grabbed(clean, NOISE_GREY, rng)[offset::2]
        readings, _ = measure(image, offset, 2, expected, slow, work)
        centres.append([(r.x_px, r.y_px) for r in readings])
    error = np.mean(centres, axis=0) - BENCH.centres_px(x_mm)
    # The rows pull by up to 0.03 px; at x = -10 a size taken as at rest leaves 0.005 of that.
    assert abs(error).max() < 0.0022


def test_the_fields_tell_how_strong_the_pull_is(learnt):
    (top, _), (bottom, _) = learnt[0], learnt[1]
    assert top.raster_scale == bottom.raster_scale
    assert 0.7 < top.raster_scale < 1.1
    apart = np.array(top.y_px) - np.array(bottom.y_px)
    pull = max(
        abs(raster(shape, edge, 2).y_px)
        for shape, edge in zip(top.moments_px2, top.edge_px, strict=True)
    )
    assert abs(apart).max() < 0.1 * pull
