"""The few lines that another program needs to listen to stations.

for sample in subscribe("vdms/*/*/displacement", connect="tcp/192.168.1.20:7447"):
    print(sample.station, sample.marker, sample.value.x_mm)
"""

from __future__ import annotations

import json
import logging
import threading
import time
import weakref
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Generic, Literal, NamedTuple, Self, TypeAlias, TypeVar, cast, overload

import zenoh
from google.protobuf.message import DecodeError, Message
from zenoh import ext

from vdms_rt.model import Displacement, Event, Health, Truth, VdmsError
from vdms_rt.wire import convert
from vdms_rt.wire.session import DEFAULT_ENDPOINT, SESSION, endpoint_fault, reason
from vdms_rt.wire.topics import ALIVE_KEY, DISPLACEMENT, EVENT, HEALTH, TOPICS, TRUTH

HISTORY = 3600
"""Samples of each key: a minute of 59.94 Hz, which is what a station keeps by default."""
QUEUE = 65536
"""Samples that wait for a slow program: 18 minutes of one marker at 59.94 Hz."""
CONNECT_TIMEOUT_S = 1.0
RETRY_S = 0.2
SESSIONS_REMEMBERED = 256

log = logging.getLogger(__name__)


class SubscribeError(VdmsError):
    """What was asked for cannot be subscribed to."""


@dataclass(frozen=True, slots=True)
class Sample:
    """One message of a station."""

    station: str
    marker: str
    """Empty where the topic is of the whole station."""
    topic: str
    received_ns: int
    """When it came, on this computer's monotonic clock."""
    value: Displacement | Truth | Health | Event | Message | bytes
    """The message of the topic (`vdms_pb2`) where there is no type of ours, the bytes where the
    topic is not known."""


@dataclass(frozen=True, slots=True)
class Missed:
    """Displacements that this subscriber never got, first and last included."""

    station: str
    marker: str
    session: int
    first_seq: int
    last_seq: int
    on_the_way: int
    """How many of them the station had sent; it never had the others: lost frames."""

    @property
    def count(self) -> int:
        return self.last_seq - self.first_seq + 1

    def __str__(self) -> str:
        return (
            f"{self.station}/{self.marker}: missed seq {self.first_seq} to {self.last_seq} "
            f"({self.count} samples, {self.on_the_way} of them on the way)"
        )


@dataclass(frozen=True, slots=True)
class Arrived:
    """A station's daemon runs and can be reached."""

    station: str

    def __str__(self) -> str:
        return f"{self.station}: arrived"


@dataclass(frozen=True, slots=True)
class Left:
    """A station's daemon stopped or cannot be reached any more."""

    station: str

    def __str__(self) -> str:
        return f"{self.station}: left"


@dataclass(frozen=True, slots=True)
class Unreadable:
    """Bytes that are not what their key promises."""

    key: str
    why: str

    def __str__(self) -> str:
        return f"{self.key}: cannot be read: {self.why}"


Notice: TypeAlias = Missed | Arrived | Left | Unreadable
Item = TypeVar("Item")


class _Raw(NamedTuple):
    """A message as it came from zenoh's thread."""

    key: str
    data: bytes
    received_ns: int
    source: object
    """Who numbered it, or None."""
    number: int


class _Last(NamedTuple):
    seq: int
    source: object
    number: int


class _Inbox:
    """Where zenoh's threads put what comes; it never makes them wait."""

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._waiting: deque[_Raw | Arrived | Left] = deque()
        self._changed = threading.Condition(threading.Lock())
        self.closed = False

    def on_sample(self, sample: zenoh.Sample) -> None:
        info = sample.source_info
        raw = _Raw(
            str(sample.key_expr),
            sample.payload.to_bytes(),
            time.monotonic_ns(),
            str(info.source_id) if info else None,
            info.source_sn if info else 0,
        )
        with self._changed:
            # The gap that this leaves is found where the queue is read.
            if len(self._waiting) < self._limit:
                self._waiting.append(raw)
                self._changed.notify()

    def on_alive(self, sample: zenoh.Sample) -> None:
        station = str(sample.key_expr).split("/")[1]
        put = sample.kind == zenoh.SampleKind.PUT
        with self._changed:
            self._waiting.append(Arrived(station) if put else Left(station))
            self._changed.notify()

    def take(self, timeout_s: float | None) -> _Raw | Arrived | Left | None:
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or self.closed, timeout_s)
            return self._waiting.popleft() if self._waiting and not self.closed else None

    def close(self) -> None:
        with self._changed:
            self.closed = True
            self._changed.notify_all()


class _Reader:
    """Makes samples and notices of raw messages: decodes, drops doubles, finds gaps."""

    def __init__(self) -> None:
        self._last: dict[tuple[str, str, int], _Last] = {}

    def read(self, raw: _Raw) -> Iterator[Sample | Notice]:
        station, marker, topic = _parts(raw.key)
        try:
            value = _decode(topic, raw.data)
        except (DecodeError, ValueError) as error:
            yield Unreadable(raw.key, str(error))
            return
        if isinstance(value, Displacement):
            last = self._last.get((station, marker, value.session))
            if last and value.seq <= last.seq:
                return
            if last and value.seq > last.seq + 1:
                yield _missed(station, marker, value, last, raw)
            self._remember((station, marker, value.session), _Last(value.seq, *raw[3:]))
        yield Sample(station, marker, topic, raw.received_ns, value)

    def _remember(self, of: tuple[str, str, int], last: _Last) -> None:
        self._last[of] = last
        if len(self._last) > SESSIONS_REMEMBERED:
            self._last.pop(next(iter(self._last)))


class Subscription(Generic[Item]):
    """Samples as they come, in order and without doubles: iterate it, or `get` with a timeout.

    Reconnects for ever; what was published meanwhile is recovered from the station's history.
    `close` it, use it in `with`, or let it go: nothing of it outlives it.
    """

    def __init__(
        self,
        inbox: _Inbox,
        links: Sequence[_Link],
        notices: bool,
        on_notice: Callable[[Notice], object] | None,
    ) -> None:
        self._inbox = inbox
        self._links = links
        self._notices = notices
        self._on_notice = on_notice
        self._reader = _Reader()
        self._ready: deque[Sample | Notice] = deque()
        self._finish = weakref.finalize(self, _finish, inbox, links)

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
                item = self._ready.popleft()
                if isinstance(item, Sample) or self._notices:
                    return cast("Item", item)
                self._tell(item)
            left_s = None if until_s is None else max(0.0, until_s - time.monotonic())
            raw = self._inbox.take(left_s)
            if raw is None:
                return None
            self._ready.extend(self._reader.read(raw) if isinstance(raw, _Raw) else (raw,))

    @property
    def waiting_for(self) -> tuple[str, ...]:
        """The addresses where nobody answers at the moment."""
        return tuple(link.endpoint for link in self._links if not link.connected)

    def close(self) -> None:
        """End it; whoever waits in it is let go. May be called twice, and by any thread."""
        self._finish()

    def _tell(self, notice: Notice) -> None:
        if self._on_notice is not None:
            self._on_notice(notice)
        elif isinstance(notice, (Missed, Unreadable)):
            log.warning("%s", notice)


class Listener:
    """Calls back from a thread of its own with each sample, in order, until `close`.

    An exception of a callback ends it: its traceback is printed, and `wait` returns.
    """

    def __init__(
        self, subscription: Subscription[Sample], on_sample: Callable[[Sample], object]
    ) -> None:
        self._subscription = subscription
        self._on_sample = on_sample
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
        return self._subscription.waiting_for

    def wait(self, timeout_s: float | None = None) -> bool:
        """Wait until it has ended and return whether it has."""
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def close(self) -> None:
        """End it, and wait for a callback that is running. May be called twice."""
        self._subscription.close()
        if self._thread is not threading.current_thread():
            self._thread.join()

    def _listen(self) -> None:
        with self._subscription:
            for sample in self._subscription:
                self._on_sample(sample)


@overload
def subscribe(
    key: str = ...,
    connect: str | Sequence[str] = ...,
    *,
    history: int = ...,
    queue: int = ...,
    notices: Literal[False] = ...,
    on_notice: Callable[[Notice], object] | None = ...,
) -> Subscription[Sample]: ...
@overload
def subscribe(
    key: str = ...,
    connect: str | Sequence[str] = ...,
    *,
    history: int = ...,
    queue: int = ...,
    notices: Literal[True],
) -> Subscription[Sample | Notice]: ...
@overload
def subscribe(
    key: str = ...,
    connect: str | Sequence[str] = ...,
    *,
    history: int = ...,
    queue: int = ...,
    on_sample: Callable[[Sample], object],
    on_notice: Callable[[Notice], object] | None = ...,
) -> Listener: ...
def subscribe(
    key: str = "vdms/*/*/displacement",
    connect: str | Sequence[str] = DEFAULT_ENDPOINT,
    *,
    history: int = HISTORY,
    queue: int = QUEUE,
    notices: bool = False,
    on_sample: Callable[[Sample], object] | None = None,
    on_notice: Callable[[Notice], object] | None = None,
) -> Subscription[Any] | Listener:
    """Return the messages under `key` as something to iterate, or call `on_sample` with each.

    `connect` is a station's or a router's address, or one for each of several stations. `history`
    is the most samples of each key that are asked for from before the subscription began; with 0
    there are none, nor the last health and set-up. Up to `queue` samples wait for a program that
    is slow; then the newest are dropped, and told as missed.

    What was missed, and stations that arrive and leave, come between the samples with `notices`,
    go to `on_notice` in the thread that takes the samples, or else what was missed is logged as
    a warning.

    Raises SubscribeError for a key or an address that cannot be one.
    """
    endpoints = (connect,) if isinstance(connect, str) else tuple(connect)
    for endpoint in endpoints:
        if fault := endpoint_fault(endpoint):
            raise SubscribeError(f"subscribe: {fault}")
    try:
        zenoh.KeyExpr(key)
    except zenoh.ZError as error:
        raise SubscribeError(
            f'subscribe: "{key}" is not a key: {reason(error)}; '
            'write for example "vdms/*/*/displacement"'
        ) from None
    inbox = _Inbox(queue)
    links = [_Link(endpoint, key, history, inbox) for endpoint in endpoints]
    subscription: Subscription[Any] = Subscription(inbox, links, notices, on_notice)
    return subscription if on_sample is None else Listener(subscription, on_sample)


class _Link:
    """The session with one address: a thread that connects, and then keeps it until `close`."""

    def __init__(self, endpoint: str, key: str, history: int, inbox: _Inbox) -> None:
        self.endpoint = endpoint
        self._key = key
        self._history = history
        self._inbox = inbox
        self._session: zenoh.Session | None = None
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"subscribe {endpoint}", daemon=True)
        self._thread.start()

    @property
    def connected(self) -> bool:
        session = self._session
        return session is not None and bool(session.info.transports())

    def ask_to_stop(self) -> None:
        self._stop.set()

    def join(self) -> None:
        if self._thread is not threading.current_thread():
            self._thread.join()

    def _run(self) -> None:
        session = self._open()
        if session is None:
            return
        history = ext.HistoryConfig(detect_late_publishers=True, max_samples=self._history)
        # The interpreter's exit hangs on a zenoh callback that is still declared, so all are
        # undeclared here, in order.
        with (
            session,
            ext.declare_advanced_subscriber(
                session,
                self._key,
                self._inbox.on_sample,
                history=history if self._history else None,
                recovery=ext.RecoveryConfig(heartbeat=True, periodic_queries=None),
            ),
            session.liveliness().declare_subscriber(
                _alive_key(self._key), self._inbox.on_alive, history=True
            ),
        ):
            self._session = session
            self._stop.wait()
            self._session = None

    def _open(self) -> zenoh.Session | None:
        config = zenoh.Config()
        for name, value in {
            **SESSION,
            "mode": "client",
            "connect/endpoints": [self.endpoint],
            "connect/timeout_ms": round(CONNECT_TIMEOUT_S * 1000),
        }.items():
            config.insert_json5(name, json.dumps(value))
        while not self._stop.is_set():
            try:
                return zenoh.open(config)
            except zenoh.ZError as error:
                log.debug("%s: %s", self.endpoint, reason(error))
                self._stop.wait(RETRY_S)
        return None


def _finish(inbox: _Inbox, links: Sequence[_Link]) -> None:
    inbox.close()
    for link in links:
        link.ask_to_stop()
    for link in links:
        link.join()


def _alive_key(key: str) -> str:
    """Return the liveliness key of the stations that `key` asks for."""
    chunks = key.split("/")
    station = chunks[1] if len(chunks) > 1 and "**" not in chunks[:2] else "*"
    return ALIVE_KEY.format(station=station)


def _parts(key: str) -> tuple[str, str, str]:
    """Return station, marker and topic; what a key does not have is empty."""
    match key.split("/"):
        case [_, station, marker, topic]:
            return station, marker, topic
        case [_, station, topic]:
            return station, "", topic
        case _:
            return "", "", key


_MESSAGES = {topic.name: topic.message for topic in TOPICS}
_VALUES: dict[str, Callable[[bytes], Displacement | Truth | Health | Event]] = {
    DISPLACEMENT.name: convert.displacement_from,
    TRUTH.name: convert.truth_from,
    HEALTH.name: convert.health_from,
    EVENT.name: convert.event_from,
}


def _decode(topic: str, data: bytes) -> Displacement | Truth | Health | Event | Message | bytes:
    if topic in _VALUES:
        return _VALUES[topic](data)
    return _MESSAGES[topic].FromString(data) if topic in _MESSAGES else data


def _missed(station: str, marker: str, value: Displacement, last: _Last, raw: _Raw) -> Missed:
    same = raw.source is not None and raw.source == last.source
    return Missed(
        station,
        marker,
        value.session,
        first_seq=last.seq + 1,
        last_seq=value.seq - 1,
        on_the_way=raw.number - last.number - 1 if same else value.seq - last.seq - 1,
    )
