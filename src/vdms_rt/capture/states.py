"""Where a device stands, from nothing to streaming and back, and every limit of time in one place.

    no device ──► starting ──► streaming ◄──► no signal
                     │             │
                     └─► stalled ◄─┘      closed and opened, then reset over USB, then again
    any of them ──► lost ──► starting

Pure: what happens is told to it with the time in seconds on a steady clock, and each change comes
back with its sentence.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from vdms_rt.model import Severity, State

RETRY_S = 1.0
"""From one try to open a device to the next. The kernel tells when a node appears, so this is for
what it does not tell: another program lets go, permissions arrive."""
START_S = 4.0
"""From the start of the stream to its first frame: analogue decoders lock within 1 s, cameras of
the UVC class take up to 3 s to wake up."""
STALL_S = 1.0
"""Without a frame: 30 periods, which no burst of load takes, and no driver to get over a lost
transfer."""
ASK_S = 0.5
"""From one question to the driver, whether there is a signal, to the next. A question is one or two
transfers on the decoder's own slow bus, some milliseconds."""
LOOK_S = 0.2
"""From one look at a picture, whether it shows anything, to the next: a look costs 0.2 ms."""
NO_SIGNAL_S = 0.6
"""Pictures of nothing for so long: three looks. A lamp that is switched may spoil one."""
SIGNAL_S = 0.6
"""Pictures of something for so long, after there was nothing: the same three looks, in which the
camera's own start-up is over."""
FROZEN_S = 1.0
"""The same picture again and again: 30 periods. A driver that repeats one or two makes up for lost
ones; those are only left out."""
REMEDY_S = 2.0
"""From a stall to the first remedy: what comes back by itself has come back by then."""
REMEDY_LONGEST_S = 30.0
"""Each remedy waits twice as long as the one before, up to this: a camera that is off may stall its
grabber for hours, and a bus that is reset all the time disturbs the devices beside it."""
RETURN_S = 10.0
"""After a reset, for the device to be there again: 1 to 3 s were seen, with slow disks more."""
STEADY_S = 10.0
"""Streaming for so long ends a trouble: the next begins with the first remedy again."""


class Remedy(Enum):
    """What is to be done with a device that stalled."""

    NONE = "wait"
    REOPEN = "close and open it"
    RESET = "reset it over USB"


@dataclass(frozen=True, slots=True)
class Change:
    """A state was entered, or its reason is another."""

    state: State
    severity: Severity
    text: str


class DeviceStates:
    """The standing of one device."""

    def __init__(self) -> None:
        self.state = State.STARTING
        self._name = ""
        self._told: set[str] = set()
        self._opened_s = 0.0
        self._frame_s: float | None = None
        """When the newest frame came, since it was opened."""
        self._worked_s: float | None = None
        """When the newest frame with a signal came, ever."""
        self._refused = ""
        self._had = False
        """There was a device."""
        self._nothing_s: float | None = None
        """Since when pictures show nothing; None while they show something."""
        self._something_s: float | None = None
        self._streaming_s: float | None = None
        self._remedies = 0
        self._remedy_s = 0.0
        self._reset_s: float | None = None

    def opened(self, now_s: float, name: str) -> bool:
        """The stream was started; `name` is how a person knows the device. Returns whether that is
        a change to `starting`: a stalled one stays stalled until a frame comes."""
        self._name = name
        self._had = True
        self._opened_s = now_s
        self._frame_s = self._nothing_s = self._something_s = self._streaming_s = None
        self._reset_s = None
        if self.state is State.STALLED:
            return False
        self.state = State.STARTING
        self._told = set()
        return True

    def not_opened(self, now_s: float, why: str, *, gone: bool) -> Change | None:
        """It could not be opened; `gone` says that it is not there at all."""
        before, self._refused = self._refused, "" if gone else why
        if not gone and (self.state is State.STALLED or why != before):
            # For a moment after it was plugged in, udev has not given its permissions yet.
            return None
        if gone and self._reset_s is not None and now_s - self._reset_s < RETURN_S:
            return None
        if gone and self.state is State.LOST:
            return None
        state = State.LOST if self._had else State.NO_DEVICE
        return self._enter(state, Severity.ERROR, why)

    def failed(self, now_s: float, why: str, *, gone: bool) -> Change | None:
        """The driver gave up in the middle of the stream; `gone` says that the device is."""
        if gone:
            return self._enter(State.LOST, Severity.ERROR, why)
        return self._stall(now_s, why)

    def frame(self, now_s: float, nothing: str, *, sure: bool = False) -> Change | None:
        """A frame came; `nothing` says why it is no camera's picture, empty if it is one. `sure`
        spares the doubt: it is the driver's own word, or was seen for long enough."""
        self._frame_s = now_s
        if nothing:
            self._something_s = self._streaming_s = None
            if self._nothing_s is None:
                self._nothing_s = now_s
            if not sure and now_s - self._nothing_s < NO_SIGNAL_S:
                return None
            return self._enter(State.NO_SIGNAL, Severity.ERROR, nothing)
        self._nothing_s = None
        if self._something_s is None:
            self._something_s = now_s
        if self.state is State.NO_SIGNAL and now_s - self._something_s < SIGNAL_S:
            return None
        if self._streaming_s is None:
            self._streaming_s = now_s
        if now_s - self._streaming_s >= STEADY_S:
            self._remedies = 0
        before_s, self._worked_s = self._worked_s, now_s
        if self.state is State.STREAMING:
            return None
        pause = "" if before_s is None else f" again, after {now_s - before_s:.1f} s"
        return self._enter(State.STREAMING, Severity.INFO, f"frames come from {self._name}{pause}")

    def silence(self, now_s: float, nothing: str) -> Change | None:
        """No frame came; `nothing` is the driver's word why there is no signal, if it has one."""
        last_s = self._opened_s if self._frame_s is None else self._frame_s
        quiet_s = now_s - last_s
        if nothing and quiet_s >= STALL_S:
            return self._enter(State.NO_SIGNAL, Severity.ERROR, nothing)
        if quiet_s < (START_S if self._frame_s is None else STALL_S):
            return None
        return self._stall(
            now_s,
            f"{self._name} gives no frames; look whether the camera is on and its cable is in the "
            "grabber's chosen input",
        )

    def remedy(self, now_s: float) -> Remedy:
        """Return what is due to be done with a stalled device, and count it as done."""
        if self.state is not State.STALLED or now_s < self._remedy_s:
            return Remedy.NONE
        self._remedies += 1
        self._remedy_s = now_s + min(REMEDY_LONGEST_S, REMEDY_S * 2.0**self._remedies)
        if self._remedies % 2:
            return Remedy.REOPEN
        self._reset_s = now_s
        return Remedy.RESET

    def _stall(self, now_s: float, why: str) -> Change | None:
        if self.state is not State.STALLED:
            self._remedy_s = now_s + min(REMEDY_LONGEST_S, REMEDY_S * 2.0**self._remedies)
        return self._enter(State.STALLED, Severity.ERROR, why)

    def _enter(self, state: State, severity: Severity, text: str) -> Change | None:
        """Return a change where there is one to tell. Waiting for a device tells every reason
        once; of the other states the first reason holds."""
        if state is self.state:
            if state not in (State.NO_DEVICE, State.LOST) or text in self._told:
                return None
        else:
            self.state = state
            self._told = set()
        self._told.add(text)
        return Change(state, severity, text)
