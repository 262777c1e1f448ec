"""The queryable: takes requests off the network, one after the other, and answers them."""

from __future__ import annotations

import contextlib
import json
import queue
import threading
from types import TracebackType
from typing import Self

import zenoh
from google.protobuf.message import DecodeError
from zenoh.handlers import Callback

from vdms_rt.command import Refused
from vdms_rt.config import Control
from vdms_rt.control.desk import Desk
from vdms_rt.model import VdmsError
from vdms_rt.wire import control_pb2 as control
from vdms_rt.wire.access import EVERYONE, access
from vdms_rt.wire.keys import KeysError, users_file
from vdms_rt.wire.session import SESSION, endpoint_fault, reason
from vdms_rt.wire.verbs import CONTROL_KEY, VERBS, Request

WAITING = 32
"""Requests that may wait; who comes then is told to come again."""
POLL_S = 0.2
ENCODING = "application/protobuf;vdms.control.Answer"


class ControlError(VdmsError):
    """Control cannot be offered as configured."""


class ControlServer:
    """Control of a station, from `__enter__` to `__exit__`; `run` is the body of its thread.

    zenoh's own threads only put requests into a queue, so whoever asks much or slowly holds up
    nobody but others who ask.
    """

    def __init__(self, config: Control, station: str, session: zenoh.Session, desk: Desk) -> None:
        """`session` is the station's, which says itself who may ask there."""
        self._config = config
        self._station = station
        self._session = session
        self._desk = desk
        self._asked: queue.Queue[tuple[zenoh.Query, str]] = queue.Queue(WAITING)

    def __enter__(self) -> Self:
        """Take requests. Raises ControlError with a sentence."""
        with contextlib.ExitStack() as stack:
            self._offer(stack, self._session, password=False)
            if self._config.password_listen:
                session = stack.enter_context(self._password_session())
                self._offer(stack, session, password=True)
            self._close = stack.pop_all()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._close.close()

    def run(self, stop: threading.Event) -> None:
        """Answer requests until `stop` is set."""
        while not stop.is_set():
            try:
                query, way = self._asked.get(timeout=POLL_S)
            except queue.Empty:
                continue
            with query:
                self._reply(query, self._answer(query, way))

    def _offer(
        self, stack: contextlib.ExitStack, session: zenoh.Session, *, password: bool
    ) -> None:
        def ask(query: zenoh.Query) -> None:
            try:
                self._asked.put_nowait((query, _way(session, query, password)))
            except queue.Full:
                text = f"{WAITING} requests wait already; ask again in a moment"
                with query:
                    self._reply(query, control.Answer(code="busy", text=text))

        stack.enter_context(
            session.declare_queryable(
                CONTROL_KEY.format(station=self._station, verb="*"),
                Callback(ask, indirect=False),
                complete=True,
            )
        )

    def _reply(self, query: zenoh.Query, answer: control.Answer) -> None:
        verb = _verb(query)
        if "*" in verb:
            return  # a question to everything, not to us
        key = CONTROL_KEY.format(station=self._station, verb=verb)
        # Who asked may be gone by now, and the session too.
        with contextlib.suppress(zenoh.ZError):
            query.reply(key, answer.SerializeToString(), encoding=ENCODING)

    def _answer(self, query: zenoh.Query, way: str) -> control.Answer:
        verb = _verb(query)
        try:
            request = _request(verb, query)
        except Refused as refused:
            return control.Answer(code=refused.code, text=str(refused))
        return self._desk.answer(verb, request, way)

    def _password_session(self) -> zenoh.Session:
        for endpoint in self._config.password_listen:
            if fault := endpoint_fault(endpoint):
                raise ControlError(f"control.password_listen: {fault}")
        try:
            users = users_file(self._config.users)
        except KeysError as error:
            raise ControlError(f"control.users: {error}") from None
        config = zenoh.Config()
        for name, value in {
            **SESSION,
            "mode": "peer",
            "listen/endpoints": list(self._config.password_listen),
            "transport/auth/usrpwd": {"user": None, "password": None, "dictionary_file": users},
            "access_control": access([EVERYONE], reading=False),
        }.items():
            config.insert_json5(name, json.dumps(value))
        try:
            return zenoh.open(config)
        except zenoh.ZError as error:
            where = ", ".join(self._config.password_listen)
            raise ControlError(
                f"control: cannot open {where}: {reason(error)}; correct control.password_listen"
            ) from None


def _request(verb: str, query: zenoh.Query) -> Request:
    kind = VERBS.get(verb)
    if kind is None:
        raise Refused("unknown-verb", f"{verb} is not known here; known: {', '.join(VERBS)}")
    try:
        return kind.FromString(query.payload.to_bytes() if query.payload is not None else b"")
    except DecodeError:
        raise Refused(
            "unreadable", f"the payload is not a {kind.DESCRIPTOR.full_name}; see control.proto"
        ) from None


def _verb(query: zenoh.Query) -> str:
    return str(query.key_expr).rsplit("/", 1)[-1]


def _way(session: zenoh.Session, query: zenoh.Query, password: bool) -> str:
    """Return in words how a request came; the session's access control has let it in."""
    if password:
        return "with a password"
    source = query.source_info
    asker = str(source.source_id.zid) if source is not None else ""
    for link in session.info.links():
        if str(link.zid) == asker:
            if link.auth_identifier:
                return f"with the certificate of {link.auth_identifier}"
            if "lo" in link.interfaces:
                return "on this computer"
            return f"from {link.dst}"
    return "from elsewhere"
