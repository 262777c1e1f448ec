"""`vdms-rt view`: serves the page and, behind it, what the stations say and answer."""

from __future__ import annotations

import asyncio
import contextlib
import signal
import socket
import sys
import time
from collections.abc import AsyncIterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from aiohttp import WSCloseCode, web
from google.protobuf.json_format import MessageToDict

import vdms_rt
from vdms_rt.control.client import ControlError, Credentials
from vdms_rt.model import VdmsError
from vdms_rt.subscribe import Notice, Sample, Subscription, subscribe
from vdms_rt.view.board import Board
from vdms_rt.view.feed import HEARTBEAT_S, LONGEST_REQUEST_BYTES, Feed
from vdms_rt.view.guard import Guard, add_headers
from vdms_rt.view.stations import Stations
from vdms_rt.wire.verbs import VERBS

KEYS = ("vdms/*/*/displacement", "vdms/*/health", "vdms/*/event", "vdms/*/setup")
STATIC = Path(__file__).parent / "static"
LOOKING = ("status", "preview", "recordings", "stroke")
"""What whoever reaches the page may ask."""
COLLECT_S = 0.02
WAIT_S = 0.2
MOST_COLLECTED = 2000
WRONG_TOKEN_S = 0.5
"""Guessing is slow."""
SHORTEST_TOKEN = 8
GRACE_S = 1.0
"""For requests that are being answered when it ends."""


class ViewError(VdmsError):
    """The page cannot be served."""


def run_view(
    connect: Sequence[str],
    control: Sequence[str],
    *,
    host: str,
    port: int,
    token: str,
    credentials: Credentials,
    seconds: float = 0.0,
) -> int:
    """Serve the page until Ctrl-C, SIGTERM or `seconds` (0: no limit); return the exit status, 0.

    It follows the stations at the addresses `connect`, and sends requests to those at `control`.
    An empty `token` leaves control to this computer. Call it in the main thread.

    Raises ViewError and SubscribeError with a sentence.
    """
    if token and len(token) < SHORTEST_TOKEN:
        raise ViewError(f"--token: of {len(token)} letters is too easy; give {SHORTEST_TOKEN}")
    with subscribe(KEYS, connect, notices=True) as items:
        who = f"page on {socket.gethostname()}"
        view = _View(items, Guard(token), (connect, control), credentials, who)
        asyncio.run(view.serve(host, port, seconds))
    return 0


class _View:
    """The server, from its start to its end."""

    def __init__(
        self,
        items: Subscription[Sample | Notice],
        guard: Guard,
        addresses: tuple[Sequence[str], Sequence[str]],
        credentials: Credentials,
        who: str,
    ) -> None:
        self._items = items
        self._guard = guard
        self._connect, self._control = addresses
        self._credentials = credentials
        self._who = who
        self._board = Board()
        self._sockets: set[web.WebSocketResponse] = set()

    async def serve(self, host: str, port: int, seconds: float) -> None:
        """Serve until it is ended. Raises ViewError if it cannot listen."""
        ended = asyncio.Event()
        loop = asyncio.get_running_loop()
        for number in (signal.SIGINT, signal.SIGTERM):
            loop.add_signal_handler(number, ended.set)
        async with self._listening(host, port) as bound_port:
            collector = asyncio.create_task(self._collect(ended))
            self._tell(host, bound_port)
            waiting = asyncio.create_task(ended.wait())
            await asyncio.wait(
                (collector, waiting), timeout=seconds or None, return_when=asyncio.FIRST_COMPLETED
            )
            ended.set()
            await waiting
            await collector

    @contextlib.asynccontextmanager
    async def _listening(self, host: str, port: int) -> AsyncIterator[int]:
        self._stations = Stations(self._control, self._credentials, self._who)
        app = web.Application(middlewares=[self._guard.middleware])
        app.on_response_prepare.append(add_headers)
        app.on_shutdown.append(self._let_go)
        app.router.add_get("/", _index)
        app.router.add_get("/feed", self._feed)
        app.router.add_post("/ask/{station}/{verb}", self._ask)
        app.router.add_static("/static", STATIC)
        runner = web.AppRunner(app, access_log=None, shutdown_timeout=GRACE_S)
        try:
            await runner.setup()
            site = web.TCPSite(runner, host, port)
            try:
                await site.start()
            except OSError as error:
                why = error.strerror or error
                raise ViewError(
                    f"{host}:{port}: cannot listen there: {why}; name another --port or --host"
                ) from None
            yield runner.addresses[0][1]
        finally:
            await runner.cleanup()
            await self._stations.close()

    async def _collect(self, ended: asyncio.Event) -> None:
        """Bring what the subscription's own thread puts into its inbox to the board."""
        loop = asyncio.get_running_loop()
        with ThreadPoolExecutor(1, "collect") as thread:
            while not ended.is_set():
                self._board.take(await loop.run_in_executor(thread, _waiting, self._items))

    def _tell(self, host: str, port: int) -> None:
        local = host in ("127.0.0.1", "::1", "localhost")
        shown = host if local else socket.gethostname()
        if ":" in shown:
            shown = f"[{shown}]"
        fragment = f"#token={self._guard.token}" if self._guard.token else ""
        lines = [f"page: http://{shown}:{port}/{fragment}"]
        if not local and not self._guard.token:
            lines.append("for looking only from other computers; --token lets them control too")
        sys.stdout.write("\n".join(lines) + "\n")
        sys.stdout.flush()

    async def _feed(self, request: web.Request) -> web.StreamResponse:
        ws = web.WebSocketResponse(
            heartbeat=HEARTBEAT_S, max_msg_size=LONGEST_REQUEST_BYTES, compress=False
        )
        try:
            await ws.prepare(request)
            self._sockets.add(ws)
            await Feed(self._board, ws).serve(
                {
                    "version": vdms_rt.__version__,
                    "access": self._guard.access(request),
                    "addresses": list(self._connect),
                }
            )
        except ConnectionError:
            pass  # the browser went meanwhile
        finally:
            self._sockets.discard(ws)
        # One that was never answered cannot be closed either.
        return ws if ws.prepared else web.Response()

    async def _ask(self, request: web.Request) -> web.Response:
        station, verb = request.match_info["station"], request.match_info["verb"]
        if verb not in VERBS:
            return _refused(404, "unknown-verb", f"{verb} is not known here")
        if request.content_type != "application/json":
            return _refused(415, "unreadable", "a request is JSON")
        try:
            fields = await request.json()
        except ValueError as error:
            return _refused(400, "unreadable", str(error))
        known = set(VERBS[verb].DESCRIPTOR.fields_by_name) - {"who"}
        if not isinstance(fields, dict) or set(fields) - known:
            return _refused(
                400, "unreadable", f"{verb} has the fields {', '.join(sorted(known)) or '(none)'}"
            )
        may_look = verb in LOOKING or (verb == "regions" and not fields.get("regions"))
        if not may_look and (why := self._guard.refusal(request)):
            await asyncio.sleep(WRONG_TOKEN_S)
            return _refused(403, "not-allowed", why)
        try:
            if verb == "preview":
                answer = await self._stations.picture(station)
            else:
                asker = "" if self._guard.local(request) else str(request.remote)
                answer = await self._stations.ask(station, verb, fields, asker)
        except ControlError as error:
            return _refused(502, "no-answer", str(error))
        except (TypeError, ValueError) as error:
            return _refused(400, "unreadable", str(error))
        told: dict[str, Any] = MessageToDict(
            answer, preserving_proto_field_name=True, always_print_fields_with_no_presence=True
        )
        return web.json_response(told)

    async def _let_go(self, _: web.Application) -> None:
        for ws in tuple(self._sockets):
            with contextlib.suppress(ConnectionError):
                await ws.close(code=WSCloseCode.GOING_AWAY, message=b"the page's server ends")


async def _index(_: web.Request) -> web.FileResponse:
    return web.FileResponse(STATIC / "index.html")


def _refused(status: int, code: str, text: str) -> web.Response:
    return web.json_response({"done": False, "code": code, "text": text}, status=status)


def _waiting(items: Subscription[Sample | Notice]) -> list[Sample | Notice]:
    """Return what has come, waiting for it; a few milliseconds' worth at once costs less."""
    got: list[Sample | Notice] = []
    until_s = time.monotonic() + WAIT_S
    while len(got) < MOST_COLLECTED:
        item = items.get(max(0.0, until_s - time.monotonic()))
        if item is None:
            break
        if not got:
            until_s = time.monotonic() + COLLECT_S
        got.append(item)
    return got
