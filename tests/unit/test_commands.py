"""Commands between two frames, through the process stage on drawn pictures."""

import dataclasses
import threading
from collections import Counter
from concurrent.futures import Future

import numpy as np
import pytest
from lab_picture import Lab, View, picture

from vdms_rt.command import (
    Applied,
    Command,
    Find,
    Look,
    Refused,
    SetZero,
    Snapshot,
    TakeReference,
    UseAxis,
    UseOrder,
    UseRegions,
    UseSize,
)
from vdms_rt.config import Config, parse_config
from vdms_rt.find import Search
from vdms_rt.measure.marker import find_markers
from vdms_rt.model import Damage, Displacement, Event, Frame, Luma, Region, Scan, State, Status
from vdms_rt.process.commands import ZERO_SAMPLES
from vdms_rt.process.loop import Processor
from vdms_rt.ring import Ring
from vdms_rt.setup import SetUp

PERIOD_NS = 33_366_667
SMALL = "[setup]\nreference_pictures = 3\n"


class Told:
    """An outlet that keeps everything."""

    def __init__(self) -> None:
        self.samples: list[Displacement] = []
        self.set_ups: list[SetUp] = []
        self.events: list[Event] = []

    def displacement(self, sample: Displacement) -> None:
        self.samples.append(sample)

    def event(self, event: Event) -> None:
        self.events.append(event)

    def set_up(self, set_up: SetUp, image: Luma) -> None:
        self.set_ups.append(set_up)

    def pixels(self, frame: Frame, *details: object) -> None:
        """Nothing here looks at pixels."""

    def checkpoint(self, *details: object) -> None:
        """Nor at these."""

    def rehearse(self) -> None:
        """Only behind a live source."""


class Station:
    """The process stage, fed frames of a marker at a place, one after the other."""

    def __init__(self, text: str = SMALL, scan: Scan = Scan.PROGRESSIVE) -> None:
        self.told = Told()
        self.config: Config = parse_config(text, "test")
        self.ring = Ring(64, live=False)
        self.ring.fit(480, 720)
        self.search = Search([m.shape for m in self.config.marker])
        self.processor = Processor(
            self.config,
            42,
            None,
            self.ring,
            self.search,
            self.told,  # type: ignore[arg-type]
        )
        self.scan = scan
        self.seq = 0
        self.stop = threading.Event()
        self.lab = dataclasses.replace(Lab(), clutter=None)
        self.finder = threading.Thread(target=self.search.run, args=(self.stop,))
        self.finder.start()

    def close(self) -> None:
        self.stop.set()
        self.finder.join()

    def frame(self, x_mm: float = 0.0, y_mm: float = 0.0, views: tuple[View, ...] = ()) -> None:
        lab = dataclasses.replace(self.lab, seed=self.seq)
        image = picture(views or (View(),), lab, (x_mm, y_mm))
        t_ns = 10**9 + self.seq * PERIOD_NS
        frame = Frame(self.seq, t_ns, t_ns, 100, t_ns, 0, PERIOD_NS, image, self.scan, Damage.NONE)
        self.processor._measure(frame, self.stop)
        self.seq += 1

    def frames(self, count: int, x_mm: float = 0.0, y_mm: float = 0.0) -> list[Displacement]:
        before = len(self.told.samples)
        for _ in range(count):
            self.frame(x_mm, y_mm)
        return self.told.samples[before:]

    def measuring(self) -> None:
        self.frames(5)
        assert self.state is State.MEASURING

    def ask(self, command: Command, x_mm: float = 0.0) -> Applied | Snapshot:
        """Let a command be carried out before the next frame."""
        answer: Future[Applied | Snapshot] = self.processor.commands.submit(command)
        self.frame(x_mm)
        return answer.result(0)

    @property
    def state(self) -> State:
        return self.processor.counters.state

    @property
    def set_up(self) -> SetUp:
        return self.told.set_ups[-1]


@pytest.fixture
def station():
    stations = []

    def make(*arguments: object) -> Station:
        stations.append(Station(*arguments))  # type: ignore[arg-type]
        return stations[-1]

    yield make
    for one in stations:
        one.close()


def test_a_reference_is_taken_anew_from_the_first_picture_that_is_named(station) -> None:
    run = station()
    run.measuring()
    applied = run.ask(TakeReference(4), x_mm=3.0)
    assert applied.seq == run.seq - 1
    assert run.told.samples[-1].status & Status.SET_UP
    later = run.frames(6, x_mm=3.0)
    assert [bool(s.status & Status.SET_UP) for s in later] == [True] * 3 + [False] * 3
    assert later[-1].x_mm == pytest.approx(0, abs=0.02)
    assert run.set_up.revision == 2
    assert run.set_up.stills == 4


def test_the_zero_is_the_mean_of_a_resting_marker(station) -> None:
    run = station()
    run.measuring()
    run.frames(ZERO_SAMPLES + 5, x_mm=5.0, y_mm=-2.0)
    applied = run.ask(SetZero(), x_mm=5.0)
    assert applied.seq == run.seq - 1
    first = run.told.samples[-1]
    assert first.setup_revision == run.set_up.revision == 2
    assert first.y_mm == pytest.approx(2.0, abs=0.02)
    (moved,) = run.frames(1, x_mm=6.0, y_mm=-2.0)
    assert moved.x_mm == pytest.approx(1.0, abs=0.02)
    assert moved.y_mm == pytest.approx(0.0, abs=0.02)
    zero = run.set_up.markers[0].zero
    assert (zero.x_mm, zero.y_mm) == pytest.approx((5.0, -2.0), abs=0.01)


def test_zeros_add_up_along_a_turned_axis(station) -> None:
    run = station(SMALL + "[[marker]]\naxis_deg = 30\n")
    run.measuring()
    for x_mm in (4.0, 7.0):
        run.frames(ZERO_SAMPLES + 5, x_mm=x_mm)
        run.ask(SetZero("m1"), x_mm=x_mm)
        at_zero = run.told.samples[-1]
        assert (at_zero.x_mm, at_zero.y_mm) == pytest.approx((0, 0), abs=0.02)
    assert run.set_up.markers[0].zero.x_mm == pytest.approx(7.0, abs=0.01)
    assert run.set_up.markers[0].zero.y_mm == pytest.approx(0.0, abs=0.01)
    run.ask(UseAxis("m1", 90.0), x_mm=7.0)
    (moved,) = run.frames(1, x_mm=8.0)
    assert (moved.x_mm, moved.y_mm) == pytest.approx((0.0, -1.0), abs=0.02)


def test_a_moving_marker_has_no_zero(station) -> None:
    run = station()
    run.measuring()
    for n in range(ZERO_SAMPLES):
        run.frame(0.02 * n)
    with pytest.raises(Refused, match=r"m1 moves: 1\.\d+ mm peak to peak") as refused:
        run.ask(SetZero())
    assert refused.value.code == "moving"
    assert len(run.told.set_ups) == 1


def test_a_zero_needs_samples_of_the_set_up_in_force(station) -> None:
    run = station()
    with pytest.raises(Refused, match="nothing is measured yet: ") as refused:
        run.ask(SetZero())
    assert refused.value.code == "not-measuring"
    run.measuring()
    with pytest.raises(Refused, match=r"only \d+ of the last 60") as refused:
        run.ask(SetZero())
    assert refused.value.code == "few-samples"


def test_an_axis_turns_x_and_is_in_the_set_up(station) -> None:
    run = station()
    run.measuring()
    run.ask(UseAxis("m1", 90.0), x_mm=2.0)
    sample = run.told.samples[-1]
    assert (sample.x_mm, sample.y_mm) == pytest.approx((0, -2), abs=0.02)
    assert run.set_up.markers[0].axis_deg == 90.0
    assert sample.setup_revision == run.set_up.revision == 2
    run.ask(TakeReference())
    run.frames(5)
    assert run.set_up.revision == 3
    assert run.set_up.markers[0].axis_deg == 90.0


def test_find_looks_in_the_whole_picture_again(station) -> None:
    run = station()
    run.measuring()
    run.told.events.clear()
    run.ask(Find())
    run.frames(6)
    assert Counter(e.code for e in run.told.events) == {"marker-found": 1, "reference": 1}
    assert run.state is State.MEASURING
    assert run.set_up.revision == 2


def test_regions_that_are_given_are_kept(station) -> None:
    run = station()
    run.measuring()
    regions = tuple(
        dataclasses.replace(r, width_px=r.width_px - 6, height_px=r.height_px - 4, x_px=r.x_px + 3)
        for r in run.set_up.markers[0].regions
    )
    run.ask(UseRegions("m1", regions))
    run.frames(4)
    assert run.set_up.markers[0].regions == regions
    assert run.state is State.MEASURING


@pytest.mark.parametrize(
    ("regions", "why"),
    [
        ((Region(10, 10, 50, 50),) * 3, "has 4 circles, 3 regions came"),
        ((Region(10, 10, 50, 50),) * 4, "regions 1 and 2 share 100%"),
        (
            tuple(Region(700, 100 * n, 50, 50) for n in range(4)),
            "reaches outside the picture of 720 x 480",
        ),
    ],
)
def test_regions_that_cannot_be_are_refused(station, regions, why: str) -> None:
    run = station()
    run.measuring()
    with pytest.raises(Refused, match=why):
        run.ask(UseRegions("m1", regions))
    assert run.told.samples[-1].valid


def test_the_size_of_the_print_scales_what_comes(station) -> None:
    run = station()
    run.measuring()
    twice = tuple((2 * x, 2 * y) for x, y in run.config.marker[0].shape.circles_mm)
    run.ask(UseSize("m1", twice, 2 * run.config.marker[0].diameter_mm))
    run.frames(4)
    (moved,) = run.frames(1, x_mm=3.0)
    assert moved.x_mm == pytest.approx(6.0, abs=0.03)
    assert run.set_up.markers[0].shape.circles_mm == twice
    # The search looks for that size, too.
    run.ask(Find())
    run.frames(6)
    assert run.state is State.MEASURING
    assert run.set_up.markers[0].shape.circles_mm == twice


def test_an_order_of_fields_is_used_from_the_next_frame_on(station) -> None:
    run = station(SMALL, Scan.TOP_FIRST)
    run.measuring()
    assert [s.scan for s in run.told.samples[-2:]] == [Scan.TOP, Scan.BOTTOM]
    applied = run.ask(UseOrder(Scan.BOTTOM_FIRST))
    last = run.told.samples[-2:]
    assert [s.scan for s in last] == [Scan.BOTTOM, Scan.TOP]
    assert [s.seq for s in last] == [applied.seq, applied.seq + 1]
    assert not last[0].status & Status.FIELD_ORDER_UNCONFIRMED
    assert run.set_up.scan is Scan.BOTTOM_FIRST
    run.ask(UseOrder(None))
    last = run.told.samples[-2:]
    assert [s.scan for s in last] == [Scan.TOP, Scan.BOTTOM]
    assert last[0].status & Status.FIELD_ORDER_UNCONFIRMED


def test_whole_frames_have_no_order(station) -> None:
    run = station()
    run.measuring()
    with pytest.raises(Refused, match="whole frames are measured"):
        run.ask(UseOrder(Scan.TOP_FIRST))


def test_a_snapshot_shows_the_frame_with_its_samples(station) -> None:
    run = station(SMALL, Scan.BOTTOM_FIRST)
    run.measuring()
    shot = run.ask(Look(), x_mm=1.0)
    assert isinstance(shot, Snapshot)
    assert shot.samples == tuple(run.told.samples[-1:])
    assert shot.seq == run.told.samples[-1].seq
    assert shot.state is State.MEASURING
    assert len(shot.regions[0]) == 4
    (found,) = find_markers(shot.image, [run.config.marker[0].shape], shot.scan)
    for (x_px, y_px), region in zip(found.centres_px, shot.regions[0], strict=True):
        assert abs(region.x_px + region.width_px / 2 - x_px) < region.width_px / 4
        assert abs(region.y_px + region.height_px / 2 - y_px) < region.height_px / 4


def test_a_snapshot_keeps_nothing_of_the_ring(station) -> None:
    run = station()
    run.measuring()
    slot = run.ring.begin(1.0)
    assert slot is not None
    slot.image[:] = 7
    answer = run.processor.commands.submit(Look())
    t_ns = 10**9 + run.seq * PERIOD_NS
    frame = Frame(run.seq, t_ns, t_ns, 100, t_ns, 0, PERIOD_NS, slot.view, run.scan, Damage.NONE)
    run.processor._measure(frame, run.stop)
    slot.image[:] = 9
    assert np.all(answer.result(0).image == 7)


def test_what_nobody_waits_for_any_more_is_not_done(station) -> None:
    run = station()
    run.measuring()
    answer = run.processor.commands.submit(TakeReference())
    assert answer.cancel()
    assert run.frames(1)[0].valid


def test_a_marker_that_is_not_here_is_refused(station) -> None:
    run = station()
    run.measuring()
    for command in (SetZero("m9"), UseAxis("m9", 1.0), UseRegions("m9", ())):
        with pytest.raises(Refused, match='there is no marker "m9" here; there is m1'):
            run.ask(command)


def test_a_reference_without_a_marker_is_refused(station) -> None:
    run = station()
    run.lab = dataclasses.replace(run.lab)
    answer = run.processor.commands.submit(TakeReference())
    run.frame(views=(View(at_px=(-900.0, 240.0)),))
    with pytest.raises(Refused, match="no marker is found yet"):
        answer.result(0)


def test_a_stored_set_up_gets_the_axes_of_the_configuration(station) -> None:
    run = station()
    run.measuring()
    turned = parse_config(SMALL + "[[marker]]\naxis_deg = 45\n", "test")
    told = Told()
    again = Processor(
        turned,
        43,
        run.set_up,
        run.ring,
        run.search,
        told,  # type: ignore[arg-type]
    )
    run.processor, run.told = again, told
    run.frame()
    assert told.set_ups[0].markers[0].axis_deg == 45
    assert told.set_ups[0].revision == 2
