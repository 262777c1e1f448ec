"""Our structures against the kernel's: the numbers are what gcc says of linux/videodev2.h on a
64-bit machine (sizeof, offsetof and the VIDIOC_ macros themselves)."""

import ctypes
import errno
import fcntl

import pytest

from vdms_rt.capture import v4l2_api as api


@pytest.mark.parametrize(
    ("structure", "size"),
    [
        (api.Capability, 104),
        (api.FormatDescription, 64),
        (api.PixFormat, 48),
        (api.Format, 208),
        (api.RequestBuffers, 20),
        (api.Buffer, 88),
        (api.Input, 80),
        (api.StreamParameters, 204),
        (api.FrameInterval, 52),
    ],
)
def test_size_of_structure(structure, size):
    assert ctypes.sizeof(structure) == size


@pytest.mark.parametrize(
    ("structure", "name", "offset"),
    [
        (api.Capability, "device_caps", 88),
        (api.FormatDescription, "pixelformat", 44),
        (api.PixFormat, "bytesperline", 16),
        (api.Format, "fmt", 8),
        (api.RequestBuffers, "memory", 8),
        (api.Buffer, "timestamp", 24),
        (api.Buffer, "timecode", 40),
        (api.Buffer, "sequence", 56),
        (api.Buffer, "m", 64),
        (api.Buffer, "length", 72),
        (api.Input, "std", 48),
        (api.Input, "status", 56),
        (api.StreamParameters, "timeperframe", 12),
        (api.FrameInterval, "discrete", 20),
    ],
)
def test_offset_of_member(structure, name, offset):
    assert getattr(structure, name).offset == offset


@pytest.mark.parametrize(
    ("name", "number"),
    [
        ("QUERYCAP", 0x80685600),
        ("ENUM_FMT", 0xC0405602),
        ("S_FMT", 0xC0D05605),
        ("REQBUFS", 0xC0145608),
        ("QUERYBUF", 0xC0585609),
        ("QBUF", 0xC058560F),
        ("DQBUF", 0xC0585611),
        ("STREAMON", 0x40045612),
        ("STREAMOFF", 0x40045613),
        ("G_PARM", 0xC0CC5615),
        ("S_STD", 0x40085618),
        ("ENUMINPUT", 0xC050561A),
        ("S_INPUT", 0xC0045627),
        ("QUERYSTD", 0x8008563F),
        ("ENUM_FRAMEINTERVALS", 0xC034564B),
    ],
)
def test_request_number(name, number):
    assert getattr(api, f"VIDIOC_{name}") == number


def test_standards_are_of_their_line_count():
    for name, bits in api.STANDARDS.items():
        lines = api.STD_625_50 if name == "pal" else api.STD_525_60
        assert bits
        assert bits & lines == bits


def test_fourcc_there_and_back():
    assert api.fourcc("YUYV") == 0x56595559
    for name in ("YUYV", "UYVY", "GREY", "MJPG", "Y10"):
        assert api.fourcc_name(api.fourcc(name.ljust(4))) == name
    assert api.fourcc_name(api.fourcc("Y16 ") | 1 << 31) == "Y16-BE"


def test_capabilities_of_the_node_not_of_the_device():
    old = api.Capability(capabilities=api.CAP_VIDEO_CAPTURE, device_caps=0)
    metadata = api.Capability(capabilities=api.CAP_VIDEO_CAPTURE | api.CAP_DEVICE_CAPS)
    assert old.of_node & api.CAP_VIDEO_CAPTURE
    assert not metadata.of_node & api.CAP_VIDEO_CAPTURE


def test_ioctl_goes_on_after_a_signal(monkeypatch):
    answers = [InterruptedError(errno.EINTR, "signal"), InterruptedError(errno.EINTR, "signal"), 0]

    def interrupted(fd, request, argument):
        answer = answers.pop(0)
        if isinstance(answer, Exception):
            raise answer
        argument.value = 7
        return answer

    monkeypatch.setattr(fcntl, "ioctl", interrupted)
    number = ctypes.c_int(0)
    api.ioctl(0, api.VIDIOC_S_INPUT, number)
    assert number.value == 7
    assert not answers
