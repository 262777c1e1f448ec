"""`vdms-rt run` on kernel drivers: from a device that shows the marker to the numbers recorded.

Counts and positions are judged, never times: the virtual machine is slower than the frames, and
what it loses of them must be accounted for.
"""

from collections.abc import Callable

import numpy as np
import pytest
from rig.devices import Projector, Vivid, run
from rig.frames import AMPLITUDE_MM
from rig.station import Station, away_mm

from vdms_rt.model import Status

pytestmark = [pytest.mark.rig, pytest.mark.timeout(240)]

FRAMES = 300


def measure(station: Station, move: Callable[[], None]) -> None:
    """Let it take its reference at rest, and measure 300 frames of the moving marker; stop it."""
    station.wait_until_said("reference taken")
    move()
    station.wait_for_frames(FRAMES)
    assert station.terminate() == 0, station.said
    assert "Traceback" not in station.said


def check(station: Station) -> None:
    (end,) = station.recorded("end")
    health = end.health
    assert end.reason == "stopped by SIGTERM"
    assert health.captured >= FRAMES
    assert (health.damaged, health.not_recorded) == (0, 0)

    samples = station.recorded("displacement")
    # Every frame was measured, or counted as overwritten before it could be.
    assert len({s.frame_seq for s in samples}) == health.captured - health.overwritten
    assert len({(s.frame_seq, s.scan) for s in samples}) == len(samples)
    first = [bool(s.status & Status.SET_UP) for s in samples].index(False)
    measured = [s for s in samples[first:] if s.valid]
    assert len(measured) == health.measured

    # The positions are those that the fields of the frames show, and no others. Right after frames
    # that the machine was too slow for, a circle is not where it was expected, and a sample may be
    # less exact.
    away = away_mm(measured)
    assert np.percentile(away, 99) < 0.02
    assert away.max() < 0.2
    positions_mm = np.array([(s.x_mm, s.y_mm) for s in measured])
    moving = np.abs(positions_mm[:, 0]) > 0.5
    assert moving.sum() >= FRAMES
    assert np.ptp(positions_mm[:, 0]) == pytest.approx(2 * AMPLITUDE_MM, abs=0.05)

    header = station.recorded("run")[-1]
    assert ("standard", "ntsc-m, as configured") in {(f.name, f.value) for f in header.facts}


def test_vivid_is_measured(vivid, pictures, tmp_path):
    with (
        Projector(vivid, pictures) as projector,
        Station(tmp_path, vivid.node, input=1, standard="ntsc-m") as station,
    ):
        measure(station, projector.move.set)
        assert "Video input : 1" in run("v4l2-ctl", "-d", vivid.node, "--get-input")
        check(station)


def test_usb_grabber_is_measured(usbtv, tmp_path):
    usbtv.set("hold", True)
    usbtv.plug()
    with Station(tmp_path, "EASY01", input=1, standard="ntsc-m") as station:
        measure(station, lambda: usbtv.set("hold", False))
        check(station)


def test_a_device_that_comes_late_is_named_in_the_recording(tmp_path):
    with Station(tmp_path, "auto", input=1, standard="ntsc-m") as station:
        station.wait_until_said("recording into")
        driver = Vivid()
        station.wait_until_said("opened")
        station.wait_until_said("no marker in sight")
        assert station.terminate() == 0, station.said
    driver.unload()
    heads = [{f.name: f.value for f in head.facts} for head in station.recorded("run")]
    assert [head["source"] == "not open yet" for head in heads] == [True, False]
    assert heads[1]["standard"] == "ntsc-m, as configured"
