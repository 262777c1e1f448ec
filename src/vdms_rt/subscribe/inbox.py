"""What came and was not read yet."""

from __future__ import annotations

import math
import queue
import threading
import time
from collections.abc import Callable
from typing import TypeAlias

from vdms_rt.subscribe.samples import Arrived, Left, Raw

QUICK_S = 0.005
"""A callback that takes longer is called by a thread that keeps no other sample waiting."""
SIGNAL_S = 0.5
"""Python loses sight of a Ctrl-C that comes just before a wait until the wait ends."""

Incoming: TypeAlias = Raw | Arrived | Left


class Inbox:
    """Where the links put what comes; it never makes zenoh's threads wait.

    With `at_once`, a function, what comes is given to it in the thread that brings it, where that
    thread may be made to wait, nothing else waits or is being worked at, and the function was quick
    the last time: waking another thread first costs more than all the rest of reading a sample.
    Whoever takes items out of such an inbox must do it by `serve`.
    """

    def __init__(self, limit: int, at_once: Callable[[Incoming], None] | None = None) -> None:
        self.limit = limit
        self.at_once = at_once
        # Wakes its reader in two thirds of the time that a Condition takes.
        self._waiting: queue.SimpleQueue[Incoming | None] = queue.SimpleQueue()
        self._lock = threading.Lock()
        self._unserved = 0
        self._quick = True
        self._turn = threading.Lock()
        self._served_by = 0
        self.closed = False

    def put(self, item: Incoming, *, patient: bool = False) -> None:
        """Add it, or drop a message when `limit` items wait: the reader then finds the gap.

        `patient`: the calling thread may be made to wait for what `at_once` does.
        """
        if self.at_once is not None:
            with self._lock:
                self._unserved += 1
                now = patient and self._quick and self._unserved == 1
            if now:
                self._serve(item, self.at_once)
                return
        if self._waiting.qsize() < self.limit or not isinstance(item, Raw):
            self._waiting.put(item)
        elif self.at_once is not None:
            with self._lock:
                self._unserved -= 1

    def take(self, timeout_s: float | None) -> Incoming | None:
        """Return the oldest item, or None if none came in time or the inbox is closed."""
        until_s = math.inf if timeout_s is None else time.monotonic() + timeout_s
        while not self.closed:
            left_s = until_s - time.monotonic()
            try:
                item = self._waiting.get(timeout=max(0.0, min(left_s, SIGNAL_S)))
            except queue.Empty:
                if left_s <= SIGNAL_S:
                    return None
                continue
            if item is None or self.closed:
                self._waiting.put(None)  # for whoever else waits
                return None
            return item
        return None

    def serve(self) -> None:
        """Give `at_once` whatever could not be given to it as it came, until the end."""
        assert self.at_once is not None
        while (item := self.take(None)) is not None:
            self._serve(item, self.at_once)

    def close(self) -> None:
        """Let go whoever waits; nothing is given to `at_once` from now on."""
        self.closed = True
        self._waiting.put(None)

    @property
    def serving(self) -> bool:
        """The calling thread is inside `at_once`."""
        return self._served_by == threading.get_ident()

    def finish(self) -> None:
        """Wait, once closed, until `at_once` has returned."""
        with self._turn:
            pass

    def _serve(self, item: Incoming, at_once: Callable[[Incoming], None]) -> None:
        with self._turn:
            self._served_by = threading.get_ident()
            since_s = time.monotonic()
            try:
                if not self.closed:
                    at_once(item)
            except BaseException:
                self.close()
                raise
            finally:
                self._served_by = 0
                self._quick = time.monotonic() - since_s < QUICK_S
        with self._lock:
            self._unserved -= 1
