"""A USB device made of code, which the kernel's vhci-hcd attaches over USB/IP.

Sources: the kernel's Documentation/usb/usbip_protocol.rst; USB 2.0, chapter 9.
"""

import errno
import logging
import selectors
import socket
import struct
import time
from typing import NamedTuple

_log = logging.getLogger(__name__)

BUS_ID = "1-1"

_OPERATION = struct.Struct(">HHI")
_REQUEST_IMPORT, _REPLY_IMPORT = 0x8003, 0x0003
_VERSION = 0x0111
_COMMAND = struct.Struct(">IIIIIIiiii8s")
_REPLY = struct.Struct(">IIIIIiiiii8x")
_SUBMIT, _UNLINK, _SUBMITTED, _UNLINKED = 1, 2, 3, 4
_HIGH_SPEED = 3
_PACKET_BYTES = 16


class Stall(Exception):
    """The device does not know the request."""


class Setup(NamedTuple):
    """A control request."""

    kind: int
    request: int
    value: int
    index: int
    length: int


class Urb(NamedTuple):
    """A transfer that the kernel waits for."""

    number: int
    length: int


class Pace:
    """A steady schedule on the monotonic clock."""

    def __init__(self, period_s: float):
        self._period_s = period_s
        self._start_s: float | None = None
        self._taken = 0

    def start(self) -> None:
        self._start_s, self._taken = time.monotonic(), 0

    def stop(self) -> None:
        self._start_s = None

    def due_s(self) -> float | None:
        """Return when the next thing is due, None while stopped."""
        if self._start_s is None:
            return None
        return self._start_s + (self._taken + 1) * self._period_s

    def take(self) -> int:
        """Return the number of the thing that is due, counted from 0."""
        self._taken += 1
        return self._taken - 1


class Device:
    """A device with one configuration. A kind of device gives its identity and interfaces, and
    fills `self.urbs` of its streaming endpoint in `stream`."""

    vendor_id: int
    product_id: int
    device_class = (0, 0, 0)
    interface_count: int
    maker: str
    product: str

    def __init__(self, serial: str):
        self._strings = (self.maker, self.product, serial)
        self._alternates: dict[int, int] = {}
        self.urbs: list[Urb] = []
        self.outbox: list[bytes] = []

    def interfaces(self) -> bytes:
        """Return the descriptors of the interfaces and endpoints."""
        raise Stall

    def own_request(self, setup: Setup) -> bytes:
        """Answer a request of the device's class or maker; raises Stall."""
        raise Stall

    def alternate_set(self, interface: int, alternate: int) -> None:
        """An interface was switched to one of its alternate settings."""

    def configured(self) -> None:
        """The device was configured: plugged in, or reset."""

    def due_s(self) -> float | None:
        """Return when `stream` has something to do next, None if never."""
        return None

    def idle(self) -> bool:
        """Return whether nothing is to be sent before `due_s`."""
        return True

    def stream(self, now_s: float) -> None:
        """Answer the waiting URBs with what is due."""

    def control(self, setup: Setup) -> bytes:
        """Answer a control request; raises Stall."""
        if setup.kind & 0x60:
            return self.own_request(setup)
        match setup.request:
            case 0:  # GET_STATUS
                return b"\0\0"
            case 1 | 3:  # CLEAR_FEATURE, SET_FEATURE
                return b""
            case 9:  # SET_CONFIGURATION
                self.configured()
                return b""
            case 6:  # GET_DESCRIPTOR
                return self._descriptor(setup.value >> 8, setup.value & 0xFF)
            case 8:  # GET_CONFIGURATION
                return b"\x01"
            case 10:  # GET_INTERFACE
                return bytes([self._alternates.get(setup.index, 0)])
            case 11:  # SET_INTERFACE
                self._alternates[setup.index] = setup.value
                self.alternate_set(setup.index, setup.value)
                return b""
        raise Stall

    def _descriptor(self, kind: int, index: int) -> bytes:
        if kind == 1:
            head = struct.pack("<BBHBBBB", 18, 1, 0x0200, *self.device_class, 64)
            ids = struct.pack("<HHH", self.vendor_id, self.product_id, 0x0100)
            return head + ids + bytes((1, 2, 3, 1))
        if kind == 2:
            body = self.interfaces()
            total = 9 + len(body)
            return (
                struct.pack("<BBHBBBBB", 9, 2, total, self.interface_count, 1, 0, 0x80, 250) + body
            )
        if kind == 3 and index == 0:
            return b"\x04\x03\x09\x04"
        if kind == 3:
            text = self._strings[index - 1].encode("utf-16-le")
            return bytes((2 + len(text), 3)) + text
        raise Stall

    def answer(self, number: int, status: int = 0, data: bytes = b"", packets: bytes = b"") -> None:
        """Complete the URB of that number; `packets` describes those of an isochronous one."""
        count = len(packets) // _PACKET_BYTES
        head = _REPLY.pack(_SUBMITTED, number, 0, 0, 0, status, len(data), 0, count, 0)
        self.outbox += [head, data, packets]


def isochronous_packets(count: int, packet_bytes: int) -> bytes:
    """Return the description of so many full packets."""
    return b"".join(
        struct.pack(">IIIi", n * packet_bytes, packet_bytes, packet_bytes, 0) for n in range(count)
    )


def serve(device: Device, port: int) -> None:
    """Wait to be attached, be the device until it is detached, and again, for ever."""
    with socket.create_server(("127.0.0.1", port)) as listener:
        _log.info("listening")
        while True:
            connection, _ = listener.accept()
            with connection:
                try:
                    _Session(connection, device).run()
                except OSError as error:
                    _log.info("closed: %s", error)


class _Session:
    """One attachment: from the import to the end of the connection."""

    def __init__(self, connection: socket.socket, device: Device):
        self._connection = connection
        self._device = device
        self._inbox = bytearray()

    def run(self) -> None:
        device = self._device
        if not self._import():
            return
        self._connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        device.urbs.clear()
        device.outbox.clear()
        selector = selectors.DefaultSelector()
        selector.register(self._connection, selectors.EVENT_READ)
        while True:
            due_s = device.due_s()
            wait_s = None if due_s is None else max(0.0, due_s - time.monotonic())
            if wait_s and device.idle():
                # Let the requests pile up: one wake-up for all of them.
                time.sleep(wait_s)
                wait_s = 0
            if selector.select(wait_s):
                chunk = self._connection.recv(1 << 18)
                if not chunk:
                    return
                self._inbox += chunk
            self._take_commands()
            device.stream(time.monotonic())
            if device.outbox:
                self._connection.sendall(b"".join(device.outbox))
                device.outbox.clear()

    def _import(self) -> bool:
        _, operation, _ = _OPERATION.unpack(self._receive(_OPERATION.size))
        bus_id = self._receive(32).rstrip(b"\0").decode() if operation == _REQUEST_IMPORT else ""
        if bus_id != BUS_ID:
            self._connection.sendall(_OPERATION.pack(_VERSION, _REPLY_IMPORT, 1))
            return False
        device = self._device
        path, name = b"/sys/devices/virtual/" + bus_id.encode(), bus_id.encode()
        where = struct.pack(">256s32sIII", path, name, 1, 1, _HIGH_SPEED)
        ids = struct.pack(">HHH", device.vendor_id, device.product_id, 0x0100)
        rest = bytes((*device.device_class, 0, 1, device.interface_count))
        self._connection.sendall(_OPERATION.pack(_VERSION, _REPLY_IMPORT, 0) + where + ids + rest)
        return True

    def _receive(self, count: int) -> bytes:
        data = b""
        while len(data) < count:
            chunk = self._connection.recv(count - len(data))
            if not chunk:
                raise ConnectionError("the other side hung up")
            data += chunk
        return data

    def _take_commands(self) -> None:
        at = 0
        while len(self._inbox) - at >= _COMMAND.size:
            command, number, _, into, endpoint, flags, length, _, packets, _, setup = (
                _COMMAND.unpack_from(self._inbox, at)
            )
            end = at + _COMMAND.size
            if command == _UNLINK:
                self._unlink(number, flags)
                at = end
                continue
            end += 0 if into else length
            end += _PACKET_BYTES * packets if packets > 0 else 0
            if len(self._inbox) < end:
                break
            at = end
            if endpoint == 0:
                self._control(number, bool(into), length, Setup(*struct.unpack("<BBHHH", setup)))
            elif into:
                self._device.urbs.append(Urb(number, length))
            else:
                self._accept(number, length)
        del self._inbox[:at]

    def _control(self, number: int, into: bool, length: int, setup: Setup) -> None:
        try:
            data = self._device.control(setup)
        except Stall:
            self._device.answer(number, -errno.EPIPE)
            return
        if into:
            self._device.answer(number, 0, data[: setup.length])
        else:
            self._accept(number, length)

    def _accept(self, number: int, length: int) -> None:
        """Say that all of what the kernel sent was taken."""
        self._device.outbox.append(_REPLY.pack(_SUBMITTED, number, 0, 0, 0, 0, length, 0, 0, 0))

    def _unlink(self, number: int, target: int) -> None:
        """Give an URB up, if it is not answered yet."""
        urbs = self._device.urbs
        waiting = [urb for urb in urbs if urb.number != target]
        status = -errno.ECONNRESET if len(waiting) < len(urbs) else 0
        urbs[:] = waiting
        self._device.outbox.append(_REPLY.pack(_UNLINKED, number, 0, 0, 0, status, 0, 0, 0, 0))
