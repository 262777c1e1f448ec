"""What a browser gets that is slow, sleeps, wakes up, or asks for nonsense."""

from __future__ import annotations

import asyncio
import json
import socket as sockets
import struct
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import numpy as np
from aiohttp import ClientSession, ClientWebSocketResponse, WSMsgType
from browsing import Server, server
from loopback import DEADLINE_S, free_endpoint, publisher, say

SHOW = {"station": "s1", "marker": "m1"}
MANY = 3600
"""As many as the station keeps for who comes late."""


@asynccontextmanager
async def feed(running: Server) -> AsyncIterator[ClientWebSocketResponse]:
    async with ClientSession() as session, session.ws_connect(f"{running.url}feed") as socket:
        hello = await told(socket, "hello")
        assert hello["access"] == "control"
        yield socket


async def told(socket: ClientWebSocketResponse, kind: str) -> dict[str, Any]:
    """Return the next message of this kind."""
    while True:
        received = await socket.receive(DEADLINE_S)
        assert received.type in (WSMsgType.TEXT, WSMsgType.BINARY), received
        if received.type is WSMsgType.TEXT:
            message: dict[str, Any] = json.loads(received.data)
            if message["kind"] == kind:
                return message


async def seqs(socket: ClientWebSocketResponse, last: int) -> list[int]:
    """Return the numbers of the samples up to `last`."""
    got: list[int] = []
    while not got or got[-1] != last:
        received = await socket.receive(DEADLINE_S)
        assert received.type in (WSMsgType.TEXT, WSMsgType.BINARY), received
        if received.type is WSMsgType.BINARY:
            _, count = np.frombuffer(received.data, "<u4", 2)
            got += (
                np.frombuffer(received.data, "<f8", count, 8 + 8 * int(count)).astype(int).tolist()
            )
    return got


def test_a_browser_that_sleeps_goes_on_where_it_was(tmp_path: Path) -> None:
    async def browse(running: Server) -> None:
        async with feed(running) as socket:
            await socket.send_json({"stream": 1, "show": SHOW})
            stretch = await told(socket, "stretch")
            assert not stretch["goes_on"]
            assert await seqs(socket, MANY - 1) == list(range(MANY))
        say(station, *range(MANY, MANY + 50))
        async with feed(running) as socket:
            known = {"session": stretch["session"], "last_seq": MANY - 1}
            await socket.send_json({"stream": 2, "show": SHOW | known})
            assert (await told(socket, "stretch"))["goes_on"]
            assert await seqs(socket, MANY + 49) == list(range(MANY, MANY + 50))

    endpoint = free_endpoint()
    with publisher(endpoint) as station, server(tmp_path, endpoint) as running:
        say(station, *range(MANY))
        asyncio.run(browse(running))


def test_what_is_gone_by_then_is_told(tmp_path: Path) -> None:
    async def browse(running: Server) -> None:
        async with feed(running) as socket:
            known = {"session": f"{7:016x}", "last_seq": 50}
            await socket.send_json({"stream": 1, "show": SHOW | known})
            skipped = await told(socket, "skipped")
            assert (skipped["first_seq"], skipped["last_seq"]) == (51, 99)
            assert await seqs(socket, 149) == list(range(100, 150))

    endpoint = free_endpoint()
    with publisher(endpoint) as station, server(tmp_path, endpoint) as running:
        say(station, *range(100, 150))
        asyncio.run(browse(running))


def test_a_new_session_begins_anew(tmp_path: Path) -> None:
    async def browse(running: Server) -> None:
        async with feed(running) as socket:
            await socket.send_json({"stream": 1, "show": SHOW})
            assert (await told(socket, "stretch"))["session"] == f"{7:016x}"
            assert await seqs(socket, 9) == list(range(10))
            say(station, *range(5), session=8)
            stretch = await told(socket, "stretch")
            assert (stretch["session"], stretch["goes_on"]) == (f"{8:016x}", False)
            assert await seqs(socket, 4) == list(range(5))

    endpoint = free_endpoint()
    with publisher(endpoint) as station, server(tmp_path, endpoint) as running:
        say(station, *range(10))
        asyncio.run(browse(running))


def test_a_browser_that_does_not_read_holds_up_nobody(tmp_path: Path) -> None:
    async def browse(running: Server) -> None:
        async with feed(running) as slow, feed(running) as quick:
            # It is sent as much as there can be, and reads none of it before the other has all.
            for stream in range(8):
                await slow.send_json({"stream": stream, "show": SHOW})
            await quick.send_json({"stream": 1, "show": SHOW})
            assert await seqs(quick, MANY - 1) == list(range(MANY))
            say(station, MANY)
            assert await seqs(quick, MANY) == [MANY]
            assert (await seqs(slow, MANY))[-1] == MANY

    endpoint = free_endpoint()
    with publisher(endpoint) as station, server(tmp_path, endpoint) as running:
        say(station, *range(MANY))
        asyncio.run(browse(running))


def test_a_browser_that_asks_for_nonsense_is_let_go(tmp_path: Path) -> None:
    async def browse(running: Server) -> None:
        for text in ("", "[]", '{"stream": -1, "show": {}}', '{"stream": 1, "show": {"x": 1}}'):
            async with feed(running) as socket:
                await socket.send_str(text)
                while (received := await socket.receive(DEADLINE_S)).type is WSMsgType.TEXT:
                    assert json.loads(received.data)["kind"] == "summary"
                assert received.type in (WSMsgType.CLOSE, WSMsgType.CLOSED, WSMsgType.CLOSING)
        async with feed(running) as socket:
            assert await told(socket, "summary")

    with server(tmp_path, free_endpoint()) as running:
        asyncio.run(browse(running))


def test_a_browser_that_goes_before_it_is_answered_leaves_no_trace(tmp_path: Path) -> None:
    async def browse(running: Server) -> None:
        async with feed(running):
            pass

    with server(tmp_path, free_endpoint()) as running:
        host, port = running.url.removeprefix("http://").rstrip("/").split(":")
        for _ in range(20):
            with sockets.create_connection((host, int(port))) as line:
                line.sendall(
                    f"GET /feed HTTP/1.1\r\nHost: {host}:{port}\r\nUpgrade: websocket\r\n"
                    "Connection: Upgrade\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n"
                    "Sec-WebSocket-Version: 13\r\n\r\n".encode()
                )
                # Closed with a reset.
                line.setsockopt(sockets.SOL_SOCKET, sockets.SO_LINGER, struct.pack("ii", 1, 0))
        asyncio.run(browse(running))
        running.stop()
        assert running.log.read_text() == ""
