"""The capture thread: opens the source, again and again if need be, and fills the ring."""

from __future__ import annotations

import dataclasses
import threading
from collections.abc import Callable
from dataclasses import dataclass

from vdms_rt.capture.clock import ClockFigures, FrameClock
from vdms_rt.capture.source import Source, open_source
from vdms_rt.config import Config
from vdms_rt.model import (
    Damage,
    Event,
    Frame,
    Grab,
    Severity,
    SourceEnded,
    SourceError,
    SourceInfo,
    State,
    Tick,
    Truth,
)
from vdms_rt.ring import Ring, RingClosed

READ_TIMEOUT_S = 0.5
"""How long a read may last, so that a stop is prompt."""
RETRY_S = 1.0
"""Between two tries to open a source: a replugged device is in use again within two seconds."""
NO_FRAMES_S = 2.0
"""Without a frame for so long the state is `no signal`: 60 frame periods are no hiccup."""
REOPEN_S = 10.0
"""Without a frame for so long the source is closed and opened: some drivers stall for good when the
camera is switched off and on."""


@dataclass(slots=True)
class CaptureCounters:
    """Written by the capture thread alone, read by the supervisor."""

    state: State = State.STARTING
    info: SourceInfo | None = None
    captured: int = 0
    damaged: int = 0
    """Short or flagged by the driver."""
    repeated: int = 0
    no_signal: int = 0
    ended: bool = False
    """The source is not live and has given its last frame, or could not be opened."""
    failure: str = ""
    """Why a source that is not live gave up; one sentence."""
    missed: int = 0
    clock: ClockFigures | None = None
    turns: int = 0
    """Goes up at least every two seconds while the thread is well, frames or none: what hangs in
    a driver's call stands still, whatever the state says."""


class Capture:
    """From a source to the ring."""

    def __init__(
        self,
        config: Config,
        ring: Ring,
        report: Callable[[Event], None],
        on_truth: Callable[[Truth], None],
    ) -> None:
        self.counters = CaptureCounters()
        self._config = config
        self._ring = ring
        self._report = report
        self._on_truth = on_truth
        self._again = config.source == "v4l2"
        """A device comes back; a file that cannot be read is not better a second later."""
        self._clock: FrameClock | None = None
        self._clock_for: object = None
        self._exposure_ns = 0
        self._first_index = 0
        self._first_segment = 0
        self._missed_before = 0
        self._last = Tick(-1, 0, 0, 0, 0)
        self._told = ""

    def run(self, stop: threading.Event) -> None:
        """Fill the ring until `stop` is set or the source ends, then close it: the body of the
        capture thread. A device that fails is opened again for ever."""
        try:
            while not stop.is_set() and not self.counters.ended:
                self.counters.turns += 1
                source = self._open(stop)
                if source is not None:
                    try:
                        self._fill(source, stop)
                    finally:
                        source.close()
        finally:
            self._ring.close()

    def _open(self, stop: threading.Event) -> Source | None:
        try:
            source = open_source(self._config, self._on_truth)
        except SourceError as error:
            if not self._again:
                self.counters.ended = True
                self.counters.failure = str(error)
                return None
            self._tell(State.NO_DEVICE, Severity.ERROR, str(error))
            stop.wait(RETRY_S)
            return None
        info = source.info
        self._ring.fit(info.height_px, info.width_px)
        self._fit_clock(info)
        facts = (
            ("source", info.name),
            ("size", f"{info.width_px} x {info.height_px} px"),
            ("rate", f"{float(1 / info.frame_period_s):.3f} frames/s"),
            ("scan", info.scan.name.lower().replace("_", " ")),
            *info.facts,
        )
        self.counters.info = info
        self.counters.state = State.STARTING
        self._told = ""
        text = f"opened {info.name}: " + ", ".join(f"{n} {v}" for n, v in facts[1:4])
        self._report(Event(Severity.INFO, "source", text, facts=facts))
        return source

    def _fill(self, source: Source, stop: threading.Event) -> None:
        silent_s = 0.0
        while not stop.is_set():
            self.counters.turns += 1
            try:
                slot = self._ring.begin(READ_TIMEOUT_S)
            except RingClosed:
                return
            if slot is None:
                continue
            try:
                grab = source.read(slot.image, READ_TIMEOUT_S)
            except SourceEnded as end:
                self._ring.abandon(slot)
                self.counters.ended = True
                self._report(Event(Severity.INFO, "source-ended", str(end)))
                return
            except SourceError as error:
                self._ring.abandon(slot)
                self._lost(error)
                stop.wait(RETRY_S if self._again else 0)
                return
            if grab is None:
                self._ring.abandon(slot)
                silent_s += READ_TIMEOUT_S
                if silent_s >= REOPEN_S:
                    return
                if silent_s >= NO_FRAMES_S:
                    text = (
                        f"{source.info.name} gives no frames; look whether the camera is on and "
                        "its cable is in the grabber's chosen input"
                    )
                    self._tell(State.NO_SIGNAL, Severity.ERROR, text)
                continue
            silent_s = 0.0
            self.counters.captured += 1
            if grab.damage is not Damage.NONE:
                self.counters.damaged += 1
            self._tell(State.STREAMING, Severity.INFO, f"frames come from {source.info.name}")
            tick = grab.tick or self._tick(grab)
            self._ring.commit(
                slot,
                Frame(
                    seq=tick.index,
                    stamp_ns=grab.stamp_ns,
                    t_ns=tick.t_ns,
                    sigma_t_ns=tick.sigma_t_ns,
                    utc_ns=tick.utc_ns,
                    segment=tick.segment,
                    period_ns=self._period_ns(source.info),
                    image=slot.view,
                    scan=grab.scan,
                    damage=grab.damage,
                    exposure_ns=self._exposure_ns,
                    order_known=source.info.scan_known,
                ),
            )

    def _fit_clock(self, info: SourceInfo) -> None:
        """Keep the clock for a source that comes back as it was; else go on with a new one."""
        self._exposure_ns = (
            round(self._config.camera.exposure_ms * 1e6)
            if info.exposure_ns is None
            else info.exposure_ns
        )
        kind = (info.kind, info.frame_period_s, info.scan, info.stamp_event)
        if kind == self._clock_for:
            return
        self._clock_for = kind
        self._first_index = self._last.index + 1
        self._first_segment = self._last.segment + 1 if self._clock else 0
        self._missed_before = self.counters.missed
        self._clock = FrameClock(
            info, self._exposure_ns, round(self._config.camera.chain_delay_ms * 1e6)
        )

    def _tick(self, grab: Grab) -> Tick:
        clock = self._clock
        assert clock is not None
        tick = clock.tick(grab.stamp_ns, grab.sequence, grab.scan)
        for event in clock.take_events():
            self._report(event)
        self._last = dataclasses.replace(
            tick,
            index=tick.index + self._first_index,
            segment=tick.segment + self._first_segment,
        )
        self.counters.clock = clock.figures
        self.counters.missed = self._missed_before + clock.figures.missed
        return self._last

    def _period_ns(self, info: SourceInfo) -> int:
        """Return the frame period: what the stamps show, or else what the source says."""
        shown = self._clock.period_ns if self._clock is not None and self._last.index >= 0 else None
        return round(info.frame_period_s * 1_000_000_000 if shown is None else shown)

    def _lost(self, error: SourceError) -> None:
        if not self._again:
            self.counters.ended = True
            self.counters.failure = str(error)
            return
        self._tell(State.LOST, Severity.ERROR, str(error))

    def _tell(self, state: State, severity: Severity, text: str) -> None:
        """Enter a state and say so, once for each sentence."""
        self.counters.state = state
        if text != self._told:
            self._told = text
            self._report(Event(severity, "state", text, facts=(("state", state.value),)))
