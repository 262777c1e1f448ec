"""Asking a station: what `vdms-rt ctl` and the page use, and any other program may."""

from __future__ import annotations

import contextlib
import getpass
import json
import socket
import sys
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import zenoh

from vdms_rt.model import VdmsError
from vdms_rt.wire import control_pb2 as control
from vdms_rt.wire.keys import client_tls
from vdms_rt.wire.session import DEFAULT_ENDPOINT, SESSION, endpoint_fault, reason
from vdms_rt.wire.topics import ALIVE_KEY
from vdms_rt.wire.verbs import CONTROL_KEY, VERBS

CONNECT_S = 5.0
ANSWER_S = 5.0


class ControlError(VdmsError):
    """Nobody answered."""


@dataclass(frozen=True, slots=True)
class Credentials:
    """What a station on another computer asks for: a folder that `vdms-rt keys client` made, or a
    name and password."""

    keys: Path | None = None
    user: str = ""
    password: str = ""


class Controller:
    """A link to one station, from `__enter__` to `__exit__`; it reconnects by itself.

    Any thread may ask.
    """

    def __init__(
        self,
        connect: str = DEFAULT_ENDPOINT,
        *,
        station: str | None = None,
        credentials: Credentials | None = None,
        who: str = "",
    ) -> None:
        """`station` may be None where only one can be reached at the address. `who` is said in the
        station's log; by default this user, computer and program.

        Raises ControlError for an address that cannot be one.
        """
        if fault := endpoint_fault(connect):
            raise ControlError(f"control: {fault}")
        self._connect = connect
        self._station = station
        self._credentials = credentials or Credentials()
        self._who = who or _who()
        self._lock = threading.Lock()
        self._open = contextlib.ExitStack()

    def __enter__(self) -> Self:
        """Connect. Raises ControlError where nobody answers or the credentials are wrong."""
        config = zenoh.Config()
        for name, value in {
            **SESSION,
            "mode": "client",
            "connect/endpoints": [self._connect],
            "connect/timeout_ms": round(CONNECT_S * 1000),
            **self._settings(),
        }.items():
            config.insert_json5(name, json.dumps(value))
        try:
            self._session = self._open.enter_context(zenoh.open(config))
        except zenoh.ZError as error:
            raise ControlError(self._cannot_connect(reason(error))) from None
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._open.close()

    def ask(
        self, verb: str, *, timeout_s: float = ANSWER_S, who: str = "", **fields: Any
    ) -> control.Answer:
        """Send a request, `fields` of its message in control.proto, and return the answer.

        `who` is said in the station's log instead of the controller's own.
        An answer that is not `done` was refused; its text says why. Raises ControlError if none
        came, and ValueError or TypeError for fields that the verb does not have.
        """
        request = VERBS[verb](who=who or self._who, **fields)
        station = self._one_station()
        key = CONTROL_KEY.format(station=station, verb=verb)
        answers = list(self._get(key, request.SerializeToString(), timeout_s))
        if not answers:
            raise ControlError(self._no_answer(station, timeout_s))
        return control.Answer.FromString(answers[0].payload.to_bytes())

    def stations(self) -> tuple[str, ...]:
        """Return the stations that answer this computer at the address."""
        request = VERBS["status"](who=self._who).SerializeToString()
        found = self._get(CONTROL_KEY.format(station="*", verb="status"), request, ANSWER_S)
        return tuple(sorted(str(sample.key_expr).split("/")[1] for sample in found))

    def _one_station(self) -> str:
        with self._lock:
            if self._station is None:
                found = self.stations()
                if len(found) > 1:
                    raise ControlError(
                        f"several stations answer at {self._connect}: {', '.join(found)}; name one"
                    )
                if not found:
                    raise ControlError(self._no_answer("*", ANSWER_S))
                self._station = found[0]
            return self._station

    def _get(self, key: str, payload: bytes, timeout_s: float) -> Iterator[zenoh.Sample]:
        # The station looks up, by the session's name in it, how a request came.
        with contextlib.ExitStack() as stack:
            querier = stack.enter_context(self._session.declare_querier(key, timeout=timeout_s))
            source = zenoh.SourceInfo(querier.id, 0)
            try:
                for reply in querier.get(payload=payload, source_info=source):
                    if reply.ok is not None:
                        yield reply.ok
            except zenoh.ZError as error:
                raise ControlError(f"{self._connect}: {reason(error)}") from None

    def _settings(self) -> dict[str, Any]:
        settings: dict[str, Any] = {}
        if self._credentials.keys is not None:
            settings["transport/link/tls"] = client_tls(str(self._credentials.keys))
        if self._credentials.user:
            settings["transport/auth/usrpwd"] = {
                "user": self._credentials.user,
                "password": self._credentials.password,
            }
        return settings

    def _cannot_connect(self, why: str) -> str:
        if self._connect.startswith(("tls/", "quic/")):
            hint = "does a station listen there, and are these keys its own and its name right?"
        elif self._credentials.user:
            hint = "does a station listen there, and are name and password right?"
        else:
            hint = "does a station run there?"
        if "Timeout" in why:
            return f"{self._connect}: no connection within {CONNECT_S:g} s; {hint}"
        return f"{self._connect}: {why}; {hint}"

    def _no_answer(self, station: str, timeout_s: float) -> str:
        alive = self._session.liveliness().get(ALIVE_KEY.format(station=station), timeout=timeout_s)
        names = sorted(str(r.ok.key_expr).split("/")[1] for r in alive if r.ok is not None)
        if names:
            return (
                f"{self._connect}: station {', '.join(names)} takes no requests from here: only "
                "from its own computer, or with keys or a password where its [control] allows them"
            )
        named = "no station" if station == "*" else f"no station {station}"
        return f"{self._connect}: {named} answers there; is it running?"


def _who() -> str:
    program = Path(sys.argv[0]).name or "python"
    try:
        user = getpass.getuser()
    except (OSError, KeyError):
        user = "somebody"
    return f"{user}@{socket.gethostname()} {program}"
