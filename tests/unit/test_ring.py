import threading

import numpy as np
import pytest

from vdms_rt.model import Damage, Frame, Scan
from vdms_rt.ring import Lease, Ring, RingClosed


def ring_of(height_px: int, width_px: int, *, live: bool) -> Ring:
    ring = Ring(64, live=live)
    ring.fit(height_px, width_px)
    return ring


def write(ring: Ring, seq: int) -> bool:
    slot = ring.begin(0)
    if slot is None:
        return False
    slot.image[:] = seq % 251
    ring.commit(slot, frame(seq, slot.view))
    return True


def frame(seq: int, image: np.ndarray) -> Frame:
    return Frame(seq, 0, 0, 0, 0, 0, 1, image, Scan.PROGRESSIVE, Damage.NONE)


def take(ring: Ring) -> Lease:
    lease = ring.take(0)
    assert lease is not None
    return lease


def test_frames_come_out_in_order_and_whole() -> None:
    ring = ring_of(4, 6, live=True)
    for seq in range(200):
        assert write(ring, seq)
        with take(ring) as got:
            assert got.seq == seq
            assert (got.image == seq % 251).all()
    assert ring.overwritten == 0
    assert ring.used == 0


def test_a_live_ring_overwrites_the_oldest_unleased_frame_and_counts_it() -> None:
    ring = ring_of(2, 2, live=True)
    write(ring, 0)
    held = take(ring)
    for seq in range(1, 101):
        assert write(ring, seq)
    assert (held.frame.image == 0).all(), "a leased frame was overwritten"
    got = []
    while (lease := ring.take(0)) is not None:
        got.append(lease.frame.seq)
        assert (lease.frame.image == lease.frame.seq % 251).all()
        lease.release()
    assert got == list(range(101 - len(got), 101))
    assert ring.overwritten + len(got) == 100
    assert len(got) >= 63


def test_a_live_ring_with_everything_leased_refuses_instead_of_waiting() -> None:
    ring = ring_of(2, 2, live=True)
    leases = []
    for seq in range(65):
        assert write(ring, seq)
        leases.append(take(ring))
    assert ring.begin(60) is None
    leases[0].release()
    assert write(ring, 65)


def test_a_ring_that_is_not_live_waits_and_drops_nothing() -> None:
    ring = ring_of(2, 2, live=False)
    for seq in range(64):
        assert write(ring, seq)
    assert ring.begin(0.01) is None
    got: list[int] = []

    def read() -> None:
        while True:
            try:
                lease = ring.take(5)
            except RingClosed:
                return
            assert lease is not None
            got.append(lease.frame.seq)
            lease.release()

    reader = threading.Thread(target=read)
    reader.start()
    for seq in range(64, 1000):
        slot = ring.begin(5)
        assert slot is not None
        ring.commit(slot, frame(seq, slot.view))
    ring.close()
    reader.join()
    assert got == list(range(1000))
    assert ring.overwritten == 0


def test_a_closed_ring_gives_what_it_holds_and_then_ends() -> None:
    ring = ring_of(2, 2, live=True)
    write(ring, 7)
    ring.close()
    with pytest.raises(RingClosed):
        ring.begin(0)
    with take(ring) as got:
        assert got.seq == 7
    with pytest.raises(RingClosed):
        ring.take(0)


def test_closing_wakes_a_waiting_reader() -> None:
    ring = ring_of(2, 2, live=True)
    ended = threading.Event()

    def read() -> None:
        with pytest.raises(RingClosed):
            ring.take(60)
        ended.set()

    reader = threading.Thread(target=read)
    reader.start()
    ring.close()
    assert ended.wait(10)
    reader.join()


def test_every_reader_of_a_closed_ring_ends() -> None:
    ring = ring_of(2, 2, live=True)
    ended = threading.Semaphore(0)

    def read() -> None:
        with pytest.raises(RingClosed):
            ring.take(60)
        ended.release()

    readers = [threading.Thread(target=read) for _ in range(3)]
    for reader in readers:
        reader.start()
    ring.close()
    for reader in readers:
        assert ended.acquire(timeout=10)
        reader.join()


def test_a_closed_ring_ends_also_after_its_frames_were_dropped() -> None:
    ring = ring_of(2, 2, live=True)
    write(ring, 0)
    ring.close()
    assert ring.used == 1
    ring.drop()
    assert ring.used == 0
    with pytest.raises(RingClosed):
        ring.take(0)


def test_an_abandoned_slot_is_free_again() -> None:
    ring = ring_of(2, 2, live=False)
    for _ in range(1000):
        slot = ring.begin(0)
        assert slot is not None
        ring.abandon(slot)


def test_a_lease_released_twice_frees_one_slot() -> None:
    ring = ring_of(2, 2, live=True)
    write(ring, 0)
    lease = take(ring)
    lease.release()
    lease.release()
    assert ring.used == 0


def test_pictures_of_another_size_get_slots_of_their_own() -> None:
    ring = ring_of(4, 6, live=True)
    for seq in range(10):
        write(ring, seq)
    held = take(ring)
    ring.fit(8, 6)
    for seq in range(10, 200):
        slot = ring.begin(0)
        if slot is not None:
            assert slot.image.shape == (8, 6)
            ring.commit(slot, frame(seq, slot.view))
    assert held.frame.image.shape == (4, 6)
    held.release()
    assert write(ring, 200)


def test_a_reader_cannot_write_into_a_frame() -> None:
    ring = ring_of(2, 2, live=True)
    write(ring, 0)
    with take(ring) as got, pytest.raises(ValueError, match="read-only"):
        got.image[0, 0] = 1


def test_dropped_frames_are_counted_and_their_slots_are_free() -> None:
    ring = ring_of(2, 2, live=False)
    for seq in range(64):
        write(ring, seq)
    held = take(ring)
    ring.drop()
    assert ring.overwritten == 63
    assert ring.take(0) is None
    held.release()
    for seq in range(64):
        assert write(ring, seq)
