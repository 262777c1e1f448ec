"""The one protocol of everything that gives frames, and the choice of those without a driver."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from vdms_rt.config import Config
from vdms_rt.model import Grab, Luma, SourceInfo, Truth


class Source(Protocol):
    """An open source. One thread uses it; nothing else may touch it meanwhile."""

    @property
    def info(self) -> SourceInfo: ...

    def read(self, out: Luma, timeout_s: float) -> Grab | None:
        """Fill `out`, (height_px, width_px) uint8, with the next image's luma and return what the
        driver says of it; None if there was none within `timeout_s`, and `out` is then undefined.

        Raises SourceEnded after the last frame, SourceError when the source is gone.
        """
        ...

    def close(self) -> None:
        """Give everything back; may be called twice."""
        ...


def open_source(config: Config, on_truth: Callable[[Truth], None]) -> Source:
    """Return the file or table that the configuration names, open and streaming; a grabber is
    opened by `capture.device`.

    `on_truth` is called in the reading thread, before `read` returns, with every marker's true
    position, by a source that knows it. Raises SourceError with a sentence for the person.
    """
    match config.source:
        case "clip":
            from vdms_rt.capture.clip import ClipSource

            return ClipSource(config.clip)
        case "log":
            from vdms_rt.capture.log import LogSource

            return LogSource(config.log)
        case _:
            from vdms_rt.capture.table import TableSource

            return TableSource(config.table, [m.shape for m in config.marker], on_truth)
