import itertools
import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from vdms_rt.measure.regions import check_circles, check_regions, regions_around
from vdms_rt.model import Circle, CircleFlag, FoundMarker, MarkerShape, Region

SQUARE = MarkerShape("m1", ((-60.0, 60.0), (60.0, 60.0), (-60.0, -60.0), (60.0, -60.0)), 50.0)
GRID = MarkerShape("g", tuple((x, y) for y in (50.0, 0.0, -50.0) for x in (-50.0, 0.0, 50.0)), 20.0)


def seen(shape, angle_deg=0.0, roll=0.0, px_per_mm=1.418, aspect=1.1, centre=(360.0, 240.0)):
    """The marker from far away: circle outlines are sampled, nothing comes from the estimator."""
    angle, turn = math.radians(angle_deg), math.radians(roll)
    around = np.linspace(0, 2 * math.pi, 721)
    outline = shape.diameter_mm / 2 * np.column_stack((np.cos(around), np.sin(around)))

    def picture(points_mm):
        x, y = points_mm[:, 0] * math.cos(angle), points_mm[:, 1]
        across = x * math.cos(turn) - y * math.sin(turn)
        up = x * math.sin(turn) + y * math.cos(turn)
        return np.column_stack(
            (centre[0] + px_per_mm * aspect * across, centre[1] - px_per_mm * up)
        )

    boxes = [picture(outline + c) for c in shape.circles_mm]
    found = FoundMarker(
        shape.name,
        tuple(map(tuple, (b[:-1].mean(axis=0) for b in boxes))),
        tuple(map(tuple, (np.ptp(b, axis=0) / 2 for b in boxes))),
        contrast=170.0,
    )
    return found, picture


def holds(region, low, high):
    """Whether the box from low to high keeps clear of the region's outermost pixels."""
    return (
        region.x_px + 0.5 <= low[0]
        and region.y_px + 0.5 <= low[1]
        and high[0] <= region.x_px + region.width_px - 1.5
        and high[1] <= region.y_px + region.height_px - 1.5
    )


@pytest.mark.parametrize("angle", [0.0, 30.0, 60.0])
@pytest.mark.parametrize("fill", [0.65, 0.3])
def test_a_motion_of_10_mm_stays_inside_and_lets_nothing_else_in(angle, fill):
    px_per_mm = fill * 480 / 220
    found, picture = seen(SQUARE, angle, px_per_mm=px_per_mm)
    regions = regions_around(found, SQUARE, 720, 480)
    unit = picture(np.array([(0.0, 0.0), (1.0, 0.0)]))
    for shift_mm in (-10.0, 10.0):
        shift = (unit[1] - unit[0]) * shift_mm
        for i, region in enumerate(regions):
            for j, (centre, semi) in enumerate(
                zip(found.centres_px, found.semi_axes_px, strict=True)
            ):
                low, high = shift + centre - semi, shift + centre + semi
                if i == j:
                    assert holds(region, low, high)
                else:
                    box = Region(*np.floor(low).astype(int), *np.ceil(high - low).astype(int) + 1)
                    assert not overlap(region, box)


def overlap(a, b):
    return min(a.x_px + a.width_px, b.x_px + b.width_px) > max(a.x_px, b.x_px) and min(
        a.y_px + a.height_px, b.y_px + b.height_px
    ) > max(a.y_px, b.y_px)


def test_a_region_reaches_half_way_to_edge_and_neighbour():
    found, _ = seen(SQUARE, px_per_mm=1.0, aspect=1.0)
    top_left = regions_around(found, SQUARE, 720, 480)[0]
    # Centre (300, 180), radius 25, sheet's edge 50 away, neighbour's edge 95 away.
    assert top_left.x_px == pytest.approx(300 - 37.5, abs=1)
    assert top_left.y_px == pytest.approx(180 - 37.5, abs=1)
    assert top_left.x_px + top_left.width_px - 1 == pytest.approx(300 + 60, abs=1)
    assert top_left.y_px + top_left.height_px - 1 == pytest.approx(180 + 60, abs=1)


@settings(deadline=None)
@given(
    shape=st.sampled_from([SQUARE, GRID]),
    angle=st.floats(-60, 60),
    roll=st.floats(-44, 44),
    px_per_mm=st.floats(0.3, 2.0),
    aspect=st.floats(0.9, 1.2),
)
def test_regions_hold_their_circle_and_no_other(shape, angle, roll, px_per_mm, aspect):
    found, _ = seen(shape, angle, roll, px_per_mm, aspect, centre=(600.0, 450.0))
    # Smaller circles are not found, and their regions would be too small to use.
    assume(np.min(found.semi_axes_px) >= 4)
    # Boxes of turned ellipses that overlap cannot have rectangles of their own.
    boxes = [
        (np.subtract(c, s), np.add(c, s))
        for c, s in zip(found.centres_px, found.semi_axes_px, strict=True)
    ]
    for (low, high), (other_low, other_high) in itertools.combinations(boxes, 2):
        assume((np.maximum(low - other_high, other_low - high) > 4).any())
    regions = regions_around(found, shape, 1200, 900)
    assert check_regions(regions, 1200, 900) == []
    for a, b in itertools.combinations(regions, 2):
        assert not overlap(a, b)
    for region, (low, high) in zip(regions, boxes, strict=True):
        assert holds(region, low, high)


@pytest.mark.parametrize("roll", [0.0, 15.0])
def test_a_region_does_not_leave_the_sheet(roll):
    found, picture = seen(SQUARE, angle_deg=45.0, roll=roll)
    corners = picture(
        np.array([(-110.0, 110.0), (110.0, 110.0), (110.0, -110.0), (-110.0, -110.0)])
    )
    for r in regions_around(found, SQUARE, 720, 480):
        for x, y in itertools.product(
            (r.x_px, r.x_px + r.width_px - 1), (r.y_px, r.y_px + r.height_px - 1)
        ):
            sides = np.roll(corners, -1, axis=0) - corners
            to_point = np.array([x, y]) - corners
            turns = sides[:, 0] * to_point[:, 1] - sides[:, 1] * to_point[:, 0]
            assert (turns >= 0).all()


def test_regions_are_cut_to_the_picture():
    found, _ = seen(SQUARE, centre=(80.0, 70.0))
    regions = regions_around(found, SQUARE, 720, 480)
    assert regions[0].x_px == 0
    assert regions[0].y_px == 0
    assert not [s for s in check_regions(regions, 720, 480) if "outside" in s]


def test_good_regions_raise_no_complaint():
    found, _ = seen(SQUARE)
    assert check_regions(regions_around(found, SQUARE, 720, 480), 720, 480) == []


@pytest.mark.parametrize(
    ("region", "says"),
    [
        (
            Region(700, 10, 40, 40),
            "region 2 (700, 10, 40 x 40) reaches outside the picture of 720 x 480",
        ),
        (Region(10, 460, 40, 40), "reaches outside"),
        (Region(-1, 10, 40, 40), "reaches outside"),
        (Region(10, -3, 40, 40), "reaches outside"),
        (Region(10, 10, 7, 40), "too small"),
        (Region(10, 10, 40, 0), "too small"),
        (Region(210, 220, 100, 100), "regions 1 and 2 share 72% of the smaller one"),
        (Region(220, 220, 20, 20), "regions 1 and 2 share 100% of the smaller one"),
    ],
)
def test_a_wrong_region_is_told_in_one_sentence(region, says):
    faults = check_regions([Region(200, 200, 100, 100), region], 720, 480)
    assert len(faults) == 1
    assert says in faults[0]


def test_every_fault_is_told():
    faults = check_regions([Region(-5, 0, 4, 4), Region(-5, 0, 4, 4)], 720, 480)
    assert len(faults) == 5


def test_regions_that_touch_a_little_are_fine():
    assert check_regions([Region(0, 0, 100, 100), Region(90, 0, 100, 100)], 720, 480) == []


def test_two_regions_over_one_circle_are_told_by_what_was_measured():
    def circle(x, y):
        return Circle(x, y, math.pi * 25**2, 170.0, CircleFlag.NONE)

    assert check_circles([circle(100, 100), circle(160, 100), circle(100, 160)]) == []
    faults = check_circles([circle(100, 100), circle(160, 100), circle(101, 100)])
    assert faults == [
        "regions 1 and 3 lie over the same circle at (101, 100); "
        "give each circle a region of its own"
    ]
    lost = Circle(math.nan, math.nan, 0.0, 0.0, CircleFlag.LOST)
    assert check_circles([lost, lost]) == []
