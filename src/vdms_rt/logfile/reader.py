"""Reading an MCAP however it ended: whole, unfinished, cut off or damaged in the middle."""

from __future__ import annotations

import contextlib
import os
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from types import TracebackType
from typing import BinaryIO, TypeAlias

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    Channel,
    Chunk,
    Footer,
    Header,
    Message,
    Metadata,
    Schema,
    Statistics,
)
from mcap.stream_reader import get_chunk_data_stream

from vdms_rt.model import VdmsError

MAGIC = b"\x89MCAP0\r\n"
HEAD = struct.Struct("<BQ")
"""Opcode and length, before every record."""
MESSAGE_HEAD = struct.Struct("<HIQQ")
"""Channel, sequence, log time and publish time, before a message's data."""
FOOTER_BYTES = HEAD.size + 20
LARGEST_CHUNK_BYTES = 1 << 30
LARGEST_RECORD_BYTES = 1 << 30
SCAN_BYTES = 1 << 20
ZSTD_MARK = b"\x04\x00\x00\x00zstd"
ZSTD_MARK_OFFSET = HEAD.size + 8 + 8 + 8 + 4
"""Where the compression's name stands in a chunk record."""
PLAIN: dict[int, type[Header | Schema | Channel | Metadata]] = {
    Opcode.HEADER: Header,
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
    Opcode.METADATA: Metadata,
}
"""Records without a checksum."""
OPCODES = frozenset(int(opcode) for opcode in Opcode)
UNREADABLE = (
    McapError,
    zstandard.ZstdError,
    struct.error,
    ValueError,
    MemoryError,
    RuntimeError,  # of lz4
)
"""What the parts of a damaged record raise."""


class LogFileError(VdmsError):
    """A file that is not there, or is not an MCAP."""


@dataclass(frozen=True, slots=True)
class StoredMessage:
    """A message as it was read."""

    channel: Channel
    schema: Schema | None
    message: Message
    chunk_offset: int = 0
    """Where its record stands in the uncompressed data of its chunk."""


LogRecord: TypeAlias = Header | Metadata | Attachment | StoredMessage


@dataclass(slots=True)
class Block:
    """A record of the file's top level, with what was readable in it."""

    opcode: int
    content: bytes
    records: list[LogRecord] = field(default_factory=list)
    chunk: Chunk | None = None
    offset: int = 0
    """Where it stands in the file."""
    orphans: int = 0
    """Messages of channels that nothing readable defines."""


class LogReader:
    """Reads one file in bounded memory, from its beginning or from any block known by then.

    Only what its checksum confirms is given out: a damaged chunk is left out as a whole, and
    reading goes on with the next one.
    """

    def __init__(self, path: Path) -> None:
        """Raises LogFileError for a file that cannot be read or is not an MCAP."""
        self.path = path
        try:
            self._file: BinaryIO = path.open("rb")
            beginning = self._file.read(len(MAGIC))
        except OSError as error:
            raise LogFileError(
                f"{path}: cannot be read: {(error.strerror or str(error)).lower()}"
            ) from None
        if beginning != MAGIC:
            self._file.close()
            raise LogFileError(f"{path}: not an MCAP file")
        self.size_bytes = os.fstat(self._file.fileno()).st_size
        self.complete = False
        """The file has its proper end; known once it is open."""
        self.dropped_bytes = 0
        """What was not readable so far."""
        self.faults: list[str] = []
        """One phrase for each place that was not readable."""
        self.counts: dict[str, int] = {}
        """Messages by topic, as the end of a complete file says it; else empty."""
        self.length_ns = 0
        """From the first log time to the last, likewise."""
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._read_summary()

    def __enter__(self) -> LogReader:
        return self

    def __exit__(
        self,
        _type: type[BaseException] | None,
        _error: BaseException | None,
        _traceback: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        self._file.close()

    def __iter__(self) -> Iterator[LogRecord]:
        """Give every readable record of the data section in the order of the file."""
        for block in self.blocks():
            yield from block.records

    def blocks(self, start: int = len(MAGIC)) -> Iterator[Block]:
        """Give every readable record of the top level of the data section.

        `start` is the `offset` of a block that was given before, to go on from there.
        """
        offset = start
        while offset < self.size_bytes:
            block = self._block_at(offset)
            if block is None:
                following = self._find_chunk(offset + 1)
                self._drop(offset, following, "damaged")
                offset = following
                continue
            if block.opcode == Opcode.DATA_END:
                return
            end = offset + HEAD.size + len(block.content)
            try:
                self._parse(block)
            except UNREADABLE as error:
                self._drop(offset, end, str(error) or "damaged")
            else:
                yield block
            offset = end

    def _block_at(self, offset: int) -> Block | None:
        """Return the record at `offset`, or None if what stands there cannot be one."""
        self._file.seek(offset)
        head = self._file.read(HEAD.size)
        if len(head) < HEAD.size:
            return None
        opcode, length = HEAD.unpack(head)
        if opcode not in OPCODES or length > LARGEST_RECORD_BYTES:
            return None
        if offset + HEAD.size + length > self.size_bytes:
            return None
        content = self._file.read(length)
        # A record with a wrong length would take what follows with it.
        return Block(opcode, content, offset=offset) if _is_consistent(opcode, content) else None

    def _find_chunk(self, offset: int) -> int:
        """Return where the next chunk begins, or the size of the file."""
        while offset < self.size_bytes:
            self._file.seek(offset)
            data = self._file.read(SCAN_BYTES + ZSTD_MARK_OFFSET + len(ZSTD_MARK))
            mark = data.find(ZSTD_MARK, ZSTD_MARK_OFFSET)
            while mark >= 0:
                start = mark - ZSTD_MARK_OFFSET
                if data[start] == Opcode.CHUNK and self._block_at(offset + start):
                    return offset + start
                mark = data.find(ZSTD_MARK, mark + 1)
            offset += SCAN_BYTES
        return self.size_bytes

    def _drop(self, start: int, end: int, reason: str) -> None:
        self.dropped_bytes += end - start
        self.faults.append(f"bytes {start} to {end}: {reason}")

    def _parse(self, block: Block) -> None:
        """Fill in what is readable; raises any of UNREADABLE."""
        content = block.content
        stream = ReadDataStream(BytesIO(content))
        match block.opcode:
            case Opcode.CHUNK:
                block.chunk = Chunk.read(stream)
                self._parse_chunk(block, block.chunk)
            case Opcode.ATTACHMENT:
                block.records.append(Attachment.read(stream))
            case Opcode.METADATA:
                block.records.append(Metadata.read(stream))
            case Opcode.HEADER:
                block.records.append(Header.read(stream))
            case Opcode.SCHEMA | Opcode.CHANNEL:
                # Those of the summary and of chunks have a checksum; these have none.
                known = self._schemas if block.opcode == Opcode.SCHEMA else self._channels
                if int.from_bytes(content[:2], "little") not in known:
                    self._parse_inner(block, block.opcode, content, 0)
            case _:
                self._parse_inner(block, block.opcode, content, 0)

    def _parse_chunk(self, block: Block, chunk: Chunk) -> None:
        if chunk.uncompressed_size > LARGEST_CHUNK_BYTES:
            raise McapError("the size of a chunk is absurd")
        if chunk.compression == "zstd":
            size = zstandard.get_frame_parameters(chunk.data).content_size
            if size != chunk.uncompressed_size:
                raise McapError("the size of a chunk is wrong")
        stream, size = get_chunk_data_stream(chunk, validate_crc=True)
        data = stream.read(size)
        offset = 0
        while offset < size:
            opcode, length = HEAD.unpack_from(data, offset)
            start = offset + HEAD.size
            self._parse_inner(block, opcode, data[start : start + length], offset)
            offset = start + length

    def _parse_inner(self, block: Block, opcode: int, content: bytes, offset: int) -> None:
        if opcode == Opcode.MESSAGE:
            channel_id, sequence, log_time, publish_time = MESSAGE_HEAD.unpack_from(content)
            channel = self._channels.get(channel_id)
            data = content[MESSAGE_HEAD.size :]
            if channel is None:
                block.orphans += 1
                self.dropped_bytes += len(data)
                self.faults.append("a message whose channel stood in a damaged place")
                return
            message = Message(channel_id, log_time, data, publish_time, sequence)
            schema = self._schemas.get(channel.schema_id)
            block.records.append(StoredMessage(channel, schema, message, offset))
        elif opcode == Opcode.SCHEMA:
            schema = Schema.read(ReadDataStream(BytesIO(content)))
            self._schemas[schema.id] = schema
        elif opcode == Opcode.CHANNEL:
            channel = Channel.read(ReadDataStream(BytesIO(content)))
            self._channels[channel.id] = channel

    def _read_summary(self) -> None:
        """Take schemas and channels from the end of a complete file, which help past damage, and
        its counts."""
        end = self.size_bytes - len(MAGIC) - FOOTER_BYTES
        if end < len(MAGIC):
            return
        self._file.seek(end)
        tail = self._file.read()
        opcode, length = HEAD.unpack_from(tail)
        if opcode != Opcode.FOOTER or length != 20 or not tail.endswith(MAGIC):
            return
        self.complete = True
        footer = Footer.read(ReadDataStream(BytesIO(tail[HEAD.size :])))
        if not len(MAGIC) < footer.summary_start <= end:
            return
        self._file.seek(footer.summary_start)
        summary = self._file.read(end - footer.summary_start)
        if footer.summary_crc not in (0, zlib.crc32(summary + tail[: HEAD.size + 16])):
            return
        offset = 0
        with contextlib.suppress(*UNREADABLE):
            while offset < len(summary):
                opcode, length = HEAD.unpack_from(summary, offset)
                start = offset + HEAD.size
                inner = summary[start : start + length]
                if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                    self._parse_inner(Block(opcode, inner), opcode, inner, 0)
                elif opcode == Opcode.STATISTICS:
                    self._take_counts(Statistics.read(ReadDataStream(BytesIO(inner))))
                offset = start + length

    def _take_counts(self, statistics: Statistics) -> None:
        """Take the counts; the channels stand before them."""
        self.length_ns = statistics.message_end_time - statistics.message_start_time
        for channel_id, count in statistics.channel_message_counts.items():
            channel = self._channels.get(channel_id)
            if channel is not None:
                self.counts[channel.topic] = self.counts.get(channel.topic, 0) + count


def _is_consistent(opcode: int, content: bytes) -> bool:
    """Whether the lengths inside of a record agree with its own, and its checksum if it has one
    outside of what it compresses."""
    match opcode:
        case Opcode.CHUNK:
            return _chunk_is_consistent(content)
        case Opcode.MESSAGE_INDEX:
            return len(content) >= 6 and 6 + int.from_bytes(content[2:6], "little") == len(content)
        case Opcode.ATTACHMENT:
            return zlib.crc32(content[:-4]) == int.from_bytes(content[-4:], "little")
        case Opcode.DATA_END:
            return len(content) == 4
        case Opcode.MESSAGE:
            return len(content) >= MESSAGE_HEAD.size
        case Opcode.HEADER | Opcode.SCHEMA | Opcode.CHANNEL | Opcode.METADATA:
            stream = ReadDataStream(BytesIO(content))
            with contextlib.suppress(*UNREADABLE):
                PLAIN[opcode].read(stream)
                return stream.count == len(content)
            return False
        case _:  # of the summary
            return False


def _chunk_is_consistent(content: bytes) -> bool:
    """Whether the lengths inside of a chunk record agree with its own."""
    if len(content) < 40:
        return False
    (name_length,) = struct.unpack_from("<I", content, 28)
    if len(content) < 40 + name_length:
        return False
    (data_length,) = struct.unpack_from("<Q", content, 32 + name_length)
    return bool(40 + name_length + data_length == len(content))
