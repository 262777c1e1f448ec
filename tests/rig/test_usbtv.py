"""V4l2Source on the kernel's own usbtv, bound to an emulated EasyCAP on an emulated USB port."""

from contextlib import closing
from fractions import Fraction

import numpy as np
import pytest
from rig.frames import PERIOD_FRAMES, REST_FRAMES
from rig.reading import TIMEOUT_S, last_words, new_image, skip_to_known, take, take_known

from vdms_rt.capture.grabber import choose_device
from vdms_rt.capture.v4l2 import V4l2Source
from vdms_rt.config import V4l2
from vdms_rt.model import Damage, Scan, SourceError, StampEvent

pytestmark = pytest.mark.rig


def opened(**settings):
    """Return a context with the open source; it closes also when the test fails."""
    return closing(V4l2Source(V4l2(**{"device": "EASY01", **settings})))


def test_300_frames_are_what_was_sent(usbtv, pictures):
    usbtv.set("hold", True)
    device = usbtv.plug()
    assert (device.driver, device.usb_id, device.serial) == ("usbtv", "1b71:3002", "EASY01")
    assert device.speed_mbit_s == 480
    assert device.inputs == ("Composite", "S-Video")
    assert {"ntsc-m", "pal"} <= set(device.standards)
    assert device.formats == ("YUYV",)
    for name in ("auto", "1b71:3002", "EASY01", device.usb_port):
        assert choose_device(name) == device

    with opened(input=1, standard="ntsc-m") as source:
        info = source.info
        # The first buffer may begin within a frame.
        skip_to_known(source, pictures)
        usbtv.set("hold", False)
        seen, grabs = take_known(source, pictures, 300)
    assert dict(info.facts)["input"] == "1 S-Video"
    assert (info.width_px, info.height_px) == (720, 480)
    assert info.frame_period_s == Fraction(1001, 30000)
    assert (info.scan, info.scan_known) == (Scan.BOTTOM_FIRST, False)
    assert info.stamp_event == StampEvent.END_OF_FRAME
    assert not info.sequence_counts_lost
    assert all(g.damage == Damage.NONE and g.scan == Scan.BOTTOM_FIRST for g in grabs)
    assert set(seen) >= set(range(REST_FRAMES, REST_FRAMES + PERIOD_FRAMES))
    # Its sequence counts what was delivered, whatever was lost.
    assert [g.sequence - grabs[0].sequence for g in grabs] == list(range(300))
    assert (np.diff([g.stamp_ns for g in grabs]) > 0).all()


def test_standard_is_assumed_and_pal_is_accepted(usbtv):
    usbtv.plug()
    with opened() as source:
        assert dict(source.info.facts)["standard"] == "ntsc-m, assumed, none was detected"
    with opened(standard="pal") as source:
        assert (source.info.width_px, source.info.height_px) == (720, 576)
        assert source.info.frame_period_s == Fraction(1, 25)


def test_what_its_controls_cannot_do_is_said(usbtv):
    usbtv.plug()
    with opened(brightness=400) as source:
        facts, warnings = dict(source.info.facts), source.info.warnings
    # The driver sets it, but keeps its default as what it says.
    assert facts["brightness"] == "448 of 0 to 1023"
    assert len(warnings) == 2
    assert "says brightness 448 after v4l2.brightness = 400 was set" in warnings[1]
    assert warnings[0].endswith(
        "has no switch for automatic gain or exposure; switch them off at the camera, and keep the "
        "light steady while it measures"
    )
    with pytest.raises(SourceError) as caught:
        opened(gain=1)
    assert str(caught.value).endswith(
        "has no control for gain; leave v4l2.gain out of the configuration"
    )


def test_no_frames_then_frames_again(usbtv):
    usbtv.plug()
    with opened() as source:
        image = new_image(source)
        take(source, 1)
        usbtv.set("stall", True)
        # What was on its way still arrives.
        answers = (source.read(image, 0.5) for _ in range(20))
        assert None in answers
        assert source.read(image, 0.5) is None
        usbtv.set("stall", False)
        take(source, 2)


def test_unplugged_and_plugged_in_again(usbtv):
    device = usbtv.plug()
    with opened() as source:
        take(source, 1)
        usbtv.unplug()
        assert last_words(source) == f"{source.info.name} was unplugged; plug it in again"
    with pytest.raises(SourceError, match="no video device"):
        opened()
    with pytest.raises(SourceError, match=f"{device.node} is not there; plug the device in"):
        opened(device=device.node)
    usbtv.plug()
    with opened() as source:
        assert source.read(new_image(source), TIMEOUT_S)
