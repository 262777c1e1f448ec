"""What the capture thread makes of vivid's faults: states, counts and the times of fields."""

from contextlib import closing

import numpy as np
import pytest
from rig.capturing import Capturing
from rig.devices import run, show
from rig.reading import take

from vdms_rt.capture import v4l2_api as api
from vdms_rt.capture.clock import FrameClock
from vdms_rt.capture.v4l2 import V4l2Source
from vdms_rt.config import V4l2
from vdms_rt.model import Damage, Frame, Scan, State
from vdms_rt.process.pictures import pictures as pictures_of

pytestmark = pytest.mark.rig

NO_SIGNAL, SELECTED_STANDARD, CURRENT_STANDARD = 1, 4, 0
"""Of vivid's control standard_signal_mode."""


@pytest.fixture
def scene(vivid):
    """vivid with a picture that has structure and is never the same twice, in NTSC."""
    run("v4l2-ctl", "-d", vivid.node, "--set-standard", "ntsc-m")
    show(vivid, "test_pattern", "100% Color Squares")
    show(vivid, "vertical_movement", "Move Up")
    return vivid


def gaps(frames: list[Frame]) -> int:
    """Return how many frames are missing between the first and the last, by the driver's stamps."""
    stamps_ns = [f.stamp_ns for f in frames]
    periods = round((stamps_ns[-1] - stamps_ns[0]) / frames[0].period_ns)
    return periods + 1 - len(frames)


@pytest.mark.parametrize(
    ("standard", "rows", "period_ns"), [("ntsc-m", 480, 33_366_667), ("pal", 576, 40_000_000)]
)
def test_ntsc_and_pal_inputs(scene, standard, rows, period_ns):
    run("v4l2-ctl", "-d", scene.node, "--set-standard", standard)
    with Capturing(scene.node) as capturing:
        capturing.wait_for_state(State.STREAMING)
        capturing.wait_for_frames(20)
    assert capturing.states() == ["streaming"]
    frame = capturing.frames[-1]
    assert frame.image.shape == (rows, 720)
    assert frame.period_ns == period_ns
    assert all(f.damage is Damage.NONE for f in capturing.frames)
    assert f"standard {standard}, detected" in " ".join(
        f"{n} {v}" for e in capturing.events if e.code == "source" for n, v in e.facts
    )


def test_signal_off_and_on(scene):
    with Capturing(scene.node) as capturing:
        capturing.wait_for_state(State.STREAMING)
        scene.control("standard_signal_mode", NO_SIGNAL)
        capturing.wait_for_state(State.NO_SIGNAL)
        capturing.wait_for_frames(10)
        scene.control("standard_signal_mode", CURRENT_STANDARD)
        capturing.wait_for_state(State.STREAMING)
        capturing.wait_for_frames(10)
    assert capturing.states() == ["streaming", "no signal", "streaming"]
    off, on = capturing.said("state").splitlines()[1:]
    assert "look whether the camera at" in off
    assert f"frames come from {scene.node} (vivid) again, after" in on
    # From its beginning to its end no frame passes for a camera's.
    flagged = [bool(f.damage & Damage.NO_SIGNAL) for f in capturing.frames]
    first, last = flagged.index(True), len(flagged) - 1 - flagged[::-1].index(True)
    assert all(flagged[first : last + 1])
    assert sum(flagged) == capturing.capture.counters.no_signal >= 10
    assert not any(flagged[-5:])


def test_test_card_is_no_signal(vivid):
    with Capturing(vivid.node) as capturing:
        capturing.wait_for_state(State.NO_SIGNAL)
        capturing.wait_for_frames(30)
    assert capturing.states() == ["no signal"]
    assert capturing.said("state").startswith("the picture is a test card; look whether")
    assert all(f.damage & Damage.NO_SIGNAL for f in capturing.frames)


def test_frozen_picture_is_no_signal(scene):
    with Capturing(scene.node) as capturing:
        capturing.wait_for_state(State.STREAMING)
        show(scene, "vertical_movement", "No Movement")
        capturing.wait_for_state(State.NO_SIGNAL)
        show(scene, "vertical_movement", "Move Up")
        capturing.wait_for_state(State.STREAMING)
    assert capturing.said("state").splitlines()[1].startswith("the picture is frozen; look")
    damages = [f.damage for f in capturing.frames]
    first = damages.index(Damage.REPEATED)
    # From the first repetition on, none of the still pictures is taken for a new one.
    still = damages[first : first + 30]
    assert all(d & Damage.REPEATED for d in still)
    assert capturing.capture.counters.repeated >= 20


def test_wrong_standard_is_no_signal_with_the_right_one_named(scene):
    show(scene, "standard", "PAL")
    with Capturing(scene.node, standard="ntsc-m") as capturing:
        capturing.wait_for_state(State.STREAMING)
        scene.control("standard_signal_mode", SELECTED_STANDARD)
        capturing.wait_for_state(State.NO_SIGNAL)
        capturing.wait_for_frames(5)
        scene.control("standard_signal_mode", CURRENT_STANDARD)
        capturing.wait_for_state(State.STREAMING)
    assert (
        f"the camera at {scene.node} (vivid) sends pal, but the grabber is set to ntsc-m; set "
        'v4l2.standard = "pal" or "auto"'
    ) in capturing.said("state")


def test_another_standard_is_followed_with_auto(scene):
    show(scene, "standard", "PAL")
    with Capturing(scene.node) as capturing:
        capturing.wait_for_frames(10)
        scene.control("standard_signal_mode", SELECTED_STANDARD)
        capturing.wait_until_said("sends pal now; the grabber is set to it")
        target = len(capturing.frames)
        capturing.wait_for_state(State.STREAMING)
        capturing.wait_for_frames(10)
        assert capturing.frames[target + 9].image.shape == (576, 720)
    segments = {f.image.shape[0]: f.segment for f in capturing.frames}
    assert segments[576] > segments[480]


def test_dropped_frames_are_counted_one_by_one(scene):
    with Capturing(scene.node) as capturing:
        capturing.wait_for_frames(30)
        scene.control("percentage_of_dropped_buffers", 40)
        capturing.wait_for_frames(40)
        scene.control("percentage_of_dropped_buffers", 0)
        capturing.wait_for_frames(10)
    missed = capturing.capture.counters.missed
    assert missed == gaps(capturing.frames) >= 5
    # Each is a gap in the frames' numbers, and an event says so.
    numbers = [f.seq for f in capturing.frames]
    assert numbers[-1] - numbers[0] + 1 - len(numbers) == missed
    told = [int(dict(e.facts)["missed"]) for e in capturing.events if e.code == "frames-missed"]
    assert sum(told) == missed
    assert capturing.states() == ["streaming"]


def test_flagged_buffers_are_counted_one_by_one(scene):
    with Capturing(scene.node) as capturing:
        for _ in range(3):
            capturing.wait_for_frames(10)
            scene.control("inject_v4l2_buf_flag_error")
        capturing.wait_for_frames(10)
    damaged = [f for f in capturing.frames if f.damage & Damage.FLAGGED]
    assert len(damaged) == capturing.capture.counters.damaged == 3
    assert capturing.states() == ["streaming"]


def test_stream_that_fails_is_opened_again(scene):
    with Capturing(scene.node) as capturing:
        capturing.wait_for_state(State.STREAMING)
        scene.control("inject_fatal_streaming_error")
        capturing.wait_until_said("Input/output error")
        capturing.wait_for_state(State.STREAMING)
        capturing.wait_for_frames(5)
    assert capturing.states() == ["streaming", "stalled", "streaming"]
    numbers = [f.seq for f in capturing.frames]
    assert numbers == sorted(set(numbers))


def test_device_that_disappears_is_lost(scene):
    with Capturing(scene.node) as capturing:
        capturing.wait_for_state(State.STREAMING)
        scene.control("disconnect")
        capturing.wait_for_state(State.LOST)
    assert capturing.said("state").splitlines()[1:] == [
        f"{scene.node} (vivid) was unplugged; plug it in again"
    ]


@pytest.mark.parametrize(
    ("field", "order", "first"),
    [
        (api.FIELD_INTERLACED, "bottom-first", Scan.BOTTOM),
        (api.FIELD_INTERLACED, "top-first", Scan.TOP),
        (api.FIELD_INTERLACED_BT, "auto", Scan.BOTTOM),
        (api.FIELD_INTERLACED_TB, "auto", Scan.TOP),
        (api.FIELD_ALTERNATE, "auto", Scan.BOTTOM),
    ],
)
def test_times_of_the_fields(scene, field, order, first):
    """V4L2 stamps the end of a frame, or of a field if they come one by one."""
    settings = V4l2(device=scene.node, standard="ntsc-m", field_order=order)
    with closing(V4l2Source(settings, field)) as source:
        clock = FrameClock(source.info, 0)
        images, grabs = take(source, 24)
    period_ns = 1e9 * 1001 / 30000
    fields = []
    for image, grab in zip(images, grabs, strict=True):
        tick = clock.tick(grab.stamp_ns, grab.sequence, grab.scan)
        frame = Frame(
            seq=tick.index,
            stamp_ns=grab.stamp_ns,
            t_ns=tick.t_ns,
            sigma_t_ns=tick.sigma_t_ns,
            utc_ns=tick.utc_ns,
            segment=tick.segment,
            period_ns=round(period_ns),
            image=image,
            scan=grab.scan,
            damage=grab.damage,
        )
        fields += pictures_of(frame, "auto", Scan.BOTTOM_FIRST if len(images[0]) == 240 else None)
    # The earlier field of a frame has the even number, the later one the odd.
    assert {f.scan for f in fields if f.seq % 2 == 0} == {first}
    assert (np.diff([f.seq for f in fields]) > 0).all()
    # With no exposure a field was when it ended less its own duration. The stamp is of the end of
    # the frame, and so of the later field; of fields that come one by one, each has its own. A busy
    # machine stamps late by some milliseconds, never early: the least age counts. Another
    # convention would be off by a quarter of a period, 8 ms.
    ages_ns = np.array([f.stamp_ns - f.t_ns for f in fields])
    odd = np.array([f.seq % 2 for f in fields], bool)
    early_ns = period_ns / 2 if field == api.FIELD_ALTERNATE else period_ns
    assert ages_ns[~odd].min() == pytest.approx(early_ns, abs=4e6)
    assert ages_ns[odd].min() == pytest.approx(period_ns / 2, abs=4e6)
    # Half a period lies between the fields, in any arrangement.
    by_seq = {f.seq: f.t_ns for f in fields}
    steps_ns = [by_seq[n + 1] - t for n, t in by_seq.items() if n + 1 in by_seq]
    assert np.median(steps_ns) == pytest.approx(period_ns / 2, abs=1e6)
