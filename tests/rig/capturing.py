"""The capture thread on a kernel driver, without the stages after it: states, counts and frames."""

import threading
from collections.abc import Callable

from rig.devices import wait_for

from vdms_rt.capture.loop import Capture
from vdms_rt.config import Config, V4l2
from vdms_rt.model import Event, Frame, State
from vdms_rt.ring import Ring, RingClosed

DEADLINE_S = 150.0
"""How long a test waits for what must come; reached only when it fails."""


class Capturing:
    """A running capture thread, and what it gave. A context manager."""

    def __init__(self, device: str, idle: Callable[[], bool] = lambda: False, **settings: object):
        self.events: list[Event] = []
        self.frames: list[Frame] = []
        """As they were, but for the image, which is the ring's."""
        config = Config(source="v4l2", v4l2=V4l2(**{"device": device, **settings}))
        self._ring = Ring(64, live=True)
        self._stop = threading.Event()
        self.capture = Capture(config, self._ring, self.events.append, lambda truth: None, idle)
        self._threads = (
            threading.Thread(target=self.capture.run, args=(self._stop,), name="capture"),
            threading.Thread(target=self._drain, name="drain"),
        )

    def __enter__(self) -> "Capturing":
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def stop(self) -> None:
        self._stop.set()
        for thread in self._threads:
            thread.join(DEADLINE_S)
            assert not thread.is_alive()

    @property
    def state(self) -> State:
        return self.capture.counters.state

    def wait_for_state(self, state: State) -> None:
        wait_for(lambda: self.state is state, f"{state.value}; it said: {self.said()}", DEADLINE_S)

    def wait_for_frames(self, count: int) -> None:
        """Wait until it has given so many frames more."""
        target = len(self.frames) + count
        wait_for(lambda: len(self.frames) >= target, f"{count} frames more", DEADLINE_S)

    def wait_until_said(self, words: str) -> None:
        wait_for(lambda: words in self.said(), f"{words!r}; it said: {self.said()}", DEADLINE_S)

    def said(self, code: str = "") -> str:
        """Return the events' sentences, one a line; of one code alone if it is given."""
        return "\n".join(e.text for e in self.events if code in ("", e.code))

    def states(self) -> list[str]:
        """Return the states that were told, in their order."""
        return [dict(e.facts)["state"] for e in self.events if e.code == "state"]

    def _drain(self) -> None:
        while True:
            try:
                lease = self._ring.take(0.2)
            except RingClosed:
                return
            if lease is not None:
                with lease as frame:
                    self.frames.append(frame)
