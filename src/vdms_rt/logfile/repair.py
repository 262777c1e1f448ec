"""Completing files that a kill, a power cut or a full disk left unfinished."""

from __future__ import annotations

import errno
import fcntl
import os
import zlib
from collections import Counter, defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

from vdms_rt import __version__
from vdms_rt.logfile.reader import HEAD, MAGIC, Block, LogFileError, LogReader, StoredMessage
from vdms_rt.logfile.writer import PART_SUFFIX, sync_directory

REPAIR_SUFFIX = ".repair"
FAULTS_TOLD = 20


@dataclass(frozen=True, slots=True)
class Repaired:
    """What became of one unfinished file."""

    path: Path
    """Of the complete file; of the unfinished one if it could not be repaired."""
    messages: int
    dropped_bytes: int
    """What was not readable, mostly a torn end."""
    sentence: str


def repair_directory(directory: Path) -> list[Repaired]:
    """Complete every unfinished file in a directory that no running daemon is writing.

    One that cannot be repaired stays as it is, and its sentence says why.
    """
    done = []
    for part in sorted(directory.glob(f"*.mcap{PART_SUFFIX}")):
        try:
            done.append(repair(part))
        except (BlockingIOError, FileNotFoundError):  # being written, or just completed
            continue
        except (OSError, LogFileError) as error:
            reason = str(error)
            if isinstance(error, OSError):
                reason = (error.strerror or reason).lower()
            done.append(Repaired(part, 0, 0, f"{part}: cannot be repaired, and stays: {reason}"))
    return done


def repair(path: Path, advance: Callable[[int], None] = lambda _: None) -> Repaired:
    """Complete the unfinished file `path`, whose name ends in `.part`.

    Everything whose checksum holds is copied as it stands into a new file, which takes the place
    of the old one only when it is on the disk; `advance` is told the bytes read since its last
    call. Raises BlockingIOError if someone is writing the
    file, LogFileError if it is not an MCAP, OSError as the disk gives it.
    """
    with path.open("r+b") as held:
        fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if os.fstat(held.fileno()).st_ino != path.stat().st_ino:
            raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(path))
        return _repair_locked(path, advance)


def _repair_locked(path: Path, advance: Callable[[int], None]) -> Repaired:
    if path.stat().st_size == 0:
        path.unlink()
        return Repaired(path, 0, 0, f"{path}: removed, nothing had reached the disk")
    new = path.with_name(path.name + REPAIR_SUFFIX)
    with LogReader(path) as reader, new.open("wb") as out:
        fcntl.flock(out, fcntl.LOCK_EX | fcntl.LOCK_NB)
        try:
            messages = copy_readable(reader, out, advance)
            out.flush()
            os.fsync(out.fileno())
        except OSError:
            new.unlink()
            raise
        new.replace(path)
        whole = _free_name(path.with_name(path.name.removesuffix(PART_SUFFIX)))
        path.rename(whole)
        sync_directory(path.parent)
    left_out = ""
    if reader.dropped_bytes:
        left_out = f", {reader.dropped_bytes} unreadable bytes left out"
    return Repaired(
        whole, messages, reader.dropped_bytes, f"{whole}: repaired, {messages} messages{left_out}"
    )


def copy_readable(
    reader: LogReader, out: BinaryIO, advance: Callable[[int], None] = lambda _: None
) -> int:
    """Write all that `reader` gives as a complete MCAP; return the number of messages.

    Chunks are copied without unpacking, so that a file of gigabytes takes seconds. A metadata
    record `repair` says what was left out.
    """
    copy = Copy(out)
    for block in reader.blocks():
        copy.add(block)
        advance(len(block.content))
    copy.metadata(
        Metadata(
            "repair",
            {
                "version": __version__,
                "messages": str(sum(copy.counts.values())),
                "dropped_bytes": str(reader.dropped_bytes),
                "faults": "; ".join(reader.faults[:FAULTS_TOLD]),
            },
        )
    )
    copy.finish()
    return sum(copy.counts.values())


class Copy:
    """A complete MCAP made of the blocks of another one, `without` the messages of some types."""

    def __init__(self, out: BinaryIO, without: frozenset[str] = frozenset()) -> None:
        self.counts: Counter[int] = Counter()
        self._without = without
        self._out = out
        self._offset = 0
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._chunks: list[ChunkIndex] = []
        self._attachments: list[AttachmentIndex] = []
        self._metadata: list[MetadataIndex] = []
        self._times_ns: list[int] = []
        self._write(MAGIC)
        self._record(Header(profile="", library=f"vdms-rt {__version__}"))

    def add(self, block: Block) -> None:
        stored = [r for r in block.records if isinstance(r, StoredMessage)]
        messages = [m for m in stored if m.schema is None or m.schema.name not in self._without]
        for message in messages:
            self._define(message)
        if block.chunk is not None:
            if messages:
                whole = not block.orphans and len(messages) == len(stored)
                self._chunk(block.chunk if whole else None, messages)
            return
        for record in block.records:
            match record:
                case StoredMessage() if record in messages:
                    self._record(record.message)
                    self._count([record])
                case Attachment():
                    self._attachment(record)
                case Metadata():
                    self.metadata(record)

    def _define(self, stored: StoredMessage) -> None:
        """Schemas and channels stand before the first chunk that needs them."""
        schema, channel = stored.schema, stored.channel
        if schema is not None and schema.id not in self._schemas:
            self._schemas[schema.id] = schema
            self._record(schema)
        if channel.id not in self._channels:
            self._channels[channel.id] = channel
            self._record(channel)

    def _chunk(self, chunk: Chunk | None, messages: list[StoredMessage]) -> None:
        """Write a chunk as it stands, or without one, make it of its messages."""
        if chunk is None:
            chunk, messages = _chunk_of(messages)
        times_ns = [stored.message.log_time for stored in messages]
        # No checksum covers these two in the file.
        chunk.message_start_time, chunk.message_end_time = min(times_ns), max(times_ns)
        start = self._offset
        length = self._record(chunk)
        times_by_channel: dict[int, list[tuple[int, int]]] = defaultdict(list)
        for stored in messages:
            times_by_channel[stored.channel.id].append(
                (stored.message.log_time, stored.chunk_offset)
            )
        index_start = self._offset
        index_offsets = {}
        for channel, entries in times_by_channel.items():
            index_offsets[channel] = self._offset
            self._record(MessageIndex(channel, entries))
        self._chunks.append(
            ChunkIndex(
                chunk_length=length,
                chunk_start_offset=start,
                compression=chunk.compression,
                compressed_size=len(chunk.data),
                message_end_time=chunk.message_end_time,
                message_index_length=self._offset - index_start,
                message_index_offsets=index_offsets,
                message_start_time=chunk.message_start_time,
                uncompressed_size=chunk.uncompressed_size,
            )
        )
        self._count(messages)

    def _count(self, messages: list[StoredMessage]) -> None:
        self.counts.update(stored.channel.id for stored in messages)
        times_ns = [stored.message.log_time for stored in messages] + self._times_ns
        self._times_ns = [min(times_ns), max(times_ns)]

    def _attachment(self, attachment: Attachment) -> None:
        start = self._offset
        length = self._record(attachment)
        self._attachments.append(
            AttachmentIndex(
                offset=start,
                length=length,
                log_time=attachment.log_time,
                create_time=attachment.create_time,
                data_size=len(attachment.data),
                name=attachment.name,
                media_type=attachment.media_type,
            )
        )

    def metadata(self, metadata: Metadata) -> None:
        start = self._offset
        length = self._record(metadata)
        self._metadata.append(MetadataIndex(offset=start, length=length, name=metadata.name))

    def finish(self) -> None:
        """Write the summary and the end."""
        self._record(DataEnd(data_section_crc=0))
        summary_start = self._offset
        times_ns = self._times_ns or [0, 0]
        statistics = Statistics(
            attachment_count=len(self._attachments),
            channel_count=len(self._channels),
            channel_message_counts=dict(self.counts),
            chunk_count=len(self._chunks),
            message_count=sum(self.counts.values()),
            message_end_time=times_ns[1],
            message_start_time=times_ns[0],
            metadata_count=len(self._metadata),
            schema_count=len(self._schemas),
        )
        groups: list[tuple[Opcode, list[McapRecord]]] = [
            (Opcode.SCHEMA, [*self._schemas.values()]),
            (Opcode.CHANNEL, [*self._channels.values()]),
            (Opcode.STATISTICS, [statistics]),
            (Opcode.CHUNK_INDEX, [*self._chunks]),
            (Opcode.ATTACHMENT_INDEX, [*self._attachments]),
            (Opcode.METADATA_INDEX, [*self._metadata]),
        ]
        summary = RecordBuilder()
        offsets = []
        for opcode, records in groups:
            group_start = summary.count
            for record in records:
                record.write(summary)
            offsets.append(
                SummaryOffset(opcode, summary_start + group_start, summary.count - group_start)
            )
        summary_offset_start = summary_start + summary.count
        for offset in offsets:
            if offset.group_length:
                offset.write(summary)
        data = _taken(summary)
        self._write(data)
        footer = Footer(summary_start, summary_offset_start, 0)
        checked = _bytes(footer)[: HEAD.size + 16]
        footer.summary_crc = zlib.crc32(data + checked)
        self._record(footer)
        self._write(MAGIC)

    def _record(self, record: McapRecord) -> int:
        return self._write(_bytes(record))

    def _write(self, data: bytes) -> int:
        self._out.write(data)
        self._offset += len(data)
        return len(data)


def _chunk_of(messages: list[StoredMessage]) -> tuple[Chunk, list[StoredMessage]]:
    """Return a chunk of these messages alone."""
    builder = RecordBuilder()
    moved = []
    for stored in messages:
        moved.append(StoredMessage(stored.channel, stored.schema, stored.message, builder.count))
        stored.message.write(builder)
    data = _taken(builder)
    chunk = Chunk(
        compression="zstd",
        data=zstandard.compress(data),
        message_end_time=0,
        message_start_time=0,
        uncompressed_crc=zlib.crc32(data),
        uncompressed_size=len(data),
    )
    return chunk, moved


def _bytes(record: McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    return _taken(builder)


def _taken(builder: RecordBuilder) -> bytes:
    return bytes(builder.end())  # type: ignore[no-untyped-call]


def _free_name(path: Path) -> Path:
    name, number = path, 2
    while name.exists():
        name = path.with_name(f"{path.stem}-{number}{path.suffix}")
        number += 1
    return name
