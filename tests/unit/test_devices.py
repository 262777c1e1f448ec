"""How the computer's devices are shown."""

import json
import subprocess
import sys
from dataclasses import replace

from vdms_rt.capture.devices import Shown, devices_json, devices_table, signal_now
from vdms_rt.capture.grabber import DeviceInfo

EASYCAP = DeviceInfo(
    node="/dev/video0",
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
WEBCAM = replace(
    EASYCAP,
    node="/dev/video1",
    driver="uvcvideo",
    card="Laptop Camera",
    usb_id="04f2:b6d9",
    serial="",
    usb_port="1-6",
    inputs=("Camera 1",),
    standards=(),
    formats=("MJPG", "YUYV"),
)
METADATA = replace(WEBCAM, node="/dev/video2", inputs=(), formats=(), capture=False)
SLOW = replace(EASYCAP, node="/dev/video3", speed_mbit_s=12)
LOCKED = DeviceInfo(node="/dev/video6", trouble="no permission to open /dev/video6; do this")


def test_table_for_a_person():
    shown = [
        Shown(EASYCAP, "a picture, mean grey level 95", "EASY01"),
        Shown(WEBCAM, "", "04f2:b6d9"),
        Shown(METADATA, "", ""),
        Shown(LOCKED, "", ""),
    ]
    assert devices_table(shown, 100).splitlines() == [
        "node        /dev/video0                    /dev/video1",
        "driver      usbtv                          uvcvideo",
        "name        usbtv                          Laptop Camera",
        "USB id      1b71:3002                      04f2:b6d9",
        "serial      EASY01",
        "port        1-1.3                          1-6",
        "speed       480 Mbit/s                     480 Mbit/s",
        "inputs      0 Composite, 1 S-Video         0 Camera 1",
        "standards   ntsc-m, pal",
        "formats     YUYV                           MJPG, YUYV",
        "signal now  a picture, mean grey level 95",
        'device =    "EASY01"                       "04f2:b6d9"',
        "To use one of them write into the section [v4l2]:",
        '    device = "EASY01"',
        '    device = "04f2:b6d9"',
        "Of no use: /dev/video2 (Laptop Camera) is not a capture device.",
        "Of no use: no permission to open /dev/video6; do this.",
    ]


def test_one_device_needs_no_setting():
    lines = devices_table([Shown(EASYCAP, "", "EASY01")]).splitlines()
    assert lines[-2:] == ['    device = "auto"', '    device = "EASY01"']


def test_a_device_on_a_slow_link_is_of_no_use():
    assert devices_table([Shown(SLOW, signal_now(SLOW), "")]) == (
        "Of no use: /dev/video3 (usbtv) is on a USB 1.1 link of 12 Mbit/s, and its pictures need "
        "480; plug it into a USB 2.0 port without an old hub or cable between."
    )


def test_json_for_a_program():
    (one,) = json.loads(devices_json([Shown(EASYCAP, "a picture", "EASY01")]))
    assert (one["node"], one["setting"], one["usable"]) == ("/dev/video0", "EASY01", True)
    assert one["inputs"] == ["Composite", "S-Video"]


def test_a_device_that_is_gone_says_so():
    assert signal_now(replace(EASYCAP, node="/dev/video987")).startswith(
        "/dev/video987 is not there; plug the device in"
    )


def test_the_program_lists_what_is_here():
    done = subprocess.run(
        [sys.executable, "-m", "vdms_rt", "devices", "--json"],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == (0 if json.loads(done.stdout) else 1), done.stderr
