"""Which device a person means."""

import re
import threading
from dataclasses import replace
from pathlib import Path

import pytest

from vdms_rt.capture.grabber import (
    GRABBERS,
    NO_DEVICE,
    DeviceInfo,
    better_device,
    choose_device,
    list_devices,
    setting_for,
)
from vdms_rt.capture.v4l2_node import DeviceGone
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
UNKNOWN = replace(CONVERTER, node="/dev/video7", usb_id="1234:5678", usb_port="1-5")
BAYER = replace(WEBCAM, node="/dev/video5", card="Sensor", formats=("BA81",), usb_port="1-7")
LOCKED = DeviceInfo(node="/dev/video6", trouble="no permission to open /dev/video6; do this")


def test_auto_prefers_analogue_grabbers_then_converters():
    assert choose_device("auto", [WEBCAM, METADATA, CONVERTER, EASYCAP]) == EASYCAP
    assert choose_device("auto", [WEBCAM, METADATA, CONVERTER]) == CONVERTER
    assert choose_device("auto", [METADATA, BAYER, WEBCAM]) == WEBCAM
    # What cannot be unplugged is the computer's own camera.
    assert choose_device("auto", [replace(WEBCAM, built_in=True), UNKNOWN]) == UNKNOWN
    assert choose_device("auto", [replace(WEBCAM, built_in=True)]).node == WEBCAM.node


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
    assert choose_device(text, [METADATA, WEBCAM, CONVERTER, EASYCAP]).node == node


def test_a_path_means_the_node_that_it_leads_to(tmp_path):
    link = tmp_path / "the-grabber"
    link.symlink_to(EASYCAP.node)
    assert choose_device(str(link), [WEBCAM, EASYCAP]) == replace(EASYCAP, node=str(link))
    assert choose_device("/dev/video3", [WEBCAM, EASYCAP]) == EASYCAP
    assert choose_device("/dev/video9", [WEBCAM]) == DeviceInfo("/dev/video9")


SLOW = replace(EASYCAP, speed_mbit_s=12)


@pytest.mark.parametrize("text", ["auto", "1b71:3002", "EASY01", "1-1.3", "/dev/video3"])
def test_a_usb_1_link_is_refused_with_the_reason(text):
    with pytest.raises(SourceError) as caught:
        choose_device(text, [SLOW])
    assert "/dev/video3 (usbtv) is on a USB 1.1 link of 12 Mbit/s" in str(caught.value)
    assert "plug it into a USB 2.0 port" in str(caught.value)


def test_auto_keeps_to_the_device_that_was_in_use():
    moved = replace(EASYCAP, node="/dev/video7", usb_port="3-2")
    assert choose_device("auto", [WEBCAM, moved], before=EASYCAP) == moved
    with pytest.raises(DeviceGone) as caught:
        choose_device("auto", [WEBCAM, OTHER_EASYCAP], before=EASYCAP)
    assert str(caught.value) == (
        "/dev/video3 (usbtv) is not there; plug it in again, or start vdms-rt anew to use another"
    )
    with pytest.raises(DeviceGone):
        choose_device("auto", [], before=EASYCAP)
    # A node may come back under another number.
    assert choose_device("/dev/video3", [WEBCAM, moved], before=EASYCAP) == moved


def test_of_two_that_are_alike_auto_keeps_to_the_port():
    twin = replace(EASYCAP, node="/dev/video8", usb_port="1-1.4")
    back = replace(EASYCAP, node="/dev/video9")
    assert choose_device("auto", [twin, back], before=EASYCAP) == back
    third = replace(twin, node="/dev/video10", usb_port="1-2")
    with pytest.raises(SourceError, match="2 video devices are like the one that was in use"):
        choose_device("auto", [twin, third], before=EASYCAP)


@pytest.mark.parametrize(
    ("device", "others", "setting"),
    [
        (EASYCAP, [OTHER_EASYCAP], "EASY01"),
        (CONVERTER, [EASYCAP], "534d:0021"),
        (CONVERTER, [replace(CONVERTER, node="/dev/video9", usb_port="1-3")], "1-2"),
        (EASYCAP, [replace(EASYCAP, node="/dev/video9", usb_port="1-3")], "1-1.3"),
        (WEBCAM, [METADATA], "0001"),
        (DeviceInfo("/dev/video0", capture=True, formats=("YUYV",)), [EASYCAP], "/dev/video0"),
    ],
)
def test_the_setting_for_a_device_means_that_one_alone(device, others, setting):
    devices = [*others, device]
    assert setting_for(device, devices) == setting
    assert choose_device(setting, devices).node == device.node


@pytest.mark.parametrize(
    ("text", "devices", "sentence"),
    [
        ("auto", [], NO_DEVICE),
        ("1b71:3002", [], NO_DEVICE),
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
        choose_device(text, devices, sysfs=Path("/no-sysfs"))
    assert str(caught.value) == sentence


def test_an_empty_name_means_no_device_without_serial():
    with pytest.raises(SourceError, match="no video device with serial"):
        choose_device("", [CONVERTER, EASYCAP])


def test_devices_of_a_computer_without_video(tmp_path):
    assert list_devices(tmp_path) == []
    with pytest.raises(DeviceGone, match="no video device on this computer"):
        choose_device("auto", sysfs=tmp_path)


def usb_device(sysfs):
    return (sysfs / "class" / "video4linux" / "video87654" / "device").resolve().parent


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
    return tmp_path


def test_usb_facts_come_from_sysfs_also_when_the_node_cannot_be_opened(sysfs):
    first, second = list_devices(sysfs)
    assert (first.node, second.node) == ("/dev/video87654", "/dev/video100000")
    assert (first.usb_id, first.serial, first.usb_port) == ("1b71:3002", "EASY01", "1-1.3")
    assert first.speed_mbit_s == 480
    assert first.trouble.startswith("/dev/video87654 is not there; plug")
    assert not first.usable
    assert (second.usb_id, second.serial, second.usb_port) == ("", "", "")


def test_a_grabber_may_be_pulled_while_the_devices_are_listed(sysfs):
    link = sysfs / "class" / "video4linux" / "video87654" / "device"
    device = link.resolve()
    done = threading.Event()

    def pull_and_plug():
        while not done.is_set():
            link.unlink()
            link.symlink_to(device)

    thread = threading.Thread(target=pull_and_plug)
    thread.start()
    try:
        seen = {d.serial for _ in range(3000) for d in list_devices(sysfs)}
    finally:
        done.set()
        thread.join()
    assert seen == {"", "EASY01"}


def test_speed_that_the_kernel_does_not_know(sysfs):
    usb = usb_device(sysfs)
    (usb / "speed").write_text("unknown\n")
    assert list_devices(sysfs)[0].speed_mbit_s is None


def test_a_grabber_plugged_in_is_better_than_a_webcam(sysfs):
    assert better_device("auto", WEBCAM, sysfs)
    assert not better_device("/dev/video0", WEBCAM, sysfs)
    assert not better_device("auto", EASYCAP, sysfs)
    (usb_device(sysfs) / "idVendor").write_text("04f2")
    assert not better_device("auto", WEBCAM, sysfs)


def test_a_known_grabber_without_a_driver_is_named(tmp_path):
    usb = tmp_path / "bus" / "usb" / "devices" / "1-4"
    (usb / "1-4:1.0").mkdir(parents=True)
    (usb / "idVendor").write_text("05e1\n")
    (usb / "idProduct").write_text("0408\n")
    with pytest.raises(SourceError) as caught:
        choose_device("auto", sysfs=tmp_path)
    assert str(caught.value) == (
        "the frame grabber 05e1:0408 at USB port 1-4 has no driver; load it with `sudo modprobe "
        "stk1160`, and see with `dmesg` what the kernel says"
    )
    with pytest.raises(SourceError, match="has no driver"):
        choose_device("auto", [METADATA], sysfs=tmp_path)
    (usb / "1-4:1.0" / "video4linux" / "video0").mkdir(parents=True)
    with pytest.raises(SourceError, match="no video device on this computer"):
        choose_device("auto", sysfs=tmp_path)


def test_the_udev_rules_know_the_same_grabbers():
    rules = (Path(__file__).parents[2] / "systemd" / "70-vdms-rt.rules").read_text()
    named = re.findall(r'ATTRS\{idVendor\}=="(\w+)", ATTRS\{idProduct\}=="([\w|]+)"', rules)
    assert {f"{vendor}:{one}" for vendor, products in named for one in products.split("|")} == set(
        GRABBERS
    )
