"""The pure step, on pictures drawn by code that shares nothing with it."""

import dataclasses
import math

import numpy as np
import pytest
from lab_picture import SQUARE, Lab, View, picture

from vdms_rt.config import Config, parse_config
from vdms_rt.measure.gate import Workspace
from vdms_rt.measure.marker import find_markers
from vdms_rt.model import ConfigError, Damage, Frame, Luma, Scan, State, Status
from vdms_rt.process.pictures import pictures
from vdms_rt.process.progress import Plan, Progress
from vdms_rt.process.step import begin, found, step

PERIOD_NS = 33_366_667


def frame(
    seq: int, image: Luma, scan: Scan = Scan.PROGRESSIVE, damage: Damage = Damage.NONE
) -> Frame:
    t_ns = 10**9 + seq * PERIOD_NS
    return Frame(seq, t_ns + 5, t_ns, 100, t_ns + 10**18, 0, PERIOD_NS, image, scan, damage)


class Run:
    """A run that is fed pictures of a marker at given positions."""

    def __init__(self, config: Config | None = None, **lab: object) -> None:
        config = config or parse_config("[setup]\nreference_pictures = 5", "test")
        self.lab = dataclasses.replace(Lab(), clutter=None, **lab)
        self.progress = begin(Plan.of(config), 42, 720, 480, 0, None)
        self.seq = 0
        self.work = Workspace()
        self.events: list[str] = []

    def image(
        self, x_mm: float = 0.0, y_mm: float = 0.0, views: tuple[View, ...] = (View(),)
    ) -> Luma:
        lab = dataclasses.replace(self.lab, seed=self.seq)
        return picture(views, lab, (x_mm, y_mm))

    def feed(self, image: Luma, damage: Damage = Damage.NONE):
        (only,) = pictures(frame(self.seq, image, damage=damage), "frame")
        if self.progress.regions == ():
            self.progress, events = found(
                self.progress, find_markers(image, self.progress.plan.shapes, only.scan), only.t_ns
            )
            self.events += [e.code for e in events]
        self.progress, samples, events = step(self.progress, only, self.work)
        self.events += [e.code for e in events]
        self.seq += 1
        assert len(samples) == len(self.progress.plan.shapes)
        return samples[0]

    def reference(self) -> "Run":
        for _ in range(5):
            sample = self.feed(self.image())
            assert sample.status & Status.SET_UP
        assert self.progress.state is State.MEASURING
        return self


def test_from_nothing_to_millimetres() -> None:
    run = Run().reference()
    assert run.events == ["marker-found", "reference"]
    for x_mm, y_mm in [(0, 0), (5, 0), (0, 3), (-7.3, 1.1)]:
        sample = run.feed(run.image(x_mm, y_mm))
        assert sample.valid
        assert sample.status is Status.OK
        assert sample.x_mm == pytest.approx(x_mm, abs=0.06)
        assert sample.y_mm == pytest.approx(y_mm, abs=0.06)
        assert abs(sample.rotation_mrad) < 0.5
        assert sample.residual_mm < 0.06
        assert sample.setup_revision == 1
        assert len(sample.circles) == 4


def test_a_sample_carries_its_picture() -> None:
    run = Run().reference()
    sample = run.feed(run.image())
    t_ns = 10**9 + 5 * PERIOD_NS
    assert (sample.session, sample.marker, sample.seq, sample.frame_seq) == (42, "m1", 5, 5)
    assert (sample.stamp_ns, sample.t_ns, sample.utc_ns) == (t_ns + 5, t_ns, t_ns + 10**18)


def test_the_same_picture_gives_the_same_numbers() -> None:
    run = Run().reference()
    (only,) = pictures(frame(9, run.image(3.0)), "frame")
    _, first, _ = step(run.progress, only, Workspace())
    _, second, _ = step(run.progress, only, Workspace())
    assert first == second


def test_a_damaged_picture_is_never_measured() -> None:
    run = Run().reference()
    sample = run.feed(run.image(), Damage.SHORT)
    assert sample.status == Status.DAMAGED
    assert math.isnan(sample.x_mm)
    assert run.feed(run.image()).valid


def test_a_covered_marker_is_a_sample_without_a_position() -> None:
    run = Run().reference()
    sample = run.feed(np.full((480, 720), 40, np.uint8))
    assert sample.status & Status.NOT_FOUND
    assert not sample.valid
    assert math.isnan(sample.x_mm)
    assert run.feed(run.image(2.0)).x_mm == pytest.approx(2.0, abs=0.06)


@pytest.mark.parametrize("grey", [0, 255])
def test_a_picture_of_one_grey_has_no_position(grey: int) -> None:
    run = Run().reference()
    sample = run.feed(np.full((480, 720), grey, np.uint8))
    assert sample.status & Status.NOT_FOUND
    assert math.isnan(sample.x_mm)


def test_one_covered_circle_leaves_a_flagged_position() -> None:
    run = Run().reference()
    image = run.image(4.0)
    box = run.progress.regions[0][1]
    image[box.y_px : box.y_px + box.height_px, box.x_px : box.x_px + box.width_px] = 30
    sample = run.feed(image)
    assert sample.status & Status.FEWER_CIRCLES
    assert sample.valid
    assert sample.x_mm == pytest.approx(4.0, abs=0.08)


def test_a_moving_marker_gets_no_reference() -> None:
    run = Run()
    for n in range(12):
        sample = run.feed(run.image(2.0 * math.sin(n / 2)))
        assert sample.status & Status.SET_UP
    assert run.progress.state is State.WAITING_FOR_STILL
    assert run.events.count("waiting-for-still") == 1
    for _ in range(5):
        run.feed(run.image(1.0))
    assert run.progress.state is State.MEASURING
    assert run.feed(run.image(1.0)).x_mm == pytest.approx(0.0, abs=0.06)


def test_one_picture_is_the_papers_reference() -> None:
    run = Run(parse_config("[setup]\nreference_pictures = 1", "test"))
    run.feed(run.image())
    assert run.progress.state is State.MEASURING
    assert run.progress.set_up is not None
    assert run.progress.set_up.stills == 1


def test_two_markers_each_give_a_sample() -> None:
    config = parse_config(
        '[setup]\nreference_pictures = 2\n[[marker]]\nname = "left"\n[[marker]]\nname = "right"',
        "test",
    )
    small = dataclasses.replace(SQUARE, name="left")
    views = tuple(
        View(shape=dataclasses.replace(small, name=name), px_per_mm=0.9, at_px=(x, 240))
        for name, x in (("left", 180.0), ("right", 540.0))
    )
    run = Run(config)
    for n in range(5):
        (only,) = pictures(frame(n, run.image(0, 0, views)), "frame")
        run.feed(only.image)
    (only,) = pictures(frame(9, run.image(1.5, 0, views)), "frame")
    _, samples, _ = step(run.progress, only, Workspace())
    assert [s.marker for s in samples] == ["left", "right"]
    for sample in samples:
        assert sample.x_mm == pytest.approx(1.5, abs=0.08)


def test_regions_of_the_configuration_are_used_and_checked() -> None:
    text = '[[marker]]\nfind = "regions"\nregions_px = [[{}, 10, 120, 120], [10, 10, 90, 90], '
    text += "[10, 200, 90, 90], [300, 200, 90, 90]]"
    with pytest.raises(ConfigError, match=r"region 1 .* outside"):
        begin(Plan.of(parse_config(text.format(700), "test")), 1, 720, 480, 0, None)
    good = parse_config(text.format(300), "test")
    progress = begin(Plan.of(good), 1, 720, 480, 0, None)
    assert progress.state is State.REFERENCE
    assert progress.regions == (good.marker[0].regions,)


def test_a_stored_set_up_holds_or_is_stale() -> None:
    first = Run().reference()
    stored = first.progress.set_up

    def again(shift_mm: float) -> Progress:
        run = Run()
        run.progress = begin(run.progress.plan, 43, 720, 480, 0, stored)
        assert run.progress.state is State.CHECKING
        for _ in range(5):
            assert run.feed(run.image(shift_mm)).status & Status.SET_UP
        sample = run.feed(run.image(shift_mm))
        assert sample.setup_revision == 1
        assert sample.valid == (run.progress.state is State.MEASURING)
        assert bool(sample.status & Status.SET_UP_STALE) != sample.valid
        return run.progress

    assert again(0.0).state is State.MEASURING
    assert again(2.0).state is State.SET_UP_STALE


@pytest.mark.parametrize(
    ("scan", "order"),
    [(Scan.TOP_FIRST, (Scan.TOP, Scan.BOTTOM)), (Scan.BOTTOM_FIRST, (Scan.BOTTOM, Scan.TOP))],
)
def test_fields_are_views_in_the_order_of_exposure(scan: Scan, order: tuple[Scan, Scan]) -> None:
    image = np.arange(480 * 720, dtype=np.uint32).astype(np.uint8).reshape(480, 720)
    whole = frame(7, image, scan)
    first, second = pictures(whole, "field")
    assert (first.scan, second.scan) == order
    assert (first.seq, second.seq) == (14, 15)
    assert first.t_ns + second.t_ns == 2 * whole.t_ns
    assert second.t_ns - first.t_ns == pytest.approx(PERIOD_NS / 2, abs=2)
    for field in (first, second):
        assert field.image.base is not None
        assert (field.image == image[field.row_offset :: 2]).all()
        assert field.row_offset == (field.scan is Scan.BOTTOM)
        assert field.utc_ns - field.t_ns == whole.utc_ns - whole.t_ns
    (as_frame,) = pictures(whole, "frame")
    assert (as_frame.seq, as_frame.t_ns, as_frame.row_step) == (7, whole.t_ns, 1)


def test_two_regions_over_one_circle_are_a_configuration_error() -> None:
    found_ones = Run().reference().progress.regions[0]
    boxes = [[r.x_px, r.y_px, r.width_px, r.height_px] for r in found_ones]
    boxes[3] = [boxes[2][0] + 1, boxes[2][1], boxes[2][2], boxes[2][3]]
    config = parse_config(
        f'[[marker]]\nfind = "regions"\nregions_px = {boxes}\n[setup]\nreference_pictures = 5',
        "test",
    )
    with pytest.raises(ConfigError, match="regions 3 and 4"):
        Run(config).reference()
