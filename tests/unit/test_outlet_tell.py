"""What the console gets to read of many events: few lines, and nothing lost without a word."""

import logging

import pytest

from vdms_rt import outlet
from vdms_rt.model import Event, Severity
from vdms_rt.outlet import Outlet


@pytest.fixture
def now_s(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The steady clock, to be moved by the test."""
    now_s = [100.0]
    monkeypatch.setattr(outlet.time, "monotonic", lambda: now_s[0])
    return now_s


def missed(station: Outlet, count: int, first: int = 0) -> None:
    for frame in range(first, first + count):
        station.event(Event(Severity.WARNING, "frames-missed", f"missed after {frame}"))


def said(caplog: pytest.LogCaptureFixture) -> list[str]:
    lines = [record.getMessage() for record in caplog.records]
    caplog.clear()
    return lines


def test_many_events_of_a_code_become_few_lines(
    now_s: list[float], caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    station = Outlet("lab", ("m1",), 1, live=True, patches="none")
    missed(station, 40)
    station.event(Event(Severity.INFO, "marker-found", "found marker m1"))
    station.tell()
    assert said(caplog) == [*(f"missed after {n}" for n in range(3)), "found marker m1"]

    now_s[0] += 5
    missed(station, 10, 40)
    station.tell()
    assert said(caplog) == []

    now_s[0] += 5
    station.tell()
    (line,) = said(caplog)
    assert line == "missed after 49 (the last of 47 more such events, frames-missed, in 10 s)"

    # As long as they go on, one line for twice as long.
    missed(station, 5, 50)
    now_s[0] += 19
    station.tell()
    assert said(caplog) == []
    now_s[0] += 1
    station.tell()
    assert said(caplog) == [
        "missed after 54 (the last of 5 more such events, frames-missed, in 20 s)"
    ]

    # After as long without any, each one is told again.
    now_s[0] += 40
    station.tell()
    missed(station, 2, 60)
    station.tell()
    assert said(caplog) == ["missed after 60", "missed after 61"]


def test_every_change_of_state_is_told(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    station = Outlet("lab", ("m1",), 1, live=True, patches="none")
    texts = [f"change {n}" for n in range(8)]
    for text in texts:
        station.event(Event(Severity.INFO, "state", text))
    station.tell()
    assert said(caplog) == texts


def test_at_the_end_all_is_told(now_s: list[float], caplog: pytest.LogCaptureFixture) -> None:
    station = Outlet("lab", ("m1",), 1, live=True, patches="none")
    missed(station, 4)
    station.tell()
    now_s[0] += 1
    said(caplog)
    station.tell(at_end=True)
    assert said(caplog) == [
        "missed after 3 (the last of 1 more such events, frames-missed, in 1 s)"
    ]
