"""A grabber as the capture thread keeps it going: found, opened, watched, and mended if need be."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from vdms_rt.capture import states
from vdms_rt.capture import v4l2_api as api
from vdms_rt.capture.grabber import DeviceInfo, better_device, choose_device
from vdms_rt.capture.plug import Arrivals, reset_usb
from vdms_rt.capture.signal import DriverSignal, Repeats, Word, blank
from vdms_rt.capture.states import Change, DeviceStates, Remedy
from vdms_rt.capture.v4l2 import V4l2Source
from vdms_rt.capture.v4l2_node import DeviceGone
from vdms_rt.config import V4l2
from vdms_rt.model import Damage, Event, Grab, Luma, Severity, SourceError, State

UNSURE = DriverSignal(Word.UNKNOWN)


class Device:
    """The grabber that the configuration means, through all its comings and goings. Used by the
    capture thread alone.

    `idle` tells whether nothing is measured yet, so that "auto" may still change its mind.
    """

    def __init__(
        self, config: V4l2, report: Callable[[Event], None], idle: Callable[[], bool]
    ) -> None:
        self._config = config
        self._report = report
        self._idle = idle
        self._states = DeviceStates()
        self._arrivals = Arrivals()
        self._before: DeviceInfo | None = None
        self._source: V4l2Source | None = None
        self._remedy = Remedy.NONE
        self._warned: set[str] = set()
        self._mended: set[str] = set()
        """What was told of remedies since frames came: a camera may be off for hours."""
        self._signal = UNSURE
        self._asked_s = self._looked_s = self._compared_s = 0.0
        self._trusted = False
        """The driver has said that there is a signal, and there was: so it may say that there is
        none. One that never detects anything would else stop the measuring."""
        self._other_standard = ""
        self._blank = ""
        self._repeats = Repeats()
        self._repeated_s: float | None = None

    @property
    def state(self) -> State:
        return self._states.state

    def open(self) -> V4l2Source | None:
        """Return the device, open and streaming, or None where that fails."""
        try:
            found = choose_device(self._config.device, before=self._before)
            source = V4l2Source(self._config, device=found)
        except SourceError as error:
            gone = isinstance(error, DeviceGone)
            self._tell(self._states.not_opened(time.monotonic(), str(error), gone=gone))
            if not gone:
                self._remedy = self._states.remedy(time.monotonic())
            return None
        self._before = found
        self._source = source
        self._signal, self._other_standard, self._blank = UNSURE, "", ""
        self._repeats, self._repeated_s = Repeats(), None
        self._asked_s = self._looked_s = 0.0
        self._states.opened(time.monotonic(), source.info.name)
        for warning in source.info.warnings:
            if warning not in self._warned:
                self._warned.add(warning)
                self._report(Event(Severity.WARNING, "device", warning))
        return source

    def frame(self, image: Luma, grab: Grab) -> Damage:
        """Return what is wrong with an image beyond what the driver says."""
        assert self._source is not None
        now_s = time.monotonic()
        damage = Damage.NONE
        if not self._source.lossy and self._repeats.seen(image, grab.scan):
            damage = Damage.REPEATED
            self._repeated_s = now_s if self._repeated_s is None else self._repeated_s
        else:
            self._repeated_s = None
        if now_s - self._looked_s >= states.LOOK_S:
            self._looked_s = now_s
            self._blank = blank(image)
        self._ask(now_s)
        nothing, sure = self._nothing(now_s)
        if not nothing and self._signal.word is Word.PRESENT:
            self._trusted = True
        self._tell(self._states.frame(now_s, nothing, sure=sure))
        if nothing or self.state is State.NO_SIGNAL:
            damage |= Damage.NO_SIGNAL
        return damage

    def silence(self) -> None:
        """There was no frame for a while."""
        now_s = time.monotonic()
        self._ask(now_s)
        nothing = self._standard_words()
        if self._signal.word is Word.ABSENT:
            nothing = self._sentence("the grabber detects no signal")
        self._tell(self._states.silence(now_s, nothing))

    def failed(self, error: SourceError) -> None:
        """The source gave up."""
        gone = isinstance(error, DeviceGone)
        now_s = time.monotonic()
        self._tell(self._states.failed(now_s, str(error), gone=gone))
        self._remedy = self._states.remedy(now_s)

    def due(self) -> bool:
        """Return whether the source is to be closed, for `mend` and a new `open`."""
        assert self._source is not None
        if self._other_standard and self._config.standard == "auto":
            self._report(
                Event(
                    Severity.WARNING,
                    "standard-changed",
                    f"the camera at {self._source.info.name} sends {self._other_standard} now; "
                    "the grabber is set to it",
                )
            )
            return True
        if self._better():
            name = self._source.info.name
            text = f"a frame grabber was plugged in; it is used in place of {name}"
            self._report(Event(Severity.INFO, "device", text))
            self._before = None
            return True
        self._remedy = self._states.remedy(time.monotonic())
        return self._remedy is not Remedy.NONE

    def mend(self) -> bool:
        """Do what is due, now that the source is closed; return whether anything was."""
        remedy, self._remedy = self._remedy, Remedy.NONE
        if remedy is Remedy.NONE or self._before is None:
            return False
        text = f"{self._before.title} gives no frames; it is closed and opened"
        if remedy is Remedy.RESET and self._before.usb_port:
            text = f"{self._before.title} gives no frames; it is reset over USB"
            try:
                reset_usb(self._before.usb_port)
            except SourceError as error:
                text = str(error)
        if text not in self._mended:
            self._mended.add(text)
            facts = (("remedy", remedy.value),)
            self._report(Event(Severity.WARNING, "remedy", text, facts=facts))
        return True

    def wait(self, stop: threading.Event) -> None:
        """Return when it is worth while to try again."""
        self._arrivals.wait(states.RETRY_S, stop)

    def _nothing(self, now_s: float) -> tuple[str, bool]:
        """Return why the frames are no camera's pictures, and whether that is beyond doubt."""
        if words := self._standard_words():
            return words, True
        if self._signal.word is Word.ABSENT and (self._trusted or self._blank):
            return self._sentence("the grabber detects no signal"), True
        if self._blank:
            return self._sentence(self._blank), False
        if self._repeated_s is not None and now_s - self._repeated_s >= states.FROZEN_S:
            return self._sentence("the picture is frozen"), True
        return "", False

    def _better(self) -> bool:
        """Return whether to change to a grabber that was plugged in since."""
        now_s = time.monotonic()
        if self._before is None or now_s - self._compared_s < states.RETRY_S:
            return False
        self._compared_s = now_s
        return better_device(self._config.device, self._before) and self._idle()

    def _sentence(self, why: str) -> str:
        assert self._source is not None
        return (
            f"{why}; look whether the camera at {self._source.info.name} is on, its lens open, and "
            "its cable in the grabber's chosen input"
        )

    def _standard_words(self) -> str:
        if not self._other_standard or self._source is None:
            return ""
        other, own = self._other_standard, self._source.standard
        return (
            f"the camera at {self._source.info.name} sends {other}, but the grabber is set to "
            f'{own}; set v4l2.standard = "{other}" or "auto"'
        )

    def _ask(self, now_s: float) -> None:
        if now_s - self._asked_s < states.ASK_S or self._source is None:
            return
        self._asked_s = now_s
        before, self._signal = self._signal, self._source.signal()
        own, now = self._source.standard, self._signal.standard
        # Twice the same, for a decoder that locks may err.
        other = own and now and before.standard == now and _lines(own) != _lines(now)
        self._other_standard = now if other else ""

    def _tell(self, change: Change | None) -> None:
        if change is not None:
            if change.state is State.STREAMING:
                self._mended = set()
            facts = (("state", change.state.value),)
            self._report(Event(change.severity, "state", change.text, facts=facts))


def _lines(standard: str) -> int:
    return 625 if api.STANDARDS[standard] & api.STD_625_50 else 525
