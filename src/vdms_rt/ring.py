"""Preallocated frames between capture and its reader: nothing is allocated for a frame."""

from __future__ import annotations

import queue
import threading
from collections import deque
from types import TracebackType

import numpy as np

from vdms_rt.model import Frame, Luma


class RingClosed(Exception):
    """No frame will ever come from this ring again."""


class Slot:
    """The memory of one frame, between `Ring.begin` and `Ring.commit` or `Ring.abandon`."""

    __slots__ = ("image", "view")

    def __init__(self, image: Luma) -> None:
        self.image = image
        self.view = image.view()
        """The same memory, read-only: what a Frame carries."""
        self.view.flags.writeable = False


class Lease:
    """A frame that stays as it is until `release`; also a context manager."""

    __slots__ = ("_ring", "_slot", "frame")

    def __init__(self, ring: Ring, slot: Slot, frame: Frame) -> None:
        self._ring = ring
        self._slot: Slot | None = slot
        self.frame = frame

    def release(self) -> None:
        """Give the slot back; may be called twice."""
        if self._slot is not None:
            slot, self._slot = self._slot, None
            self._ring._release(slot)

    def __enter__(self) -> Frame:
        return self.frame

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.release()


class Ring:
    """One writer, one or more readers; each frame goes to one of them, oldest first.

    Behind a live source `begin` never waits: without a free slot it takes the oldest frame that
    nobody has leased, and counts it in `overwritten`. Behind one that is not live it waits.
    """

    def __init__(self, slots: int, *, live: bool) -> None:
        self._free: deque[Slot] = deque()
        # Wakes its reader in two thirds of the time that a Condition takes. The None that `close`
        # puts behind the last frame stays in it.
        self._ready: queue.SimpleQueue[tuple[Slot, Frame] | None] = queue.SimpleQueue()
        self._leased = 0
        self._shape = (0, 0)
        self._changed = threading.Condition()
        self._closed = False
        self.live = live
        self.slots = slots
        self.overwritten = 0
        """Frames that no reader took in time."""

    def fit(self, height_px: int, width_px: int) -> None:
        """Make the slots of this size; called by the writer before it begins, and when a source
        comes back with pictures of another size. Frames already in the ring stay as they are."""
        with self._changed:
            if self._shape == (height_px, width_px):
                return
            self._shape = (height_px, width_px)
            # One slot beyond those promised, so that the writer has one even when all are leased.
            memory = np.zeros((self.slots + 1, height_px, width_px), np.uint8)
            self._free = deque(Slot(image) for image in memory)

    def begin(self, timeout_s: float) -> Slot | None:
        """Return a slot to write the next frame into, or None if none came free in time.

        Behind a live source None comes at once, and only when every slot is leased.
        Raises RingClosed after `close`.
        """
        with self._changed:
            if self._closed:
                raise RingClosed
            if not self.live:
                # The spare slot stays in reserve, so that used + writing never exceeds `slots`.
                self._changed.wait_for(lambda: len(self._free) > 1 or self._closed, timeout_s)
                if self._closed:
                    raise RingClosed
                return self._free.popleft() if len(self._free) > 1 else None
            if self._free:
                return self._free.popleft()
            if (oldest := self._oldest()) is not None:
                self.overwritten += 1
                if oldest.image.shape == self._shape:
                    return oldest
            return None

    def commit(self, slot: Slot, frame: Frame) -> None:
        """Hand the written frame to the readers; `frame.image` must be `slot.view`."""
        self._ready.put((slot, frame))

    def abandon(self, slot: Slot) -> None:
        """Give back a slot in which nothing was written."""
        with self._changed:
            self._free.append(slot)
            self._changed.notify_all()

    def take(self, timeout_s: float) -> Lease | None:
        """Return a lease of the oldest frame, or None if none came in time.

        Raises RingClosed once the ring is closed and the last frame was taken.
        """
        try:
            taken = self._ready.get(timeout=timeout_s)
        except queue.Empty:
            return None
        if taken is None:
            self._ready.put(None)  # for whoever takes next
            raise RingClosed
        with self._changed:
            self._leased += 1
        return Lease(self, *taken)

    def drop(self) -> None:
        """Give up the frames that no reader has taken yet, and count them as overwritten."""
        with self._changed:
            while (dropped := self._oldest()) is not None:
                self.overwritten += 1
                self._give_back(dropped)
            self._changed.notify_all()

    def close(self) -> None:
        """No more frames will be written; those in the ring can still be taken. For the writer."""
        with self._changed:
            if not self._closed:
                self._closed = True
                self._ready.put(None)
            self._changed.notify_all()

    @property
    def used(self) -> int:
        """Slots that hold a frame nobody has finished with."""
        return max(self._ready.qsize() - self._closed, 0) + self._leased

    def _release(self, slot: Slot) -> None:
        with self._changed:
            self._leased -= 1
            self._give_back(slot)
            self._changed.notify_all()

    def _oldest(self) -> Slot | None:
        """Take away the oldest frame and return its slot, or None if there is none."""
        try:
            oldest = self._ready.get_nowait()
        except queue.Empty:
            return None
        if oldest is None:
            self._ready.put(None)
            return None
        return oldest[0]

    def _give_back(self, slot: Slot) -> None:
        if slot.image.shape == self._shape:
            self._free.append(slot)
