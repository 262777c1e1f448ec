"""Decisions of the V4L2 source, and its sentences, as far as they need no driver."""

import os

import pytest

from vdms_rt.capture import v4l2_api as api
from vdms_rt.capture.v4l2 import V4l2Source
from vdms_rt.capture.v4l2_settings import detected_standard, image_scan
from vdms_rt.config import V4l2
from vdms_rt.model import Scan, SourceError


@pytest.mark.parametrize(
    ("field", "scan", "known"),
    [
        (api.FIELD_NONE, Scan.PROGRESSIVE, True),
        (api.FIELD_INTERLACED, Scan.BOTTOM_FIRST, False),
        (api.FIELD_INTERLACED_TB, Scan.TOP_FIRST, True),
        (api.FIELD_INTERLACED_BT, Scan.BOTTOM_FIRST, True),
        (api.FIELD_SEQ_TB, Scan.TOP_FIRST, True),
        (api.FIELD_SEQ_BT, Scan.BOTTOM_FIRST, True),
        (api.FIELD_ALTERNATE, Scan.TOP, True),
    ],
)
def test_scan_of_each_field_setting(field, scan, known):
    assert image_scan(field, Scan.BOTTOM_FIRST, "auto") == (scan, known)


@pytest.mark.parametrize(
    ("override", "scan"),
    [
        ("progressive", Scan.PROGRESSIVE),
        ("top-first", Scan.TOP_FIRST),
        ("bottom-first", Scan.BOTTOM_FIRST),
    ],
)
def test_configured_field_order_wins_over_driver(override, scan):
    for field in (api.FIELD_NONE, api.FIELD_INTERLACED, api.FIELD_INTERLACED_TB):
        assert image_scan(field, Scan.BOTTOM_FIRST, override) == (scan, True)
    assert image_scan(api.FIELD_ALTERNATE, Scan.BOTTOM_FIRST, override) == (Scan.TOP, True)


@pytest.mark.parametrize("field", [api.FIELD_TOP, api.FIELD_BOTTOM])
def test_one_field_alone_is_refused(field):
    with pytest.raises(ValueError, match="only one field"):
        image_scan(field, Scan.TOP_FIRST, "auto")


@pytest.mark.parametrize(
    ("bits", "name"),
    [
        (0, ""),
        (api.STD_525_60 | api.STD_625_50, ""),
        (api.STD_525_60, "ntsc-m"),
        (api.STANDARDS["ntsc"], "ntsc-m"),
        (api.STANDARDS["ntsc-443"], "ntsc-443"),
        (api.STANDARDS["pal-60"], "pal-60"),
        (api.STD_625_50, "pal"),
        (0x00000001, "pal"),
    ],
)
def test_detected_standard(bits, name):
    assert detected_standard(bits) == name


def open_files() -> set[str]:
    return set(os.listdir("/proc/self/fd"))  # noqa: PTH208 - names alone


def test_absent_node():
    with pytest.raises(SourceError) as caught:
        V4l2Source(V4l2(device="/dev/video-not-there"))
    assert str(caught.value) == (
        "/dev/video-not-there is not there; plug the device in, or set v4l2.device to another "
        "(`vdms-rt devices` lists them)"
    )


@pytest.mark.parametrize("kind", ["/dev/null", "a file"])
def test_not_a_video_device(tmp_path, kind):
    path = kind
    if kind == "a file":
        path = str(tmp_path / "frames.yuyv")
        (tmp_path / "frames.yuyv").write_bytes(b"no device")
    before = open_files()
    with pytest.raises(SourceError) as caught:
        V4l2Source(V4l2(device=path))
    assert str(caught.value) == (
        f"{path} is not a video device; set v4l2.device to a node that `vdms-rt devices` lists"
    )
    assert open_files() == before


def test_a_folder_is_not_a_device(tmp_path):
    with pytest.raises(SourceError, match=r"cannot open .*: Is a directory; set v4l2.device to"):
        V4l2Source(V4l2(device=str(tmp_path)))
