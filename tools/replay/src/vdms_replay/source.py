"""Recordings as a stream of decoded messages, in bounded memory, however they ended."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple, TypeAlias

from google.protobuf.message import DecodeError, Message
from mcap.records import Attachment, Metadata

from vdms_rt.logfile.reader import LogFileError, LogReader, StoredMessage
from vdms_rt.model import VdmsError
from vdms_rt.wire.topics import TOPICS

TYPES: dict[str, type[Message]] = {
    topic.message.DESCRIPTOR.full_name: topic.message for topic in TOPICS
}
SAMPLE = "vdms.Displacement"
FAULTS_TOLD = 20
PathLike: TypeAlias = str | Path


class ReplayError(VdmsError):
    """A recording does not hold what was asked of it, or a file cannot be written."""


class Entry(NamedTuple):
    """One message, as it stands in a file."""

    key: str
    log_time_ns: int
    publish_time_ns: int
    type: str
    """Full protobuf name, `vdms.Displacement`."""
    value: Message


@dataclass(slots=True)
class Damage:
    """What of a file could not be read."""

    path: Path
    complete: bool = True
    """The file has its proper end."""
    dropped_bytes: int = 0
    undecodable: int = 0
    """Messages whose bytes are not what their schema says."""
    faults: list[str] = field(default_factory=list)

    def sentences(self) -> list[str]:
        """Return what is wrong with the file, one sentence each; none of a whole file."""
        told = []
        if not self.complete:
            told.append(f"{self.path}: unfinished; `vdms-replay recover` completes it")
        if self.dropped_bytes:
            told.append(
                f"{self.path}: {self.dropped_bytes} bytes were not readable "
                f"({'; '.join(self.faults[:FAULTS_TOLD])})"
            )
        if self.undecodable:
            told.append(
                f"{self.path}: {self.undecodable} messages could not be decoded; was it recorded "
                "by a newer version of vdms-rt?"
            )
        return told


Item: TypeAlias = Entry | Attachment | Metadata


class Source:
    """The files of one station, in the order of their time.

    `items` may be called any number of times; each reads the files anew from the beginning.
    """

    def __init__(self, paths: Iterable[PathLike]) -> None:
        """Raises ReplayError if there is none, or one cannot be read or is not ours."""
        self.paths = _in_order([Path(path) for path in paths])
        self.damage = {path: Damage(path) for path in self.paths}
        """What the last `items` could not read."""

    @property
    def size_bytes(self) -> int:
        return sum(path.stat().st_size for path in self.paths)

    def counted(self) -> tuple[dict[str, int], float] | None:
        """Return how many messages of each key the files hold by their own word, and how many
        seconds they span together; None where one of them does not say it."""
        counts: Counter[str] = Counter()
        seconds = 0.0
        for path in self.paths:
            with open_log(path) as reader:
                if not reader.counts:
                    return None
                counts.update(reader.counts)
                seconds += reader.length_ns / 1e9
        return dict(counts), seconds

    def items(
        self, types: Sequence[str] | None = None, advance: Callable[[int], None] | None = None
    ) -> Iterator[Item]:
        """Give the messages of these types (all for None), attachments and metadata.

        `advance` is told the bytes that were read since the last call.
        """
        for path in self.paths:
            yield from self._file(path, types, advance)

    def _file(
        self, path: Path, types: Sequence[str] | None, advance: Callable[[int], None] | None
    ) -> Iterator[Item]:
        damage = self.damage[path] = Damage(path)
        with open_log(path) as reader:
            for block in reader.blocks():
                for record in block.records:
                    if isinstance(record, (Attachment, Metadata)):
                        yield record
                    elif isinstance(record, StoredMessage):
                        entry = _entry(record, types, damage)
                        if entry is not None:
                            yield entry
                if advance is not None:
                    advance(len(block.content))
            damage.complete = reader.complete
            damage.dropped_bytes = reader.dropped_bytes
            damage.faults = reader.faults[:FAULTS_TOLD]


def open_log(path: Path) -> LogReader:
    """Return a reader of the file. Raises ReplayError."""
    try:
        return LogReader(path)
    except LogFileError as error:
        raise ReplayError(f"{error}; name a recording of vdms-rt, an .mcap file") from None


def _entry(record: StoredMessage, types: Sequence[str] | None, damage: Damage) -> Entry | None:
    name = record.schema.name if record.schema is not None else ""
    if name not in TYPES or (types is not None and name not in types):
        return None
    try:
        value = TYPES[name].FromString(record.message.data)
    except DecodeError:
        damage.undecodable += 1
        return None
    message = record.message
    return Entry(record.channel.topic, message.log_time, message.publish_time, name, value)


def by_station(paths: Iterable[PathLike]) -> dict[str, list[Path]]:
    """Return the files of each station, in the order of their time. Raises ReplayError."""
    stations: dict[str, list[Path]] = {}
    for path in _in_order([Path(path) for path in paths]):
        stations.setdefault(_first(path)[1], []).append(path)
    return stations


def _in_order(paths: list[Path]) -> list[Path]:
    """Return the files by the log time of their first message of ours."""
    if not paths:
        raise ReplayError("no file was named; name a recording of vdms-rt, an .mcap file")
    begins = {path: _first(path)[0] for path in dict.fromkeys(paths)}
    return sorted(begins, key=lambda path: (begins[path], path.name))


def _first(path: Path) -> tuple[int, str]:
    """Return log time and station of the file's first message of ours."""
    with open_log(path) as reader:
        for record in reader:
            if (
                isinstance(record, StoredMessage)
                and record.schema is not None
                and record.schema.name in TYPES
            ):
                return record.message.log_time, station_of(record.channel.topic)
        if reader.faults:
            raise ReplayError(f"{path}: damaged, nothing can be read: {reader.faults[0]}")
    raise ReplayError(f"{path}: an MCAP, but not one that vdms-rt recorded, or an empty one")


def keep(recordings: Iterable[Path], target: Path) -> None:
    """Raise ReplayError if `target`, where something is to be written, is one of the recordings."""
    if target.resolve() in [path.resolve() for path in recordings]:
        raise ReplayError(f"{target}: is the recording itself; choose another --out")


def station_of(key: str) -> str:
    """Return the station in a key `vdms/<station>/...`; empty if it has none."""
    return key.split("/")[1] if key.count("/") > 1 else ""
