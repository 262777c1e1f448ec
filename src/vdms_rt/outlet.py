"""Everything said in a run goes through here: encoded once, the same bytes to network and log."""

from __future__ import annotations

import logging
import math
import threading
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace

from vdms_rt import codec
from vdms_rt.model import Displacement, Event, Frame, Health, Luma, Picture, Region, Severity, Truth
from vdms_rt.publish import Publisher
from vdms_rt.record import Recorder
from vdms_rt.report import set_up_report
from vdms_rt.setup import SetUp, set_up_json
from vdms_rt.wire import convert, topics
from vdms_rt.wire import vdms_pb2 as pb
from vdms_rt.wire.topics import Topic

log = logging.getLogger("vdms_rt")

LEVELS = {
    Severity.INFO: logging.INFO,
    Severity.WARNING: logging.WARNING,
    Severity.ERROR: logging.ERROR,
}

TOLD_OF_A_CODE = 3
TELL_S = 10.0
"""After so long, the events of one code beyond the first few are told in one line, and as long as
they go on in one line for twice as long each time: a bad cable may lose frames many times a second,
for hours. The recording has them one by one."""
TELL_LONGEST_S = 600.0
RECENT = 3600
"""Samples of each marker that are kept for questions about the last minute."""


@dataclass(slots=True)
class _Telling:
    """What was said to the console of one code lately."""

    since_s: float
    lasts_s: float = TELL_S
    told: int = 0
    held: int = 0
    """Events not told yet."""
    newest: Event | None = None
    """Of those."""


class Outlet:
    """Used by all threads. Sinks are attached before the threads start."""

    def __init__(
        self, station: str, markers: tuple[str, ...], session: int, *, live: bool, patches: str
    ) -> None:
        self.publisher: Publisher | None = None
        self.recorder: Recorder | None = None
        self._station = station
        self.session = session
        self._markers = markers
        self.newest_set_up: SetUp | None = None
        self.newest_set_up_message: pb.SetUp | None = None
        self.newest_health: pb.Health | None = None
        self._recent: dict[str, deque[Displacement]] = {m: deque(maxlen=RECENT) for m in markers}
        self._live = live
        self._patches = patches
        self._utc_offset_ns = time.time_ns() - time.monotonic_ns()
        self._newest_ns = 0
        self._untold: deque[Event] = deque(maxlen=1000)
        self._tellings: dict[str, _Telling] = {}
        self._lock = threading.Lock()
        self._age_sum_ms = 0.0
        self._age_count = 0

    def now_ns(self) -> int:
        """Return the log time of what happens now: UTC, or behind a source that is not live the
        time of the newest sample, so that a file has one clock."""
        return time.time_ns() if self._live else self._newest_ns

    def displacement(self, sample: Displacement) -> None:
        """Say one sample."""
        self._newest_ns = sample.utc_ns or sample.t_ns
        self._say(
            topics.DISPLACEMENT,
            sample.marker,
            self._newest_ns,
            convert.displacement_bytes(sample),
        )
        self._recent[sample.marker].append(sample)
        if self._live:
            with self._lock:
                self._age_sum_ms += (time.monotonic_ns() - sample.t_ns) / 1e6
                self._age_count += 1

    def rehearse(self) -> None:
        """Go the way of a sample once more without saying anything, so that the next goes it
        quickly."""
        if newest := self._recent[self._markers[0]]:
            convert.displacement_bytes(newest[-1])

    def recent(self, marker: str) -> Sequence[Displacement]:
        """Return a marker's last samples, the newest last; any thread may ask."""
        return self._recent[marker].copy()

    def sample_age_ms(self) -> float:
        """Return the mean age of the samples since the last call, NaN without any."""
        with self._lock:
            mean = self._age_sum_ms / self._age_count if self._age_count else math.nan
            self._age_sum_ms, self._age_count = 0.0, 0
        return mean

    def truth(self, truth: Truth) -> None:
        """Say where the virtual table's sheet really was."""
        at_ns = truth.t_ns + self._utc_offset_ns if self._live else truth.t_ns
        self._say(topics.TRUTH, truth.marker, at_ns, convert.truth_bytes(truth))

    def event(self, event: Event) -> None:
        """Say that something happened: to network and log now, to the console by `tell`."""
        if not event.utc_ns and not event.t_ns:
            event = replace(event, utc_ns=self.now_ns())
        self._untold.append(event)
        self._say(
            topics.EVENT,
            "",
            event.utc_ns or event.t_ns,
            convert.event_bytes(event, self.session),
        )

    def tell(self, *, at_end: bool = False) -> None:
        """Write what happened since the last call to the console, which may make its writer wait;
        so no stage does it, but the supervisor. Every change of state; of many other events of
        one code the first few, and from time to time, or `at_end`, how many more."""
        now_s = time.monotonic()
        while self._untold:
            event = self._untold.popleft()
            telling = self._tellings.setdefault(event.code, _Telling(now_s))
            if telling.told < TOLD_OF_A_CODE or event.code == "state":
                telling.told += 1
                log.log(LEVELS[event.severity], event.text)
            else:
                telling.held += 1
                telling.newest = event
            if event.code == "reference" and self.newest_set_up is not None:
                self._tell_set_up(self.newest_set_up)
        for code, telling in list(self._tellings.items()):
            if at_end or now_s - telling.since_s >= telling.lasts_s:
                self._tell_held(code, telling, now_s)

    def _tell_held(self, code: str, telling: _Telling, now_s: float) -> None:
        newest = telling.newest
        if newest is None:
            del self._tellings[code]
            return
        log.log(
            LEVELS[newest.severity],
            "%s (the last of %d more such events, %s, in %.0f s)",
            newest.text,
            telling.held,
            code,
            now_s - telling.since_s,
        )
        telling.since_s, telling.lasts_s = now_s, min(2 * telling.lasts_s, TELL_LONGEST_S)
        telling.held, telling.newest = 0, None

    def _tell_set_up(self, set_up: SetUp) -> None:
        advised = any(m.aim is not None and m.aim.advice for m in set_up.markers)
        log.log(logging.WARNING if advised else logging.INFO, set_up_report(set_up))

    def set_up(self, set_up: SetUp, image: Luma) -> None:
        """Say the set-up now in force; `image` is a picture taken with it, which is kept where the
        reference is new: then it shows the reference pose."""
        before, self.newest_set_up = self.newest_set_up, set_up
        message = pb.SetUp(
            session=self.session,
            utc_ns=set_up.utc_ns,
            revision=set_up.revision,
            json=set_up_json(set_up),
            report=set_up_report(set_up),
            aims=[convert.aim_message(m.aim) for m in set_up.markers if m.aim is not None],
        )
        self.newest_set_up_message = message
        self._say(topics.SETUP, "", self.now_ns(), message.SerializeToString())
        if self.recorder is not None and not _same_reference(before, set_up):
            png = codec.png(image)
            self.recorder.attach("reference.png", "image/png", png)
            now_ns = self.now_ns()
            self._say(topics.PICTURE, "", now_ns, convert.picture_bytes(png, now_ns, self._station))

    def checkpoint(self, picture: Picture, revision: int, text: str) -> None:
        """Log where measuring stands just before a picture."""
        if self.recorder is None or self._patches == "none":
            return
        message = pb.Checkpoint(
            session=self.session,
            seq=picture.seq,
            t_ns=picture.t_ns,
            setup_revision=revision,
            json=text,
        )
        at_ns = picture.utc_ns or picture.t_ns
        self._say(topics.CHECKPOINT, "", at_ns, message.SerializeToString())

    def pixels(
        self,
        frame: Frame,
        regions: tuple[tuple[Region, ...], ...],
        revision: int,
    ) -> None:
        """Log the frame's regions, or all of it, without loss."""
        if self.recorder is None or self._patches == "none":
            return
        data = convert.pixels_bytes(
            frame, self._markers, regions, revision, self._patches == "frames"
        )
        if data:
            self._say(topics.PIXELS, "", frame.utc_ns or frame.t_ns, data)

    def run(self, header: bytes) -> None:
        """Log a serialised `vdms.Run` that tells more than that at the head of the file."""
        self._say(topics.RUN, "", self.now_ns(), header)

    def health(self, health: Health) -> None:
        """Say how the daemon is."""
        self.newest_health = message = convert.health_message(health)
        self._say(topics.HEALTH, "", self.now_ns(), message.SerializeToString())

    def _say(self, topic: Topic, marker: str, at_ns: int, data: bytes) -> None:
        if topic.network and self.publisher is not None:
            self.publisher.put(topic, marker, data)
        if topic.recorded and self.recorder is not None:
            key = topic.key.format(station=self._station, marker=marker)
            self.recorder.put(topic, key, at_ns, data)


def _same_reference(before: SetUp | None, now: SetUp) -> bool:
    """Return whether two set-ups stand against the same stills."""
    return before is not None and [m.homography for m in before.markers] == [
        m.homography for m in now.markers
    ]
