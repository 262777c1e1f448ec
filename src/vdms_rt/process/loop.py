"""The process thread: frames in, displacements out; all that measures is in `step`."""

from __future__ import annotations

import dataclasses
import threading
import time
from collections import deque
from collections.abc import Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from vdms_rt.command import Applied, Look, Refused, Snapshot
from vdms_rt.config import Config
from vdms_rt.measure.gate import Workspace
from vdms_rt.measure.regions import with_read
from vdms_rt.model import (
    Displacement,
    Event,
    FoundMarker,
    Frame,
    Luma,
    MarkerShape,
    Picture,
    Region,
    Scan,
    Severity,
    State,
    Status,
)
from vdms_rt.process.checkpoint import checkpoint
from vdms_rt.process.commands import ZERO_SAMPLES, Mailbox, changed, with_axes
from vdms_rt.process.pictures import pictures
from vdms_rt.process.progress import Phase, Plan, Progress
from vdms_rt.process.step import begin, found, step, trusted
from vdms_rt.process.zero import zeroed
from vdms_rt.ring import Lease, Ring, RingClosed
from vdms_rt.setup import SetUp, mismatch

SEARCH_S = 0.5
"""Least time between two searches: they cost a quarter of a core at this pace."""
TAKE_TIMEOUT_S = 0.2
REHEARSAL_NS = 1_000_000
"""How long before a frame is due: it may come a little early, and little must cool down again."""
CHECKPOINT_NS = 1_000_000_000
"""Between two checkpoints: the most that cannot be measured again with the same numbers from a
file that begins in the middle of a run."""


class Outlet(Protocol):
    """Where the process thread hands things on; none of these waits behind a live source."""

    def displacement(self, sample: Displacement) -> None: ...

    def event(self, event: Event) -> None: ...

    def set_up(self, set_up: SetUp, image: Luma) -> None: ...

    def checkpoint(self, picture: Picture, revision: int, text: str) -> None: ...

    def pixels(
        self, frame: Frame, regions: tuple[tuple[Region, ...], ...], revision: int
    ) -> None: ...

    def rehearse(self) -> None: ...


class Search(Protocol):
    """The search for markers in a picture, which goes on elsewhere."""

    shapes: Sequence[MarkerShape]

    @property
    def busy(self) -> bool: ...

    def ask(self, image: Luma, scan: Scan) -> bool: ...

    def answer(self, timeout_s: float = 0.0) -> tuple[FoundMarker, ...] | None: ...


@dataclass(slots=True)
class ProcessCounters:
    """Written by the process thread alone, read by the supervisor."""

    state: State = State.STARTING
    measured: int = 0
    invalid: int = 0
    newest: Displacement | None = None
    """Of the first marker that moves."""


class Processor:
    """The loop around `step`: takes frames, asks the search, hands displacements on."""

    def __init__(
        self,
        config: Config,
        session: int,
        stored: SetUp | None,
        ring: Ring,
        search: Search,
        outlet: Outlet,
        *,
        trust_stored: bool = False,
    ) -> None:
        self.counters = ProcessCounters()
        self._plan = Plan.of(config)
        names = [s.name for s in self._plan.shapes if not s.fixed] or [self._plan.shapes[0].name]
        self._shown = names[0]
        self._sampling = config.process.sampling
        self._session = session
        self._stored = stored and with_axes(stored, self._plan.axes_deg)
        self._trust = trust_stored
        self._ring = ring
        self._search = search
        self._outlet = outlet
        self._progress: Progress | None = None
        self._checkpoint_ns = 0
        self._due_ns = 0
        self._asked_ns: int | None = None
        self._told_missing = False
        self._work = Workspace()
        self.commands = Mailbox()
        self._recent: dict[str, deque[Displacement]] = {
            shape.name: deque(maxlen=ZERO_SAMPLES) for shape in self._plan.shapes
        }
        self._old_search = False
        if stored is not None and not trust_stored and (why := mismatch(stored, config)):
            outlet.event(
                Event(Severity.WARNING, "set-up-ignored", f"the stored set-up is ignored: {why}")
            )
            self._stored = None

    def run(self, stop: threading.Event) -> None:
        """Measure until the ring is closed and empty: the body of the process thread.

        `stop` is only looked at by what waits for a search; the ring's end is what ends the loop.
        """
        while True:
            try:
                lease = self._take()
            except RingClosed:
                return
            if lease is None:
                continue
            with lease as frame:
                self._measure(frame, stop)

    def _take(self) -> Lease | None:
        """Return a lease of the next frame, or None if none came in time.

        Behind a live source it wakes once shortly before, for nothing: what has lain still since
        the frame before has left the CPU's caches, and the first sample would wait for it.
        """
        lease = None
        until_rehearsal_ns = self._due_ns - REHEARSAL_NS - time.monotonic_ns()
        if until_rehearsal_ns > 0:
            lease = self._ring.take(until_rehearsal_ns / 1e9)
            if lease is None:
                self._outlet.rehearse()
        if lease is None:
            lease = self._ring.take(TAKE_TIMEOUT_S)
        if lease is not None and self._ring.live:
            period_ns = min(lease.frame.period_ns, round(TAKE_TIMEOUT_S * 1e9))
            self._due_ns = time.monotonic_ns() + period_ns
        return lease

    def _measure(self, frame: Frame, stop: threading.Event) -> None:
        progress, looks = self._commanded(self._progress_for(frame), frame)
        samples: tuple[Displacement, ...] = ()
        self._work.read.clear()
        for picture in pictures(frame, self._sampling, progress.order):
            if progress.searched:
                progress = self._searched(progress, picture, stop)
            self._keep(progress, picture)
            before = progress.set_up
            progress, samples, events = step(progress, picture, self._work)
            self._progress = progress
            samples = zeroed(progress, samples)
            for sample in samples:
                self._count(sample)
                self._outlet.displacement(sample)
            if progress.set_up is not None and progress.set_up is not before:
                self._outlet.set_up(progress.set_up, frame.image)
            for event in events:
                self._outlet.event(_at(event, picture))
        seen = with_read(progress.regions, self._work.read)
        self._outlet.pixels(frame, seen, progress.revision)
        self.counters.state = progress.state
        for look in looks:
            look.set_result(_snapshot(frame, progress, samples))

    def _keep(self, progress: Progress, picture: Picture) -> None:
        """Say where the run stands, before the picture is measured: after whatever else than a step
        has changed it, and now and then while measuring."""
        since_ns = picture.t_ns - self._checkpoint_ns
        due = progress.phase in (Phase.MEASURING, Phase.STALE) and not 0 <= since_ns < CHECKPOINT_NS
        if due or progress is not self._progress:
            self._checkpoint_ns = picture.t_ns
            self._outlet.checkpoint(picture, progress.revision, checkpoint(progress))

    def _commanded(
        self, progress: Progress, frame: Frame
    ) -> tuple[Progress, list[Future[Applied | Snapshot]]]:
        """Carry out the commands that wait, and return those that only want to see the frame."""
        looks = []
        while (waiting := self.commands.take()) is not None:
            command, answer = waiting
            if isinstance(command, Look):
                looks.append(answer)
                continue
            first = pictures(frame, self._sampling, progress.order)[0]
            try:
                after, text = changed(progress, command, first, self._recent)
            except Refused as refused:
                answer.set_exception(refused)
                continue
            if after.phase is Phase.SEARCHING and progress.phase is not Phase.SEARCHING:
                self._old_search, self._asked_ns = self._search.busy, None
            if after.plan.shapes != progress.plan.shapes:
                self._search.shapes = after.plan.shapes
            if after.set_up is not None and after.set_up is not progress.set_up:
                self._outlet.set_up(after.set_up, frame.image)
            progress = after
            answer.set_result(Applied(first.seq, text))
        return progress, looks

    def _progress_for(self, frame: Frame) -> Progress:
        height_px, width_px = frame.image.shape
        if frame.scan in (Scan.TOP, Scan.BOTTOM):
            height_px *= 2
        now = self._progress
        if now is not None and (now.width_px, now.height_px) == (width_px, height_px):
            return now
        revision = now.revision if now else 0
        plan = dataclasses.replace(now.plan, regions=self._plan.regions) if now else self._plan
        if now is not None:
            text = f"pictures are now {width_px} x {height_px} px; a new reference is needed"
            self._outlet.event(Event(Severity.WARNING, "size-changed", text))
        progress = begin(
            plan,
            self._session,
            width_px,
            height_px,
            revision,
            self._stored,
            frame.exposure_ns,
            frame.period_ns,
        )
        if self._trust and progress.phase is Phase.CHECKING:
            progress = trusted(progress)
        if progress.set_up is not None:
            self._outlet.set_up(progress.set_up, frame.image)
        return progress

    def _searched(self, progress: Progress, picture: Picture, stop: threading.Event) -> Progress:
        """Ask for a search and apply an answer. A source that is not live waits for the answer, so
        that each run on it is the same."""
        due = self._asked_ns is None or picture.t_ns - self._asked_ns >= SEARCH_S * 1e9
        if due and not picture.damage and self._search.ask(picture.image, picture.scan):
            self._asked_ns = picture.t_ns
        answer = self._search.answer()
        while answer is None and not self._ring.live and self._search.busy and not stop.is_set():
            answer = self._search.answer(TAKE_TIMEOUT_S)
        if answer is not None and self._old_search:
            # It is of a picture from before a command that made its question void.
            self._old_search, self._asked_ns, answer = False, None, None
        if answer is None:
            return progress
        progress, events = found(progress, answer, self._asked_ns or picture.t_ns)
        if progress.phase is Phase.SEARCHING and not self._told_missing:
            events = (*events, _missing(self._plan, answer))
        self._told_missing = progress.phase is Phase.SEARCHING
        for event in events:
            self._outlet.event(_at(event, picture))
        return progress

    def _count(self, sample: Displacement) -> None:
        if sample.valid:
            self.counters.measured += 1
        elif not sample.status & Status.SET_UP:
            self.counters.invalid += 1
        if sample.marker == self._shown:
            self.counters.newest = sample
        self._recent[sample.marker].append(sample)


def _at(event: Event, picture: Picture) -> Event:
    return dataclasses.replace(event, t_ns=picture.t_ns, utc_ns=picture.utc_ns)


def _snapshot(frame: Frame, progress: Progress, samples: tuple[Displacement, ...]) -> Snapshot:
    return Snapshot(
        image=np.array(frame.image),
        scan=frame.scan,
        seq=samples[0].seq,
        t_ns=samples[0].t_ns,
        utc_ns=samples[0].utc_ns,
        state=progress.state,
        width_px=progress.width_px,
        height_px=progress.height_px,
        regions=progress.regions,
        samples=samples,
    )


def _missing(plan: Plan, markers: Sequence[FoundMarker]) -> Event:
    seen = {m.name for m in markers}
    names = ", ".join(shape.name for shape in plan.shapes if shape.name not in seen)
    text = (
        f"no marker in sight: looking for {names}. All of its circles must be in the picture, "
        "sharp, lit and not covered"
    )
    return Event(Severity.WARNING, "no-marker", text)
