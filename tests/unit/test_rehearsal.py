"""What the process thread does while it waits for a frame."""

import threading
from collections.abc import Iterator

import pytest

from vdms_rt.config import parse_config
from vdms_rt.find import Search
from vdms_rt.model import Damage, Event, Frame, Scan
from vdms_rt.outlet import Outlet
from vdms_rt.process.loop import Processor
from vdms_rt.ring import Ring

PERIOD_NS = 50_000_000


class Told(Outlet):
    """Notes each rehearsal."""

    def __init__(self) -> None:
        super().__init__("lab", ("m1",), 1, live=True, patches="none")
        self.rehearsed = threading.Semaphore(0)
        self.events: list[Event] = []

    def rehearse(self) -> None:
        super().rehearse()
        self.rehearsed.release()


@pytest.fixture
def told() -> Told:
    return Told()


@pytest.fixture
def ring(request: pytest.FixtureRequest, told: Told) -> Iterator[Ring]:
    """A ring with a process thread behind it that sees no marker."""
    config = parse_config("", "test")
    ring = Ring(8, live=request.param)
    ring.fit(480, 720)
    processor = Processor(config, 1, None, ring, Search([m.shape for m in config.marker]), told)
    stop = threading.Event()
    thread = threading.Thread(target=processor.run, args=(stop,))
    thread.start()
    yield ring
    stop.set()
    ring.close()
    thread.join(5)
    assert not thread.is_alive()


def give(ring: Ring, seq: int) -> None:
    slot = ring.begin(1)
    assert slot is not None
    at_ns = seq * PERIOD_NS
    frame = Frame(seq, at_ns, at_ns, 0, 0, 0, PERIOD_NS, slot.view, Scan.PROGRESSIVE, Damage.NONE)
    ring.commit(slot, frame)


@pytest.mark.parametrize("ring", [True], indirect=True)
def test_it_rehearses_once_before_a_live_frame_is_due(ring: Ring, told: Told) -> None:
    assert not told.rehearsed.acquire(timeout=0.3)
    for seq in range(3):
        give(ring, seq)
        assert told.rehearsed.acquire(timeout=10)
    # However late the next one is.
    assert not told.rehearsed.acquire(timeout=0.3)
    give(ring, 3)
    assert told.rehearsed.acquire(timeout=10)


@pytest.mark.parametrize("ring", [False], indirect=True)
def test_what_waits_for_no_clock_is_not_rehearsed(ring: Ring, told: Told) -> None:
    give(ring, 0)
    assert not told.rehearsed.acquire(timeout=0.3)
