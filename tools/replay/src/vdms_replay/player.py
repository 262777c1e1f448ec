"""Says cues at their moments: pace, pause, seek, loop."""

from __future__ import annotations

import secrets
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from vdms_replay.ahead import Ahead
from vdms_replay.track import Cue, Programme

SLOWEST, FASTEST = 0.1, 100.0
LATENESS_KEPT = 100_000
CUES_AHEAD = 4096
WAIT_S = 0.5


@dataclass(frozen=True, slots=True)
class Standing:
    """Where the player is."""

    position_s: float
    """Since the start of the programme."""
    length_s: float
    speed: float
    paused: bool
    ended: bool


class Player:
    """Plays a programme in the thread that calls `run`; any thread may steer it.

    Each start, seek and turn of the loop is a take: `say` gets the cues of a take with one number,
    by which receivers can tell it from the takes before.
    """

    def __init__(
        self,
        programme: Programme,
        say: Callable[[Cue, int], None],
        *,
        speed: float = 1.0,
        loop: bool = False,
        from_ns: int | None = None,
        to_ns: int | None = None,
        paused: bool = False,
    ) -> None:
        """`from_ns` and `to_ns` are moments of the programme; None is its start and its end."""
        self._programme = programme
        self._say = say
        self._loop = loop
        self._from_ns = programme.start_ns if from_ns is None else from_ns
        self._to_ns = programme.end_ns if to_ns is None else to_ns
        self._changed = threading.Condition()
        self._speed = speed
        self._paused = paused
        self._quit = False
        self._ended = False
        self._seek_ns: int | None = self._from_ns
        self._anchor_at_ns = self._from_ns
        self._anchor_ns = 0
        """The monotonic clock at `_anchor_at_ns`; meaningless while it is paused."""
        self.lateness_ns: deque[int] = deque(maxlen=LATENESS_KEPT)
        """From the moment at which a cue was due until it was said, of the newest cues."""

    def run(self) -> None:
        """Play until the end, or until `quit`; with loop only until `quit`."""
        while (from_ns := self._begin()) is not None:
            with Ahead(self._programme.cues(from_ns), CUES_AHEAD) as cues:
                if not self._play(cues, from_ns, secrets.randbits(64)):
                    return

    def _begin(self) -> int | None:
        """Return the moment at which the next take begins, None if there is none."""
        with self._changed:
            if self._ended and self._loop and self._seek_ns is None:
                self._seek_ns = self._from_ns
            from_ns, self._seek_ns = self._seek_ns, None
            if self._quit or from_ns is None:
                return None
            self._ended = False
            self._anchor(from_ns)
            return from_ns

    def _play(self, cues: Iterator[Cue], from_ns: int, take: int) -> bool:
        """Say one take, until its end or until it is broken off; False if it has no cue."""
        cue = self._next(cues)
        said = False
        with self._changed:
            if not self._paused:
                self._anchor(from_ns)
        while True:
            with self._changed:
                if self._quit or self._seek_ns is not None:
                    return True
                if cue is None:
                    self._ended = True
                    return said
                if self._paused:
                    self._changed.wait(WAIT_S)
                    continue
                due_ns = self._anchor_ns + round((cue.at_ns - self._anchor_at_ns) / self._speed)
                wait_ns = due_ns - time.monotonic_ns()
                if wait_ns > 0:
                    self._changed.wait(min(wait_ns / 1e9, WAIT_S))
                    continue
            self.lateness_ns.append(time.monotonic_ns() - due_ns)
            self._say(cue, take)
            said = True
            cue = self._next(cues)

    def pause(self, paused: bool = True) -> None:
        """Stop the time, or let it go on."""
        with self._changed:
            if paused != self._paused:
                self._anchor(self._now_ns())
                self._paused = paused
                self._changed.notify_all()

    def seek(self, position_s: float) -> None:
        """Go on from so long after the start of the programme; it stays between its ends."""
        with self._changed:
            self._seek_to(position_s)

    def skip(self, seconds: float) -> None:
        """Go so far on, or back if negative."""
        with self._changed:
            self._seek_to((self._now_ns() - self._programme.start_ns) / 1e9 + seconds)

    def set_speed(self, speed: float) -> None:
        """Go on at another speed, kept between SLOWEST and FASTEST."""
        with self._changed:
            self._anchor(self._now_ns())
            self._speed = min(max(speed, SLOWEST), FASTEST)
            self._changed.notify_all()

    def quit(self) -> None:
        """Let `run` return."""
        with self._changed:
            self._quit = True
            self._changed.notify_all()

    def standing(self) -> Standing:
        """Return where the player is."""
        with self._changed:
            return Standing(
                position_s=(self._now_ns() - self._programme.start_ns) / 1e9,
                length_s=self._programme.seconds,
                speed=self._speed,
                paused=self._paused,
                ended=self._ended,
            )

    def _seek_to(self, position_s: float) -> None:
        at_ns = self._programme.start_ns + round(position_s * 1e9)
        self._seek_ns = min(max(at_ns, self._from_ns), self._to_ns)
        self._changed.notify_all()

    def _anchor(self, at_ns: int) -> None:
        self._anchor_at_ns, self._anchor_ns = at_ns, time.monotonic_ns()

    def _now_ns(self) -> int:
        """Return the moment of the programme that it is now."""
        if self._seek_ns is not None:
            return self._seek_ns
        if self._paused:
            return self._anchor_at_ns
        run_ns = round((time.monotonic_ns() - self._anchor_ns) * self._speed)
        return min(self._anchor_at_ns + run_ns, self._to_ns)

    def _next(self, cues: Iterator[Cue]) -> Cue | None:
        cue = next(cues, None)
        return cue if cue is not None and cue.at_ns <= self._to_ns else None


def lateness(player: Player) -> dict[str, Any]:
    """Return how late cues were said, in milliseconds: how many, median, 99 %, most."""
    late_ms = np.array(player.lateness_ns, np.float64) / 1e6
    if not len(late_ms):
        return {"count": 0}
    median, high = np.percentile(late_ms, [50, 99])
    return {
        "count": len(late_ms),
        "median_ms": float(median),
        "p99_ms": float(high),
        "most_ms": float(late_ms.max()),
    }
