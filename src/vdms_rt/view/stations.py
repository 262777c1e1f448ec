"""Requests to stations, for all browsers together."""

from __future__ import annotations

import asyncio
import contextlib
import threading
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from vdms_rt.control.client import ControlError, Controller, Credentials
from vdms_rt.wire import control_pb2 as control

THREADS = 4
PICTURE_AGE_S = 0.15
"""A picture no older than this serves a further browser too."""
PICTURE = {"quality": 75, "most_width_px": 960}


class Stations:
    """Asks stations; each one's link is kept. The loop's thread uses it."""

    def __init__(self, endpoints: Sequence[str], credentials: Credentials, who: str) -> None:
        """Any of the addresses may lead to a station."""
        self._endpoints = tuple(endpoints)
        self._credentials = credentials
        self._who = who
        self._links: dict[str, Controller] = {}
        self._open = contextlib.ExitStack()
        self._lock = threading.Lock()
        self._pool = ThreadPoolExecutor(THREADS, "ask")
        self._pictures: dict[str, tuple[float, asyncio.Future[control.Answer]]] = {}

    async def ask(
        self, station: str, verb: str, fields: dict[str, Any], asker: str = ""
    ) -> control.Answer:
        """Return a station's answer; its log names `asker`, if this is not empty, too.

        Raises ControlError if none came, TypeError or ValueError for fields it does not have.
        """
        return await asyncio.get_running_loop().run_in_executor(
            self._pool, self._ask, station, verb, fields, asker
        )

    async def picture(self, station: str) -> control.Answer:
        """Return what the camera sees; browsers that ask at the same time get the same."""
        taken_s, answer = self._pictures.get(station, (0.0, None))
        if answer is None or (answer.done() and time.monotonic() - taken_s > PICTURE_AGE_S):
            answer = asyncio.ensure_future(self.ask(station, "preview", PICTURE))
            self._pictures[station] = time.monotonic(), answer
        return await asyncio.shield(answer)

    async def close(self) -> None:
        """Wait for what is being asked, and close the links."""
        await asyncio.to_thread(self._pool.shutdown)
        self._open.close()

    def _ask(self, station: str, verb: str, fields: dict[str, Any], asker: str) -> control.Answer:
        who = f"{asker} at {self._who}" if asker else self._who
        return self._link(station).ask(verb, who=who, **fields)

    def _link(self, station: str) -> Controller:
        with self._lock:
            if station in self._links:
                return self._links[station]
            fault = ControlError(f"no address of station {station} is known")
            for endpoint in self._endpoints:
                link = Controller(
                    endpoint, station=station, credentials=self._credentials, who=self._who
                )
                try:
                    self._links[station] = self._reach(link)
                except ControlError as error:
                    fault = error
                    continue
                return link
            raise fault

    def _reach(self, link: Controller) -> Controller:
        with contextlib.ExitStack() as stack:
            stack.enter_context(link)
            link.ask("status")
            self._open.push(stack.pop_all())
        return link
