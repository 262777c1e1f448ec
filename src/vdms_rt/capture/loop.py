"""The capture thread: opens the source, again and again if need be, and fills the ring."""

from __future__ import annotations

import dataclasses
import threading
from collections.abc import Callable
from dataclasses import dataclass

from vdms_rt.capture.clock import ClockFigures, FrameClock
from vdms_rt.capture.device import Device
from vdms_rt.capture.source import Source, open_source
from vdms_rt.config import Config
from vdms_rt.model import (
    Damage,
    Event,
    Frame,
    Grab,
    Luma,
    Severity,
    SourceEnded,
    SourceError,
    SourceInfo,
    State,
    Tick,
    Truth,
)
from vdms_rt.ring import Ring, RingClosed, Slot

READ_TIMEOUT_S = 0.5
"""How long a read may last, so that a stop is prompt."""


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
        idle: Callable[[], bool],
    ) -> None:
        """`idle` tells whether nothing is measured yet, so that another device may be used."""
        self.counters = CaptureCounters()
        self._config = config
        self._ring = ring
        self._report = report
        self._on_truth = on_truth
        self._device: Device | None = None
        """A device comes back; a file that cannot be read is not better a second later."""
        if config.source == "v4l2":
            self._device = Device(config.v4l2, report, idle)
        self._clock: FrameClock | None = None
        self._clock_for: object = None
        self._exposure_ns = 0
        self._first_index = 0
        self._first_segment = 0
        self._missed_before = 0
        self._last = Tick(-1, 0, 0, 0, 0)

    def run(self, stop: threading.Event) -> None:
        """Fill the ring until `stop` is set or the source ends, then close it: the body of the
        capture thread. A device that fails is opened again for ever."""
        try:
            while not stop.is_set() and not self.counters.ended:
                self.counters.turns += 1
                source = self._open()
                if source is not None:
                    try:
                        self._fill(source, stop)
                    finally:
                        source.close()
                if self._device is not None:
                    self._recover(self._device, stop)
        finally:
            self._ring.close()

    def _recover(self, device: Device, stop: threading.Event) -> None:
        """Get a device that was closed, or could not be opened, ready to be opened again."""
        if not device.mend() and device.state in (State.NO_DEVICE, State.LOST, State.STALLED):
            device.wait(stop)

    def _open(self) -> Source | None:
        source: Source | None
        if self._device is not None:
            source = self._device.open()
            self.counters.state = self._device.state
            if source is None:
                return None
        else:
            try:
                source = open_source(self._config, self._on_truth)
            except SourceError as error:
                self.counters.ended = True
                self.counters.failure = str(error)
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
        text = f"opened {info.name}: " + ", ".join(f"{n} {v}" for n, v in facts[1:4])
        self._report(Event(Severity.INFO, "source", text, facts=facts))
        return source

    def _fill(self, source: Source, stop: threading.Event) -> None:
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
                self._failed(error)
                return
            damage = self._judge(slot.image, grab)
            if grab is None:
                self._ring.abandon(slot)
            else:
                self._commit(source, slot, grab, damage)
            if self._device is not None and self._device.due():
                return

    def _judge(self, image: Luma, grab: Grab | None) -> Damage:
        """Return what is wrong with an image, and take the state that it shows."""
        if self._device is None:
            self.counters.state = State.STREAMING
            return grab.damage if grab else Damage.NONE
        damage = Damage.NONE
        if grab is None:
            self._device.silence()
        else:
            damage = grab.damage | self._device.frame(image, grab)
        self.counters.state = self._device.state
        return damage

    def _commit(self, source: Source, slot: Slot, grab: Grab, damage: Damage) -> None:
        """Count a frame, give it its time and hand it on."""
        self.counters.captured += 1
        if damage & (Damage.FLAGGED | Damage.SHORT):
            self.counters.damaged += 1
        elif damage & Damage.NO_SIGNAL:
            self.counters.no_signal += 1
        elif damage & Damage.REPEATED:
            self.counters.repeated += 1
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
                damage=damage,
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

    def _failed(self, error: SourceError) -> None:
        if self._device is None:
            self.counters.ended = True
            self.counters.failure = str(error)
            return
        self._device.failed(error)
        self.counters.state = self._device.state
