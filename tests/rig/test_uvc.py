"""V4l2Source on the kernel's own uvcvideo, bound to an emulated camera without TV standards."""

from contextlib import closing
from fractions import Fraction

import numpy as np
import pytest
from rig.devices import Grabber
from rig.reading import last_words, take, take_known

from vdms_rt.capture.grabber import list_devices
from vdms_rt.capture.v4l2 import V4l2Source
from vdms_rt.config import V4l2
from vdms_rt.model import Damage, Scan, SourceError, StampEvent

pytestmark = pytest.mark.rig


@pytest.fixture(scope="module")
def uvc_emulator(tmp_path_factory):
    grabber = Grabber("uvc", "UVC01", tmp_path_factory.mktemp("uvc"))
    yield grabber
    grabber.close()


@pytest.fixture
def uvc(uvc_emulator):
    """An emulated UVC camera that is not plugged in yet."""
    yield uvc_emulator
    uvc_emulator.reset()


def opened(**settings):
    """Return a context with the open source; it closes also when the test fails."""
    return closing(V4l2Source(V4l2(device="UVC01", **settings)))


def test_frames_are_what_was_sent(uvc, pictures):
    device = uvc.plug()
    others = [d for d in list_devices() if d.serial == "UVC01" and d.node != device.node]
    assert others  # its node of metadata
    assert not any(d.usable for d in others)

    with opened() as source:
        info = source.info
        seen, grabs = take_known(source, pictures, 40)
    assert dict(info.facts)["standard"] == "none"
    assert (info.width_px, info.height_px) == (720, 480)
    # uvcvideo rounds the interval, 333667 times 100 ns, to a simpler fraction.
    assert info.frame_period_s == Fraction(100, 2997)
    assert (info.scan, info.scan_known) == (Scan.PROGRESSIVE, True)
    assert info.stamp_event == StampEvent.START_OF_EXPOSURE
    assert info.sequence_counts_lost
    assert all(g.damage == Damage.NONE for g in grabs)
    assert len(set(seen)) > 5
    assert (np.diff([g.sequence for g in grabs]) > 0).all()
    assert (np.diff([g.stamp_ns for g in grabs]) > 0).all()


def test_standard_is_refused_where_there_is_none(uvc):
    uvc.plug()
    with pytest.raises(SourceError) as caught:
        opened(standard="ntsc-m")
    assert str(caught.value).endswith(
        'does not accept the standard ntsc-m; it has none; set v4l2.standard = "auto"'
    )


def test_unplugged(uvc):
    uvc.plug()
    with opened() as source:
        take(source, 1)
        uvc.unplug()
        assert last_words(source) == f"{source.info.name} was unplugged; plug it in again"
