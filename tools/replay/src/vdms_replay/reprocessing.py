"""The work of `reprocess`: read, hand out, collect in order, write, and hold against the record."""

from __future__ import annotations

import contextlib
import json
import os
import platform
from collections import defaultdict, deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from dataclasses import dataclass, field
from multiprocessing import get_context
from pathlib import Path
from typing import NamedTuple, TypeAlias

import cv2
import numpy as np
from mcap.records import Attachment

import vdms_replay
import vdms_rt
from vdms_replay.account import Account
from vdms_replay.chosen import exposure_of
from vdms_replay.pieces import AsItWas, Changed, Terms
from vdms_replay.refitted import Stamps, refitted
from vdms_replay.remeasure import (
    CHECKPOINT,
    EVENT,
    PIXELS,
    SAMPLE,
    SET_UP,
    Change,
    Piece,
    Result,
    Said,
    Times,
    remeasure,
)
from vdms_replay.source import Damage, ReplayError, Source, open_log, station_of
from vdms_replay.verb import Advance
from vdms_rt.config import Lens
from vdms_rt.config.camera import lens_of_file
from vdms_rt.logfile.reader import StoredMessage
from vdms_rt.logfile.writer import LogAttachment, LogMessage, LogWriter
from vdms_rt.model import Scan
from vdms_rt.process import checkpoint
from vdms_rt.setup import SetUpError, set_up_from_json
from vdms_rt.wire import topics
from vdms_rt.wire import vdms_pb2 as pb

Work: TypeAlias = Piece | Result
TOPICS = {
    topic.message.DESCRIPTOR.full_name: topic
    for topic in (topics.RUN, topics.SETUP, topics.EVENT, topics.DISPLACEMENT, topics.TRUTH,
                  topics.END)
}  # fmt: skip
RUN, TRUTH = "vdms.Run", "vdms.Truth"
MEASURED = (PIXELS, CHECKPOINT, SET_UP)


class Settings(NamedTuple):
    """What was asked to be otherwise; None leaves it."""

    method: str | None
    sampling: str | None
    lens: Lens | None
    refit_time: bool
    other_version: bool = False
    """Where measuring stood in the recording cannot be taken over."""

    @property
    def changed(self) -> bool:
        return self != Settings(None, None, None, False)


@dataclass(slots=True)
class Known:
    """What a first look at a session has found."""

    order: Scan | None = None
    stamps: Stamps = field(default_factory=Stamps)


def read_lens(path: Path) -> Lens:
    """Return the section [lens] of a file. Raises ReplayError."""
    try:
        return lens_of_file(Lens(file=str(path)))
    except ValueError as error:
        raise ReplayError(str(error)) from None


def is_current(source: Source) -> bool:
    """Return whether the recording's first checkpoint is of this version; True without any."""
    for message in _messages(source, lambda _: None):
        if isinstance(message, _Message) and message.type == CHECKPOINT:
            return checkpoint.is_current(pb.Checkpoint.FromString(message.data).json)
    return True


def survey(source: Source, advance: Advance, *, times: bool) -> dict[int, Known]:
    """Return what the whole recording knows of each session: the proved order of its fields, and
    with `times` its stamps."""
    known: dict[int, Known] = {}
    session = 0
    for message in _messages(source, advance):
        if isinstance(message, Attachment):
            continue
        match message.type:
            case "vdms.Run":
                session = pb.Run.FromString(message.data).session
            case "vdms.SetUp":
                with contextlib.suppress(SetUpError):
                    set_up = set_up_from_json(pb.SetUp.FromString(message.data).json)
                    if set_up.order_proved:
                        known.setdefault(session, Known()).order = set_up.scan
            case "vdms.Displacement" if times:
                sample = pb.Displacement.FromString(message.data)
                known.setdefault(session, Known()).stamps.add(sample)
    return known


class Job:
    """One recording's way through."""

    def __init__(
        self,
        source: Source,
        log: LogWriter,
        account: Account,
        settings: Settings,
        known: dict[int, Known],
        advance: Advance,
    ) -> None:
        self._source, self._log, self._account = source, log, account
        self._settings, self._known, self._advance = settings, known, advance
        self._station = ""
        self._session = 0
        self._recorded: dict[str, deque[tuple[int, bool, bytes]]] = defaultdict(deque)
        """Each marker's samples that were not measured again yet: number, valid, serialised."""
        self._has_checkpoints = False
        self._begin_ns = 0
        """Of the first sample that was measured again."""
        self._sequence = 0
        self._last_ns = 0

    def work(self) -> Iterator[Work]:
        """Read the recording; copy what stays, and give what is to be measured."""
        pieces: AsItWas | Changed | None = None
        pixels = False
        for message in _messages(self._source, self._advance):
            if isinstance(message, Attachment):
                self._log.attach(
                    LogAttachment(
                        message.name, message.media_type, message.create_time, message.data
                    ),
                    message.log_time,
                )
                continue
            self._station = self._station or station_of(message.key)
            self._last_ns = message.log_time_ns
            if message.type == RUN:
                run = pb.Run.FromString(message.data)
                if pieces is None or run.session != self._session:
                    if pieces is not None:
                        yield from pieces.end()
                    pieces = self._begin(run)
            elif pieces is None:
                continue
            elif message.type in MEASURED:
                pixels = pixels or message.type == PIXELS
                self._has_checkpoints = self._has_checkpoints or message.type == CHECKPOINT
                yield from pieces.take(message.type, message.data)
            self._copy(message)
        if not pixels:
            raise ReplayError(
                f"{self._source.paths[0]}: holds no pixels, so nothing can be measured again; "
                'record with record.pixels = "regions" or "frames"'
            )
        if not self._has_checkpoints:
            raise ReplayError(
                f"{self._source.paths[0]}: holds no checkpoint to begin from, of which there is "
                "one a second; name the part before it too"
            )
        if pieces is not None:
            yield from pieces.end()

    def finish(self, result: Result) -> None:
        """Write what a piece gave, and hold it against the record."""
        account = self._account
        account.frames += result.frames
        account.unknown += result.unknown
        for said in result.said:
            self._write(said)
            if said.type == SAMPLE:
                account.samples += 1
                self._begin_ns = self._begin_ns or said.log_time_ns
                account.recorded_s = (said.log_time_ns - self._begin_ns) / 1e9
                self._hold(said)

    def end(self) -> None:
        """Count what was not measured again, and write the end."""
        account = self._account
        for waiting in self._recorded.values():
            account.without_pixels += sum(valid for _, valid, _ in waiting)
        end = pb.End(session=self._session, utc_ns=self._last_ns, reason="measured again")
        self._write(Said("vdms.End", "", 0, self._last_ns, end.SerializeToString()))

    def _hold(self, said: Said) -> None:
        """Hold a sample against the recorded one of its number; those before it have no pixels."""
        waiting = self._recorded[said.marker]
        while waiting and waiting[0][0] <= said.seq:
            seq, valid, data = waiting.popleft()
            if seq == said.seq:
                self._account.compare(data, said.data)
            else:
                self._account.without_pixels += valid

    def _begin(self, run: pb.Run) -> AsItWas | Changed:
        """Write the head of a session, and return what cuts it into pieces."""
        self._session = run.session
        config = json.loads(run.effective_config) if run.effective_config else {}
        facts = {fact.name: fact.value for fact in run.facts}
        here = _machine()
        self._account.elsewhere = [
            f"{name} {facts[name]} there, {value} here"
            for name, value in here.items()
            if facts.get(name, value) != value
        ]
        if run.version != vdms_rt.__version__:
            self._account.elsewhere.append(
                f"vdms-rt {run.version} there, {vdms_rt.__version__} here"
            )
        settings = self._settings
        section = config.setdefault("process", {})
        was = section.get("sampling", "auto")
        sampling = settings.sampling or was
        section["sampling"] = sampling
        if settings.method is not None:
            section["method"] = settings.method
        if settings.lens is not None:
            config["lens"] = settings.lens.model_dump(mode="json")
        told = ", ".join(
            text
            for text in (
                settings.method and f"method {settings.method}",
                settings.sampling and f"sampling {settings.sampling}",
                settings.lens and "another lens",
                settings.refit_time and "times refitted",
            )
            if text
        )
        run.facts.add(name="measured again", value=told or "as it was")
        run.facts.add(name="measured again by", value=f"vdms-replay {vdms_replay.__version__}")
        run.effective_config = json.dumps(config)
        self._write(Said(RUN, "", 0, run.utc_ns, run.SerializeToString()))
        known = self._known.get(run.session, Known())
        times: Times | None = None
        if settings.refit_time:
            exposure_ns = round(1e9 * exposure_of(config))
            delay_ns = round(1e6 * config.get("camera", {}).get("chain_delay_ms", 0.0))
            times = refitted(known.stamps.rows, exposure_ns, delay_ns)
        anew = settings.sampling is not None or settings.refit_time or settings.other_version
        change = Change(settings.method, settings.lens, anew, known.order, was)
        terms = Terms(run.session, sampling, change, times)
        return Changed(terms) if settings.changed else AsItWas(terms)

    def _copy(self, message: _Message) -> None:
        """Take over what measuring does not change."""
        if message.type == SAMPLE:
            if self._settings.sampling is None:
                sample = pb.Displacement.FromString(message.data)
                self._recorded[sample.marker].append((sample.seq, sample.valid, message.data))
            return
        own = (TRUTH,) if self._settings.changed else (TRUTH, SET_UP, EVENT)
        if message.type in own:
            marker = message.key.split("/")[2] if message.type == TRUTH else ""
            self._write(Said(message.type, marker, 0, message.log_time_ns, message.data))

    def _write(self, said: Said) -> None:
        topic = TOPICS[said.type]
        key = topic.key.format(station=self._station, marker=said.marker)
        self._sequence += 1
        at_ns = said.log_time_ns
        self._log.add(
            LogMessage(key, topic.message, self._sequence & 0xFFFFFFFF, at_ns, at_ns, said.data)
        )
        self._log.drain()


class _Message(NamedTuple):
    key: str
    type: str
    log_time_ns: int
    data: bytes


def _messages(source: Source, advance: Advance) -> Iterator[_Message | Attachment]:
    """Give the raw messages of ours, and attachments."""
    for path in source.paths:
        damage = source.damage[path] = Damage(path)
        with open_log(path) as reader:
            for block in reader.blocks():
                for record in block.records:
                    if isinstance(record, Attachment):
                        yield record
                    elif isinstance(record, StoredMessage) and record.schema is not None:
                        message = record.message
                        yield _Message(
                            record.channel.topic,
                            record.schema.name,
                            message.log_time,
                            message.data,
                        )
                advance(len(block.content))
            damage.complete = reader.complete
            damage.dropped_bytes = reader.dropped_bytes
            damage.faults = list(reader.faults)


def _machine() -> dict[str, str]:
    return {
        "opencv": cv2.__version__,
        "numpy": np.__version__,
        "python": platform.python_version(),
        "system": platform.platform(),
        "host": platform.node(),
    }


@contextlib.contextmanager
def measuring(jobs: int) -> Iterator[Callable[[Iterable[Work]], Iterator[Result]]]:
    """Give a function that measures pieces, in `jobs` processes, and gives the results in their
    order. A single piece is measured here."""
    with contextlib.ExitStack() as stack:

        def measure(work: Iterable[Work]) -> Iterator[Result]:
            waiting: deque[Future[Result] | Result | Piece] = deque()
            pool: ProcessPoolExecutor | None = None
            for one in work:
                if pool is None and jobs > 1 and any(isinstance(w, Piece) for w in waiting):
                    pool = stack.enter_context(_pool(jobs))
                    waiting = deque(
                        pool.submit(remeasure, w) if isinstance(w, Piece) else w for w in waiting
                    )
                waiting.append(
                    pool.submit(remeasure, one)
                    if pool is not None and isinstance(one, Piece)
                    else one
                )
                while len(waiting) > (jobs + 1 if jobs > 1 else 0):
                    yield _result(waiting.popleft())
            while waiting:
                yield _result(waiting.popleft())

        yield measure


def _result(waiting: Future[Result] | Result | Piece) -> Result:
    if isinstance(waiting, Future):
        return waiting.result()
    return remeasure(waiting) if isinstance(waiting, Piece) else waiting


@contextlib.contextmanager
def _pool(jobs: int) -> Iterator[ProcessPoolExecutor]:
    # Each process has its own core; threads of the linear algebra would only stand in their way.
    before = os.environ.get("OPENBLAS_NUM_THREADS")
    os.environ["OPENBLAS_NUM_THREADS"] = "1"
    try:
        with ProcessPoolExecutor(
            jobs, mp_context=get_context("spawn"), initializer=cv2.setNumThreads, initargs=(1,)
        ) as pool:
            yield pool
    finally:
        if before is None:
            del os.environ["OPENBLAS_NUM_THREADS"]
        else:
            os.environ["OPENBLAS_NUM_THREADS"] = before


@contextlib.contextmanager
def writing_log(path: Path, *, force: bool) -> Iterator[LogWriter]:
    """Give a log that gets its name when it is complete. Raises ReplayError."""
    if path.exists() and not force:
        raise ReplayError(f"{path}: exists; name another with --out, or overwrite it with --force")
    part = path.with_name(f"{path.name}.new")
    try:
        part.unlink(missing_ok=True)
        log = LogWriter(part)
    except OSError as error:
        raise ReplayError(
            f"{path}: cannot be written: {(error.strerror or str(error)).lower()}"
        ) from None
    done = False
    try:
        yield log
        log.close()
        part.replace(path)
        done = True
    except OSError as error:
        where = error.filename or path
        raise ReplayError(f"{where}: {(error.strerror or str(error)).lower()}") from None
    finally:
        if not done:
            log.abandon()
            log.part_path.unlink(missing_ok=True)
