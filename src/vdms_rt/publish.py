"""zenoh: the station's session, its keys, and how samples reach those who ask for them."""

from __future__ import annotations

import contextlib
import json
import math
import threading
from collections.abc import Sequence
from types import TracebackType
from typing import Any, Self

import zenoh
from zenoh import ext

from vdms_rt.config import Control, Publish
from vdms_rt.model import VdmsError
from vdms_rt.wire.access import BY_CERTIFICATE, EVERYONE, THIS_COMPUTER, access
from vdms_rt.wire.keys import KeysError, server_tls
from vdms_rt.wire.session import SESSION, endpoint_fault, reason
from vdms_rt.wire.topics import ALIVE_KEY, TOPICS, Priority, Recovery, Topic

HEARTBEAT_S = 0.5
"""How often a subscriber learns the newest number, so that it misses even the last sample."""


PRIORITIES = {
    Priority.HIGH: zenoh.Priority.DATA_HIGH,
    Priority.NORMAL: zenoh.Priority.DATA,
}


class PublishError(VdmsError):
    """The station cannot be reached as configured."""


class Publisher:
    """The station on the network, from `__enter__` to `__exit__`.

    A session of its own listens at `config.listen`, so no router is needed; in mode "client" it
    opens no port and dials `config.connect` instead, for ever. Nothing here waits for anybody:
    a message for which a link has no room is dropped there, and a subscriber recovers it from
    the history of the last `config.recover_s`.
    """

    def __init__(
        self,
        config: Publish,
        station: str,
        markers: Sequence[str],
        *,
        sample_rate_hz: float,
        control: Control | None = None,
        beside: Publisher | None = None,
    ) -> None:
        """`sample_rate_hz` is of each marker's samples and sizes the history; `control` says who
        may send requests through this session (None: nobody); `beside` is another station's, whose
        session serves this one too."""
        self._config = config
        self._control = control or Control(enabled=False)
        self._beside = beside
        self._station = station
        self._markers = tuple(markers)
        self._history = math.ceil(sample_rate_hz * config.recover_s) + 1
        self._listen = config.listen if config.mode == "peer" else ()
        if self._control.enabled:
            self._listen += self._control.listen
        self._session: zenoh.Session | None = None
        self._publishers: dict[tuple[str, str], zenoh.Publisher | ext.AdvancedPublisher] = {}
        self._unsent = 0
        self._lock = threading.Lock()

    def __enter__(self) -> Self:
        """Open the session and declare every key. Raises PublishError with a sentence."""
        settings = self._settings()
        with contextlib.ExitStack() as stack:
            try:
                self._session = (
                    self._beside.session
                    if self._beside is not None
                    else stack.enter_context(zenoh.open(settings))
                )
            except zenoh.ZError as error:
                raise PublishError(self._cannot_open(reason(error))) from None
            for topic in TOPICS:
                if topic.network:
                    for marker in self._markers if "{marker}" in topic.key else ("",):
                        key = topic.key.format(station=self._station, marker=marker)
                        self._publishers[topic.name, marker] = self._declare(topic, key)
            self._alive = self._session.liveliness().declare_token(
                ALIVE_KEY.format(station=self._station)
            )
            self._close = stack.pop_all()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._close.close()

    @property
    def session(self) -> zenoh.Session:
        """The session, open from `__enter__` to `__exit__`."""
        assert self._session is not None
        return self._session

    @property
    def unsent(self) -> int:
        """Messages that the session refused."""
        return self._unsent

    @property
    def links(self) -> int:
        """Subscribers, routers and other sessions that are linked to this one now."""
        return 0 if self._session is None else len(self._session.info.transports())

    @property
    def state(self) -> str:
        """Where the station can be reached, in words."""
        if self._listen:
            return f"listening on {', '.join(self._listen)}"
        where = " or ".join(self._config.connect)
        return f"connected to {where}" if self.links else f"waiting for {where}"

    def put(self, topic: Topic, marker: str, data: bytes) -> bool:
        """Hand over a serialised `topic.message` and return whether the session took it.

        `marker` is empty for a topic of the whole station. Never waits; any thread may call it.
        """
        try:
            self._publishers[topic.name, marker].put(data)
        except zenoh.ZError:
            with self._lock:
                self._unsent += 1
            return False
        return True

    def _settings(self) -> zenoh.Config:
        for key, endpoints in (
            ("publish.listen", self._config.listen),
            ("publish.connect", self._config.connect),
            ("control.listen", self._control.listen),
        ):
            for endpoint in endpoints:
                if fault := endpoint_fault(endpoint):
                    raise PublishError(f"{key}: {fault}")
        config = zenoh.Config()
        # A zenoh client would refuse to start without its router; a peer that does not listen
        # is the same to the router and dials for ever.
        for name, value in {
            **SESSION,
            "mode": "peer",
            "listen/endpoints": list(self._listen),
            "connect/endpoints": list(self._config.connect),
            "connect/timeout_ms": -1,
            "connect/exit_on_failure": False,
            # With the smallest queue a busy computer drops samples that it need not.
            "transport/link/tx/queue/size/data_high": 16,
            "transport/link/tx/queue/size/data": 16,
            "transport/link/tx/queue/congestion_control/drop/wait_before_drop": 20_000,
            "access_control": access(self._controllers()),
            **self._tls(),
        }.items():
            config.insert_json5(name, json.dumps(value))
        return config

    def _controllers(self) -> list[dict[str, Any]]:
        if not self._control.enabled:
            return []
        if self._control.through_router:
            return [EVERYONE]
        # In mode "client" what comes through the loopback interface comes from a router.
        here = [THIS_COMPUTER] if self._config.mode == "peer" else []
        return [*here, BY_CERTIFICATE] if self._control.listen else here

    def _tls(self) -> dict[str, Any]:
        if not (self._control.enabled and self._control.listen):
            return {}
        try:
            return {"transport/link/tls": server_tls(self._control.keys)}
        except KeysError as error:
            raise PublishError(f"control.keys: {error}") from None

    def _cannot_open(self, why: str) -> str:
        named = [e for e in self._listen if e.split("/", 1)[1] in why]
        where = ", ".join(named or self._listen or self._config.connect)
        if "Address already in use" in why:
            return (
                f"publish: {where} is in use; is another vdms-rt running? "
                f"Stop it, or set {self._key(named)} to another port"
            )
        if "Cannot assign requested address" in why:
            return (
                f"publish: {where} is not an address of this computer; set publish.listen "
                'to one that is, or to "tcp/0.0.0.0:7447" for all of them'
            )
        return f"publish: cannot open {where}: {why}; correct publish.listen or publish.connect"

    def _key(self, endpoints: Sequence[str]) -> str:
        """Return the configuration's key of listening addresses."""
        of_control = set(endpoints) & set(self._control.listen)
        return "control.listen" if of_control else "publish.listen"

    def _declare(self, topic: Topic, key: str) -> zenoh.Publisher | ext.AdvancedPublisher:
        assert self._session is not None
        encoding = f"application/protobuf;{topic.message.DESCRIPTOR.full_name}"
        priority = PRIORITIES[topic.priority]
        if topic.recovery is Recovery.NONE:
            return self._session.declare_publisher(
                key,
                encoding=encoding,
                congestion_control=zenoh.CongestionControl.DROP,
                priority=priority,
            )
        return ext.declare_advanced_publisher(
            self._session,
            key,
            encoding=encoding,
            congestion_control=zenoh.CongestionControl.DROP,
            priority=priority,
            # While it replays, the history is locked against `put`: a reader that stops in the
            # middle may therefore lose some of it, but not stop the station.
            cache=ext.CacheConfig(
                max_samples=self._history if topic.recovery is Recovery.ALL else 1,
                replies_config=ext.RepliesConfig(congestion_control=zenoh.CongestionControl.DROP),
            ),
            publisher_detection=True,
            sample_miss_detection=(
                ext.MissDetectionConfig(heartbeat=HEARTBEAT_S, sporadic_heartbeat=None)
                if topic.recovery is Recovery.ALL
                else None
            ),
        )
