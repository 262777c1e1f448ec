"""One file as a series of cues: what was said, and when, from any moment on."""

from __future__ import annotations

import bisect
import heapq
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from google.protobuf.message import DecodeError, Message

from vdms_replay.columns import Clock
from vdms_replay.source import ReplayError, open_log, station_of
from vdms_rt.logfile.reader import MAGIC, StoredMessage
from vdms_rt.wire import vdms_pb2 as pb
from vdms_rt.wire.topics import DISPLACEMENT, SETUP, TOPICS, TRUTH, Topic

NETWORK = {topic.message.DESCRIPTOR.full_name: topic for topic in TOPICS if topic.network}
SILENCE_NS = 500_000_000
"""Without a sample for so long, what else is said comes at its own time."""


class Cue(NamedTuple):
    """A message and its moment."""

    at_ns: int
    """On the clock that all files share: UTC where it is known."""
    station: str
    marker: str
    topic: Topic
    value: Message


class Track:
    """One file. A sample's moment is its own time, steady within a session; what is said between
    samples keeps its place among them."""

    def __init__(self, path: Path, clock: Clock, advance: Callable[[int], None]) -> None:
        """Read the file once to know its times. Raises ReplayError."""
        self.path = path
        self._clock = clock
        self._reader = open_log(path)
        self._offsets: list[int] = []
        self._begins_ns: list[int] = []
        """Moment of the first cue of the block at each offset."""
        self.keys: set[tuple[str, str]] = set()
        """Station and marker, which is empty for a topic of the whole station."""
        self._set_ups: list[Cue] = []
        self.start_ns = self.end_ns = 0
        self.samples = 0
        for offset, cue in self._cues(len(MAGIC), advance):
            if not self._offsets or self._offsets[-1] != offset:
                self._offsets.append(offset)
                self._begins_ns.append(cue.at_ns)
            self.keys.add((cue.station, cue.marker))
            self.samples += cue.topic is DISPLACEMENT
            if cue.topic is SETUP:
                self._set_ups.append(cue)
            self.end_ns = max(self.end_ns, cue.at_ns)
        if not self._offsets:
            self.close()
            raise ReplayError(f"{path}: holds nothing that could be played")
        self.start_ns = self._begins_ns[0]

    def close(self) -> None:
        self._reader.close()

    def cues(self, from_ns: int) -> Iterator[Cue]:
        """Give the cues from a moment on, before them the set-up in force then."""
        if from_ns > self.end_ns:
            return
        before = [cue for cue in self._set_ups if cue.at_ns < from_ns]
        if before:
            yield before[-1]._replace(at_ns=from_ns)
        block = max(bisect.bisect_left(self._begins_ns, from_ns) - 1, 0)
        for _, cue in self._cues(self._offsets[block], lambda _: None):
            if cue.at_ns >= from_ns:
                yield cue

    def _cues(self, start: int, advance: Callable[[int], None]) -> Iterator[tuple[int, Cue]]:
        newest_ns = 0
        for block in self._reader.blocks(start):
            for record in block.records:
                if not isinstance(record, StoredMessage) or record.schema is None:
                    continue
                topic = NETWORK.get(record.schema.name)
                if topic is None:
                    continue
                try:
                    value = topic.message.FromString(record.message.data)
                except DecodeError:
                    continue
                key = record.channel.topic
                marker = key.split("/")[2] if "{marker}" in topic.key else ""
                at_ns = self._moment(topic, value, record.message.log_time, newest_ns)
                newest_ns = max(newest_ns, at_ns)
                yield block.offset, Cue(newest_ns, station_of(key), marker, topic, value)
            advance(len(block.content))

    def _moment(self, topic: Topic, value: Message, log_time_ns: int, newest_ns: int) -> int:
        if topic is DISPLACEMENT and isinstance(value, pb.Displacement):
            return value.t_ns + self._clock.offset_ns(value.session, value.t_ns, value.utc_ns)
        if topic is TRUTH or log_time_ns - newest_ns < SILENCE_NS:
            return newest_ns or log_time_ns
        return log_time_ns


class Programme:
    """Several files of one or several stations on one clock."""

    def __init__(self, paths: Sequence[Path], advance: Callable[[int], None]) -> None:
        """Read each file once. Raises ReplayError."""
        clock = Clock()
        self._tracks: list[Track] = []
        try:
            for path in dict.fromkeys(paths):
                self._tracks.append(Track(path, clock, advance))
        except ReplayError:
            self.close()
            raise
        self.start_ns = min(track.start_ns for track in self._tracks)
        self.end_ns = max(track.end_ns for track in self._tracks)
        self.samples = sum(track.samples for track in self._tracks)
        self.stations: dict[str, tuple[str, ...]] = {}
        """Markers by station."""
        for station, marker in sorted({key for track in self._tracks for key in track.keys}):
            known = self.stations.setdefault(station, ())
            self.stations[station] = (*known, marker) if marker else known

    @property
    def seconds(self) -> float:
        return (self.end_ns - self.start_ns) / 1e9

    def cues(self, from_ns: int) -> Iterator[Cue]:
        """Give the cues of all files from a moment on, in the order of their moments."""
        return heapq.merge(
            *(track.cues(from_ns) for track in self._tracks), key=lambda cue: cue.at_ns
        )

    def close(self) -> None:
        for track in self._tracks:
            track.close()
