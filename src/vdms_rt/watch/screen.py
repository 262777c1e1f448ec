"""The board on a terminal."""

from __future__ import annotations

from rich.console import Console, ConsoleOptions, Group, RenderableType, RenderResult
from rich.table import Table
from rich.text import Text

from vdms_rt.model import State
from vdms_rt.watch.board import (
    GONE,
    PLOT_SPAN_S,
    Board,
    MarkerView,
    StationView,
    figures,
)
from vdms_rt.watch.plot import plot

LEAST_PLOT_HEIGHT = 5
MOST_PLOT_HEIGHT = 18
EVENT_LINES = 3

_BAD_STATES = {
    GONE,
    State.NO_DEVICE.value,
    State.NO_SIGNAL.value,
    State.STALLED.value,
    State.LOST.value,
    State.SET_UP_STALE.value,
}


class Screen:
    """Head, stations, plots, events: what fits into the terminal. Made anew for each refresh."""

    def __init__(
        self, board: Board, connect: tuple[str, ...], waiting_for: tuple[str, ...], now_ns: int
    ) -> None:
        self._board = board
        self._connect = connect
        self._waiting_for = waiting_for
        self._now_ns = now_ns

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        width = options.max_width
        height = options.height or console.height
        stations = self._stations()
        events = [
            Text(line, style="dim", no_wrap=True, overflow="ellipsis")
            for line in list(self._board.events)[-EVENT_LINES:]
        ]
        used = 2 + len(events) + len(console.render_lines(stations, options.update(height=None)))
        yield self._head(width)
        yield Text("─" * width, style="dim")
        yield stations
        yield from self._plots(width, height - used)
        yield from events

    def _head(self, width: int) -> Text:
        if self._waiting_for:
            where = Text(f"waiting for {', '.join(self._waiting_for)} ...", style="bold yellow")
        else:
            where = Text(f"connected to {', '.join(self._connect)}", style="green")
            if not self._board.stations:
                where = Text(f"{where.plain}, waiting for a station ...", style="bold yellow")
        head = Text("vdms-rt watch  ", style="bold", no_wrap=True)
        head.append_text(where)
        end = "  Ctrl-C ends"
        head.truncate(max(width - len(end), 0), overflow="ellipsis", pad=True)
        return head.append(end, style="dim")

    def _stations(self) -> RenderableType:
        parts: list[RenderableType] = []
        for name, station in self._board.stations.items():
            parts.append(_station_line(name, station))
            if station.markers:
                parts.append(self._markers(station))
        return Group(*parts)

    def _markers(self, station: StationView) -> Table:
        table = Table(box=None, padding=(0, 2, 0, 0), pad_edge=False, header_style="dim")
        table.add_column("  marker", no_wrap=True)
        for name in ("x mm", "y mm", "rot. mrad", "sigma mm", "Hz", "missed"):
            table.add_column(name, justify="right", no_wrap=True)
        table.add_column("status")
        for name, marker in station.markers.items():
            newest = marker.newest
            fresh = station.alive and not marker.silent(self._now_ns)
            good = fresh and newest is not None and newest.valid
            x_mm, y_mm, rotation_mrad, sigma_mm = figures(newest)
            table.add_row(
                f"  {name}",
                Text(x_mm, style="bold" if good else "dim"),
                Text(y_mm, style="bold" if good else "dim"),
                rotation_mrad,
                sigma_mm,
                f"{marker.rate_hz if fresh else 0.0:.2f}",
                Text(str(marker.missed), style="bold red" if marker.missed else ""),
                Text(marker.standing(self._now_ns), style="" if good else "yellow"),
            )
        return table

    def _plots(self, width: int, height: int) -> list[RenderableType]:
        """Return as many plots as have room in `height` lines, or what there is no room for."""
        shown: list[tuple[str, MarkerView]] = [
            (f"{station_name}/{name}", marker)
            for station_name, station in self._board.stations.items()
            for name, marker in station.markers.items()
            if marker.newest is not None
        ]
        count = min(len(shown), height // (LEAST_PLOT_HEIGHT + 1))
        if not count:
            return []
        each = min(height // count - 1, MOST_PLOT_HEIGHT)
        parts: list[RenderableType] = []
        for name, marker in shown[:count]:
            parts.append(Text(f"x of {name}, mm", style="dim", no_wrap=True))
            lines = plot(list(marker.points), width, each, PLOT_SPAN_S)
            parts.append(Text("\n".join(lines), no_wrap=True, style="cyan"))
        return parts


def _station_line(name: str, station: StationView) -> Text:
    line = Text(no_wrap=True, overflow="ellipsis")
    line.append(name, style="bold")
    state = station.state
    style = "bold red" if state in _BAD_STATES else "bold yellow"
    line.append(f"  {state}", style="bold green" if state == State.MEASURING.value else style)
    health = station.health
    if health is not None and station.alive:
        line.append(f"  {health.frame_rate_hz:.2f} frames/s  ")
        line.append(f"lost {station.lost}", style="bold red" if station.lost else "")
        if health.record_trouble:
            line.append(f"  NOT RECORDING: {health.record_trouble}", style="bold red")
            return line
        if health.pixels_left_out:
            line.append(f"  without pixels of {health.pixels_left_out} frames", style="yellow")
        if health.recording:
            line.append(f"  recording {health.recording}")
        else:
            line.append("  not recording", style="dim")
    return line
