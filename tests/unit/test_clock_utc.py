"""UTC beside the monotonic clock."""

from __future__ import annotations

import time

import pytest

from vdms_rt.capture.utc import UtcOffset, utc_state

SECOND_NS = 1_000_000_000


class Clocks:
    """A computer's clocks; each reading takes `slow_ns`."""

    def __init__(self) -> None:
        self.monotonic_ns = 10**12
        self.offset_ns = 10**18
        self.asleep_ns = 0
        self.slow_ns = iter(())
        self.state = ("synchronised", 500)

    def read_monotonic(self) -> int:
        self.monotonic_ns += next(self.slow_ns, 50)
        return self.monotonic_ns

    def read_utc(self) -> int:
        self.monotonic_ns += next(self.slow_ns, 50)
        return self.monotonic_ns + self.offset_ns

    def read_boot(self) -> int:
        return self.monotonic_ns + self.asleep_ns

    def utc(self) -> UtcOffset:
        return UtcOffset(self.read_monotonic, self.read_utc, self.read_boot, lambda: self.state)


def test_the_tightest_bracket_holds() -> None:
    clocks = Clocks()
    clocks.slow_ns = iter([50, 90_000, 50, 50, 40, 60, 50, 50, 5_000])
    utc = clocks.utc()
    assert utc.sample() == (False, [])
    assert abs(utc.offset_ns - clocks.offset_ns) <= utc.error_ns <= 50
    clocks.slow_ns = iter([900_000] * 15)
    held = utc.offset_ns
    assert utc.sample() == (False, [])
    assert utc.offset_ns == held
    assert utc.state == "synchronised"


@pytest.mark.parametrize(("step_ns", "way"), [(3 * SECOND_NS, "forward"), (-5_000_000, "back")])
def test_a_step_is_followed_and_told(step_ns: int, way: str) -> None:
    clocks = Clocks()
    utc = clocks.utc()
    utc.sample()
    clocks.offset_ns += step_ns
    slept, (event,) = utc.sample()
    assert not slept
    assert event.code == "utc-step"
    assert f"was set {way} by {abs(step_ns) / 1e9:.3f} s" in event.text
    assert abs(utc.offset_ns - clocks.offset_ns) <= utc.error_ns
    assert utc.sample() == (False, [])


def test_a_small_step_is_followed_without_a_word() -> None:
    clocks = Clocks()
    utc = clocks.utc()
    utc.sample()
    clocks.offset_ns += 20_000
    assert utc.sample() == (False, [])
    assert abs(utc.offset_ns - clocks.offset_ns) <= utc.error_ns


def test_sleep_is_no_step() -> None:
    clocks = Clocks()
    utc = clocks.utc()
    utc.sample()
    clocks.offset_ns += 100 * SECOND_NS
    clocks.asleep_ns += 100 * SECOND_NS
    assert utc.sample() == (True, [])
    assert abs(utc.offset_ns - clocks.offset_ns) <= utc.error_ns
    assert utc.sample() == (False, [])


def test_a_pause_between_two_readings_is_no_sleep() -> None:
    clocks = Clocks()
    pauses_ns = iter([0] * 5 + [20_000_000] * 4)

    def read_boot() -> int:
        clocks.monotonic_ns += next(pauses_ns, 0)
        return clocks.read_boot()

    utc = UtcOffset(clocks.read_monotonic, clocks.read_utc, read_boot, lambda: clocks.state)
    assert utc.sample() == (False, [])
    assert utc.sample() == (False, [])


def test_this_computers_clocks() -> None:
    state, error_us = utc_state()
    assert state in ("synchronised", "not synchronised", "unknown")
    assert error_us >= 0
    utc = UtcOffset()
    slept, events = utc.sample()
    assert not slept
    assert not events
    assert utc.error_ns < SECOND_NS
    before_ns = time.time_ns()
    middle_ns = time.monotonic_ns() + utc.offset_ns
    after_ns = time.time_ns()
    assert before_ns - utc.error_ns - 1000 <= middle_ns <= after_ns + utc.error_ns + 1000
