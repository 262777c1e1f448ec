from __future__ import annotations

import io
import math

from loopback import displacement
from rich.console import Console

from vdms_rt.model import Event, Health, Severity, State, Status
from vdms_rt.subscribe import Arrived, Left, Missed, Sample
from vdms_rt.watch.board import Board, MarkerView, figures, marker_line, summary
from vdms_rt.watch.screen import Screen

NOW_NS = 50_000_000_000
PERIOD_NS = 33_366_667


def sample(seq: int, station: str = "s1", marker: str = "m1", **values: object) -> Sample:
    value = displacement(seq, marker=marker, t_ns=seq * PERIOD_NS, **values)  # type: ignore[arg-type]
    return Sample(station, marker, "displacement", NOW_NS, value)


def health(state: State = State.MEASURING, **values: object) -> Sample:
    numbers = dict.fromkeys(Health.__dataclass_fields__, 0)
    words = dict.fromkeys(("device", "recording", "record_trouble", "utc_state"), "")
    all_values = numbers | words | {"session": 7, "state": state, "frame_rate_hz": 29.97} | values
    return Sample("s1", "", "health", NOW_NS, Health(**all_values))  # type: ignore[arg-type]


def board(*items: object) -> Board:
    made = Board()
    for item in items:
        made.take(item)  # type: ignore[arg-type]
    return made


def screen(
    of: Board, width: int = 100, height: int = 30, waiting_for: tuple[str, ...] = (), at: int = 0
) -> list[str]:
    console = Console(
        file=io.StringIO(), width=width, height=height, force_terminal=True, color_system=None
    )
    lines = console.render_lines(
        Screen(of, ("tcp/127.0.0.1:7447",), waiting_for, NOW_NS + at),
        console.options.update(width=width, height=height),
        pad=False,
    )
    return ["".join(part.text for part in line).rstrip() for line in lines]


def test_the_rate_is_by_the_samples_own_times() -> None:
    marker = MarkerView()
    assert marker.rate_hz == 0.0
    for seq in (*range(300), *range(330, 400)):
        marker.take(displacement(seq, t_ns=seq * PERIOD_NS), NOW_NS)
    assert math.isclose(marker.rate_hz, 1e9 / PERIOD_NS, rel_tol=1e-3)
    assert marker.points[0][0] >= 399 * PERIOD_NS / 1e9 - 10
    assert marker.samples == 370


def test_a_new_session_begins_a_new_plot() -> None:
    marker = MarkerView()
    marker.take(displacement(500, t_ns=10**12), NOW_NS)
    marker.take(displacement(0, session=8, t_ns=5), NOW_NS)
    assert len(marker.points) == 1
    assert marker.sessions == 2


def test_invalid_samples_leave_a_gap_in_the_plot() -> None:
    marker = MarkerView()
    marker.take(displacement(0, x_mm=3.0, status=Status.RESIDUAL), NOW_NS)
    assert math.isnan(marker.points[0][1])


def test_figures_have_signs_and_dashes() -> None:
    assert figures(displacement(3)) == ("+3.0000", "-0.5000", "+0.250", "0.0156")
    assert figures(displacement(3, x_mm=math.nan, sigma_x_mm=math.nan))[0] == "-"
    assert figures(None) == ("-", "-", "-", "-")


def test_a_plain_line_says_everything() -> None:
    made = board(Arrived("s1"), health(recording="run.mcap"), sample(1), sample(2))
    station = made.stations["s1"]
    line = marker_line("s1/m1", station, station.markers["m1"], NOW_NS)
    assert line == (
        "s1/m1  x   +2.0000 mm  y   -0.5000 mm  rotation   +0.250 mrad  sigma 0.0156 mm  "
        "29.97 Hz  missed 0  measuring  ok  recording run.mcap"
    )
    later = marker_line("s1/m1", station, station.markers["m1"], NOW_NS + 3_000_000_000)
    assert "no sample for 3 s" in later


def test_notices_and_events_are_lines_and_samples_are_not() -> None:
    made = Board()
    assert made.take(sample(0)) is None
    assert made.take(health()) is None
    arrived = made.take(Arrived("s1"))
    assert arrived is not None
    assert arrived.endswith(" s1: arrived")
    event = Event(Severity.INFO, "state", "measuring", 0, 0)
    told = made.take(Sample("s1", "", "event", NOW_NS, event))
    assert told == "--:--:-- s1: measuring"
    assert list(made.events) == [arrived, told]


def test_the_summary_counts_what_came_and_what_did_not() -> None:
    assert summary(Board()) == ["no sample came"]
    made = board(
        sample(0),
        sample(5),
        Missed("s1", "m1", 7, 1, 4, on_the_way=1),
        sample(0, session=8),
        sample(0, marker="m2"),
        sample(0, station="s2"),
    )
    assert summary(made) == [
        "s1/m1: 3 samples, 4 missed (1 of them on the way), 2 sessions",
        "s1/m2: 1 samples, 0 missed",
        "s2/m1: 1 samples, 0 missed",
    ]


def test_the_screen_says_what_it_waits_for() -> None:
    assert screen(Board(), waiting_for=("tcp/127.0.0.1:7447",))[0].startswith(
        "vdms-rt watch  waiting for tcp/127.0.0.1:7447 ..."
    )
    assert "connected to tcp/127.0.0.1:7447, waiting for a station ..." in screen(Board())[0]
    assert screen(Board())[0].endswith("Ctrl-C ends")


def test_the_screen_shows_station_marker_plot_and_events() -> None:
    made = board(
        Arrived("s1"),
        health(missed=2, overwritten=1, recording="run.mcap"),
        *(sample(seq, x_mm=math.sin(seq / 10)) for seq in range(200)),
        Missed("s1", "m1", 7, 200, 200, on_the_way=0),
        sample(201, x_mm=0.125, status=Status.FIELD_ORDER_UNCONFIRMED),
    )
    lines = screen(made)
    assert lines[2] == "s1  measuring  29.97 frames/s  lost 3  recording run.mcap"
    assert " ".join(lines[3].split()) == ("marker x mm y mm rot. mrad sigma mm Hz missed status")
    assert " ".join(lines[4].split()) == (
        "m1 +0.1250 -0.5000 +0.250 0.0156 29.46 1 field order unconfirmed"
    )
    assert lines[5] == "x of s1/m1, mm"
    assert any(0x2800 < ord(character) < 0x2900 for line in lines[6:] for character in line)
    text = "\n".join(lines)
    assert "s1: arrived" in text
    assert "s1/m1: missed 1 sample, seq 200, lost by the station" in text


def test_the_screen_fits_into_any_terminal() -> None:
    made = board(
        *(Arrived(f"s{k}") for k in range(3)),
        *(sample(0, station=f"s{k}", marker=f"m{j}") for k in range(3) for j in range(3)),
    )
    for width, height in ((80, 24), (100, 50), (200, 60), (60, 20)):
        lines = screen(made, width, height)
        assert len(lines) <= height
        assert max(len(line) for line in lines) <= width
    assert sum("x of" in line for line in screen(made, 100, 100)) == 9
    assert sum("x of" in line for line in screen(made, 80, 24)) == 0


def test_the_screen_tells_what_is_wrong() -> None:
    made = board(Arrived("s1"), sample(0), health(record_trouble="the disk is full"))
    assert "NOT RECORDING: the disk is full" in screen(made)[2]
    assert "without pixels" not in screen(made)[2]
    left_out = board(Arrived("s1"), sample(0), health(recording="a.mcap", pixels_left_out=3))
    assert screen(left_out)[2].endswith("without pixels of 3 frames  recording a.mcap")
    assert "no sample for 4 s" in screen(made, at=4_000_000_000)[4]
    made.take(Left("s1"))
    assert screen(made)[2] == "s1  gone"
