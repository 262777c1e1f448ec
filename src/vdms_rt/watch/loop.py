"""`vdms-rt watch`: listens until it is ended."""

from __future__ import annotations

import contextlib
import math
import signal
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import TracebackType
from typing import Protocol, Self

from rich.console import Console
from rich.live import Live

from vdms_rt.model import Displacement
from vdms_rt.subscribe import Notice, Sample, Subscription, subscribe
from vdms_rt.watch.board import Board, marker_line, summary
from vdms_rt.watch.csv_file import CsvFile
from vdms_rt.watch.screen import Screen

KEYS = ("vdms/*/*/displacement", "vdms/*/health", "vdms/*/event")
SCREEN_PERIOD_S = 0.125
LINES_PERIOD_S = 1.0
FLUSH_PERIOD_S = 1.0


def run_watch(
    connect: str | Sequence[str], csv_path: Path | None = None, *, seconds: float = 0.0
) -> int:
    """Show what the stations at `connect` say until Ctrl-C, SIGTERM or `seconds` (0: no limit).

    On a terminal it is a screen that moves; elsewhere a line a second for each marker. Every
    sample goes to `csv_path`, also those that the station keeps from before. Ends with a summary
    on stdout and returns the exit status, 0. Call it in the main thread.

    Raises CsvError and SubscribeError with a sentence.
    """
    endpoints = (connect,) if isinstance(connect, str) else tuple(connect)
    console = Console(highlight=False, soft_wrap=True)
    board = Board()
    csv_file = CsvFile(csv_path) if csv_path is not None else None
    with contextlib.ExitStack() as stack:
        if csv_file is not None:
            stack.callback(csv_file.close)
        stack.callback(_account, console, board, csv_file)
        stack.enter_context(contextlib.suppress(KeyboardInterrupt))
        stack.enter_context(_sigterm_is_ctrl_c())
        items = stack.enter_context(subscribe(KEYS, endpoints, notices=True))
        view_of = _ScreenView if console.is_terminal else _LinesView
        with view_of(console, board, endpoints, items) as view:
            _listen(items, board, csv_file, view, seconds)
    return 0


def _listen(
    items: Subscription[Sample | Notice],
    board: Board,
    csv_file: CsvFile | None,
    view: _View,
    seconds: float,
) -> None:
    now_s = time.monotonic()
    end_s = now_s + seconds if seconds else math.inf
    show_s, flush_s = now_s, now_s + FLUSH_PERIOD_S
    while now_s < end_s:
        if now_s >= show_s:
            view.show()
            show_s = now_s + view.period_s
        if now_s >= flush_s:
            if csv_file is not None:
                csv_file.flush()
            flush_s = now_s + FLUSH_PERIOD_S
        item = items.get(max(min(show_s, flush_s, end_s) - time.monotonic(), 0.0))
        now_s = time.monotonic()
        if item is None:
            continue
        if (
            csv_file is not None
            and isinstance(item, Sample)
            and isinstance(item.value, Displacement)
        ):
            csv_file.write(item.station, item.value)
        line = board.take(item)
        if line is not None:
            view.tell(line)


def _account(console: Console, board: Board, csv_file: CsvFile | None) -> None:
    for line in summary(board):
        console.print(line)
    if csv_file is not None:
        console.print(f"{csv_file.samples} samples written to {csv_file.path}")


@contextlib.contextmanager
def _sigterm_is_ctrl_c() -> Iterator[None]:
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


class _View(Protocol):
    @property
    def period_s(self) -> float: ...

    def show(self) -> None:
        """Bring the newest to the person; called every `period_s`."""
        ...

    def tell(self, line: str) -> None:
        """Say what has just happened."""
        ...


class _ScreenView:
    """The whole terminal, drawn anew every `period_s`."""

    period_s = SCREEN_PERIOD_S

    def __init__(
        self,
        console: Console,
        board: Board,
        endpoints: tuple[str, ...],
        items: Subscription[Sample | Notice],
    ) -> None:
        self._board = board
        self._endpoints = endpoints
        self._items = items
        self._live = Live(console=console, screen=True, auto_refresh=False)

    def __enter__(self) -> Self:
        self._live.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._live.stop()

    def show(self) -> None:
        screen = Screen(self._board, self._endpoints, self._items.waiting_for, time.monotonic_ns())
        self._live.update(screen, refresh=True)

    def tell(self, line: str) -> None:
        """Nothing: the screen shows the newest events anyway."""


class _LinesView:
    """Plain lines: one a second for each marker, and what happens as it happens."""

    period_s = LINES_PERIOD_S

    def __init__(
        self,
        console: Console,
        board: Board,
        endpoints: tuple[str, ...],
        items: Subscription[Sample | Notice],
    ) -> None:
        self._console = console
        self._board = board
        self._endpoints = endpoints
        self._items = items
        self._waiting_for: tuple[str, ...] | None = None
        self._shown: dict[str, tuple[int, bool]] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Nothing is left to do: every line is out."""

    def show(self) -> None:
        waiting_for = self._items.waiting_for
        if waiting_for != self._waiting_for:
            self._waiting_for = waiting_for
            self.tell(
                f"waiting for {', '.join(waiting_for)} ..."
                if waiting_for
                else f"connected to {', '.join(self._endpoints)}"
            )
        now_ns = time.monotonic_ns()
        for station_name, station in self._board.stations.items():
            for marker_name, marker in station.markers.items():
                name = f"{station_name}/{marker_name}"
                # A silent marker is told once, not every second.
                state = marker.samples, marker.silent(now_ns)
                if self._shown.get(name) != state:
                    self._shown[name] = state
                    self.tell(marker_line(name, station, marker, now_ns))

    def tell(self, line: str) -> None:
        self._console.print(line, markup=False)
        self._console.file.flush()
