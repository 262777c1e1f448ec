"""A USB grabber whose cable is pulled and whose camera is switched off while the program measures.

In the virtual machine the grabber is emulated, under the kernel's usbtv; with `--device` it is a
real one, and a person is asked to do what the test wants (see docs/hardware-test.md).
"""

import random
import sys
import threading
import time
from itertools import pairwise

import numpy as np
import pytest
from rig.capturing import Capturing
from rig.devices import wait_for
from rig.station import Station, away_mm

from vdms_rt.model import State, Status

pytestmark = [pytest.mark.rig, pytest.mark.timeout(600)]

BACK_S = 3.0
"""From the node's return to the exposure of the first sample that is a measurement."""
REST_MM = 0.1
"""The most that a marker at rest is off, where the truth is not known."""


@pytest.mark.hardware
def test_steady_stream(hands, capsys):
    hands.plug()
    with Capturing(hands.device, **hands.settings) as capturing:
        capturing.wait_for_state(State.STREAMING)
        capturing.wait_for_frames(hands.stream_frames)
    counters = capturing.capture.counters
    stamps_ns = np.array([f.stamp_ns for f in capturing.frames])
    gaps_ms = np.diff(stamps_ns) / 1e6
    period_ms = capturing.frames[-1].period_ns / 1e6
    with capsys.disabled():
        sys.stdout.write(f"\n{len(gaps_ms)} intervals; a period is {period_ms:.3f} ms\n")
        counts, edges_ms = np.histogram(gaps_ms, bins=12)
        for count, left_ms in zip(counts, edges_ms[:-1], strict=True):
            sys.stdout.write(f"{left_ms:8.2f} ms {count:6d} {'#' * (60 * count // counts.max())}\n")
    assert counters.damaged == counters.no_signal == 0
    numbers = [f.seq for f in capturing.frames]
    assert numbers == sorted(set(numbers))
    # What is missing is a gap in the numbers; what was only held up, and was called missed, is too.
    assert numbers[-1] - numbers[0] + 1 - len(numbers) >= counters.missed
    if not hands.truth_known:
        # The emulated machine is too slow for this.
        assert capturing.states() == ["streaming"]
        assert counters.missed <= len(numbers) / 100
        assert gaps_ms.mean() == pytest.approx(period_ms, rel=0.02)


@pytest.mark.hardware
@pytest.mark.parametrize(
    "times",
    [pytest.param(5, id="5 times"), pytest.param(20, id="20 times", marks=pytest.mark.soak)],
)
def test_pulled_and_plugged_in_while_it_measures(hands, tmp_path, capsys, times):
    chance = random.Random(times)
    hands.hold(True)
    hands.plug()
    with Station(tmp_path, hands.device, **hands.settings) as station:
        station.wait_until_said("reference taken")
        hands.hold(False)
        process = station.pid
        back_ns: list[int] = []
        with station.samples() as samples:
            samples.wait_for_valid(20)
            for n in range(1, times + 1):
                time.sleep(chance.uniform(0.2, 1.5))
                hands.unplug()
                station.wait_until_said("plug it in again", n)
                time.sleep(chance.uniform(0.0, 1.0))
                hands.plug()
                node_ns = time.monotonic_ns()
                first = samples.wait_for_valid(1, after_ns=node_ns)
                back_ns.append(first.t_ns - node_ns)
                samples.wait_for_valid(20, after_ns=node_ns)
        assert station.pid == process
        assert station.terminate() == 0, station.said
    assert "Traceback" not in station.said
    with capsys.disabled():
        seconds = " ".join(f"{ns / 1e9:.2f}" for ns in back_ns)
        sys.stdout.write(f"\nmeasured again, seconds after the node was back: {seconds}\n")
    assert max(back_ns) <= BACK_S * 1e9

    # The recording is one file, and whole. Every gap is an event.
    events = [e for e in station.recorded("event") if e.code == "state"]
    told = [fact.value for event in events for fact in event.facts if fact.name == "state"]
    between = " ".join(told).split("lost")
    assert len(between) == times + 1, told
    assert all("streaming" in states for states in between), told
    measured = [s for s in station.recorded("displacement") if s.valid]
    # No sample has a position that the marker never had.
    if hands.truth_known:
        sigma_mm = np.array([max(s.sigma_x_mm, s.sigma_y_mm) for s in measured])
        assert (away_mm(measured) < np.maximum(0.02, 4 * sigma_mm)).all()
    else:
        positions = np.array([(s.x_mm, s.y_mm) for s in measured])
        assert np.abs(positions).max() < REST_MM
    numbers = [s.seq for s in measured]
    assert numbers == sorted(set(numbers))
    # The times go on, as well as the clock says that it knows them: a busy machine holds frames up,
    # and where it takes that back a new segment begins.
    for before, after in pairwise(measured):
        doubt_ns = 4 * (before.sigma_t_ns + after.sigma_t_ns)
        assert after.t_ns > before.t_ns - doubt_ns or after.segment > before.segment


@pytest.mark.hardware
def test_camera_switched_off_and_on(hands):
    hands.hold(True)
    hands.plug()
    with Capturing(hands.device, **hands.settings) as capturing:
        capturing.wait_for_state(State.STREAMING)
        capturing.wait_for_frames(10)
        hands.camera(False)
        # A driver without a picture gives a blank, noise, or nothing.
        wait_for(
            lambda: capturing.state in (State.NO_SIGNAL, State.STALLED),
            "no signal",
            hands.patience_s,
        )
        if capturing.state is State.NO_SIGNAL:
            capturing.wait_for_frames(5)
            assert all(f.damage for f in capturing.frames[-3:])
        hands.camera(True)
        wait_for(lambda: capturing.state is State.STREAMING, "streaming", hands.patience_s)
        capturing.wait_for_frames(10)
    off, on = capturing.said("state").splitlines()[1:3]
    assert "look whether the camera" in off
    assert "again, after" in on
    assert not capturing.frames[-1].damage


def test_wedged_grabber_is_reset_over_usb(usbtv):
    usbtv.set("hold", True)
    device = usbtv.plug()
    with Capturing("auto", input=1, standard="ntsc-m") as capturing:
        capturing.wait_for_state(State.STREAMING)
        usbtv.set("wedge", True)
        capturing.wait_for_state(State.STALLED)
        capturing.wait_for_state(State.STREAMING)
        capturing.wait_for_frames(5)
    assert capturing.states() == ["streaming", "stalled", "streaming"]
    remedies = [dict(e.facts)["remedy"] for e in capturing.events if e.code == "remedy"]
    assert remedies == ["close and open it", "reset it over USB"]
    assert f"{device.title} gives no frames; it is reset over USB" in capturing.said("remedy")


@pytest.mark.hardware
@pytest.mark.soak
def test_it_just_measures(hands, tmp_path):
    """First light: no configuration at all. In the virtual machine test_service shows it each
    time, and this one is for `make soak`."""
    hands.hold(True)
    hands.plug()
    with Station.without_configuration(tmp_path) as station:
        station.wait_until_said("reference taken")
        with station.samples() as samples:
            first = samples.wait_for_valid(1)
        assert station.terminate() == 0, station.said
    assert abs(first.x_mm) < REST_MM
    assert not first.status & Status.SET_UP


def test_auto_leaves_another_device_for_a_grabber_until_it_measures(vivid, usbtv):
    measuring = threading.Event()
    with Capturing("auto", idle=lambda: not measuring.is_set()) as capturing:
        capturing.wait_for_state(State.NO_SIGNAL)
        assert capturing.capture.counters.info.name == f"{vivid.node} (vivid)"
        measuring.set()
        usbtv.plug()
        capturing.wait_for_frames(60)
        assert capturing.capture.counters.info.name == f"{vivid.node} (vivid)"
        measuring.clear()
        capturing.wait_until_said("a frame grabber was plugged in; it is used in place of")
        capturing.wait_for_state(State.STREAMING)
        assert capturing.capture.counters.info.name.endswith("(usbtv)")
