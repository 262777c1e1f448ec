"""Samples to iterate over, or to be called back with."""

from __future__ import annotations

import logging
import threading
import time
import weakref
from collections import deque
from collections.abc import Callable, Sequence
from types import TracebackType
from typing import Any, Generic, Literal, Self, TypeVar, cast, overload

import zenoh

from vdms_rt.model import VdmsError
from vdms_rt.subscribe.inbox import Inbox, Incoming
from vdms_rt.subscribe.link import Link
from vdms_rt.subscribe.samples import Missed, Notice, Reader, Sample, Unreadable
from vdms_rt.wire.session import DEFAULT_ENDPOINT, endpoint_fault, reason

QUEUE = 65536
"""Samples that wait for a slow program: 18 minutes of one marker at 59.94 Hz."""

log = logging.getLogger("vdms_rt.subscribe")

Item = TypeVar("Item")


class SubscribeError(VdmsError):
    """What was asked for cannot be subscribed to."""


class Subscription(Generic[Item]):
    """Samples as they come, in order and without doubles: iterate it, or `get` with a timeout.

    Reconnects for ever; what was published meanwhile is recovered from the station's history.
    `close` it, use it in `with`, or let it go: nothing of it outlives it.
    """

    def __init__(
        self,
        inbox: Inbox,
        links: Sequence[Link],
        notices: bool,
        on_notice: Callable[[Notice], object] | None,
    ) -> None:
        self._inbox = inbox
        self._links = links
        self._notices = notices
        self._on_notice = on_notice
        self._reader = Reader()
        self._ready: deque[Sample | Notice] = deque()
        weakref.finalize(self, _abandon, links).atexit = False

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> Item:
        while not self._inbox.closed:
            item = self.get()
            if item is not None:
                return item
        raise StopIteration

    def get(self, timeout_s: float | None = None) -> Item | None:
        """Return the next item, or None if none came in time or the subscription is closed."""
        until_s = None if timeout_s is None else time.monotonic() + timeout_s
        while True:
            while self._ready and not self._inbox.closed:
                said = self._ready.popleft()
                if isinstance(said, Sample) or self._notices:
                    return cast("Item", said)
                _tell(said, self._on_notice)
            left_s = None if until_s is None else max(0.0, until_s - time.monotonic())
            item = self._inbox.take(left_s)
            if item is None:
                return None
            self._ready.extend(self._reader.read(item))

    @property
    def waiting_for(self) -> tuple[str, ...]:
        """The addresses where nobody answers at the moment."""
        return _silent(self._links)

    def close(self) -> None:
        """End it; whoever waits in it is let go. May be called twice, and by any thread."""
        self._inbox.close()
        _stop(self._links)


class Listener:
    """Calls back with each sample, in order, one at a time, until `close`.

    It calls from the thread that receives the samples, or, as long as a callback takes more than
    5 ms, from one more; none of them is zenoh's, so a callback may take its time. An exception of
    a callback ends it: its traceback is printed, and `wait` returns.
    """

    def __init__(self, inbox: Inbox, links: Sequence[Link]) -> None:
        self._inbox = inbox
        self._links = links
        self._thread = threading.Thread(target=self._listen, name="subscribe", daemon=True)
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    @property
    def waiting_for(self) -> tuple[str, ...]:
        """The addresses where nobody answers at the moment."""
        return _silent(self._links)

    def wait(self, timeout_s: float | None = None) -> bool:
        """Wait until it has ended and return whether it has."""
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def close(self) -> None:
        """End it, and wait for a callback that is running, unless that is who closes it. May be
        called twice."""
        self._inbox.close()
        if not self._inbox.serving:
            self._inbox.finish()
            self._thread.join()

    def _listen(self) -> None:
        try:
            self._inbox.serve()
        finally:
            self._inbox.close()
            _stop(self._links)


class _Caller:
    """What a `Listener` does with an item; one thread at a time uses it."""

    def __init__(
        self,
        on_sample: Callable[[Sample], object],
        on_notice: Callable[[Notice], object] | None,
    ) -> None:
        self._on_sample = on_sample
        self._on_notice = on_notice
        self._reader = Reader()

    def __call__(self, item: Incoming) -> None:
        for said in self._reader.read(item):
            if isinstance(said, Sample):
                self._on_sample(said)
            else:
                _tell(said, self._on_notice)


@overload
def subscribe(
    key: str | Sequence[str] = ...,
    connect: str | Sequence[str] = ...,
    *,
    queue: int = ...,
    notices: Literal[False] = ...,
    on_notice: Callable[[Notice], object] | None = ...,
) -> Subscription[Sample]: ...
@overload
def subscribe(
    key: str | Sequence[str] = ...,
    connect: str | Sequence[str] = ...,
    *,
    queue: int = ...,
    notices: Literal[True],
) -> Subscription[Sample | Notice]: ...
@overload
def subscribe(
    key: str | Sequence[str] = ...,
    connect: str | Sequence[str] = ...,
    *,
    queue: int = ...,
    on_sample: Callable[[Sample], object],
    on_notice: Callable[[Notice], object] | None = ...,
) -> Listener: ...
def subscribe(
    key: str | Sequence[str] = "vdms/*/*/displacement",
    connect: str | Sequence[str] = DEFAULT_ENDPOINT,
    *,
    queue: int = QUEUE,
    notices: bool = False,
    on_sample: Callable[[Sample], object] | None = None,
    on_notice: Callable[[Notice], object] | None = None,
) -> Subscription[Any] | Listener:
    """Return the messages under `key` as something to iterate, or call `on_sample` with each.

    `key` is one zenoh key expression or several; `connect` is a station's or a router's address,
    or one for each of several stations. First come the samples that the station keeps from
    before the subscription (a minute, unless its `publish.recover_s` says otherwise). Up to
    `queue` samples wait for a program that is slow; then some are dropped, and told as missed.

    What was missed, and stations that arrive and leave, come between the samples with `notices`,
    go to `on_notice` in the thread that takes the samples, or else what was missed is logged as
    a warning.

    Raises SubscribeError for a key or an address that cannot be one.
    """
    endpoints = (connect,) if isinstance(connect, str) else tuple(connect)
    for endpoint in endpoints:
        if fault := endpoint_fault(endpoint):
            raise SubscribeError(f"subscribe: {fault}")
    keys = (key,) if isinstance(key, str) else tuple(key)
    for one in keys:
        try:
            zenoh.KeyExpr(one)
        except zenoh.ZError as error:
            raise SubscribeError(
                f'subscribe: "{one}" is not a key: {reason(error)}; '
                'write for example "vdms/*/*/displacement"'
            ) from None
    inbox = Inbox(queue, None if on_sample is None else _Caller(on_sample, on_notice))
    links = [Link(endpoint, keys, inbox) for endpoint in endpoints]
    if on_sample is not None:
        return Listener(inbox, links)
    return Subscription(inbox, links, notices, on_notice)


def _tell(notice: Notice, on_notice: Callable[[Notice], object] | None) -> None:
    if on_notice is not None:
        on_notice(notice)
    elif isinstance(notice, (Missed, Unreadable)):
        log.warning("%s", notice)


def _silent(links: Sequence[Link]) -> tuple[str, ...]:
    return tuple(link.endpoint for link in links if not link.connected)


def _stop(links: Sequence[Link]) -> None:
    for link in links:
        link.stop()
    for link in links:
        link.join()


def _abandon(links: Sequence[Link]) -> None:
    for link in links:
        link.abandon()
