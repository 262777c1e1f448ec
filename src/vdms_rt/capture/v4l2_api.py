"""The kernel's V4L2 interface by ctypes: structures, request numbers and flags, and nothing else.

Source: include/uapi/linux/videodev2.h, a stable interface, as 64-bit machines lay it out. Names
follow it. Only what capture uses is here.
"""

from __future__ import annotations

import ctypes
import errno
import fcntl
import os
from collections.abc import Callable
from ctypes import Structure, Union, c_char, c_int, c_int32, c_long, c_uint8, c_uint32, c_uint64
from typing import TypeVar

BUF_TYPE_VIDEO_CAPTURE = 1
MEMORY_MMAP = 1

CAP_VIDEO_CAPTURE = 0x00000001
CAP_STREAMING = 0x04000000
CAP_DEVICE_CAPS = 0x80000000

FIELD_NONE = 1
FIELD_TOP = 2
FIELD_BOTTOM = 3
FIELD_INTERLACED = 4
FIELD_SEQ_TB = 5
FIELD_SEQ_BT = 6
FIELD_ALTERNATE = 7
FIELD_INTERLACED_TB = 8
FIELD_INTERLACED_BT = 9

BUF_FLAG_ERROR = 0x00000040
BUF_FLAG_TIMESTAMP_MASK = 0x0000E000
BUF_FLAG_TIMESTAMP_MONOTONIC = 0x00002000
BUF_FLAG_TSTAMP_SRC_MASK = 0x00070000
BUF_FLAG_TSTAMP_SRC_SOE = 0x00010000

FRMIVAL_TYPE_DISCRETE = 1

IN_ST_NO_POWER = 0x00000001
IN_ST_NO_SIGNAL = 0x00000002
IN_ST_NO_H_LOCK = 0x00000100
IN_ST_NO_V_LOCK = 0x00000400
IN_ST_NO_SYNC = 0x00010000

CID_BRIGHTNESS = 0x00980900
CID_CONTRAST = 0x00980901
CID_SATURATION = 0x00980902
CID_HUE = 0x00980903
CID_AUTOGAIN = 0x00980912
CID_GAIN = 0x00980913
CID_AUTOBRIGHTNESS = 0x00980920
CID_EXPOSURE_AUTO = 0x009A0901
EXPOSURE_MANUAL = 1

CTRL_FLAG_DISABLED = 0x0001
CTRL_FLAG_READ_ONLY = 0x0004

STD_525_60 = 0x0000F900
STD_625_50 = 0x00FF06FF

STANDARDS = {
    "ntsc-m": 0x00001000,
    "ntsc-m-jp": 0x00002000,
    "ntsc-m-kr": 0x00008000,
    "ntsc": 0x0000B000,
    "ntsc-443": 0x00004000,
    "pal": 0x000000FF,
    "pal-m": 0x00000100,
    "pal-60": 0x00000800,
}
"""Bits of `v4l2_std_id` by the names of the configuration."""


class Capability(Structure):
    driver: bytes
    card: bytes
    bus_info: bytes
    capabilities: int
    device_caps: int
    _fields_ = (
        ("driver", c_char * 16),
        ("card", c_char * 32),
        ("bus_info", c_char * 32),
        ("version", c_uint32),
        ("capabilities", c_uint32),
        ("device_caps", c_uint32),
        ("reserved", c_uint32 * 3),
    )

    @property
    def of_node(self) -> int:
        """What this node can do; `capabilities` is what all nodes of the device can."""
        return self.device_caps if self.capabilities & CAP_DEVICE_CAPS else self.capabilities


class FormatDescription(Structure):
    index: int
    type: int
    pixelformat: int
    _fields_ = (
        ("index", c_uint32),
        ("type", c_uint32),
        ("flags", c_uint32),
        ("description", c_char * 32),
        ("pixelformat", c_uint32),
        ("mbus_code", c_uint32),
        ("reserved", c_uint32 * 3),
    )


class PixFormat(Structure):
    width: int
    height: int
    pixelformat: int
    field: int
    bytesperline: int
    sizeimage: int
    _fields_ = (
        ("width", c_uint32),
        ("height", c_uint32),
        ("pixelformat", c_uint32),
        ("field", c_uint32),
        ("bytesperline", c_uint32),
        ("sizeimage", c_uint32),
        ("colorspace", c_uint32),
        ("priv", c_uint32),
        ("flags", c_uint32),
        ("ycbcr_enc", c_uint32),
        ("quantization", c_uint32),
        ("xfer_func", c_uint32),
    )


class _FormatUnion(Union):
    # The kernel's union holds pointers too (v4l2_window), so it is aligned like one.
    _fields_ = (("pix", PixFormat), ("raw_data", c_uint8 * 200), ("alignment", c_uint64))


class Format(Structure):
    type: int
    pix: PixFormat
    _anonymous_ = ("fmt",)
    _fields_ = (("type", c_uint32), ("fmt", _FormatUnion))


class RequestBuffers(Structure):
    count: int
    type: int
    memory: int
    _fields_ = (
        ("count", c_uint32),
        ("type", c_uint32),
        ("memory", c_uint32),
        ("capabilities", c_uint32),
        ("flags", c_uint8),
        ("reserved", c_uint8 * 3),
    )


class _TimeVal(Structure):
    tv_sec: int
    tv_usec: int
    _fields_ = (("tv_sec", c_long), ("tv_usec", c_long))


class _TimeCode(Structure):
    _fields_ = (("type", c_uint32), ("flags", c_uint32), ("numbers", c_uint8 * 8))


class _BufferMemory(Union):
    _fields_ = (("offset", c_uint32), ("userptr", c_uint64))


class Buffer(Structure):
    index: int
    type: int
    bytesused: int
    flags: int
    field: int
    timestamp: _TimeVal
    sequence: int
    memory: int
    offset: int
    length: int
    _anonymous_ = ("m",)
    _fields_ = (
        ("index", c_uint32),
        ("type", c_uint32),
        ("bytesused", c_uint32),
        ("flags", c_uint32),
        ("field", c_uint32),
        ("timestamp", _TimeVal),
        ("timecode", _TimeCode),
        ("sequence", c_uint32),
        ("memory", c_uint32),
        ("m", _BufferMemory),
        ("length", c_uint32),
        ("reserved2", c_uint32),
        ("request_fd", c_int32),
    )


class Input(Structure):
    index: int
    name: bytes
    std: int
    status: int
    _fields_ = (
        ("index", c_uint32),
        ("name", c_char * 32),
        ("type", c_uint32),
        ("audioset", c_uint32),
        ("tuner", c_uint32),
        ("std", c_uint64),
        ("status", c_uint32),
        ("capabilities", c_uint32),
        ("reserved", c_uint32 * 3),
    )


class ControlDescription(Structure):
    """`v4l2_queryctrl`"""

    id: int
    name: bytes
    minimum: int
    maximum: int
    step: int
    default_value: int
    flags: int
    _fields_ = (
        ("id", c_uint32),
        ("type", c_uint32),
        ("name", c_char * 32),
        ("minimum", c_int32),
        ("maximum", c_int32),
        ("step", c_int32),
        ("default_value", c_int32),
        ("flags", c_uint32),
        ("reserved", c_uint32 * 2),
    )


class Control(Structure):
    id: int
    value: int
    _fields_ = (("id", c_uint32), ("value", c_int32))


class Fraction(Structure):
    numerator: int
    denominator: int
    _fields_ = (("numerator", c_uint32), ("denominator", c_uint32))


class StreamParameters(Structure):
    """`v4l2_streamparm` with its `v4l2_captureparm`."""

    type: int
    timeperframe: Fraction
    _fields_ = (
        ("type", c_uint32),
        ("capability", c_uint32),
        ("capturemode", c_uint32),
        ("timeperframe", Fraction),
        ("extendedmode", c_uint32),
        ("readbuffers", c_uint32),
        ("reserved", c_uint8 * 176),
    )


class FrameInterval(Structure):
    """`v4l2_frmivalenum` with its discrete member."""

    index: int
    pixel_format: int
    width: int
    height: int
    type: int
    discrete: Fraction
    _fields_ = (
        ("index", c_uint32),
        ("pixel_format", c_uint32),
        ("width", c_uint32),
        ("height", c_uint32),
        ("type", c_uint32),
        ("discrete", Fraction),
        ("stepwise_rest", Fraction * 2),
        ("reserved", c_uint32 * 2),
    )


_WRITE, _READ = 1, 2


def _request(direction: int, number: int, size: int) -> int:
    # _IOC of asm-generic/ioctl.h, as x86 and ARM have it.
    return direction << 30 | size << 16 | ord("V") << 8 | number


_INT = ctypes.sizeof(c_int)
_STD = ctypes.sizeof(c_uint64)

VIDIOC_QUERYCAP = _request(_READ, 0, ctypes.sizeof(Capability))
VIDIOC_ENUM_FMT = _request(_READ | _WRITE, 2, ctypes.sizeof(FormatDescription))
VIDIOC_S_FMT = _request(_READ | _WRITE, 5, ctypes.sizeof(Format))
VIDIOC_REQBUFS = _request(_READ | _WRITE, 8, ctypes.sizeof(RequestBuffers))
VIDIOC_QUERYBUF = _request(_READ | _WRITE, 9, ctypes.sizeof(Buffer))
VIDIOC_QBUF = _request(_READ | _WRITE, 15, ctypes.sizeof(Buffer))
VIDIOC_DQBUF = _request(_READ | _WRITE, 17, ctypes.sizeof(Buffer))
VIDIOC_STREAMON = _request(_WRITE, 18, _INT)
VIDIOC_STREAMOFF = _request(_WRITE, 19, _INT)
VIDIOC_G_PARM = _request(_READ | _WRITE, 21, ctypes.sizeof(StreamParameters))
VIDIOC_S_STD = _request(_WRITE, 24, _STD)
VIDIOC_G_CTRL = _request(_READ | _WRITE, 27, ctypes.sizeof(Control))
VIDIOC_S_CTRL = _request(_READ | _WRITE, 28, ctypes.sizeof(Control))
VIDIOC_QUERYCTRL = _request(_READ | _WRITE, 36, ctypes.sizeof(ControlDescription))
VIDIOC_G_INPUT = _request(_READ, 38, _INT)
VIDIOC_ENUMINPUT = _request(_READ | _WRITE, 26, ctypes.sizeof(Input))
VIDIOC_S_INPUT = _request(_READ | _WRITE, 39, _INT)
VIDIOC_QUERYSTD = _request(_READ, 63, _STD)
VIDIOC_ENUM_FRAMEINTERVALS = _request(_READ | _WRITE, 75, ctypes.sizeof(FrameInterval))

NOT_OFFERED = frozenset((errno.ENOTTY, errno.ENODATA, errno.EINVAL))
"""Errors by which a driver says that it has no such thing: no such call, not on this input, no
such index."""

Argument = Structure | c_int | c_uint64
_Item = TypeVar("_Item", FormatDescription, Input, FrameInterval)


def open_node(path: str) -> int:
    """Return a file descriptor of a video node that never blocks; raises OSError."""
    return os.open(path, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)


def ioctl(fd: int, request: int, argument: Argument) -> None:
    """Ask the driver; it fills `argument`. Goes on after a signal; raises OSError."""
    while True:
        try:
            fcntl.ioctl(fd, request, argument)
        except InterruptedError:
            continue
        return


def capability(fd: int) -> Capability:
    """Return what the driver says of itself; raises OSError (ENOTTY: not a video node)."""
    answer = Capability()
    ioctl(fd, VIDIOC_QUERYCAP, answer)
    return answer


def inputs(fd: int) -> list[Input]:
    """Return the node's inputs in their order; empty if it has no choice of them."""
    return _all(fd, VIDIOC_ENUMINPUT, lambda index: Input(index=index))


def pixel_formats(fd: int) -> list[str]:
    """Return the four-character names of the node's picture formats, in the driver's order."""
    found = _all(
        fd,
        VIDIOC_ENUM_FMT,
        lambda index: FormatDescription(index=index, type=BUF_TYPE_VIDEO_CAPTURE),
    )
    return [fourcc_name(f.pixelformat) for f in found]


def _all(fd: int, request: int, ask: Callable[[int], _Item]) -> list[_Item]:
    found: list[_Item] = []
    while True:
        item = ask(len(found))
        try:
            ioctl(fd, request, item)
        except OSError as error:
            if error.errno in NOT_OFFERED:
                return found
            raise
        found.append(item)


def fourcc(name: str) -> int:
    return int.from_bytes(name.encode("ascii"), "little")


def fourcc_name(code: int) -> str:
    # Bit 31 marks a big-endian variant, which is another format than the one without it.
    name = (code & 0x7FFFFFFF).to_bytes(4, "little").decode("latin-1").rstrip()
    return f"{name}-BE" if code & 0x80000000 else name


def text(raw: bytes) -> str:
    """Return a string of the kernel's."""
    return raw.decode("utf-8", "replace").strip()
