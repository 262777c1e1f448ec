"""One session with one address: connects, stays connected, and fills an inbox."""

from __future__ import annotations

import atexit
import contextlib
import json
import logging
import queue
import threading
import time
from collections.abc import Sequence
from typing import NamedTuple

import zenoh
from zenoh import ext
from zenoh.handlers import Callback, RingChannel

from vdms_rt.subscribe.inbox import Inbox
from vdms_rt.subscribe.samples import SOURCES_REMEMBERED, Arrived, Left, Raw
from vdms_rt.wire.session import SESSION, reason
from vdms_rt.wire.topics import ALIVE_KEY

CONNECT_TIMEOUT_S = 1.0
EAR_S = 1.0
"""How long an interpreter that exits waits for a callback."""
RETRY_S = 0.2
HISTORY_TIMEOUT_S = 10.0

log = logging.getLogger("vdms_rt.subscribe")


class _Request(NamedTuple):
    """Ask the stations' histories for `selector`, and then release what is held of `source`."""

    selector: str
    source: str


class Link:
    """A thread that connects, keeps the session, and asks for history, until `stop`.

    zenoh's advanced subscriber puts samples in order and recovers what is missing once it has a
    first one. Its own history loses a race: a live sample that comes between its two queries ends
    it. So the history is asked for here: the first sample of each publisher is held until what
    the publisher keeps from before it has come.
    """

    def __init__(self, endpoint: str, keys: Sequence[str], inbox: Inbox) -> None:
        self.endpoint = endpoint
        self._keys = tuple(keys)
        self._inbox = inbox
        self._session: zenoh.Session | None = None
        self._cancel = zenoh.CancellationToken()
        self._requests: queue.SimpleQueue[_Request | None] = queue.SimpleQueue()
        self._lock = threading.Lock()
        self._known: dict[str, None] = {}
        self._held: dict[str, list[Raw]] = {}
        self._thread = threading.Thread(target=self._run, name=f"subscribe {endpoint}", daemon=True)
        _running.add(self)
        self._thread.start()

    @property
    def connected(self) -> bool:
        """Somebody answers at the address."""
        session = self._session
        return session is not None and bool(session.info.transports())

    def abandon(self) -> None:
        """Let it end by itself. Takes no lock, so the garbage collector may call it."""
        self._requests.put(None)

    def stop(self) -> None:
        """End it now; `join` waits until it has."""
        self.abandon()
        self._cancel.cancel()  # type: ignore[no-untyped-call]

    def join(self) -> None:
        """Wait until its thread has ended: at most as long as one attempt to connect."""
        self._thread.join()

    def _run(self) -> None:
        try:
            session = self._open()
            if session is not None:
                self._serve(session)
        finally:
            _running.discard(self)

    def _open(self) -> zenoh.Session | None:
        config = zenoh.Config()
        for name, value in {
            **SESSION,
            "mode": "client",
            "connect/endpoints": [self.endpoint],
            "connect/timeout_ms": round(CONNECT_TIMEOUT_S * 1000),
        }.items():
            config.insert_json5(name, json.dumps(value))
        while True:
            try:
                return zenoh.open(config)
            except zenoh.ZError as error:
                log.debug("%s: %s", self.endpoint, reason(error))
            try:
                self._requests.get(timeout=RETRY_S)
            except queue.Empty:
                continue
            return None

    def _serve(self, session: zenoh.Session) -> None:
        # The interpreter's exit hangs on a zenoh callback that is still declared, so all are
        # undeclared here, in order. Callbacks run in zenoh's own thread: they only fill the inbox.
        with contextlib.ExitStack() as stack:
            stack.enter_context(session)
            for key in {_alive_key(key) for key in self._keys}:
                stack.enter_context(
                    session.liveliness().declare_subscriber(
                        key, Callback(self._on_alive, indirect=False), history=True
                    )
                )
            for key in self._keys:
                self._listen(session, key, stack)
            self._session = session
            while (request := self._requests.get()) is not None:
                self._fetch(session, request)
            self._session = None

    def _listen(self, session: zenoh.Session, key: str, stack: contextlib.ExitStack) -> None:
        """Subscribe until `stack` is closed."""
        recovery = ext.RecoveryConfig(heartbeat=True, periodic_queries=None)
        if self._inbox.at_once is None:
            callback = Callback(self._on_sample, indirect=False)
            stack.enter_context(
                ext.declare_advanced_subscriber(session, key, callback, recovery=recovery)
            )
            return
        # Full, it drops the oldest, so it never makes zenoh's thread wait.
        channel: RingChannel[zenoh.Sample] = RingChannel(self._inbox.limit)
        subscriber = ext.declare_advanced_subscriber(session, key, channel, recovery=recovery)
        ear = threading.Thread(
            target=self._hear,
            args=(subscriber,),
            name=f"subscribe {self.endpoint} {key}",
            daemon=True,
        )
        ear.start()
        stack.callback(ear.join, EAR_S)
        stack.enter_context(subscriber)

    def _hear(self, subscriber: ext.AdvancedSubscriber[zenoh.Handler[zenoh.Sample]]) -> None:
        for sample in subscriber:
            self._on_sample(sample, patient=True)

    def _on_sample(self, sample: zenoh.Sample, *, patient: bool = False) -> None:
        raw = _raw(sample)
        if not raw.sequenced:
            self._inbox.put(raw, patient=patient)
            return
        with self._lock:
            if raw.source in self._held:
                self._held[raw.source].append(raw)
            elif raw.source in self._known or raw.number == 0:
                self._know(raw.source)
                self._inbox.put(raw, patient=patient)
            else:
                self._know(raw.source)
                self._held[raw.source] = [raw]
                before = f"{raw.key}/@adv/pub/{raw.source}/**?_sn=..{raw.number - 1}"
                self._requests.put(_Request(before, raw.source))

    def _know(self, source: str) -> None:
        self._known[source] = None
        if len(self._known) > SOURCES_REMEMBERED:
            self._known.pop(next(iter(self._known)))

    def _on_alive(self, sample: zenoh.Sample) -> None:
        station = str(sample.key_expr).split("/")[1]
        if sample.kind == zenoh.SampleKind.DELETE:
            self._inbox.put(Left(station))
            return
        self._inbox.put(Arrived(station))
        for key in self._keys:
            # The last message of each topic that has no numbers.
            self._requests.put(_Request(f"{key}/@adv/pub/*/uhlc/**", ""))

    def _fetch(self, session: zenoh.Session, request: _Request) -> None:
        try:
            replies = session.get(
                request.selector,
                consolidation=zenoh.ConsolidationMode.NONE,
                accept_replies=zenoh.ReplyKeyExpr.ANY,
                timeout=HISTORY_TIMEOUT_S,
                cancellation_token=self._cancel,
            )
            kept = sorted(
                (_raw(reply.ok) for reply in replies if reply.ok is not None),
                key=lambda raw: raw.number,
            )
        except zenoh.ZError as error:
            log.warning("%s: no history of %s: %s", self.endpoint, request.selector, reason(error))
            kept = []
        with self._lock:
            for raw in (*kept, *self._held.pop(request.source, ())):
                self._inbox.put(raw)


_running: set[Link] = set()


@atexit.register
def _stop_all() -> None:
    """zenoh must be silent before the interpreter goes."""
    running = tuple(_running)
    for link in running:
        link.stop()
    for link in running:
        link.join()


def _alive_key(key: str) -> str:
    """Return the liveliness key of the stations that `key` asks for."""
    chunks = key.split("/")
    station = chunks[1] if len(chunks) > 1 and "**" not in chunks[:2] else "*"
    return ALIVE_KEY.format(station=station)


def _raw(sample: zenoh.Sample) -> Raw:
    info = sample.source_info
    if info is not None:
        by = info.source_id
        source, number = f"{by.zid}/{by.eid}", info.source_sn
    elif (stamp := sample.timestamp) is not None:
        source, number = bytes(stamp.get_id()).hex(), stamp.get_time_as_ntp64().as_nanos()
    else:
        source, number = "", 0
    return Raw(
        str(sample.key_expr),
        sample.payload.to_bytes(),
        time.monotonic_ns(),
        source,
        number,
        info is not None,
    )
