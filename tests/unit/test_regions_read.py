"""Regions grown over what was read."""

from vdms_rt.measure.regions import with_read
from vdms_rt.model import Region

REGIONS = (
    (Region(100, 100, 50, 40), Region(200, 100, 50, 40)),
    (Region(100, 300, 50, 40),),
)


def test_what_was_read_inside_changes_nothing() -> None:
    assert with_read(REGIONS, [(100, 100, 150, 140), (210, 110, 240, 130)]) == REGIONS
    assert with_read(REGIONS, []) == REGIONS


def test_the_nearest_region_grows_over_what_was_read() -> None:
    read = [(195, 90, 240, 130), (110, 305, 155, 345), (101, 102, 149, 139), (205, 120, 252, 141)]
    assert with_read(REGIONS, read) == (
        (Region(100, 100, 50, 40), Region(195, 90, 57, 51)),
        (Region(100, 300, 55, 45),),
    )


def test_without_regions_there_is_nothing_to_grow() -> None:
    assert with_read((), [(1, 2, 3, 4)]) == ()
