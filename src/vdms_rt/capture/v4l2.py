"""A frame grabber through the kernel's V4L2: frames, and the driver's own word on each of them."""

from __future__ import annotations

import contextlib
import errno
import mmap
import select
import time
from ctypes import c_int

import numpy as np
from numpy.typing import NDArray

from vdms_rt.capture import v4l2_api as api
from vdms_rt.capture.grabber import DeviceInfo, choose_device
from vdms_rt.capture.signal import DriverSignal, driver_signal
from vdms_rt.capture.v4l2_luma import Part, decode_mjpg
from vdms_rt.capture.v4l2_node import Node
from vdms_rt.capture.v4l2_settings import agree
from vdms_rt.config import V4l2
from vdms_rt.model import Damage, Grab, Luma, Scan, SourceError, SourceInfo, StampEvent

SEQUENCE_COUNTS_LOST = ("uvcvideo", "vivid")
"""Drivers whose sequence goes on over a frame that they lose; the analogue ones count what they
deliver."""

_GONE = select.POLLERR | select.POLLHUP


class V4l2Source:
    """A video capture node, open and streaming: a `Source`.

    Raises SourceError with the sentence for the person, and then holds nothing. `field`, a
    V4L2_FIELD_*, is the arrangement of fields that the driver is asked for; what it answers counts.
    `device` is the one to open, by default what the configuration means.
    """

    def __init__(
        self,
        config: V4l2,
        field: int = api.FIELD_INTERLACED,
        device: DeviceInfo | None = None,
    ) -> None:
        self.device = device or choose_device(config.device)
        self._input = config.input
        self._maps: list[mmap.mmap] = []
        self._bytes: list[NDArray[np.uint8]] = []
        self._parts: list[tuple[Part, ...]] = []
        self._buffer = api.Buffer(type=api.BUF_TYPE_VIDEO_CAPTURE, memory=api.MEMORY_MMAP)
        self._stream = c_int(api.BUF_TYPE_VIDEO_CAPTURE)
        self._node = Node(self.device.node)
        try:
            settings = agree(self._node, config, field)
            self._layout = settings.layout
            self.standard = settings.standard
            flags = self._map_buffers(config.buffers)
            self._node.call(api.VIDIOC_STREAMON, self._stream, "starting to stream")
        except BaseException:
            self.close()
            raise
        # The first buffer may begin within a frame (usbtv) or be from before (v4l2loopback).
        self._to_skip = 2 if self._layout.field == api.FIELD_ALTERNATE else 1
        self._poll = select.poll()
        self._poll.register(self._node.fd, select.POLLIN)
        clock = flags & api.BUF_FLAG_TIMESTAMP_MASK
        self._stamped = clock == api.BUF_FLAG_TIMESTAMP_MONOTONIC
        event = StampEvent.END_OF_FRAME
        stamps = "this computer's at arrival, for the driver gives no monotonic ones"
        if self._stamped:
            if flags & api.BUF_FLAG_TSTAMP_SRC_MASK == api.BUF_FLAG_TSTAMP_SRC_SOE:
                event = StampEvent.START_OF_EXPOSURE
            stamps = f"the driver's, monotonic, {event}"
        self._info = SourceInfo(
            kind="v4l2",
            name=self._node.name,
            width_px=self._layout.width_px,
            height_px=self._layout.height_px,
            frame_period_s=settings.frame_period_s,
            scan=settings.scan,
            live=True,
            stamp_event=event,
            sequence_counts_lost=self._node.driver in SEQUENCE_COUNTS_LOST,
            scan_known=settings.scan_known,
            facts=(
                ("node", self._node.path),
                ("driver", self._node.driver),
                ("card", self._node.card),
                ("bus", self._node.bus),
                *settings.facts,
                ("stamps", stamps),
                ("buffers", str(len(self._maps))),
            ),
            warnings=settings.warnings,
        )

    @property
    def info(self) -> SourceInfo:
        return self._info

    @property
    def lossy(self) -> bool:
        """Pictures come compressed, so that two may be the same though time went on."""
        return self._layout.pixel_format == "MJPG"

    def signal(self) -> DriverSignal:
        """Return the driver's word on the signal at the input."""
        return driver_signal(self._node.fd, self._input)

    def read(self, out: Luma, timeout_s: float) -> Grab | None:
        assert out.shape == (self._layout.height_px, self._layout.width_px)
        deadline_s = time.monotonic() + timeout_s
        left_s = timeout_s
        while True:
            events = self._poll.poll(int(left_s * 1000))
            if events and self._dequeue():
                if not self._to_skip:
                    break
                self._to_skip -= 1
                self._give_back()
            elif events and events[0][1] & _GONE:
                raise SourceError(
                    f"{self._node.name} stopped giving pictures; check the cables and plug it in "
                    "anew"
                )
            left_s = deadline_s - time.monotonic()
            if not events or left_s <= 0:
                return None
        buffer = self._buffer
        stamp_ns = time.monotonic_ns()
        if self._stamped:
            stamp = buffer.timestamp
            stamp_ns = stamp.tv_sec * 1_000_000_000 + stamp.tv_usec * 1000
        grab = Grab(stamp_ns, buffer.sequence, self._scan(), self._copy(out))
        self._give_back()
        return grab

    def close(self) -> None:
        if self._node.fd < 0:
            return
        with contextlib.suppress(OSError):  # Unplugged: there is nothing left to stop.
            api.ioctl(self._node.fd, api.VIDIOC_STREAMOFF, self._stream)
        # A map cannot be closed while a view looks into it.
        self._bytes.clear()
        self._parts.clear()
        for one in self._maps:
            one.close()
        self._maps.clear()
        self._node.close()

    def _map_buffers(self, count: int) -> int:
        """Map and queue the driver's buffers, and return the flags that they carry."""
        asked = api.RequestBuffers(
            count=count, type=api.BUF_TYPE_VIDEO_CAPTURE, memory=api.MEMORY_MMAP
        )
        self._node.call(api.VIDIOC_REQBUFS, asked, f"asking for {count} buffers")
        buffer = self._buffer
        for index in range(asked.count):
            buffer.index = index
            self._node.call(api.VIDIOC_QUERYBUF, buffer, "asking for a buffer")
            if buffer.length < self._layout.needed_bytes:
                raise SourceError(
                    f"{self._node.name} has buffers of {buffer.length} bytes for pictures of "
                    f"{self._layout.needed_bytes}; set another v4l2.pixel_format"
                )
            try:
                one = mmap.mmap(
                    self._node.fd,
                    buffer.length,
                    mmap.MAP_SHARED,
                    mmap.PROT_READ,
                    offset=buffer.offset,
                )
            except OSError as error:
                raise self._node.error(error, "mapping a buffer") from None
            self._maps.append(one)
            self._bytes.append(np.frombuffer(one, np.uint8))
            if self._layout.pixel_format != "MJPG":
                self._parts.append(self._layout.parts(one))
            self._node.call(api.VIDIOC_QBUF, buffer, "queueing a buffer")
        return buffer.flags

    def _give_back(self) -> None:
        self._node.call(api.VIDIOC_QBUF, self._buffer, "giving a buffer back")

    def _dequeue(self) -> bool:
        """Take the next filled buffer; False if there is none yet."""
        try:
            api.ioctl(self._node.fd, api.VIDIOC_DQBUF, self._buffer)
        except OSError as error:
            if error.errno == errno.EAGAIN:
                return False
            raise self._node.error(error, "giving a picture") from None
        return True

    def _copy(self, out: Luma) -> Damage:
        """Copy the buffer's luma into `out` and return what the driver says is wrong with it."""
        buffer, layout = self._buffer, self._layout
        damage = Damage.FLAGGED if buffer.flags & api.BUF_FLAG_ERROR else Damage.NONE
        if layout.pixel_format == "MJPG":
            data = self._bytes[buffer.index][: buffer.bytesused]
            return damage | decode_mjpg(data, layout.field, out)
        layout.copy(self._parts[buffer.index], out)
        return damage | Damage.SHORT if buffer.bytesused < layout.needed_bytes else damage

    def _scan(self) -> Scan:
        if self._layout.field != api.FIELD_ALTERNATE:
            return self._info.scan
        return Scan.BOTTOM if self._buffer.field == api.FIELD_BOTTOM else Scan.TOP
