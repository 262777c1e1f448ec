"""Two USB grabbers on one computer."""

import json
import subprocess
import sys

import pytest
from rig.capturing import Capturing
from rig.devices import Grabber

from vdms_rt.model import State

pytestmark = [pytest.mark.rig, pytest.mark.timeout(240)]


@pytest.fixture
def other(tmp_path):
    """A second emulated EasyCAP, plugged in."""
    grabber = Grabber("usbtv", "EASY02", tmp_path, tcp_port=3241)
    yield grabber
    grabber.reset()
    grabber.close()


def devices(*arguments: str) -> tuple[int, str]:
    """Return exit status and output of `vdms-rt devices`."""
    done = subprocess.run(
        [sys.executable, "-m", "vdms_rt", "devices", *arguments],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
        env={"COLUMNS": "100", "PATH": "/usr/bin:/bin"},
    )
    assert done.stderr == ""
    return done.returncode, done.stdout


def test_devices_of_two_grabbers_each_its_own_station(usbtv, other):
    status, text = devices()
    assert status == 1
    assert text == (
        "No video device on this computer; plug the frame grabber in, and see with `lsusb` and "
        "`dmesg` whether the kernel knows it.\n"
    )

    other.set("blank", True)
    first, second = usbtv.plug(), other.plug()
    assert first.node != second.node
    assert first.usb_port != second.usb_port
    status, text = devices()
    assert status == 0
    table, _, below = text.partition("To use one of them")
    rows = {line[:12].strip(): line[12:].split() for line in table.splitlines()}
    assert rows["node"] == [first.node, second.node]
    assert rows["driver"] == ["usbtv", "usbtv"]
    assert rows["USB id"] == ["1b71:3002", "1b71:3002"]
    assert rows["serial"] == ["EASY01", "EASY02"]
    assert rows["port"] == [first.usb_port, second.usb_port]
    assert rows["speed"] == ["480", "Mbit/s", "480", "Mbit/s"]
    assert rows["inputs"] == ["0", "Composite,", "1", "S-Video"] * 2
    assert rows["formats"] == ["YUYV", "YUYV"]
    assert rows["device ="] == ['"EASY01"', '"EASY02"']
    assert '    device = "EASY01"\n    device = "EASY02"\n' in below

    status, text = devices("--json")
    assert status == 0
    by_serial = {one["serial"]: one for one in json.loads(text)}
    assert by_serial["EASY01"]["setting"] == "EASY01"
    assert by_serial["EASY01"]["signal"].startswith("a picture, mean grey level ")
    assert by_serial["EASY02"]["signal"] == "none: the picture is blank"

    # Each is used by a station of its own, which sees its own camera.
    with Capturing("EASY01") as one, Capturing("EASY02") as two:
        one.wait_for_state(State.STREAMING)
        two.wait_for_state(State.NO_SIGNAL)
        _, text = devices("--json")
        assert all("is in use by another program" in d["signal"] for d in json.loads(text))
