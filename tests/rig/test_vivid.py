"""V4l2Source on the kernel's virtual video driver: NTSC and PAL, formats, fields and faults."""

import os
import time
from contextlib import closing
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from rig.devices import Projector, Vivid, run, show
from rig.frames import PERIOD_FRAMES, REST_FRAMES
from rig.reading import last_words, new_image, skip_to_known, take, take_known

from vdms_rt.capture import v4l2_api as api
from vdms_rt.capture.devices import devices_table, look_through
from vdms_rt.capture.grabber import choose_device, list_devices
from vdms_rt.capture.v4l2 import V4l2Source
from vdms_rt.config import V4l2
from vdms_rt.model import Damage, Scan, SourceError, StampEvent

pytestmark = pytest.mark.rig


def opened(vivid: Vivid, field: int = api.FIELD_INTERLACED, **settings):
    """Return a context with the open source; it closes also when the test fails."""
    return closing(V4l2Source(V4l2(device=vivid.node, **settings), field))


def refusal(node: str, field: int = api.FIELD_INTERLACED, **settings) -> str:
    """Return the sentence with which a node is not opened."""
    with pytest.raises(SourceError) as caught:
        V4l2Source(V4l2(device=node, **settings), field)
    return str(caught.value)


def test_300_ntsc_frames_of_the_marker(vivid, pictures):
    with (
        Projector(vivid, pictures) as projector,
        opened(vivid, input=1, standard="ntsc-m") as source,
    ):
        assert "Video input : 1" in run("v4l2-ctl", "-d", vivid.node, "--get-input")
        assert "NTSC-M" in run("v4l2-ctl", "-d", vivid.node, "--get-standard")
        info = source.info
        # Until the projector's first frame comes, vivid shows a picture of its own.
        skip_to_known(source, pictures)
        projector.move.set()
        seen, grabs = take_known(source, pictures, 300)
        source.close()
    assert (info.kind, info.live, info.name) == ("v4l2", True, f"{vivid.node} (vivid)")
    assert (info.width_px, info.height_px) == (720, 480)
    assert info.frame_period_s == Fraction(1001, 30000)
    assert (info.scan, info.scan_known) == (Scan.BOTTOM_FIRST, False)
    assert info.sequence_counts_lost
    assert info.stamp_event == StampEvent.END_OF_FRAME
    assert dict(info.facts)["standard"] == "ntsc-m, as configured"
    assert all(g.damage == Damage.NONE and g.scan == Scan.BOTTOM_FIRST for g in grabs)
    assert set(seen) >= set(range(REST_FRAMES, REST_FRAMES + PERIOD_FRAMES))
    sequences = np.array([g.sequence for g in grabs])
    stamps_ns = np.array([g.stamp_ns for g in grabs])
    assert (np.diff(sequences) > 0).all()
    assert (np.diff(stamps_ns) > 0).all()
    period_ns = (stamps_ns[-1] - stamps_ns[0]) / (sequences[-1] - sequences[0])
    assert period_ns == pytest.approx(1e9 * 1001 / 30000, rel=0.01)


def test_closes_and_opens_again(vivid):
    for _ in range(3):
        with opened(vivid) as source:
            # The first image of a stream is not taken.
            assert [g.sequence for g in take(source, 2)[1]] == [1, 2]


def test_pal_is_detected(vivid):
    run("v4l2-ctl", "-d", vivid.node, "--set-standard", "pal")
    with opened(vivid) as source:
        info = source.info
        assert (info.width_px, info.height_px) == (720, 576)
        assert info.frame_period_s == Fraction(1, 25)
        assert (info.scan, info.scan_known) == (Scan.TOP_FIRST, False)
        assert dict(info.facts)["standard"] == "pal, detected"
        assert len({g.sequence for g in take(source, 10)[1]}) == 10


def test_standard_that_is_not_detected_is_ntsc(vivid):
    vivid.control("standard_signal_mode", 1)  # no signal
    with opened(vivid) as source:
        assert dict(source.info.facts)["standard"] == "ntsc-m, assumed, none was detected"
        assert source.info.height_px == 480


def test_luma_is_the_same_in_every_pixel_format(vivid):
    # Without colour, for vivid weighs colours otherwise in its grey pictures.
    show(vivid, "test_pattern", "Gray Ramp")
    lumas = {}
    for name in ("YUYV", "UYVY", "GREY"):
        with opened(vivid, standard="ntsc", pixel_format=name) as source:
            assert dict(source.info.facts)["format"] == f"{name} 720x480"
            lumas[name] = take(source, 2)[0][1]
    assert len(np.unique(lumas["YUYV"])) > 100
    np.testing.assert_array_equal(lumas["YUYV"], lumas["UYVY"])
    # Those are in full range, 0 to 255, and the others in 16 to 235.
    np.testing.assert_allclose(lumas["YUYV"], 16 + lumas["GREY"] * (219 / 255), atol=1)


@pytest.fixture
def striped(vivid):
    """vivid with a picture whose top and bottom field differ."""
    show(vivid, "test_pattern", "Alternating Hor Lines")
    return vivid


def whole_frame(vivid: Vivid) -> np.ndarray:
    with opened(vivid, standard="ntsc") as source:
        frame = take(source, 2)[0][1]
    assert (frame[0::2] != frame[1::2]).any()
    return frame


def test_alternating_fields_come_one_by_one(striped):
    frame = whole_frame(striped)
    with opened(striped, api.FIELD_ALTERNATE, standard="ntsc") as source:
        assert (source.info.width_px, source.info.height_px) == (720, 240)
        assert (source.info.scan, source.info.scan_known) == (Scan.TOP, True)
        images, grabs = take(source, 20)
    # Bottom and top of each sequence number, but for those that the machine was too slow for.
    fields = [(g.sequence, g.scan is Scan.TOP) for g in grabs]
    assert fields == sorted(set(fields))
    assert {g.scan for g in grabs} == {Scan.BOTTOM, Scan.TOP}
    for image, grab in zip(images, grabs, strict=True):
        first = 1 if grab.scan == Scan.BOTTOM else 0
        np.testing.assert_array_equal(image, frame[first::2])


@pytest.mark.parametrize(
    ("field", "scan"),
    [
        (api.FIELD_SEQ_TB, Scan.TOP_FIRST),
        (api.FIELD_SEQ_BT, Scan.BOTTOM_FIRST),
        (api.FIELD_INTERLACED_TB, Scan.TOP_FIRST),
        (api.FIELD_INTERLACED_BT, Scan.BOTTOM_FIRST),
    ],
    ids=["SEQ_TB", "SEQ_BT", "INTERLACED_TB", "INTERLACED_BT"],
)
def test_fields_make_the_same_frame_in_any_arrangement(striped, field, scan):
    frame = whole_frame(striped)
    with opened(striped, field, standard="ntsc") as source:
        assert (source.info.scan, source.info.scan_known) == (scan, True)
        np.testing.assert_array_equal(take(source, 2)[0][1], frame)


def test_one_field_of_each_frame_is_refused(vivid):
    assert refusal(vivid.node, api.FIELD_TOP, standard="ntsc") == (
        f"{vivid.node} (vivid) gives only one field of each frame; set v4l2.height_px to the rows "
        "of a whole frame"
    )


def test_configured_field_order(vivid):
    with opened(vivid, standard="ntsc", field_order="top-first") as source:
        assert (source.info.scan, source.info.scan_known) == (Scan.TOP_FIRST, True)


def test_stamps_of_the_start_of_exposure(vivid):
    vivid.control("timestamp_source", 1)
    with opened(vivid) as source:
        assert source.info.stamp_event == StampEvent.START_OF_EXPOSURE
        before_ns = time.monotonic_ns()
        stamp_ns = take(source, 5)[1][-1].stamp_ns
        assert before_ns - 10**9 < stamp_ns < time.monotonic_ns() + 10**9


def test_flagged_buffer_is_damaged(vivid):
    with opened(vivid) as source:
        assert take(source, 2)[1][1].damage == Damage.NONE
        vivid.control("inject_v4l2_buf_flag_error")
        damages = [g.damage for g in take(source, 20)[1]]
    assert damages.count(Damage.FLAGGED) == 1
    assert damages.count(Damage.NONE) == 19


def test_dropped_frames_are_gaps_in_sequence(vivid):
    with opened(vivid) as source:
        vivid.control("percentage_of_dropped_buffers", 50)
        gaps = np.diff([g.sequence for g in take(source, 40)[1]])
    assert (gaps >= 1).all()
    assert gaps.sum() > 45


def test_disconnected_device(vivid):
    with opened(vivid) as source:
        take(source, 2)
        vivid.control("disconnect")
        assert last_words(source) == f"{vivid.node} (vivid) was unplugged; plug it in again"


def test_fatal_error_of_the_stream(vivid):
    with opened(vivid) as source:
        take(source, 2)
        vivid.control("inject_fatal_streaming_error")
        assert last_words(source) == (
            f"{vivid.node} (vivid) failed while giving a picture: Input/output error; check the "
            "cables and plug it in anew"
        )
    with opened(vivid) as source:
        take(source, 2)


def test_read_without_a_frame(vivid):
    with opened(vivid) as source:
        image = new_image(source)
        vivid.control("percentage_of_dropped_buffers", 100)
        # What was filled before is still there.
        answers = (source.read(image, 0.2) for _ in range(20))
        assert None in answers
        assert source.read(image, 0.2) is None
        vivid.control("percentage_of_dropped_buffers", 0)
        take(source, 2)


@pytest.mark.parametrize("standard", ["ntsc-m", "pal"])
def test_device_in_use_is_left_as_it_is(vivid, standard):
    with opened(vivid, standard="ntsc-m") as source:
        take(source, 2)
        assert refusal(vivid.node, standard=standard, input=1) == (
            f"{vivid.node} (vivid) is in use by another program; end it (`fuser -v /dev/video*` "
            "names it), or set v4l2.device to another"
        )
        assert "Video input : 0" in run("v4l2-ctl", "-d", vivid.node, "--get-input")
        assert "NTSC-M" in run("v4l2-ctl", "-d", vivid.node, "--get-standard")
        take(source, 5)


@pytest.mark.parametrize(
    ("request_name", "doing"),
    [
        ("reqbufs", "asking for 8 buffers"),
        ("qbuf", "queueing a buffer"),
        ("streamon", "starting to stream"),
    ],
)
def test_driver_that_refuses_to_stream(vivid, request_name, doing):
    vivid.control(f"inject_vidioc_{request_name}_error")
    assert refusal(vivid.node) == (
        f"{vivid.node} (vivid) failed while {doing}: Invalid argument; check the cables and plug "
        "it in anew"
    )
    with opened(vivid) as source:
        take(source, 2)


def test_input_that_is_not_there(vivid):
    assert refusal(vivid.node, input=7) == (
        f"{vivid.node} (vivid) has no input 7; set v4l2.input to one of: 0 S-Video 0, 1 S-Video 1"
    )


def test_pixel_format_that_is_not_there(vivid):
    sentence = refusal(vivid.node, pixel_format="MJPG")
    assert sentence.startswith(f"{vivid.node} (vivid) has no picture format MJPG, only ")
    assert "YUYV" in sentence
    assert sentence.endswith('; set v4l2.pixel_format = "auto"')


def test_controls_are_set_and_read_back(vivid):
    vivid.control("gain_automatic", 1)
    with opened(vivid, brightness=100, hue=-5) as source:
        facts = dict(source.info.facts)
        assert (facts["brightness"], facts["hue"]) == ("100 of 0 to 255", "-5 of -128 to 128")
        assert facts["automatic gain"] == "off"
        assert "contrast" in facts
        assert source.info.warnings == ()
    said = run("v4l2-ctl", "-d", vivid.node, "--get-ctrl", "brightness,hue,gain_automatic")
    assert said.split() == ["brightness:", "100", "hue:", "-5", "gain_automatic:", "0"]
    vivid.control("gain_automatic", 1)
    with opened(vivid, automatic="leave"):
        assert "1" in run("v4l2-ctl", "-d", vivid.node, "--get-ctrl", "gain_automatic")


def test_control_beyond_its_range(vivid):
    assert refusal(vivid.node, brightness=300) == (
        f"{vivid.node} (vivid) takes a brightness of 0 to 255; v4l2.brightness = 300 is beyond"
    )


def test_output_node_is_no_capture_device(vivid):
    assert refusal(vivid.output_node) == (
        f"{vivid.output_node} (vivid) is not a capture device that streams; set v4l2.device to "
        "one that `vdms-rt devices` lists with its formats"
    )


def test_node_without_permission(vivid):
    Path(vivid.node).chmod(0o600)
    Path(vivid.output_node).chmod(0o600)
    os.seteuid(65534)
    try:
        by_path, by_itself = refusal(vivid.node), refusal("auto")
    finally:
        os.seteuid(0)
    assert by_path == (
        f"no permission to open {vivid.node}; add the user to the group video (sudo usermod -aG "
        "video USER) and log in again"
    )
    assert by_itself.startswith("no permission to open /dev/video")


@pytest.fixture
def hdmi():
    """vivid with S-Video as input 0 and HDMI as input 1."""
    driver = Vivid(input_types="0xe")
    yield driver
    driver.unload()


def test_input_without_standards(hdmi):
    with opened(hdmi, input=1, width_px=1280, height_px=720) as source:
        assert dict(source.info.facts)["standard"] == "none"
        assert (source.info.scan, source.info.scan_known) == (Scan.PROGRESSIVE, True)
        assert source.info.frame_period_s == Fraction(1, 60)
        assert (source.info.width_px, source.info.height_px) == (1280, 720)
        take(source, 2)


def test_size_that_the_device_does_not_have_gives_way_to_its_own(hdmi):
    with opened(hdmi, input=1, width_px=640, height_px=480) as source:
        assert (source.info.width_px, source.info.height_px) == (1280, 720)
        take(source, 2)


def test_standard_on_an_input_without_standards(hdmi):
    assert refusal(hdmi.node, input=1, standard="ntsc-m") == (
        f"{hdmi.node} (vivid) does not accept the standard ntsc-m; it has none; set "
        'v4l2.standard = "auto"'
    )


def test_devices_of_the_computer(vivid):
    devices = {device.node: device for device in list_devices()}
    capture, output = devices[vivid.node], devices[vivid.output_node]
    assert (capture.driver, capture.card, capture.trouble) == ("vivid", "vivid", "")
    assert capture.inputs == ("S-Video 0", "S-Video 1")
    assert {"ntsc", "ntsc-m", "pal"} <= set(capture.standards)
    assert {"YUYV", "UYVY", "GREY"} <= set(capture.formats)
    assert capture.usable
    assert not output.usable
    assert choose_device("auto").node == vivid.node
    table = devices_table(look_through([capture, output])).splitlines()
    assert "signal now  none: the picture is a test card" in table
    assert f'device =    "{vivid.node}"' in table
    assert f"Of no use: {vivid.output_node} (vivid) is not a capture device." in table
