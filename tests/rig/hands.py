"""Who handles the grabber of a test: the emulator's controls, or a person at a real one.

The tests of one grabber are written against this, so that they run in the virtual machine and, with
`--device`, on a real grabber: then each act is asked of a person, and seen on the device.
"""

import sys
from collections.abc import Callable
from types import MappingProxyType
from typing import TypeVar

from rig.devices import Grabber, wait_for

from vdms_rt.capture.grabber import DeviceInfo, choose_device, list_devices
from vdms_rt.model import SourceError

_Answer = TypeVar("_Answer")


class Hands:
    """The emulated USB grabber."""

    settings = MappingProxyType({"input": 1, "standard": "ntsc-m"})
    """Of the section [v4l2] beside the device."""
    truth_known = True
    """The positions that the marker takes are those of rig.frames."""
    patience_s = 30.0
    """For an act to show."""
    stream_frames = 60
    """How long a stream is watched."""

    def __init__(self, grabber: Grabber):
        self._grabber = grabber
        self.device = grabber.serial

    def plug(self) -> DeviceInfo:
        """Plug it in and return it, as soon as its node is there."""
        return self._grabber.plug()

    def unplug(self) -> None:
        """Pull it out, and return when its node is gone."""
        self._grabber.unplug()

    def hold(self, on: bool) -> None:
        """Let the marker rest, or move again."""
        self._grabber.set("hold", on)

    def camera(self, on: bool) -> None:
        """Switch the camera off or on."""
        self._grabber.set("blank", not on)


class Person:
    """A real grabber, camera and marker, and somebody who reads what the terminal says."""

    settings = MappingProxyType[str, object]({})
    truth_known = False
    patience_s = 120.0
    stream_frames = 900

    def __init__(self, device: str):
        self.device = device
        self._there = choose_device(device)

    def plug(self) -> DeviceInfo:
        found = self._found()
        if found is None:
            found = self._ask("plug the grabber in", self._found)
        return found

    def unplug(self) -> None:
        self._ask("pull the grabber out of its USB port", lambda: self._found() is None)

    def hold(self, on: bool) -> None:
        if on:
            say("let the marker rest, and do not touch table or camera")

    def camera(self, on: bool) -> None:
        # What it did shows in the states, which the test waits for.
        say(f"switch the camera {'on' if on else 'off, or pull its cable out of the grabber'}")

    def _found(self) -> DeviceInfo | None:
        """Return the grabber if it is plugged in, wherever it went."""
        devices = list_devices()
        try:
            return choose_device("auto", devices, before=self._there)
        except SourceError:
            return None

    def _ask(self, what: str, done: Callable[[], _Answer]) -> _Answer:
        say(what)
        return wait_for(done, f"somebody to {what}", self.patience_s)


def say(text: str) -> None:
    """Tell the person what to do now."""
    sys.__stderr__.write(f"\n>>> Please {text}.\n")
    sys.__stderr__.flush()
