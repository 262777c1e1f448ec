"""What one browser gets, at the pace at which it takes it."""

from __future__ import annotations

import asyncio
import contextlib
import json
import math
from dataclasses import dataclass
from typing import Any

from aiohttp import WSMsgType, web

from vdms_rt.view.board import Board
from vdms_rt.view.history import History, message

SEND_PERIOD_S = 1 / 30
SUMMARY_PERIOD_S = 0.5
MOST_ROWS = 4096
"""In one message: what is caught up comes in several."""
MOST_STREAMS = 8
HEARTBEAT_S = 10.0
"""A browser that is gone without a word is noticed within this time."""
LONGEST_REQUEST_BYTES = 4096


@dataclass(slots=True)
class _Stream:
    """A marker that the browser shows."""

    station: str
    marker: str
    place: int = 0
    stretch: int = -1
    session: str = ""
    last_seq: int | None = None
    resumed: bool = False
    """The next stretch is the one that the browser has the beginning of."""


class Feed:
    """One browser's connection. Its place in the history waits for it, and nothing else does: a
    slow browser has a longer way to catch up, one slower than the history is told what it skipped.
    """

    def __init__(self, board: Board, socket: web.WebSocketResponse) -> None:
        self._board = board
        self._socket = socket
        self._streams: dict[int, _Stream] = {}
        self._told = 0

    async def serve(self, hello: dict[str, Any]) -> None:
        """Send and receive until the browser goes."""
        await self._say("hello", **hello)
        sender = asyncio.create_task(self._send())
        try:
            async for received in self._socket:
                if received.type is not WSMsgType.TEXT or not self._asked(received.data):
                    break
        finally:
            sender.cancel()
            with contextlib.suppress(asyncio.CancelledError, ConnectionError):
                await sender

    async def _send(self) -> None:
        clock = asyncio.get_running_loop().time
        summary_s = clock()
        while True:
            for number, stream in tuple(self._streams.items()):
                await self._send_samples(number, stream)
            if clock() >= summary_s:
                summary_s = clock() + SUMMARY_PERIOD_S
                await self._send_summary()
            await asyncio.sleep(SEND_PERIOD_S)

    async def _send_samples(self, number: int, stream: _Stream) -> None:
        history = self._board.history(stream.station, stream.marker)
        if history is None:
            return
        if stream.stretch != history.stretch:
            await self._begin_stretch(number, stream, history)
        while True:
            rows, stream.place, skipped = history.after(stream.place, stream.last_seq, MOST_ROWS)
            if skipped is not None:
                await self._say("skipped", stream=number, first_seq=skipped[0], last_seq=skipped[1])
            if not len(rows):
                return
            stream.last_seq = int(rows["seq"][-1])
            await self._socket.send_bytes(message(number, rows))
            if len(rows) < MOST_ROWS or stream.stretch != history.stretch:
                return

    async def _begin_stretch(self, number: int, stream: _Stream, history: History) -> None:
        session = f"{history.session:016x}"
        goes_on = stream.resumed and stream.session == session and stream.last_seq is not None
        first = history.place_after(-1)
        if goes_on and stream.last_seq is not None:
            stream.place = history.place_after(stream.last_seq)
            if stream.place == first:
                # What it has may end before the history begins: `after` finds how much is missing.
                stream.place = -1
        else:
            stream.place, stream.last_seq = first, None
        stream.session, stream.stretch, stream.resumed = session, history.stretch, False
        await self._say("stretch", stream=number, session=session, goes_on=goes_on)

    async def _send_summary(self) -> None:
        events = self._board.events_after(self._told)
        if events:
            self._told = events[-1]["number"]
        await self._say("summary", stations=self._board.summary(), events=events)

    async def _say(self, kind: str, **fields: Any) -> None:
        await self._socket.send_str(json.dumps({"kind": kind, **fields}, allow_nan=False))

    def _asked(self, text: str) -> bool:
        """Begin or end a stream; return False for what the page never sends."""
        try:
            request = json.loads(text)
            number = int(request["stream"])
            if request["show"] is None:
                self._streams.pop(number, None)
                return True
            show = request["show"]
            stream = _Stream(str(show["station"]), str(show["marker"]))
            if show.get("session"):
                stream.session, stream.resumed = str(show["session"]), True
                stream.last_seq = int(show["last_seq"])
        except (KeyError, TypeError, ValueError, OverflowError):
            return False
        if not 0 <= number < 1 << 32 or (stream.last_seq or 0) > math.pow(2, 53):
            return False
        self._streams[number] = stream
        return len(self._streams) <= MOST_STREAMS
