"""The part of a recording that a verb takes: held in little memory, and not beyond a limit."""

from __future__ import annotations

import argparse
import contextlib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from vdms_replay.columns import Clock, Held, Samples, Truths
from vdms_replay.load import (
    ROWS_AT_ONCE,
    About,
    Once,
    Reach,
    Recording,
    between,
    choose_marker,
    extend,
    health_table,
)
from vdms_replay.source import SAMPLE, Entry, PathLike, ReplayError, Source
from vdms_replay.verb import number
from vdms_rt.wire import topics
from vdms_rt.wire import vdms_pb2 as pb

MOST_SAMPLES = 2_000_000
"""Of one marker; 9 hours of NTSC fields."""
TYPES = (
    SAMPLE, "vdms.Health", "vdms.Event", "vdms.SetUp", "vdms.Run", "vdms.End",
)  # fmt: skip

seconds = number(0, 1e12, "seconds, 0 or more")


@dataclass(frozen=True, slots=True)
class Part:
    """Which samples, and what of them."""

    columns: Sequence[str]
    """`time_s` and `marker` among them."""
    marker: str | None = None
    """None: the only one that is not fixed."""
    from_s: float = -math.inf
    to_s: float = math.inf
    """Both in seconds from the recording's first sample."""


def add_part_arguments(parser: argparse.ArgumentParser) -> None:
    """Add what says which samples of a recording are meant."""
    group = parser.add_argument_group("which samples")
    group.add_argument("--marker", metavar="NAME", help="where the recording has several")
    group.add_argument(
        "--from-s", type=seconds, default=-math.inf, metavar="S",
        help="begin there, in seconds from the recording's first sample",
    )  # fmt: skip
    group.add_argument("--to-s", type=seconds, default=math.inf, metavar="S", help="end there")


def read_part(
    *files: PathLike, part: Part, advance: Callable[[int], None] | None = None
) -> Recording:
    """Return a recording with only the samples of a part, texts as categories.

    `truth` is empty, and `health` has its last row alone. `files` and `advance` are as for `read`.
    Where no single marker can be chosen, no samples are held, and `of_marker` says why. Raises
    ReplayError with a sentence, as early as it is known, for more than MOST_SAMPLES.
    """
    source = Source(files)
    about, once = About(), Once()
    taking = _Taking(source, about, part)
    health: pb.Health | None = None
    for item in source.items(TYPES, advance):
        about.take(item)
        if not isinstance(item, Entry):
            continue
        match item.value:
            case pb.Displacement() as sample:
                if once.is_new(sample):
                    taking.take(sample)
            case pb.Health() as one:
                health = one
    taking.keep()
    return Recording(
        paths=tuple(source.paths),
        about=about,
        samples=taking.held.whole(),
        truth=Truths(Clock()).take(),
        health=health_table([] if health is None else [health]),
        damage=tuple(source.damage.values()),
        doubled=once.doubled,
        reach_s=taking.reach_s,
    )


class _Taking:
    """The samples of a part, as they come."""

    def __init__(self, source: Source, about: About, part: Part) -> None:
        self._source, self._about, self._part = source, about, part
        self._clock = Clock()
        self.reach_s: Reach = {}
        self._chosen: str | None = None
        """Among the markers that were seen so far."""
        self._begin()

    def _begin(self) -> None:
        self._samples = Samples(self._clock)
        self.held = Held(self._part.columns, compact=True)
        self._count = 0
        self._begin_s = math.nan

    def take(self, sample: pb.Displacement) -> None:
        if sample.marker not in self.reach_s:
            self._see(sample.marker)
        # The recording's first sample is the clock's zero, whichever marker it is of.
        self._clock.offset_ns(sample.session, sample.t_ns, sample.utc_ns)
        if sample.marker == self._chosen:
            self._samples.add(sample)
            if len(self._samples) >= ROWS_AT_ONCE:
                self.keep()

    def _see(self, marker: str) -> None:
        """Take note of a marker; it may change which one is meant."""
        self.reach_s[marker] = math.nan, math.nan
        chosen = None
        # Not seen yet, or several: who asks for it in the end gets that sentence.
        with contextlib.suppress(ReplayError):
            chosen = choose_marker(self._about, tuple(self.reach_s), self._part.marker)
        if chosen != self._chosen:
            self._chosen = chosen
            self._begin()

    def keep(self) -> None:
        """Hold what was taken since the last call, as far as it is in the part."""
        part, table = self._part, self._samples.take()
        if not self._count:
            self._check_counts()
        time_s = table["time_s"].to_numpy()
        inside = (time_s >= part.from_s) & (time_s <= part.to_s)
        if len(table) and self._chosen is not None:
            extend(self.reach_s, table)
        if inside.any():
            if not self._count:
                self._begin_s = float(time_s[inside][0])
            self._count += int(inside.sum())
            if self._count > MOST_SAMPLES:
                span_s = float(time_s[inside][-1]) - self._begin_s
                raise self._too_many(
                    f"more than {MOST_SAMPLES}", span_s * MOST_SAMPLES / self._count
                )
        self.held.add(table, inside)

    def _check_counts(self) -> None:
        """Raise ReplayError if the files themselves say that there are too many."""
        if self._chosen is None or self._part.from_s > -math.inf or math.isfinite(self._part.to_s):
            return
        counted = self._source.counted()
        key = topics.DISPLACEMENT.key.format(station=self._about.station, marker=self._chosen)
        if counted is not None and (count := counted[0].get(key, 0)) > MOST_SAMPLES:
            raise self._too_many(f"{count}", counted[1] * MOST_SAMPLES / count)

    def _too_many(self, count: str, span_s: float) -> ReplayError:
        part = self._part
        where = ""
        if part.from_s > -math.inf or math.isfinite(part.to_s):
            where = f" {between(part.from_s, part.to_s)}"
        named = ", ".join(str(path) for path in self._source.paths)
        return ReplayError(
            f"{named}: marker {self._chosen} has {count} samples{where}, and {MOST_SAMPLES} "
            "are the most that are taken at once; choose a part with --from-s and --to-s, here "
            f"of {_length(span_s)} at most"
        )


def _length(span_s: float) -> str:
    """Return a span in seconds, rounded down to three digits, and in hours where it is long."""
    digits = 10.0 ** (math.floor(math.log10(span_s)) - 2) if span_s > 0 else 1.0
    rounded_s = math.floor(span_s / digits) * digits
    hours = f" ({rounded_s / 3600:.1f} h)" if rounded_s >= 3600 else ""
    return f"{rounded_s:.10g} s{hours}"
