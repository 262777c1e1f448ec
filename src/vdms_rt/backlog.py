"""The bounded queue before the log: what waits for the record thread, and exactly what was lost."""

from __future__ import annotations

import threading
from collections import deque

from vdms_rt.logfile.writer import LogAttachment, LogMessage
from vdms_rt.wire import topics
from vdms_rt.wire import vdms_pb2 as pb
from vdms_rt.wire.topics import Topic

WAIT_S = 30.0
"""The longest that `put` waits for room behind a source that is not live."""
BATCH_MESSAGES = 256
LIMIT_BYTES = 256 << 20
PIXELS_SHARE = 0.75
"""Of the limits: what pixels may fill, so that they are lost before a displacement is."""
RESERVE_MESSAGES = 64
"""Beyond the limit, for the rare messages that explain a file: events and set-ups."""
RANGES_TOLD = 20
SPARED = (topics.PIXELS, topics.CHECKPOINT)
"""What is left out when the disk has little room."""


class Backlog:
    """Messages on their way to the record thread. Any thread may call any method."""

    def __init__(self, limit_messages: int, live: bool) -> None:
        self._limit_messages = limit_messages
        self._worth_waking = min(BATCH_MESSAGES, limit_messages // 2)
        self._lock = threading.Lock()
        self._ready = threading.Condition(self._lock)
        self._room = threading.Condition(self._lock)
        self._items: deque[LogMessage | LogAttachment] = deque()
        self._bytes = 0
        self._sequences: dict[str, int] = {}
        self._lost: dict[str, _Lost] = {}
        self._spared: dict[str, _Lost] = {}
        self._sparing = False
        self._lost_messages = 0
        self._lost_pixels = 0
        self._waiting_allowed = not live
        self._paused = False
        self._ended = False
        self._reader = 0

    def __len__(self) -> int:
        with self._lock:
            return len(self._items)

    @property
    def lost_messages(self) -> int:
        """Of the whole run."""
        with self._lock:
            return self._lost_messages

    @property
    def lost_pixels(self) -> int:
        """Of the lost messages those with a frame's pixels."""
        with self._lock:
            return self._lost_pixels

    def put(self, topic: Topic, key: str, log_time_ns: int, data: bytes) -> bool:
        """Queue a message; False if it was dropped, which is counted and remembered.

        Waits for room only behind a source that is not live, while nothing speaks against it.
        """
        with self._lock:
            sequence = self._sequences.get(key, 0)
            self._sequences[key] = sequence + 1
            message = LogMessage(
                key, topic.message, sequence & 0xFFFFFFFF, log_time_ns, log_time_ns, data
            )
            if self._sparing and not self._ended and topic in SPARED:
                self._lose(message, self._spared)
                return False
            if not self._has_room(message) and self._may_wait():
                self._ready.notify()
                self._room.wait_for(lambda: self._has_room(message) or not self._may_wait(), WAIT_S)
            closed = self._ended and threading.get_ident() != self._reader
            if closed or not self._has_room(message):
                self._lose(message)
                return False
            self._append(message)
            return True

    def attach(self, attachment: LogAttachment) -> None:
        with self._lock:
            self._append(attachment)

    def hurry(self) -> None:
        """From now on nobody waits in `put`."""
        with self._lock:
            self._waiting_allowed = False
            self._room.notify_all()

    def end(self) -> None:
        """Take nothing more, except from the record thread itself."""
        with self._lock:
            self._ended = True
            self._tell_spared()
            self._ready.notify()
            self._room.notify_all()

    # For the record thread.

    def claim(self) -> None:
        """The calling thread is the one that takes; it never waits in `put`."""
        self._reader = threading.get_ident()

    def pause(self, paused: bool) -> None:
        """While the disk is in trouble nobody waits in `put`."""
        with self._lock:
            self._paused = paused
            self._room.notify_all()

    def spare(self, sparing: bool) -> None:
        """Take no more pixels, or take them again; then `take_lost` tells which are missing."""
        with self._lock:
            self._sparing = sparing
            if not sparing:
                self._tell_spared()

    def wait_ready(self, timeout_s: float) -> None:
        """Return when a batch is there, when `end` was called, or after `timeout_s`."""
        with self._lock:
            self._ready.wait_for(
                lambda: self._ended or len(self._items) >= self._worth_waking, timeout_s
            )

    def wait_end(self, timeout_s: float) -> None:
        """Return when `end` was called, or after `timeout_s`."""
        with self._lock:
            self._ready.wait_for(lambda: self._ended, timeout_s)

    def first_log_time_ns(self, otherwise: int) -> int:
        with self._lock:
            messages = (item for item in self._items if isinstance(item, LogMessage))
            first = next(messages, None)
            return first.log_time_ns if first else otherwise

    def take(self) -> list[LogMessage | LogAttachment]:
        """Return the oldest batch, which may be empty."""
        with self._lock:
            count = min(BATCH_MESSAGES, len(self._items))
            items = [self._items.popleft() for _ in range(count)]
            self._bytes -= sum(len(item.data) for item in items)
            self._room.notify_all()
            return items

    def put_back(self, messages: list[LogMessage]) -> None:
        """Queue again, before all others, what could not be kept."""
        with self._lock:
            self._items.extendleft(reversed(messages))
            self._bytes += sum(len(message.data) for message in messages)

    def lose_all(self) -> None:
        """Count what is queued as lost."""
        with self._lock:
            self._tell_spared()
            for item in self._items:
                if isinstance(item, LogMessage):
                    self._lose(item)
            self._items.clear()
            self._bytes = 0

    def take_lost(self) -> list[tuple[str, str]]:
        """Return (key, how many and which) of what was lost since this was last called."""
        with self._lock:
            lost, self._lost = self._lost, {}
        return [(key, what.text()) for key, what in lost.items()]

    @property
    def has_lost(self) -> bool:
        """`take_lost` has something to tell."""
        with self._lock:
            return bool(self._lost)

    # With the lock held.

    def _append(self, item: LogMessage | LogAttachment) -> None:
        self._items.append(item)
        self._bytes += len(item.data)
        if len(self._items) == self._worth_waking:
            self._ready.notify()

    def _has_room(self, message: LogMessage) -> bool:
        messages, size = float(self._limit_messages), float(LIMIT_BYTES)
        if message.type is pb.Pixels:
            messages, size = messages * PIXELS_SHARE, size * PIXELS_SHARE
        elif message.type in (pb.Event, pb.SetUp):
            messages += RESERVE_MESSAGES
        return len(self._items) < messages and self._bytes + len(message.data) <= size

    def _may_wait(self) -> bool:
        return (
            self._waiting_allowed
            and not self._paused
            and not self._ended
            and threading.get_ident() != self._reader
        )

    def _lose(self, message: LogMessage, among: dict[str, _Lost] | None = None) -> None:
        self._lost_messages += 1
        self._lost_pixels += message.type is pb.Pixels
        lost = self._lost if among is None else among
        lost.setdefault(message.key, _Lost(message.type is pb.Displacement)).add(message)

    def _tell_spared(self) -> None:
        """What was spared is lost; told at once, it would be told every second for days."""
        for key, spared in self._spared.items():
            self._lost.setdefault(key, _Lost(samples=False)).join(spared)
        self._spared = {}


class _Lost:
    """Which messages of one key are in no file."""

    def __init__(self, samples: bool) -> None:
        self._samples = samples
        self._count = 0
        self._ranges: list[list[int]] = []

    def add(self, message: LogMessage) -> None:
        number = message.sequence
        if self._samples:
            number = pb.Displacement.FromString(message.data).seq
        self._count += 1
        self._add_range(number, number)

    def join(self, later: _Lost) -> None:
        self._count += later._count
        for first, last in later._ranges:
            self._add_range(first, last)

    def _add_range(self, first: int, last: int) -> None:
        if self._ranges and self._ranges[-1][1] + 1 == first:
            self._ranges[-1][1] = last
        else:
            self._ranges.append([first, last])

    def text(self) -> str:
        told = [f"{a}-{b}" if b > a else f"{a}" for a, b in self._ranges[:RANGES_TOLD]]
        if more := len(self._ranges) - len(told):
            told.append(f"{more} more stretches up to {self._ranges[-1][1]}")
        return f"{self._count} ({'seq' if self._samples else 'message'} {', '.join(told)})"
