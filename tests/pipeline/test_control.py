"""A whole station on this computer, asked and told what to do."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from loopback import DEADLINE_S, free_endpoint

from vdms_rt import cli, codec
from vdms_rt.control.client import ControlError, Controller, Credentials
from vdms_rt.logfile.reader import LogReader, StoredMessage
from vdms_rt.model import Displacement, Event
from vdms_rt.subscribe import subscribe
from vdms_rt.wire import control_pb2 as control
from vdms_rt.wire import vdms_pb2 as pb

pytestmark = pytest.mark.slow

PATIENCE_S = 60.0


class Station:
    """A daemon in a process of its own."""

    def __init__(self, folder: Path, sections: str = "", source: str = "table") -> None:
        self.folder = folder
        self.endpoint = free_endpoint()
        config = folder / "vdms.toml"
        config.write_text(f"""
source = "{source}"
station.name = "lab"
setup.directory = "{folder}"
publish.listen = ["{self.endpoint}"]
record.directory = "{folder / "recordings"}"
[table.motion]
kind = "still"
{sections}
""")
        self._log = (folder / "log").open("w")
        self.process = subprocess.Popen(
            [sys.executable, "-m", "vdms_rt", "run", "--config", str(config)], stderr=self._log
        )

    def log(self) -> str:
        return (self.folder / "log").read_text()

    def end(self) -> int:
        self.process.terminate()
        status = self.process.wait(PATIENCE_S)
        self._log.close()
        return status


@pytest.fixture(scope="module")
def station(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Station]:
    running = Station(tmp_path_factory.mktemp("station"))
    yield running
    running.end()


@pytest.fixture(scope="module")
def ask(station: Station) -> Iterator[Controller]:
    until_s = time.monotonic() + PATIENCE_S
    while "recording into" not in station.log():
        assert time.monotonic() < until_s, station.log()
        time.sleep(0.05)
    with Controller(station.endpoint, who="ann@laptop test") as controller:
        wait(lambda: health(controller) == "measuring")
        yield controller


def wait(done: Callable[[], bool]) -> None:
    until_s = time.monotonic() + PATIENCE_S
    while not done():
        assert time.monotonic() < until_s
        time.sleep(0.05)


def health(controller: Controller) -> str:
    return controller.ask("status").status.health.state


def refused(answer: control.Answer, code: str) -> str:
    assert not answer.done
    assert not answer.applied
    assert answer.code == code
    return answer.text


def commands(station: Station, last: str) -> list[Event]:
    """Return the events of commands so far, up to one with this text."""
    found = []
    with subscribe("vdms/lab/event", station.endpoint) as events:
        while not found or last not in found[-1].text:
            event = events.get(DEADLINE_S)
            assert event is not None
            assert isinstance(event.value, Event)
            if event.value.code.startswith("command"):
                found.append(event.value)
    return found


def test_status_says_all_that_health_does(ask: Controller) -> None:
    status = ask.ask("status").status
    assert status.health.state == "measuring"
    assert status.health.frame_rate_hz > 0
    assert "set-up" in status.set_up.report
    assert json.loads(status.set_up.json)["revision"] == status.set_up.revision
    assert status.run == ""


def test_a_preview_is_the_picture_with_its_regions(ask: Controller) -> None:
    answer = ask.ask("preview", most_width_px=360)
    picture = answer.preview
    image = codec.picture_from(picture.jpeg)
    assert image is not None
    assert image.shape == (240, 360)
    assert (picture.width_px, picture.height_px) == (720, 480)
    (seen,) = picture.markers
    assert seen.marker == "m1"
    assert seen.newest.seq == picture.seq
    assert seen.aim.focus == "sharp"
    assert 1 < seen.aim.scale_x_px_per_mm < 2
    for region, circle in zip(seen.regions, seen.newest.circles, strict=True):
        assert region.x_px < circle.x_px < region.x_px + region.width_px
        assert region.y_px < circle.y_px < region.y_px + region.height_px
        x, y = round(circle.x_px / 2), round(circle.y_px / 2)
        assert image[y, x] > 150


def test_an_answer_names_the_first_sample_that_it_changes(
    ask: Controller, station: Station
) -> None:
    answer = ask.ask("axis", axis_deg=90.0)
    assert answer.applied
    with subscribe("vdms/lab/m1/displacement", station.endpoint) as samples:
        revisions: dict[int, int] = {}
        while answer.seq not in revisions:
            sample = samples.get(DEADLINE_S)
            assert sample is not None
            assert isinstance(sample.value, Displacement)
            revisions[sample.value.seq] = sample.value.setup_revision
    assert revisions[answer.seq] == revisions[answer.seq - 1] + 1
    assert answer.session == ask.ask("status").status.health.session
    assert ask.ask("axis", axis_deg=0.0).done


def test_a_zero_a_reference_and_regions(ask: Controller) -> None:
    wait(lambda: ask.ask("zero").done)
    revision = ask.ask("status").status.set_up.revision
    (given,) = ask.ask("regions").regions
    assert given.marker == "m1"
    assert ask.ask("regions", regions=given.regions).applied
    wait(lambda: ask.ask("status").status.set_up.revision == revision + 1)
    assert ask.ask("reference", stills=12).applied
    wait(lambda: ask.ask("status").status.set_up.revision == revision + 2)
    # The new reference is younger than the second that a zero is the mean of.
    assert ask.ask("zero").done
    assert json.loads(ask.ask("status").status.set_up.json)["stills"] == 24
    assert ask.ask("find").applied
    wait(lambda: ask.ask("status").status.set_up.revision == revision + 4)


@pytest.mark.parametrize(
    ("verb", "fields", "code", "why"),
    [
        ("zero", {"marker": "m9"}, "unknown-marker", 'there is no marker "m9" here; there is m1'),
        ("axis", {"axis_deg": 181.0}, "bounds", "axis_deg = 181 is not between -180 and 180"),
        ("axis", {"axis_deg": float("nan")}, "bounds", "axis_deg = nan is not between"),
        ("reference", {"stills": 1001}, "bounds", "stills = 1001 is not between 0 and 1000"),
        ("preview", {"quality": 101}, "bounds", "quality = 101"),
        ("field-order", {"order": 3}, "order", "order is TOP_FIRST"),
        ("regions", {"regions": [{"width_px": 9}]}, "regions", "has 4 circles, 1 regions came"),
        ("marker", {"spacing_mm": 40, "diameter_mm": 50}, "size", "circles 1 and 2 touch"),
        ("marker", {"spacing_mm": -1, "diameter_mm": 50}, "size", "spacing_mm: "),
        ("stroke", {"stroke_mm": 20}, "no-stroke", "marker m1: "),
        ("record", {"action": 3}, "note", "a mark needs a note"),
        ("record", {"action": 0}, "action", "action is START, STOP or MARK"),
        ("record", {"action": 1, "text": "../x"}, "name", '"../x" cannot name a file'),
        ("record", {"action": 2}, "no-run", "no run was started"),
    ],
)
def test_what_cannot_be_is_refused_with_the_reason(
    ask: Controller, verb: str, fields: dict[str, object], code: str, why: str
) -> None:
    assert why in refused(ask.ask(verb, **fields), code)


def test_a_run_has_files_of_its_own_and_notes(ask: Controller, station: Station) -> None:
    assert ask.ask("record", action=1, text="run 7").done
    assert "run-7 is recorded" in refused(ask.ask("record", action=1, text="x"), "run")
    assert ask.ask("status").status.run == "run-7"
    mark = ask.ask("record", action=3, text="hammer\nblow")
    assert mark.seq > 0
    wait(lambda: any(r.run == "run-7" for r in ask.ask("recordings").recordings.recordings))
    wait(lambda: "run-7" in ask.ask("status").status.health.recording)
    assert ask.ask("record", action=2).done

    def closed() -> list[control.Recording]:
        listed = ask.ask("recordings").recordings.recordings
        return [r for r in listed if r.run == "run-7" and not r.open]

    wait(lambda: bool(closed()))
    (recording,) = closed()
    path = station.folder / "recordings" / recording.name
    assert path.stat().st_size == recording.size_bytes
    with LogReader(path) as log:
        stored = [r for r in log if isinstance(r, StoredMessage)]
    events = [
        pb.Event.FromString(m.message.data)
        for m in stored
        if m.schema is not None and m.schema.name == "vdms.Event"
    ]
    (note,) = [e for e in events if e.code == "mark"]
    assert note.text == "hammer blow"
    assert [f.value for f in note.facts if f.name == "seq"] == [str(mark.seq)]


def test_every_command_is_an_event_with_who_what_and_when(
    ask: Controller, station: Station
) -> None:
    before_ns = time.time_ns()
    applied = ask.ask("axis", axis_deg=12.5)
    ask.ask("axis", axis_deg=900.0, who="bob\n@ the page")
    ask.ask("axis", axis_deg=-7.25)
    done, no, _ = [e for e in commands(station, "along -7.25 deg") if e.utc_ns > before_ns]
    assert ask.ask("axis", axis_deg=0.0).done
    assert (done.code, no.code) == ("command", "command-refused")
    assert done.text.startswith("axis by ann@laptop test on this computer: x of marker m1 is now")
    facts = dict(done.facts)
    assert facts["verb"] == "axis"
    assert facts["who"] == "ann@laptop test"
    assert facts["way"] == "on this computer"
    assert facts["request"] == "axis_deg: 12.5"
    assert int(facts["seq"]) == applied.seq
    assert dict(no.facts)["code"] == "bounds"
    assert dict(no.facts)["who"] == "bob @ the page"
    assert before_ns < done.utc_ns < time.time_ns()


def test_questions_are_no_events(ask: Controller, station: Station) -> None:
    ask.ask("axis", axis_deg=3.5)
    for verb in ("status", "preview", "regions", "recordings"):
        ask.ask(verb)
    ask.ask("axis", axis_deg=4.5)
    assert ask.ask("axis", axis_deg=0.0).done
    last, newest = commands(station, "along 4.5 deg")[-2:]
    assert "along 3.5 deg" in last.text
    assert "along 4.5 deg" in newest.text


def test_nonsense_is_answered(ask: Controller) -> None:
    for key, payload, code in (
        ("vdms/lab/control/dance", b"", "unknown-verb"),
        ("vdms/lab/control/zero", b"\xff\xff", "unreadable"),
    ):
        (reply,) = ask._get(key, payload, DEADLINE_S)
        refused(control.Answer.FromString(reply.payload.to_bytes()), code)
    assert not list(ask._get("vdms/lab/control/*", b"", DEADLINE_S))


# --- the command line -------------------------------------------------------------------------


def test_ctl_says_what_was_done_and_what_not(
    ask: Controller, station: Station, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    def ctl(*words: str) -> tuple[int, str, str]:
        status = cli.run(["ctl", "--connect", station.endpoint, *words])
        said = capsys.readouterr()
        return status, said.out, said.err

    status, out, _ = ctl("axis", "15")
    assert status == 0
    assert out.startswith("x of marker m1 is now along 15 deg")
    assert "(from seq " in out
    assert ctl("axis", "0")[0] == 0
    status, out, err = ctl("zero", "--marker", "m9")
    assert (status, out) == (1, "")
    assert err == 'vdms-rt: there is no marker "m9" here; there is m1\n'
    assert "state      measuring" in ctl("status")[1]
    assert json.loads(ctl("--json", "status")[1])["status"]["health"]["state"] == "measuring"
    assert ctl("regions")[1].startswith("m1  ")
    status, out, _ = ctl("preview", "--out", str(tmp_path / "p.jpg"))
    assert out.startswith(f"{tmp_path / 'p.jpg'}: measuring, seq ")
    assert np.shape(codec.picture_from((tmp_path / "p.jpg").read_bytes())) == (480, 720)
    assert ctl("record", "mark", "two", "words")[1].endswith(": two words\n")
    assert "being written" in ctl("recordings")[1]
    assert ctl("--station", "other", "status")[2] == (
        f"vdms-rt: {station.endpoint}: no station other answers there; is it running?\n"
    )


def test_nobody_at_the_address_is_one_sentence(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("vdms_rt.control.client.CONNECT_S", 0.3)
    endpoint = free_endpoint()
    assert cli.run(["ctl", "--connect", endpoint, "status"]) == 1
    assert capsys.readouterr().err == (
        f"vdms-rt: {endpoint}: no connection within 0.3 s; does a station run there?\n"
    )
    with pytest.raises(ControlError, match="is not an address"):
        Controller("nonsense")
    with pytest.raises(Exception, match="`vdms-rt keys client` makes it"):
        Controller(endpoint, credentials=Credentials(keys=Path("nowhere"))).__enter__()


# --- stations that cannot ---------------------------------------------------------------------


def test_without_pictures_a_command_is_not_done_later(tmp_path: Path) -> None:
    station = Station(tmp_path, source="v4l2", sections='[v4l2]\ndevice = "/dev/video99"\n')
    try:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("vdms_rt.control.client.CONNECT_S", PATIENCE_S)
            with Controller(station.endpoint) as ask:
                wait(lambda: ask.ask("status").done)
                text = refused(ask.ask("reference"), "no-pictures")
                assert text == (
                    "no pictures come (no device), so nothing was done; ask again when they do"
                )
                refused(ask.ask("preview"), "no-pictures")
    finally:
        assert station.end() == 0


def test_control_can_be_switched_off(tmp_path: Path) -> None:
    station = Station(tmp_path, "[control]\nenabled = false\n")
    try:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("vdms_rt.control.client.CONNECT_S", PATIENCE_S)
            with (
                Controller(station.endpoint) as ask,
                pytest.raises(ControlError, match="station lab takes no requests from here"),
            ):
                ask.ask("status")
    finally:
        station.end()
