from __future__ import annotations

import math
import re

from hypothesis import given
from hypothesis import strategies as st

from vdms_rt.watch.plot import plot, scale

DOTS = ((0x01, 0x08), (0x02, 0x10), (0x04, 0x20), (0x40, 0x80))


def dots(lines: list[str]) -> set[tuple[int, int]]:
    """Return (column, row) of every dot of a plot."""
    return {
        (2 * column + x, 4 * row + y)
        for row, line in enumerate(lines[:-1])
        for column, character in enumerate(re.split("[┤│]", line)[1])
        for y in range(4)
        for x in range(2)
        if ord(character) - 0x2800 & DOTS[y][x]
    }


def label_rows(lines: list[str]) -> dict[float, int]:
    return {float(line.split("┤")[0]): row for row, line in enumerate(lines) if "┤" in line}


@given(
    st.lists(
        st.tuples(
            st.floats(0, 20),
            st.one_of(st.floats(-1e5, 1e5), st.just(math.nan)),
        ),
        max_size=40,
    ).map(sorted),
    st.integers(24, 120),
    st.integers(3, 30),
)
def test_it_has_the_size_that_was_asked_for(
    points: list[tuple[float, float]], width: int, height: int
) -> None:
    lines = plot(points, width, height, 10.0)
    assert len(lines) == height
    assert {len(line) for line in lines} == {width}


@given(st.lists(st.floats(-1e5, 1e5)), st.integers(2, 4))
def test_the_scale_holds_every_value_and_is_round(values_mm: list[float], ticks: int) -> None:
    low_mm, high_mm, step_mm = scale([*values_mm, math.nan], ticks)
    tolerance_mm = 1e-7 * max(1.0, *(abs(v) for v in values_mm), step_mm)
    assert all(low_mm - tolerance_mm <= v <= high_mm + tolerance_mm for v in values_mm)
    assert high_mm - low_mm >= 0.02 - 1e-9
    mantissa = step_mm / 10.0 ** math.floor(math.log10(step_mm) + 1e-9)
    assert min(abs(mantissa - m) for m in (1, 2, 5)) < 1e-6
    inside = math.floor(high_mm / step_mm + 1e-9) - math.ceil(low_mm / step_mm - 1e-9) + 1
    assert inside >= ticks


def test_points_and_labels_are_where_the_scale_says() -> None:
    points = [(100 + i / 30, 8.0 * math.sin(i / 30)) for i in range(301)]
    lines = plot(points, 100, 21, 10.0)
    low_mm, high_mm, _ = scale([mm for _, mm in points], 4)

    def row(mm: float) -> float:
        return (high_mm - mm) / (high_mm - low_mm) * 79

    seen = dots(lines)
    for t_s, mm in points[1:]:
        column = min(int((t_s - 100) / 10 * 180), 179)
        assert min(abs(row(mm) - y) for x, y in seen if x == column) <= 0.5
    assert set(label_rows(lines)) == set(range(-8, 9, 2))
    for mm, line in label_rows(lines).items():
        assert 4 * line - 0.5 <= row(mm) <= 4 * line + 3.5


def test_the_newest_is_at_the_right_and_what_is_older_than_the_span_is_not_shown() -> None:
    lines = plot([(0.0, 5.0), (100.0, 1.0), (109.8, 1.0), (110.0, 1.0)], 40, 9, 10.0)
    assert {x for x, _ in dots(lines)} == {58, 59}
    assert len({y for _, y in dots(lines)}) == 1


def test_points_are_joined_but_not_over_gaps() -> None:
    steady = plot([(9.0, -1.0), (9.4, 1.0)], 60, 9, 10.0)
    assert len({y for _, y in dots(steady)}) > 10
    for broken in ([(9.0, -1.0), (9.6, 1.0)], [(9.0, -1.0), (9.2, math.nan), (9.4, 1.0)]):
        assert len(dots(plot(broken, 60, 9, 10.0))) == 2


def test_the_axes_read_well() -> None:
    points = [(i / 30, 10 * math.sin(i / 5)) for i in range(300)]
    lines = plot(points, 60, 10, 10.0)
    assert label_rows(lines) == {10.0: 0, 0.0: 4, -10.0: 8}
    assert lines[0].startswith("     +10 ┤")
    assert lines[4].startswith("       0 ┤")
    assert lines[-1].startswith("         └-10 s")
    assert "-5 s" in lines[-1]
    assert lines[-1].endswith("now")


def test_a_still_marker_does_not_fill_the_plot_with_its_noise() -> None:
    lines = plot([(i / 30, 0.001 * math.sin(i)) for i in range(300)], 60, 10, 10.0)
    rows = {y for _, y in dots(lines)}
    assert max(rows) - min(rows) <= 5


def test_without_a_point_there_are_axes() -> None:
    lines = plot([], 40, 6, 10.0)
    assert dots(lines) == set()
    assert 0.0 in label_rows(lines)
