"""Where a programme is said again: each station under a name that no live station can have."""

from __future__ import annotations

import contextlib
import functools
import json
import time
from collections.abc import Callable, Iterator
from types import TracebackType
from typing import Any, Self

import zenoh
from zenoh.handlers import Callback

from vdms_replay.player import Player, Standing
from vdms_replay.source import ReplayError
from vdms_replay.track import Cue, Programme
from vdms_rt.config import Control, Publish
from vdms_rt.publish import Publisher, PublishError
from vdms_rt.wire import topics
from vdms_rt.wire import vdms_pb2 as pb

SUFFIX = "@replay"
"""Of a replayed station's name: no configuration may have an @ in a station's."""
CONTROL_KEY = "vdms/{station}/control/replay/{verb}"
SESSION_BITS = (1 << 64) - 1


class Stage:
    """Publishes cues from `__enter__` to `__exit__`; all stations share one session.

    What is said is as it was recorded, but for two things: `session` is another one in each take,
    since within a session receivers drop what they had before; and `Health.recording` is empty.
    """

    def __init__(self, programme: Programme, config: Publish, speed: float) -> None:
        """`speed` sizes the history that late receivers get."""
        self._publishers: dict[str, Publisher] = {}
        first: Publisher | None = None
        rate_hz = max(programme.samples / max(programme.seconds, 1.0), 1.0) * speed
        for station, markers in programme.stations.items():
            publisher = Publisher(
                config,
                station + SUFFIX,
                markers,
                sample_rate_hz=rate_hz,
                control=Control(),
                beside=first,
            )
            self._publishers[station] = publisher
            first = first or publisher

    def __enter__(self) -> Self:
        """Open the session. Raises ReplayError."""
        with contextlib.ExitStack() as stack:
            try:
                for publisher in self._publishers.values():
                    stack.enter_context(publisher)
            except PublishError as error:
                raise ReplayError(
                    f"{error}".replace("publish.listen", "--listen").replace(
                        "publish.connect", "--connect"
                    )
                ) from None
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
    def stations(self) -> tuple[str, ...]:
        """The names under which they are said."""
        return tuple(station + SUFFIX for station in self._publishers)

    @property
    def state(self) -> str:
        """Where they can be reached, in words."""
        return next(iter(self._publishers.values())).state

    def say(self, cue: Cue, take: int) -> None:
        """Publish one cue of a take."""
        value: Any = cue.value
        if "session" in value.DESCRIPTOR.fields_by_name:
            value.session = (value.session ^ take) & SESSION_BITS
        if isinstance(value, pb.Health):
            value.recording = ""
        self._publishers[cue.station].put(cue.topic, cue.marker, value.SerializeToString())

    def tell(self, text: str) -> None:
        """Publish an event of the replay itself, at every station."""
        now_ns = time.time_ns()
        event = pb.Event(utc_ns=now_ns, severity=pb.Event.INFO, code="replay", text=text)
        for publisher in self._publishers.values():
            publisher.put(topics.EVENT, "", event.SerializeToString())

    @contextlib.contextmanager
    def controlled_by(self, player: Player) -> Iterator[None]:
        """Let programs on this computer steer `player` by queryable while the context lasts."""
        session = next(iter(self._publishers.values())).session
        with contextlib.ExitStack() as stack:
            for station in self.stations:
                for verb, act in VERBS.items():
                    key = CONTROL_KEY.format(station=station, verb=verb)

                    answer = functools.partial(_answer, key=key, player=player, act=act)
                    stack.enter_context(
                        session.declare_queryable(key, Callback(answer, indirect=False))
                    )
            yield


def _number(query: zenoh.Query) -> float:
    try:
        return float(query.parameters["value"] or "")
    except (KeyError, ValueError):
        raise ReplayError("give the number as ?value=12.5") from None


VERBS: dict[str, Callable[[Player, zenoh.Query], object]] = {
    "status": lambda *_: None,
    "pause": lambda player, _: player.pause(),
    "resume": lambda player, _: player.pause(False),
    "seek": lambda player, query: player.seek(_number(query)),
    "skip": lambda player, query: player.skip(_number(query)),
    "speed": lambda player, query: player.set_speed(_number(query)),
    "quit": lambda player, _: player.quit(),
}
"""What may be asked: `seek` and `skip` in seconds, `speed` as a factor, with `?value=`."""


def _answer(
    query: zenoh.Query, key: str, player: Player, act: Callable[[Player, zenoh.Query], object]
) -> None:
    """Act, and reply in JSON: `done`, `text` if it was refused, and where the player is."""
    with query:
        refusal = ""
        try:
            act(player, query)
        except ReplayError as error:
            refusal = str(error)
        query.reply(key, json.dumps(_values(player.standing(), refusal)))


def _values(standing: Standing, refusal: str) -> dict[str, Any]:
    return {
        "done": not refusal,
        "text": refusal,
        "position_s": round(standing.position_s, 6),
        "length_s": round(standing.length_s, 6),
        "speed": standing.speed,
        "paused": standing.paused,
        "ended": standing.ended,
    }
