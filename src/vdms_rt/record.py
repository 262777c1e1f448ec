"""The log: everything that was said, in an MCAP, on the disk within half a second.

`Recorder.put` is called by any thread and only queues; `Recorder.run` is the body of the record
thread, the only one that touches the disk.
"""

from __future__ import annotations

import tempfile
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from vdms_rt.backlog import Backlog
from vdms_rt.config import Record
from vdms_rt.logfile.shelf import Shelf
from vdms_rt.logfile.thin import ABOUT, KEEP_PIXELS
from vdms_rt.logfile.writer import LogAttachment, LogMessage, LogWriter
from vdms_rt.model import Event, Severity, VdmsError
from vdms_rt.wire import topics
from vdms_rt.wire import vdms_pb2 as pb
from vdms_rt.wire.topics import Topic

POLL_S = 0.05
SLOW_MS = 1000.0
"""A flush that takes longer is told."""
RETRY_S = 1.0
TELL_LOST_S = 1.0
HEADS = (topics.SETUP.message, topics.PICTURE.message)
"""Of these the newest stands at the head of each file, so that it can be read alone."""


class RecordError(VdmsError):
    """The recording directory cannot be used."""


@dataclass(frozen=True, slots=True)
class RecordCounters:
    """What the recorder has done, for `Health`."""

    recorded: int
    """Messages on the disk."""
    not_recorded: int
    """Messages that are in no file and never will be."""
    pixels_left_out: int
    """Of these the pixels, one for each frame: the disk had no room for them, or no time."""
    queued: int
    fsync_ms: float
    """The slowest flush to disk since the counters were last asked for, one under way included."""
    disk_free_bytes: int
    file: str
    """Path of the file being written (without its .part), or of the last one; empty before."""
    trouble: str
    """One sentence, or empty."""


class Recorder:
    """A bounded queue before a file.

    Behind a live source a full queue drops what comes and remembers exactly what; behind one that
    is not, `put` waits. When the disk gives trouble, recording pauses and is tried again once a
    second, with what the queue holds. All messages' log times must be of one clock.
    """

    def __init__(
        self,
        config: Record,
        station: str,
        live: bool,
        run_header: Callable[[], bytes],
        run_end: Callable[[str], bytes],
        report: Callable[[Event], None],
        *,
        passing: bool = False,
    ) -> None:
        """Make sure that the directory can be written; raises RecordError with a sentence.

        `run_header` gives a serialised `vdms.Run` for the start of each file, `run_end(reason)` a
        `vdms.End` for its end, and `report` passes an event on, also back to `put` before it
        returns. All three are called by the record thread. `passing` says that outside of the runs
        that somebody starts only the newest pixels are kept.
        """
        self._config = config
        self._station = station
        self._run_header = run_header
        self._run_end = run_end
        self._report = report
        self._passing = passing
        self._directory = Path(config.directory).expanduser().absolute()
        self._run = ""
        self._name = self._file_name()
        self._cut = ""
        self._backlog = Backlog(config.queue_messages, live)

        self._lock = threading.Lock()
        self._end_reason: str | None = None
        self._recorded = 0
        self._fsync_ms = 0.0
        self._flushing_since_s: float | None = None
        self._files: list[str] = []
        self._trouble = ""

        self._log: LogWriter | None = None
        self._unsynced: list[LogMessage] = []
        self._part = 0
        self._part_opened_s = 0.0
        self._log_time_ns = 0
        self._sync_due_s = 0.0
        self._retry_due_s = 0.0
        self._tell_lost_due_s = 0.0
        self._heads: dict[str, LogMessage] = {}
        self._attachments: dict[str, LogAttachment] = {}
        self._probe_directory()
        self._shelf = Shelf(self._directory, station, config)

    def put(self, topic: Topic, key: str, log_time_ns: int, data: bytes) -> bool:
        """Queue a serialised message; False if it was dropped, which is counted and remembered.

        Never waits behind a live source. Behind one that is not live it waits for room, unless
        the disk is in trouble or `hurry` was called.
        """
        return self._backlog.put(topic, key, log_time_ns, data)

    def attach(self, name: str, media_type: str, data: bytes) -> None:
        """Put a small file (a reference picture) into this log and at the head of all later ones.

        One of the same name takes the place of the one before.
        """
        self._backlog.attach(LogAttachment(name, media_type, time.time_ns(), data))

    @property
    def run_name(self) -> str:
        """The name of the run that somebody started, or empty."""
        return self._run

    def start_run(self, name: str) -> None:
        """Record from now on into files of their own, which carry the name of a run."""
        with self._lock:
            self._run, self._cut = name, f"run {name} begins in a file of its own"

    def stop_run(self) -> None:
        """End the run's file; what comes goes into files without a name."""
        with self._lock:
            self._run, self._cut = "", f"end of run {self._run}"

    def hurry(self) -> None:
        """From now on nobody waits in `put`."""
        self._backlog.hurry()

    def finish(self, reason: str) -> None:
        """Take no more; `run` writes what is queued, ends the file with `reason` and returns."""
        with self._lock:
            if self._end_reason is None:
                self._end_reason = reason
        self._backlog.end()

    def counters(self) -> RecordCounters:
        """Return the counters; the slowest flush is sought anew from here."""
        with self._lock:
            since_s = self._flushing_since_s
            under_way_ms = 0.0 if since_s is None else (time.monotonic() - since_s) * 1e3
            counters = RecordCounters(
                recorded=self._recorded,
                not_recorded=self._backlog.lost_messages,
                pixels_left_out=self._backlog.lost_pixels,
                queued=len(self._backlog),
                fsync_ms=max(self._fsync_ms, under_way_ms),
                disk_free_bytes=self._shelf.free_bytes,
                file=self._files[-1] if self._files else "",
                trouble=self._trouble,
            )
            self._fsync_ms = 0.0
            return counters

    @property
    def files(self) -> tuple[str, ...]:
        """Paths of the files begun so far, as they are named once they are closed."""
        with self._lock:
            return tuple(self._files)

    def run(self) -> None:
        """Write what is queued until `finish` was called and everything is on the disk.

        The body of the record thread. With the disk in trouble at the end it tries once more,
        counts what it could not write and leaves the file for the next start to repair.
        """
        failed_at_end = 0
        self._backlog.claim()
        try:
            self._look_after()
            while self._wait():
                try:
                    self._work()
                except OSError as error:
                    self._pause(error)
                    failed_at_end += self._ending
                    if failed_at_end > 1:
                        break
                self._tell_lost()
                self._look_after()
        finally:
            self._shelf.close()
            self._backlog.end()
            self._give_up()

    @property
    def _ending(self) -> bool:
        with self._lock:
            return self._end_reason is not None

    def _wait(self) -> bool:
        """Wait for something to do; False when all is done."""
        if self._trouble:
            self._backlog.wait_end(max(0.0, self._retry_due_s - time.monotonic()))
        else:
            until_due_s = max(0.0, self._sync_due_s - time.monotonic())
            self._backlog.wait_ready(min(POLL_S, until_due_s) if self._log else POLL_S)
        return not self._ending or len(self._backlog) > 0 or self._log is not None

    def _work(self) -> None:
        log = self._log
        if log is None:
            if not len(self._backlog):
                return
            log = self._log = self._open()
        elif log.sealed:
            self._close(log, "")
            return
        elif len(self._backlog) and (why := self._full(log)):
            self._close(log, why)
            return
        elif self._trouble:
            self._sync(log)
        for item in self._backlog.take():
            self._write(log, item)
        log.drain()
        if time.monotonic() >= self._sync_due_s or self._trouble:
            self._sync(log)
        if self._ending and not len(self._backlog) and not self._backlog.has_lost:
            self._close(log, self._end_reason or "")

    def _write(self, log: LogWriter, item: LogMessage | LogAttachment) -> None:
        if isinstance(item, LogAttachment):
            self._attachments[item.name] = item
            log.attach(item, self._log_time_ns)
            return
        if item.type in HEADS:
            self._heads[item.key] = item
        self._log_time_ns = max(self._log_time_ns, item.log_time_ns)
        log.add(item)
        self._unsynced.append(item)

    def _sync(self, log: LogWriter) -> None:
        # From its beginning: a slow disk must not make it rarer.
        self._sync_due_s = time.monotonic() + self._config.sync_s
        self._timed(log.sync)
        self._resume(log)

    def _timed(self, to_disk: Callable[[], None]) -> None:
        started_s = time.monotonic()
        with self._lock:
            self._flushing_since_s = started_s
        try:
            to_disk()
        finally:
            took_ms = (time.monotonic() - started_s) * 1e3
            with self._lock:
                self._flushing_since_s = None
                self._fsync_ms = max(self._fsync_ms, took_ms)
        with self._lock:
            self._recorded += len(self._unsynced)
            self._unsynced.clear()
        if took_ms >= SLOW_MS and not self._ending:
            waiting, limit = len(self._backlog), self._config.queue_messages
            text = (
                f"the disk took {took_ms / 1e3:.1f} s to store what was recorded: {waiting} "
                f"messages wait now, and nothing is lost up to {limit} (record.queue_messages)"
            )
            self._tell(Severity.WARNING, "slow-disk", text)

    def _full(self, log: LogWriter) -> str:
        """Return why what comes next belongs into the next file, or nothing."""
        if self._cut:
            return self._cut
        if time.monotonic() - self._part_opened_s >= self._config.rotate_s:
            return f"continued in the next file after {self._config.rotate_s:g} s"
        if log.length >= self._config.rotate_mb * 1e6:
            return f"continued in the next file after {self._config.rotate_mb:g} MB"
        return ""

    def _open(self) -> LogWriter:
        """Return the next file, with all at its head that makes it readable alone."""
        self._directory.mkdir(parents=True, exist_ok=True)
        with self._lock:
            if self._cut:
                self._cut, self._name, self._part = "", self._file_name(), 0
        log = self._create()
        self._log_time_ns = self._backlog.first_log_time_ns(self._log_time_ns)
        header = self._run_header()
        log.add_metadata(ABOUT, self._metadata(header))
        for attachment in self._attachments.values():
            log.attach(attachment, self._log_time_ns)
        log.add(self._own(topics.RUN, header))
        for head in self._heads.values():
            log.add(replace(head, log_time_ns=self._log_time_ns))
        self._part_opened_s = time.monotonic()
        self._sync_due_s = 0.0
        with self._lock:
            self._files.append(str(log.path))
        self._tell(
            Severity.INFO, "recording", f"recording into {log.path}", ("file", str(log.path))
        )
        return log

    def _file_name(self) -> str:
        named = f"_{self._run}" if self._run else ""
        return f"{self._station}_{time.strftime('%Y%m%dT%H%M%SZ', time.gmtime())}{named}"

    def _create(self) -> LogWriter:
        part = self._part
        while True:
            part += 1
            try:
                log = LogWriter(self._directory / f"{self._name}_{part:03}.mcap")
            except (FileExistsError, BlockingIOError):
                continue
            self._part = part
            return log

    def _metadata(self, header: bytes) -> dict[str, str]:
        run = pb.Run.FromString(header)
        return {fact.name: fact.value for fact in run.facts} | {
            "version": run.version,
            "station": run.station,
            "session": f"{run.session:016x}",
            "run": self._run,
            "part": str(self._part),
            KEEP_PIXELS: "newest" if self._passing and not self._run else "always",
        }

    def _own(self, topic: Topic, data: bytes) -> LogMessage:
        key = topic.key.format(station=self._station)
        time_ns = self._log_time_ns
        return LogMessage(key, topic.message, self._part, time_ns, time_ns, data)

    def _close(self, log: LogWriter, reason: str) -> None:
        if not log.sealed:
            log.add(self._own(topics.END, self._run_end(reason)))
            log.sealed = True
        self._sync(log)
        self._timed(log.close)
        self._log = None

    def _pause(self, error: OSError) -> None:
        """Tell the trouble once; what a broken file did not keep goes back to the queue."""
        if self._log is not None and self._log.broken:
            self._log.abandon()
            self._log = None
            in_head = [id(head) for head in self._heads.values()]
            self._backlog.put_back([m for m in self._unsynced if id(m) not in in_head])
            self._unsynced.clear()
        where = error.filename or (self._log.part_path if self._log else self._directory)
        sentence = (
            f"recording pauses: {where}: {_reason(error)}; measuring goes on, and recording will "
            "by itself once the disk takes data again"
        )
        self._retry_due_s = time.monotonic() + RETRY_S
        with self._lock:
            told = bool(self._trouble)
            self._trouble = sentence
        self._backlog.pause(True)
        if not told:
            self._tell(Severity.ERROR, "record-trouble", sentence)

    def _resume(self, log: LogWriter) -> None:
        with self._lock:
            if not self._trouble:
                return
            self._trouble = ""
        self._backlog.pause(False)
        if not (log.sealed and self._ending):  # no file comes that could say it
            self._tell(Severity.INFO, "record-resumed", "recording again")

    def _give_up(self) -> None:
        """Leave nothing open, and count what is in no file."""
        if self._log is not None:
            self._log.abandon()
            self._log = None
        self._backlog.put_back(self._unsynced)
        self._unsynced = []
        self._backlog.lose_all()
        self._tell_lost()

    def _tell_lost(self) -> None:
        """At a fixed pace, not while the disk is in trouble: it would take no event either."""
        now_s = time.monotonic()
        if not self._ending and (self._trouble or now_s < self._tell_lost_due_s):
            return
        if lost := self._backlog.take_lost():
            self._tell_lost_due_s = now_s + TELL_LOST_S
            what = "; ".join(f"{text} of {key}" for key, text in lost)
            self._tell(Severity.WARNING, "not-recorded", f"not recorded: {what}", *lost)

    def _look_after(self) -> None:
        """See to the room on the disk; not at the end, when no file comes that could say it."""
        if self._ending:
            return
        log = self._log
        notices = self._shelf.turn(log.path if log else None, log.length if log else 0)
        self._backlog.spare(self._shelf.tight)
        for notice in notices:
            self._tell(notice.severity, notice.code, notice.text)

    def _tell(self, severity: Severity, code: str, text: str, *facts: tuple[str, str]) -> None:
        self._report(Event(severity, code, text, time.monotonic_ns(), time.time_ns(), facts))

    def _probe_directory(self) -> None:
        try:
            self._directory.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=self._directory):
                pass
        except OSError as error:
            file = self._directory.is_file()
            raise RecordError(
                f"record.directory = {self._directory}: "
                f"{'is a file' if file else f'cannot be written: {_reason(error)}'}; "
                "name a directory that this user may write, or set record.enabled = false"
            ) from None


def _reason(error: OSError) -> str:
    return (error.strerror or str(error)).lower()
