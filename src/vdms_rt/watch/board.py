"""What is known of the stations, and how it reads."""

from __future__ import annotations

import math
import time
from collections import deque
from dataclasses import dataclass, field

from vdms_rt.model import Displacement, Event, Health
from vdms_rt.status import status_words
from vdms_rt.subscribe import Arrived, Left, Missed, Notice, Sample

PLOT_SPAN_S = 10.0
RATE_SPAN_NS = 2_000_000_000
SILENT_S = 1.5
"""Without a sample for so long it is said."""
EVENTS_KEPT = 50
GONE = "gone"


@dataclass(slots=True)
class MarkerView:
    """One marker of one station."""

    newest: Displacement | None = None
    received_ns: int = 0
    points: deque[tuple[float, float]] = field(default_factory=deque)
    """(s, mm) of x in the last `PLOT_SPAN_S`, on the station's clock; NaN where invalid."""
    samples: int = 0
    missed: int = 0
    on_the_way: int = 0
    sessions: int = 0

    def take(self, sample: Displacement, received_ns: int) -> None:
        """Add one sample."""
        if self.newest is None or self.newest.session != sample.session:
            self.sessions += 1
            self.points.clear()
        self.newest = sample
        self.received_ns = received_ns
        self.samples += 1
        self.points.append((sample.t_ns / 1e9, sample.x_mm if sample.valid else math.nan))
        while self.points[0][0] < sample.t_ns / 1e9 - PLOT_SPAN_S:
            self.points.popleft()

    @property
    def rate_hz(self) -> float:
        """Samples a second by the samples' own times over the last 2 s; 0 if unknown."""
        if not self.points:
            return 0.0
        newest_s = self.points[-1][0]
        recent = [t_s for t_s, _ in self.points if t_s >= newest_s - RATE_SPAN_NS / 1e9]
        return (len(recent) - 1) / (newest_s - recent[0]) if newest_s > recent[0] else 0.0

    def silent(self, now_ns: int) -> bool:
        """No sample has come for longer than any pause between pictures."""
        return (now_ns - self.received_ns) / 1e9 > SILENT_S

    def standing(self, now_ns: int) -> str:
        """Return the newest sample's status in words, or that there is none any more."""
        if self.newest is None:
            return "no sample yet"
        if self.silent(now_ns):
            return f"no sample for {(now_ns - self.received_ns) / 1e9:.0f} s"
        return status_words(self.newest.status)


@dataclass(slots=True)
class StationView:
    """One station."""

    alive: bool = False
    health: Health | None = None
    markers: dict[str, MarkerView] = field(default_factory=dict)

    @property
    def state(self) -> str:
        """The daemon's state in words, or that it is gone."""
        if not self.alive:
            return GONE
        return self.health.state.value if self.health else "no health yet"

    @property
    def lost(self) -> int:
        """Frames that the station itself has lost."""
        return self.health.missed + self.health.overwritten if self.health else 0


class Board:
    """Everything that came, by station and marker."""

    def __init__(self) -> None:
        self.stations: dict[str, StationView] = {}
        self.events: deque[str] = deque(maxlen=EVENTS_KEPT)
        """Lines for a person, the newest last."""

    def take(self, item: Sample | Notice) -> str | None:
        """Add one item; return the line to tell a person at once, if it deserves one."""
        line = self._notice(item) if not isinstance(item, Sample) else self._sample(item)
        if line is not None:
            self.events.append(line)
        return line

    def _sample(self, sample: Sample) -> str | None:
        station = self._station(sample.station)
        match sample.value:
            case Displacement() as displacement:
                marker = station.markers.setdefault(sample.marker, MarkerView())
                marker.take(displacement, sample.received_ns)
            case Health() as health:
                station.health = health
            case Event() as event:
                return f"{_clock(event.utc_ns)} {sample.station}: {event.text}"
        return None

    def _notice(self, notice: Notice) -> str:
        if isinstance(notice, (Arrived, Left)):
            self._station(notice.station).alive = isinstance(notice, Arrived)
        elif isinstance(notice, Missed):
            marker = self._station(notice.station).markers.setdefault(notice.marker, MarkerView())
            marker.missed += notice.count
            marker.on_the_way += notice.on_the_way
        return f"{_clock(time.time_ns())} {notice}"

    def _station(self, name: str) -> StationView:
        return self.stations.setdefault(name, StationView())


def marker_line(name: str, station: StationView, marker: MarkerView, now_ns: int) -> str:
    """Return one plain line of a marker's newest sample."""
    x_mm, y_mm, rotation_mrad, sigma_mm = figures(marker.newest)
    parts = [
        f"{name}  x {x_mm:>9} mm  y {y_mm:>9} mm  rotation {rotation_mrad:>8} mrad",
        f"sigma {sigma_mm:>6} mm",
        f"{marker.rate_hz:.2f} Hz",
        f"missed {marker.missed}",
        station.state,
        marker.standing(now_ns),
    ]
    if station.health and station.health.recording:
        parts.append(f"recording {station.health.recording}")
    return "  ".join(parts)


def figures(sample: Displacement | None) -> tuple[str, str, str, str]:
    """Return x, y in mm, rotation in mrad, and the larger sigma in mm; a dash for none."""
    if sample is None:
        return "-", "-", "-", "-"
    return (
        _number(sample.x_mm, "+.4f"),
        _number(sample.y_mm, "+.4f"),
        _number(sample.rotation_mrad, "+.3f"),
        _number(max(sample.sigma_x_mm, sample.sigma_y_mm), ".4f"),
    )


def _number(value: float, form: str) -> str:
    return format(value, form) if math.isfinite(value) else "-"


def summary(board: Board) -> list[str]:
    """Return the account at the end, a line for each marker."""
    lines = []
    for station_name, station in board.stations.items():
        for marker_name, marker in station.markers.items():
            line = f"{station_name}/{marker_name}: {marker.samples} samples, "
            line += f"{marker.missed} missed"
            if marker.missed:
                line += f" ({marker.on_the_way} of them on the way)"
            if marker.sessions > 1:
                line += f", {marker.sessions} sessions"
            lines.append(line)
    return lines or ["no sample came"]


def _clock(utc_ns: int) -> str:
    return time.strftime("%H:%M:%S", time.localtime(utc_ns / 1e9)) if utc_ns else "--:--:--"
