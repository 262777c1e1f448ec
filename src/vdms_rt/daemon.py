"""Builds the stages, starts, supervises and joins their threads; the only place with threads."""

from __future__ import annotations

import contextlib
import logging
import os
import platform
import secrets
import signal
import sys
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np

import vdms_rt
from vdms_rt.capture.loop import Capture
from vdms_rt.config import Config, effective_values, is_live
from vdms_rt.console import Console
from vdms_rt.control.desk import Desk
from vdms_rt.control.server import ControlServer
from vdms_rt.find import Search
from vdms_rt.logfile.repair import repair_directory
from vdms_rt.model import Displacement, Event, Health, Severity, SourceInfo, State, VdmsError
from vdms_rt.notify import Notifier
from vdms_rt.outlet import Outlet
from vdms_rt.process.loop import Processor
from vdms_rt.publish import Publisher
from vdms_rt.realtime import claimed_cpu, lock_memory, scheduling, stay_on
from vdms_rt.record import Recorder
from vdms_rt.ring import Ring
from vdms_rt.setup import SetUp, SetUpError, load_set_up, save_set_up, set_up_path
from vdms_rt.status import status_line, summary
from vdms_rt.wire import convert
from vdms_rt.wire import vdms_pb2 as pb

log = logging.getLogger("vdms_rt")

HEALTH_S = 1.0
SAMPLE_RATE_HZ = 60.0
"""The most that a marker is measured with an analogue source: sizes the history for subscribers."""
STATUS_LINE_S = 0.2
RATE_WINDOW_S = 3.0
DRAIN_S = 1.5
"""For measuring what is in the ring. After it the rest is given up and counted, and what finds no
room in the recorder's queue is lost."""
REPAIR_S = 900
"""The most that completing what a power cut left of a recording may take: 2 GB on a slow disk."""
JOIN_S = 2.5
"""A stop takes less than 3 s; a thread that has not ended by then hangs, and is named."""


class Daemon:
    """One run, from its configuration to its exit status."""

    def __init__(self, config: Config, config_text: str, console: Console) -> None:
        self._console = console
        self.config = config
        self._config_text = config_text
        self._stop = threading.Event()
        self._signal = ""
        self._kept: SetUp | None = None
        self._faults: list[BaseException] = []
        self._notifier = Notifier()
        self._control: ControlServer | None = None
        self._named_source: SourceInfo | None = None
        self._fed: tuple[int, Displacement | None] = (0, None)
        self._started_s = time.monotonic()
        self._rates: deque[tuple[float, int]] = deque()
        live = is_live(config)
        self._live = live
        self._names = tuple(m.name for m in config.marker)
        self._outlet = Outlet(
            config.station.name,
            self._names,
            secrets.randbits(63),
            live=live,
            patches=config.record.pixels,
        )
        self._shared_cpu: int | None = None
        self._ring = Ring(config.process.ring_slots, live=live)
        self._search = Search([m.shape for m in config.marker])
        self._capture = Capture(
            config, self._ring, self._outlet.event, self._outlet.truth, self._idle
        )
        stored, trusted = self._stored_set_up()
        self._processor = Processor(
            config,
            self._outlet.session,
            stored,
            self._ring,
            self._search,
            self._outlet,
            trust_stored=trusted,
        )

    def run(self, seconds: float) -> int:
        """Run until a signal, the source's end or `seconds` of frames (0: no limit).

        Returns the exit status: 0 stopped, 1 failed. Raises VdmsError for what a person can mend
        before anything was measured.
        """
        self._memory_locked = lock_memory()
        with self._signals(), self._notifier, contextlib.ExitStack() as sinks:
            if self.config.source == "v4l2":
                self._shared_cpu = sinks.enter_context(claimed_cpu())
                # OpenCV's own threads, once the process thread needs them, would stay there too.
                cv2.setNumThreads(1)
            if self.config.publish.enabled:
                self._outlet.publisher = sinks.enter_context(
                    Publisher(
                        self.config.publish,
                        self.config.station.name,
                        self._names,
                        sample_rate_hz=SAMPLE_RATE_HZ,
                        control=self.config.control,
                    )
                )
            if self.config.record.enabled:
                self._outlet.recorder = self._recorder()
            if self._outlet.publisher is not None and self.config.control.enabled:
                self._control = sinks.enter_context(self._control_server(self._outlet.publisher))
            threads = self._start()
            self._notifier.ready()
            try:
                self._supervise(seconds, threads["process"])
            finally:
                self._shut(threads)
            return self._account()

    def _recorder(self) -> Recorder:
        record = self.config.record
        recorder = Recorder(
            record,
            self.config.station.name,
            self._live,
            self._run_header,
            self._run_end,
            self._outlet.event,
            passing=self.config.source == "v4l2",
        )
        self._notifier.busy(REPAIR_S)
        for repaired in repair_directory(Path(record.directory).expanduser()):
            log.warning(repaired.sentence)
        return recorder

    def _control_server(self, publisher: Publisher) -> ControlServer:
        desk = Desk(
            station=self._outlet,
            state=self._state,
            submit=self._processor.commands.submit,
            markers=self.config.marker,
            pixel_aspect=self.config.lens.pixel_aspect,
            runs=self._outlet.recorder,
            directory=Path(self.config.record.directory).expanduser(),
        )
        return ControlServer(self.config.control, self.config.station.name, publisher.session, desk)

    def _start(self) -> dict[str, threading.Thread]:
        bodies: dict[str, Callable[[], None]] = {
            "capture": lambda: self._together(self._capture.run),
            "process": lambda: self._together(self._processor.run),
            "find": lambda: self._search.run(self._stop),
        }
        if self._outlet.recorder is not None:
            bodies["record"] = self._outlet.recorder.run
        if (control := self._control) is not None:
            bodies["control"] = lambda: control.run(self._stop)
        threads = {
            name: threading.Thread(target=self._guarded, args=(body,), name=name)
            for name, body in bodies.items()
        }
        for thread in threads.values():
            thread.start()
        return threads

    def _together(self, body: Callable[[threading.Event], None]) -> None:
        """Run what hands frames over, or takes them, where the other does too: waking a thread on
        another CPU takes twice as long. A drawn or decoded frame is so much work that the two are
        better apart."""
        if self._shared_cpu is not None and not stay_on(self._shared_cpu):
            self._shared_cpu = None
        body(self._stop)

    def _guarded(self, body: Callable[[], None]) -> None:
        try:
            body()
        except BaseException as fault:  # noqa: BLE001 - kept, told and turned into the exit status
            self._faults.append(fault)
            self._stop.set()

    def _supervise(self, seconds: float, process: threading.Thread) -> None:
        """Say how things are until it is time to stop."""
        first_frame_s: float | None = None
        health_due_s = time.monotonic() + HEALTH_S
        health = self._health()
        while process.is_alive() and not self._stop.wait(STATUS_LINE_S):
            now_s = time.monotonic()
            if first_frame_s is None and self._capture.counters.captured:
                first_frame_s = now_s
            self._rates.append((now_s, self._capture.counters.captured))
            while now_s - self._rates[0][0] > RATE_WINDOW_S:
                self._rates.popleft()
            self._name_source()
            if now_s >= health_due_s:
                health_due_s += HEALTH_S
                health = self._health()
                self._outlet.health(health)
                self._notifier.status(status_line(health, self._processor.counters.newest))
            self._feed_watchdog()
            self._keep_set_up()
            self._outlet.tell()
            self._console.status(status_line(health, self._processor.counters.newest))
            since_s = self._started_s if first_frame_s is None else first_frame_s
            if seconds and now_s - since_s >= seconds:
                return

    def _name_source(self) -> None:
        """Log the head of the file once more for a grabber that was not there when it began."""
        recorder = self._outlet.recorder
        begun = recorder is not None and recorder.files
        if begun and self._capture.counters.info != self._named_source:
            self._outlet.run(self._run_header())

    def _feed_watchdog(self) -> None:
        """Tell systemd that capture went on since the last time, and process too if it had
        anything to do. How fast does not matter, so a slow machine is not taken for a hung one;
        nor does the record thread, because a disk in trouble must not end measuring."""
        capture = self._capture.counters
        turns, newest = self._fed
        captures = capture.turns != turns or capture.ended
        processes = self._processor.counters.newest is not newest or not self._ring.used
        if captures and processes:
            self._fed = (capture.turns, self._processor.counters.newest)
            self._notifier.progress()

    def _shut(self, threads: dict[str, threading.Thread]) -> None:
        """Stop in the order of the data: capture, process, record."""
        self._notifier.stopping()
        self._notifier.status(f"{State.STOPPING.value}: {self._reason()}")
        self._stop.set()
        recorder = self._outlet.recorder
        deadline_s = time.monotonic() + JOIN_S
        threads["capture"].join(JOIN_S)
        threads["process"].join(DRAIN_S)
        self._ring.drop()
        if recorder is not None:
            recorder.hurry()
        for name in ("process", "find", "control"):
            if name in threads:
                threads[name].join(max(0.0, deadline_s - time.monotonic()))
        self._keep_set_up()
        self._outlet.health(self._health())
        if recorder is not None:
            recorder.finish(self._reason())
            threads["record"].join(max(0.0, deadline_s - time.monotonic()) + 0.5)
        hanging = [name for name, thread in threads.items() if thread.is_alive()]
        if hanging:
            log.error("did not stop: %s; ending without it", ", ".join(hanging))
            for name in hanging:
                _print_stack(threads[name])
            os._exit(1)

    def _account(self) -> int:
        """Tell what there is to tell at the end and return the exit status."""
        self._outlet.tell(at_end=True)
        for fault in self._faults:
            if isinstance(fault, VdmsError):
                raise fault
            log.critical("failed, please report this:", exc_info=fault)
        health = self._health()
        recorder = self._outlet.recorder
        self._console.block(summary(health, recorder.files if recorder else ()))
        if failure := self._capture.counters.failure:
            log.error(failure)
        idle = not health.captured and not self._signal
        failed = self._faults or failure or health.record_trouble or idle
        return 1 if failed else 0

    def _idle(self) -> bool:
        """Return whether no marker was found yet."""
        return self._processor.counters.state in (State.STARTING, State.SEARCHING)

    def _stored_set_up(self) -> tuple[SetUp | None, bool]:
        """Return the set-up to begin with, and whether it holds without a look at the picture."""
        if self.config.source == "log":
            from vdms_rt.capture.log import recorded_set_up

            return recorded_set_up(self.config.log), True
        if not self.config.setup.load:
            return None, False
        try:
            return load_set_up(set_up_path(self.config.setup)), False
        except SetUpError as error:
            log.warning(error)
            return None, False

    def _keep_set_up(self) -> None:
        """Store a new set-up: here, because a slow disk must not hold up measuring."""
        set_up = self._outlet.newest_set_up
        if set_up is None or set_up is self._kept or self.config.source == "log":
            return
        self._kept = set_up
        if not self.config.setup.store:
            return
        try:
            save_set_up(set_up_path(self.config.setup), set_up)
        except SetUpError as error:
            self._outlet.event(Event(Severity.WARNING, "set-up-not-stored", str(error)))

    def _health(self) -> Health:
        capture = self._capture.counters
        clock = capture.clock
        process = self._processor.counters
        publisher = self._outlet.publisher
        record = self._outlet.recorder.counters() if self._outlet.recorder else None
        rate_hz = 0.0
        if len(self._rates) > 1:
            (then_s, then), (now_s, now) = self._rates[0], self._rates[-1]
            rate_hz = (now - then) / (now_s - then_s)
        return Health(
            session=self._outlet.session,
            utc_ns=time.time_ns(),
            uptime_s=time.monotonic() - self._started_s,
            state=self._state(),
            device=capture.info.name if capture.info else "",
            captured=capture.captured,
            missed=capture.missed,
            damaged=capture.damaged,
            repeated=capture.repeated,
            no_signal=capture.no_signal,
            overwritten=self._ring.overwritten,
            measured=process.measured,
            invalid=process.invalid,
            not_recorded=record.not_recorded if record else 0,
            pixels_left_out=record.pixels_left_out if record else 0,
            unsent=publisher.unsent if publisher else 0,
            frame_rate_hz=rate_hz,
            sample_age_ms=self._outlet.sample_age_ms(),
            ring_used=self._ring.used,
            record_queue=record.queued if record else 0,
            recording=record.file if record else "",
            record_trouble=record.trouble if record else "",
            fsync_ms=record.fsync_ms if record else 0.0,
            disk_free_bytes=record.disk_free_bytes if record else 0,
            clock_jitter_us=clock.jitter_us if clock else 0.0,
            clock_sigma_us=clock.sigma_us if clock else 0.0,
            clock_rate_ppm=clock.rate_ppm if clock else 0.0,
            utc_state=clock.utc_state if clock else "unknown",
        )

    def _state(self) -> State:
        if self._stop.is_set():
            return State.STOPPING
        capture = self._capture.counters.state
        return capture if capture is not State.STREAMING else self._processor.counters.state

    def _where(self) -> str:
        return "on any cpu" if self._shared_cpu is None else f"on cpu {self._shared_cpu}"

    def _run_header(self) -> bytes:
        info = self._named_source = self._capture.counters.info
        clock = self._capture.counters.clock
        facts = [
            ("source", info.name if info else "not open yet"),
            *(info.facts if info else ()),
            ("host", platform.node()),
            ("system", platform.platform()),
            ("scheduling", scheduling()),
            ("capture and process", self._where()),
            ("memory", "locked" if self._memory_locked else "not locked"),
            ("python", platform.python_version()),
            ("opencv", cv2.__version__),
            ("numpy", np.__version__),
            ("utc clock", clock.utc_state if clock else "unknown"),
        ]
        return pb.Run(
            session=self._outlet.session,
            utc_ns=time.time_ns(),
            version=vdms_rt.__version__,
            station=self.config.station.name,
            config_text=self._config_text,
            effective_config=effective_values(self.config),
            facts=[pb.Fact(name=name, value=value) for name, value in facts],
        ).SerializeToString()

    def _run_end(self, reason: str) -> bytes:
        return pb.End(
            session=self._outlet.session,
            utc_ns=time.time_ns(),
            reason=reason,
            health=convert.health_message(self._health()),
        ).SerializeToString()

    def _reason(self) -> str:
        if self._faults:
            return f"failed: {self._faults[0]}"
        if self._signal:
            return f"stopped by {self._signal}"
        return "the source ended" if self._capture.counters.ended else "the time was up"

    @contextlib.contextmanager
    def _signals(self) -> Iterator[None]:
        """Let SIGINT and SIGTERM stop the run in order, and a second one at once."""

        def stop(number: int, _: object) -> None:
            if self._stop.is_set():
                os.write(2, b"\nvdms-rt: forced to end\n")
                os._exit(1)
            self._signal = signal.Signals(number).name
            self._stop.set()

        before = {s: signal.signal(s, stop) for s in (signal.SIGINT, signal.SIGTERM)}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)


def _print_stack(thread: threading.Thread) -> None:
    frame = sys._current_frames().get(thread.ident or 0)
    if frame is not None:
        sys.stderr.write("".join(traceback.format_stack(frame)))
