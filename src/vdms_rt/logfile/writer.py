"""One MCAP of ours: written so that it survives a kill, read however it ended, and repaired.

A file is named `.mcap.part` and locked (flock) while it is written; it gets its own name when it is
complete and on the disk. Everything here raises OSError as the disk gives it.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import cast

from google.protobuf.descriptor import FileDescriptor
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.message import Message as ProtobufMessage
from mcap.writer import CompressionType, Writer

from vdms_rt import __version__

CHUNK_BYTES = 1 << 20
PART_SUFFIX = ".part"
NO_SPACE = (errno.ENOSPC, errno.EDQUOT)


@dataclass(frozen=True, slots=True)
class LogMessage:
    """One message as it stands in a log."""

    key: str
    """The MCAP topic, which is the zenoh key."""
    type: type[ProtobufMessage]
    sequence: int
    log_time_ns: int
    publish_time_ns: int
    """Differs from `log_time_ns` in a copy at the head of a later file: when it was said first."""
    data: bytes


@dataclass(frozen=True, slots=True)
class LogAttachment:
    name: str
    media_type: str
    created_ns: int
    data: bytes


class _Pending:
    """What the MCAP writer has said and the disk has not taken yet.

    The writer only ever writes to memory, so that a full disk cannot leave it half-way through a
    record: what the disk refuses stays here, and is offered again.
    """

    def __init__(self, fd: int) -> None:
        self._fd = fd
        self._pending = bytearray()
        self.length = 0
        """Of the file, once all of it is on the disk."""

    def write(self, data: bytes) -> int:
        self._pending += data
        self.length += len(data)
        return len(data)

    def tell(self) -> int:
        return self.length

    def flush(self) -> None:
        """The writer asks for it; `drain` does it, where an error can be handled."""

    def drain(self) -> None:
        while self._pending:
            written = os.write(self._fd, memoryview(self._pending)[: 1 << 20])
            del self._pending[:written]


class LogWriter:
    """An MCAP being written by one thread.

    `add` and `attach` never fail; `drain`, `sync` and `close` raise OSError. After a write that
    found no space nothing is lost: the same call again goes on where it stopped. After anything
    else `broken` is True, and `abandon` leaves what was synced.
    """

    def __init__(self, path: Path) -> None:
        """Create `path` + `.part`; raises FileExistsError where either is there already."""
        self.path = path
        self.part_path = path.with_name(path.name + PART_SUFFIX)
        if path.exists():
            raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(path))
        self._fd = os.open(self.part_path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o644)
        try:
            fcntl.flock(self._fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
            sync_directory(path.parent)
        except OSError:
            os.close(self._fd)
            self.part_path.unlink(missing_ok=True)
            raise
        self.sealed = False
        """Nothing more can be added; only `close` remains."""
        self._summarised = False
        self.broken = False
        self._synced_length = 0
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        self._sink = _Pending(self._fd)
        self._writer = Writer(
            self._sink,  # type: ignore[arg-type]  # has all that the writer uses of a stream
            chunk_size=CHUNK_BYTES,
            compression=CompressionType.ZSTD,
        )
        self._writer.start(library=f"vdms-rt {__version__}")

    @property
    def length(self) -> int:
        """Bytes of the file so far, those in the current chunk aside."""
        return self._sink.length

    def add(self, message: LogMessage) -> None:
        channel = self._channels.get(message.key)
        if channel is None:
            channel = self._register(message)
        self._writer.add_message(
            channel, message.log_time_ns, message.data, message.publish_time_ns, message.sequence
        )

    def _register(self, message: LogMessage) -> int:
        descriptor = message.type.DESCRIPTOR
        schema = self._schemas.get(descriptor.full_name)
        if schema is None:
            schema = self._writer.register_schema(
                descriptor.full_name, "protobuf", schema_bytes(message.type)
            )
            self._schemas[descriptor.full_name] = schema
        channel = self._writer.register_channel(message.key, "protobuf", schema)
        self._channels[message.key] = channel
        return channel

    def attach(self, attachment: LogAttachment, log_time_ns: int) -> None:
        self._writer.add_attachment(
            attachment.created_ns,
            log_time_ns,
            attachment.name,
            attachment.media_type,
            attachment.data,
        )

    def add_metadata(self, name: str, values: dict[str, str]) -> None:
        self._writer.add_metadata(name, values)

    def drain(self) -> None:
        """Hand the chunks that are complete to the operating system."""
        with self._breaking(*NO_SPACE):
            self._sink.drain()

    def sync(self) -> None:
        """Put everything so far on the disk."""
        if not self._summarised:
            self._writer.flush()  # type: ignore[no-untyped-call]
        self.drain()
        # After a flush that failed the system holds what it had not written for written.
        with self._breaking():
            os.fsync(self._fd)
            self._check_in_place()
        self._synced_length = self._sink.length

    def close(self) -> None:
        """Complete the file, put it on the disk and give it its own name."""
        self.sealed = True
        if not self._summarised:
            self._writer.finish()  # type: ignore[no-untyped-call]
            self._summarised = True
        self.sync()
        with self._breaking(*NO_SPACE):
            if self.path.exists():
                raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(self.path))
            self.part_path.rename(self.path)
            sync_directory(self.path.parent)
        os.close(self._fd)

    def abandon(self) -> None:
        """Let go of the file as it was at the last sync; the next `repair` completes it."""
        with contextlib.suppress(OSError):
            os.ftruncate(self._fd, self._synced_length)
            if self._synced_length == 0:
                self.part_path.unlink()
        with contextlib.suppress(OSError):
            os.close(self._fd)

    def _check_in_place(self) -> None:
        ours = os.fstat(self._fd)
        there = self.part_path.stat()
        if (ours.st_dev, ours.st_ino) != (there.st_dev, there.st_ino):
            raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(self.part_path))

    @contextlib.contextmanager
    def _breaking(self, *harmless: int) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            self.broken = error.errno not in harmless
            raise


def schema_bytes(message: type[ProtobufMessage]) -> bytes:
    """Return the serialised FileDescriptorSet of a message type, what it imports first."""
    descriptors = FileDescriptorSet()

    def collect(file: FileDescriptor) -> None:
        for imported in file.dependencies:
            collect(imported)
        if file.name not in [known.name for known in descriptors.file]:
            file.CopyToProto(descriptors.file.add())

    collect(cast("FileDescriptor", message.DESCRIPTOR.file))
    return descriptors.SerializeToString()


def sync_directory(directory: Path) -> None:
    fd = os.open(directory, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)
