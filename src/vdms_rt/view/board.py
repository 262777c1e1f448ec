"""What is known of the stations: their state for the page, and the history of each marker."""

from __future__ import annotations

import contextlib
import math
import time
from collections import deque
from dataclasses import asdict, dataclass, field
from typing import Any

from vdms_rt.model import Displacement, Event, Health
from vdms_rt.setup import SetUpError, set_up_from_json
from vdms_rt.status import status_words
from vdms_rt.subscribe import Arrived, Left, Missed, Notice, Sample
from vdms_rt.view.history import History
from vdms_rt.wire import vdms_pb2 as pb

EVENTS_KEPT = 200
SILENT_S = 1.5
"""Without a sample for so long it is said."""


@dataclass(slots=True)
class MarkerView:
    """One marker of one station."""

    history: History = field(default_factory=History)
    newest: Displacement | None = None
    received_s: float = 0.0
    missed: int = 0
    on_the_way: int = 0


@dataclass(slots=True)
class StationView:
    """One station."""

    alive: bool = False
    health: Health | None = None
    markers: dict[str, MarkerView] = field(default_factory=dict)
    order: tuple[str, ...] = ()
    """Of the markers: as configured, those that move first. Empty before the first set-up."""

    def marker(self, name: str) -> MarkerView:
        """Return the marker of this name, a new one where it is not known yet."""
        # Not by setdefault: it would make a whole history for each sample and throw it away.
        known = self.markers.get(name)
        if known is None:
            known = self.markers[name] = MarkerView()
        return known


class Board:
    """Everything that came. The loop's thread alone uses it."""

    def __init__(self) -> None:
        self.stations: dict[str, StationView] = {}
        self.events: deque[dict[str, Any]] = deque(maxlen=EVENTS_KEPT)
        self._told = 0

    def take(self, items: list[Sample | Notice]) -> None:
        """Add what came, in its order."""
        now_s = time.time()
        for item in items:
            if isinstance(item, Sample):
                self._sample(item, now_s)
            else:
                self._notice(item, now_s)

    def summary(self) -> dict[str, Any]:
        """Return every station and the newest sample of each marker, ready for JSON."""
        now_s = time.monotonic()
        return {
            name: {
                "alive": station.alive,
                "state": _state(station),
                "health": _health(station.health),
                "markers": {m: _marker(station.markers[m], now_s) for m in _ordered(station)},
            }
            for name, station in sorted(self.stations.items())
        }

    def events_after(self, number: int) -> list[dict[str, Any]]:
        """Return the events with a larger number, the oldest first."""
        return [event for event in self.events if event["number"] > number]

    def history(self, station: str, marker: str) -> History | None:
        """Return the samples of a marker, None if none ever came."""
        known = self.stations.get(station)
        view = known.markers.get(marker) if known else None
        return view.history if view else None

    def _sample(self, sample: Sample, now_s: float) -> None:
        station = self._station(sample.station)
        match sample.value:
            case Displacement() as displacement:
                marker = station.marker(sample.marker)
                marker.newest = displacement
                marker.received_s = sample.received_ns / 1e9
                marker.history.append(displacement, now_s)
            case Health() as health:
                station.health = health
            case Event() as event:
                utc_s = event.utc_ns / 1e9 or now_s
                self._tell(sample.station, utc_s, event.severity, event.code, event.text)
            case pb.SetUp() as message:
                # A station of another version has its markers in the order of their coming.
                with contextlib.suppress(SetUpError):
                    shapes = [m.shape for m in set_up_from_json(message.json).markers]
                    station.order = tuple(s.name for s in sorted(shapes, key=lambda s: s.fixed))

    def _notice(self, notice: Notice, now_s: float) -> None:
        name = ""
        severity = 1
        if isinstance(notice, (Arrived, Left)):
            name = notice.station
            self._station(name).alive = isinstance(notice, Arrived)
            severity = int(isinstance(notice, Left))
        elif isinstance(notice, Missed):
            name = notice.station
            marker = self._station(name).marker(notice.marker)
            marker.missed += notice.count
            marker.on_the_way += notice.on_the_way
            if not notice.on_the_way:
                return  # the station has told of it itself
        text = str(notice).removeprefix(f"{name}: ")
        self._tell(name, now_s, severity, type(notice).__name__.lower(), text)

    def _tell(self, station: str, utc_s: float, severity: int, code: str, text: str) -> None:
        self._told += 1
        self.events.append(
            {
                "number": self._told,
                "station": station,
                "utc_s": utc_s,
                "severity": int(severity),
                "code": code,
                "text": text,
            }
        )

    def _station(self, name: str) -> StationView:
        return self.stations.setdefault(name, StationView())


def _ordered(station: StationView) -> list[str]:
    first = [name for name in station.order if name in station.markers]
    return first + [name for name in station.markers if name not in first]


def _state(station: StationView) -> str:
    if not station.alive:
        return "gone"
    return station.health.state.value if station.health else "starting"


def _health(health: Health | None) -> dict[str, Any] | None:
    if health is None:
        return None
    values = asdict(health)
    del values["session"]
    return {name: _finite(value) for name, value in values.items()}


def _marker(view: MarkerView, now_s: float) -> dict[str, Any]:
    newest = view.newest
    silent_s = now_s - view.received_s
    standing = "no sample yet"
    if newest is not None:
        standing = status_words(newest.status)
        if silent_s > SILENT_S:
            standing = f"no sample for {silent_s:.0f} s"
    return {
        "x_mm": _finite(newest.x_mm) if newest and newest.valid else None,
        "y_mm": _finite(newest.y_mm) if newest and newest.valid else None,
        "valid": bool(newest and newest.valid and silent_s <= SILENT_S),
        "standing": standing,
        "missed": view.missed,
        "on_the_way": view.on_the_way,
    }


def _finite(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value
