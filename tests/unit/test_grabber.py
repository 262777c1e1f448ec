"""Which device a person means, and how devices are shown."""

import errno
import os
from dataclasses import replace

import pytest

from vdms_rt.capture import grabber
from vdms_rt.capture.grabber import DeviceInfo, choose_device, devices_table, list_devices
from vdms_rt.model import SourceError

WEBCAM = DeviceInfo(
    node="/dev/video0",
    driver="uvcvideo",
    card="Laptop Camera",
    bus_info="usb-0000:00:14.0-6",
    usb_id="04f2:b6d9",
    serial="0001",
    usb_port="1-6",
    speed_mbit_s=480,
    inputs=("Camera 1",),
    formats=("MJPG", "YUYV"),
    capture=True,
)
METADATA = replace(WEBCAM, node="/dev/video1", inputs=(), formats=(), capture=False)
CONVERTER = replace(
    WEBCAM, node="/dev/video2", card="AV TO USB2.0", usb_id="534d:0021", serial="", usb_port="1-2"
)
EASYCAP = DeviceInfo(
    node="/dev/video3",
    driver="usbtv",
    card="usbtv",
    bus_info="usb-0000:00:14.0-1.3",
    usb_id="1b71:3002",
    serial="EASY01",
    usb_port="1-1.3",
    speed_mbit_s=480,
    inputs=("Composite", "S-Video"),
    standards=("ntsc-m", "pal"),
    formats=("YUYV",),
    capture=True,
)
OTHER_EASYCAP = replace(EASYCAP, node="/dev/video4", serial="EASY02", usb_port="1-1.4")
BAYER = replace(WEBCAM, node="/dev/video5", card="Sensor", formats=("BA81",), usb_port="1-7")
LOCKED = DeviceInfo(node="/dev/video6", trouble="no permission to open /dev/video6; do this")


def test_auto_prefers_analogue_grabbers_then_converters():
    assert choose_device("auto", [WEBCAM, METADATA, CONVERTER, EASYCAP]) == "/dev/video3"
    assert choose_device("auto", [WEBCAM, METADATA, CONVERTER]) == "/dev/video2"
    assert choose_device("auto", [METADATA, BAYER, WEBCAM]) == "/dev/video0"


@pytest.mark.parametrize(
    ("text", "node"),
    [
        ("1b71:3002", "/dev/video3"),
        ("1B71:3002", "/dev/video3"),
        ("EASY01", "/dev/video3"),
        ("1-1.3", "/dev/video3"),
        ("04f2:b6d9", "/dev/video0"),
        ("0001", "/dev/video0"),
    ],
)
def test_device_by_usb_id_serial_or_port(text, node):
    assert choose_device(text, [METADATA, WEBCAM, CONVERTER, EASYCAP]) == node


def test_a_path_is_taken_as_it_is():
    assert choose_device("/dev/v4l/by-id/some-grabber", []) == "/dev/v4l/by-id/some-grabber"


@pytest.mark.parametrize(
    ("text", "devices", "sentence"),
    [
        ("auto", [], grabber.NO_DEVICE),
        ("1b71:3002", [], grabber.NO_DEVICE),
        ("auto", [LOCKED], "no permission to open /dev/video6; do this"),
        (
            "auto",
            [METADATA, BAYER],
            "no video device gives pictures that vdms-rt reads: /dev/video1 (Laptop Camera) is "
            "not a capture device; /dev/video5 (Sensor) has only BA81; plug in a frame grabber",
        ),
        (
            "1-7",
            [WEBCAM, BAYER],
            "no video device gives pictures that vdms-rt reads: /dev/video5 (Sensor) has only "
            "BA81; plug in a frame grabber",
        ),
        (
            "2040:c200",
            [WEBCAM],
            "no video device with USB id 2040:c200; plug it in, or set v4l2.device to one of "
            "those here: /dev/video0 (Laptop Camera)",
        ),
        (
            "EASY09",
            [EASYCAP],
            "no video device with serial or USB port EASY09; plug it in, or set v4l2.device to "
            "one of those here: /dev/video3 (usbtv)",
        ),
        (
            "1b71:3002",
            [EASYCAP, OTHER_EASYCAP],
            "2 video devices are 1b71:3002: /dev/video3 (usbtv), /dev/video4 (usbtv); set "
            "v4l2.device to the USB port of one: 1-1.3, 1-1.4",
        ),
    ],
)
def test_sentence_when_no_device_fits(text, devices, sentence):
    with pytest.raises(SourceError) as caught:
        choose_device(text, devices)
    assert str(caught.value) == sentence


def test_an_empty_name_means_no_device_without_serial():
    with pytest.raises(SourceError, match="no video device with serial"):
        choose_device("", [CONVERTER, EASYCAP])


def test_table_for_a_person():
    assert devices_table([EASYCAP, METADATA, LOCKED]) == (
        "/dev/video3 (usbtv)\n"
        "  driver    usbtv\n"
        "  bus       usb-0000:00:14.0-1.3\n"
        "  USB       1b71:3002, serial EASY01, port 1-1.3, 480 Mbit/s\n"
        "  inputs    0 Composite, 1 S-Video\n"
        "  standards ntsc-m, pal\n"
        "  formats   YUYV\n"
        "\n"
        "/dev/video1 (Laptop Camera)\n"
        "  driver    uvcvideo\n"
        "  bus       usb-0000:00:14.0-6\n"
        "  USB       04f2:b6d9, serial 0001, port 1-6, 480 Mbit/s\n"
        "  no use    is not a capture device\n"
        "\n"
        "/dev/video6\n"
        "  trouble   no permission to open /dev/video6; do this"
    )


def test_table_without_devices_is_one_sentence():
    assert devices_table([]) == (
        "No video device on this computer; plug the frame grabber in, and see with `lsusb` and "
        "`dmesg` whether the kernel knows it."
    )


def test_devices_of_a_computer_without_video(tmp_path):
    assert list_devices(tmp_path / "video4linux") == []


@pytest.fixture
def sysfs(tmp_path):
    """Sysfs with video nodes 87654 on a USB port and 100000 on none; neither is in /dev."""
    usb = tmp_path / "devices" / "usb1" / "1-1" / "1-1.3"
    for name, text in (
        ("idVendor", "1b71"),
        ("idProduct", "3002"),
        ("serial", "EASY01"),
        ("speed", "480"),
    ):
        usb.mkdir(parents=True, exist_ok=True)
        (usb / name).write_text(text + "\n")
    classes = tmp_path / "class" / "video4linux"
    for name, device in (
        ("video100000", tmp_path / "devices" / "platform"),
        ("video87654", usb / "1-1.3:1.0"),
        ("vbi0", usb / "1-1.3:1.0"),
    ):
        device.mkdir(parents=True, exist_ok=True)
        (classes / name).mkdir(parents=True)
        (classes / name / "device").symlink_to(device)
    return classes


def test_usb_facts_come_from_sysfs_also_when_the_node_cannot_be_opened(sysfs):
    first, second = list_devices(sysfs)
    assert (first.node, second.node) == ("/dev/video87654", "/dev/video100000")
    assert (first.usb_id, first.serial, first.usb_port) == ("1b71:3002", "EASY01", "1-1.3")
    assert first.speed_mbit_s == 480
    assert first.trouble.startswith("/dev/video87654 is not there; plug")
    assert not first.usable
    assert (second.usb_id, second.serial, second.usb_port) == ("", "", "")


def test_speed_that_the_kernel_does_not_know(sysfs):
    usb = (sysfs / "video87654" / "device").resolve().parent
    (usb / "speed").write_text("unknown\n")
    assert list_devices(sysfs)[0].speed_mbit_s is None


@pytest.mark.parametrize(
    ("number", "part"),
    [
        (errno.EACCES, "no permission to open /dev/video0; add the user to the group video"),
        (errno.ENOENT, "/dev/video0 is not there; plug the device in"),
        (errno.ENODEV, "/dev/video0 is not there; plug the device in"),
        (errno.EBUSY, "/dev/video0 is in use by another program; end it"),
        (errno.EIO, "cannot open /dev/video0: Input/output error; set v4l2.device"),
    ],
)
def test_sentence_for_a_node_that_does_not_open(number, part):
    text = grabber.open_sentence("/dev/video0", OSError(number, os.strerror(number)))
    assert text.startswith(part)
