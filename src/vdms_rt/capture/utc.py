"""UTC beside the monotonic clock: their offset, its steps, and whether anything keeps UTC right."""

from __future__ import annotations

import ctypes
import functools
import time
from collections.abc import Callable

from vdms_rt.model import Event, Severity

TRIES = 5
STEP_NS = 1_000_000
"""Smaller changes of the offset are followed without a word."""
SUSPEND_NS = 10_000_000

_TIME_ERROR = 5
_STA_UNSYNC = 0x0040


class _Timex(ctypes.Structure):
    """The head of `struct timex`, adjtimex(2), with room for the rest of it."""

    _fields_ = (
        ("modes", ctypes.c_uint),
        ("offset", ctypes.c_long),
        ("freq", ctypes.c_long),
        ("maxerror", ctypes.c_long),
        ("esterror", ctypes.c_long),
        ("status", ctypes.c_int),
        ("rest", ctypes.c_long * 64),
    )


@functools.cache
def _libc() -> ctypes.CDLL:
    return ctypes.CDLL(None, use_errno=True)


def utc_state() -> tuple[str, int]:
    """Return `synchronised`, `not synchronised` or `unknown`, and the kernel's bound on the error
    of its UTC clock in microseconds (0 where unknown).

    The kernel keeps this for whoever disciplines its clock: NTP daemons, and phc2sys for PTP.
    `unknown` means that this process may not ask (adjtimex(2) without any right to set).
    """
    timex = _Timex()
    try:
        result = _libc().adjtimex(ctypes.byref(timex))
    except (OSError, AttributeError):
        return "unknown", 0
    if result < 0:
        return "unknown", 0
    if result == _TIME_ERROR or timex.status & _STA_UNSYNC:
        return "not synchronised", int(timex.maxerror)
    return "synchronised", int(timex.maxerror)


def _boot_ns() -> int:
    return time.clock_gettime_ns(time.CLOCK_BOOTTIME)


class UtcOffset:
    """UTC minus the monotonic clock, from readings that bracket one another.

    The kernel slews both clocks together, so between steps the offset is a constant: the tightest
    bracket since the last step holds it, and a reading outside of that bracket is a step.
    """

    def __init__(
        self,
        read_monotonic: Callable[[], int] = time.monotonic_ns,
        read_utc: Callable[[], int] = time.time_ns,
        read_boot: Callable[[], int] = _boot_ns,
        read_state: Callable[[], tuple[str, int]] = utc_state,
    ) -> None:
        self._monotonic, self._utc, self._boot = read_monotonic, read_utc, read_boot
        self._read_state = read_state
        self.offset_ns = 0
        self.error_ns = 0
        """The offset is right within this (half a bracket)."""
        self.state = "unknown"
        self._known = False
        self._asleep_ns = 0

    def sample(self) -> tuple[bool, list[Event]]:
        """Read the clocks; return whether the computer slept since the last call, and an event if
        UTC was stepped. Takes some 10 us."""
        offset_ns, error_ns, now_ns, asleep_ns = self._tightest()
        slept_ns = asleep_ns - self._asleep_ns if self._known else 0
        self._asleep_ns = asleep_ns
        self.state, _ = self._read_state()
        slept = slept_ns > SUSPEND_NS
        step_ns = offset_ns - self.offset_ns
        if not self._known or abs(step_ns) > error_ns + self.error_ns:
            events = self._stepped(step_ns, now_ns, offset_ns) if self._known and not slept else []
            self.offset_ns, self.error_ns, self._known = offset_ns, error_ns, True
            return slept, events
        if error_ns < self.error_ns:
            self.offset_ns, self.error_ns = offset_ns, error_ns
        return slept, []

    def _tightest(self) -> tuple[int, int, int, int]:
        """Return the offset, its error, when it was read, and how long the computer has slept."""
        best = (0, 0, 0)
        # The two clocks are read one after the other: a pause in between makes the sleep longer.
        asleep_ns = 2**63
        for attempt in range(TRIES):
            before_ns = self._monotonic()
            utc_ns = self._utc()
            after_ns = self._monotonic()
            boot_ns = self._boot()
            error_ns = (after_ns - before_ns + 1) // 2
            if attempt == 0 or error_ns < best[1]:
                middle_ns = before_ns + error_ns
                best = (utc_ns - middle_ns, error_ns, after_ns)
            asleep_ns = min(asleep_ns, boot_ns - after_ns)
        return *best, asleep_ns

    @staticmethod
    def _stepped(step_ns: int, now_ns: int, offset_ns: int) -> list[Event]:
        if abs(step_ns) < STEP_NS:
            return []
        way = "forward" if step_ns > 0 else "back"
        return [
            Event(
                Severity.WARNING,
                "utc-step",
                f"the computer's UTC clock was set {way} by {abs(step_ns) / 1e9:.3f} s; "
                "utc_ns follows it, t_ns does not",
                now_ns,
                now_ns + offset_ns,
                (("step_ns", str(step_ns)),),
            )
        ]
