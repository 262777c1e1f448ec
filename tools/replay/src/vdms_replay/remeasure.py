"""Measuring recorded pixels again: the process stage's own steps, from where the log says it stood.

Two ways. *As it was*: each checkpoint of the log gives the state, the pixels give the pictures, and
the numbers are those of the live run. *Changed*: another method, sampling, lens or time; then the
log tells where the circles are and what a person ordered, and the rest is found anew.
"""

from __future__ import annotations

import dataclasses
from collections import deque
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vdms_replay.source import ReplayError
from vdms_rt.config import Lens
from vdms_rt.measure.gate import Workspace
from vdms_rt.measure.marker import find_markers
from vdms_rt.model import Damage, Displacement, Event, Frame, Luma, Picture, Region, Scan
from vdms_rt.process.checkpoint import checkpoint, outlined, resumed
from vdms_rt.process.observing import relocated
from vdms_rt.process.pictures import pictures
from vdms_rt.process.progress import Phase, Progress, Watch, lost_long, watches_of
from vdms_rt.process.step import step
from vdms_rt.process.zero import zeroed
from vdms_rt.report import set_up_report
from vdms_rt.setup import SetUp, set_up_from_json, set_up_json
from vdms_rt.wire import convert
from vdms_rt.wire import vdms_pb2 as pb

NO_STILLS = (
    "the recording has no pictures of the marker at rest from before its reference (it begins "
    "later, or used a stored one), so this method or sampling has nothing to refer to; measure "
    "it again as it was, or use the part that holds the beginning"
)
SET_UP, CHECKPOINT, PIXELS = "vdms.SetUp", "vdms.Checkpoint", "vdms.Pixels"
SAMPLE, EVENT = "vdms.Displacement", "vdms.Event"


_WORK = Workspace()
"""Scratch, one for each process: the windows that one piece has made serve the next."""


class Change(NamedTuple):
    """What is to be otherwise than it was; None leaves it."""

    method: str | None = None
    lens: Lens | None = None
    anew: bool = False
    """The sampling or the times are others, so what the log knew before a picture does not fit."""
    order: Scan | None = None
    """Of the fields, where the recording's end knows it."""
    was: str = "auto"
    """The sampling with which it was recorded."""

    @property
    def nothing(self) -> bool:
        return self.method is None and self.lens is None and not self.anew


class Times(NamedTuple):
    """Times to take in place of the recorded ones, by the driver's stamp, which ascends."""

    stamps_ns: NDArray[np.int64]
    t_ns: NDArray[np.int64]

    def of(self, pixels: pb.Pixels) -> int:
        place = int(np.searchsorted(self.stamps_ns, pixels.stamp_ns))
        if place < len(self.stamps_ns) and self.stamps_ns[place] == pixels.stamp_ns:
            return int(self.t_ns[place])
        return pixels.t_ns


class Said(NamedTuple):
    """A message that measuring again has brought forth."""

    type: str
    marker: str
    seq: int
    log_time_ns: int
    data: bytes


class Piece(NamedTuple):
    """A stretch of a recording that can be measured by itself."""

    session: int
    sampling: str
    change: Change
    times: Times | None
    set_ups: dict[int, str]
    """Known before its first message: JSON by revision."""
    begin: tuple[str, str] | None
    """Checkpoint and set-up to begin with; None: its first message is a checkpoint."""
    warm_up: int
    """Frames at its beginning that only lead up to it."""
    messages: list[tuple[str, bytes]]
    """Set-ups, checkpoints and pixels in the order of the log."""


class Result(NamedTuple):
    said: list[Said]
    frames: int
    unknown: int
    """Frames of which nothing says where measuring stood."""


def remeasure(piece: Piece) -> Result:
    """Return what measuring a piece again gives.

    Raises ReplayError, CheckpointError, SetUpError.
    """
    progress = None
    if piece.begin is not None:
        text, set_up = piece.begin
        progress = resumed(text, set_up_from_json(set_up), piece.session)
    walk = Walk(piece.session, piece.sampling, piece.change, piece.times, piece.set_ups, progress)
    walk.astray = piece.warm_up > 0
    frames = 0
    said: list[Said] = []
    for type_, data in piece.messages:
        found = walk.take(type_, data)
        if type_ == PIXELS:
            frames += 1
            if frames > piece.warm_up:
                said += found
    return Result(said, frames - piece.warm_up, walk.unknown)


class Walk:
    """Goes through the messages of one session."""

    def __init__(
        self,
        session: int,
        sampling: str,
        change: Change,
        times: Times | None,
        set_ups: dict[int, str],
        progress: Progress | None = None,
    ) -> None:
        self.progress = progress
        self.unknown = 0
        self.astray = False
        """The marker is to be looked for where the log has it."""
        self._session, self._sampling = session, sampling
        self._change, self._times = change, times
        self.set_ups = dict(set_ups)
        """JSON by revision, as the log has them."""
        self._waiting: deque[pb.Checkpoint] = deque()
        self._work = _WORK
        self._image: Luma = np.zeros((0, 0), np.uint8)

    def take(self, type_: str, data: bytes) -> list[Said]:
        """Take the next message; of pixels, return what measuring them again says."""
        if type_ == PIXELS:
            return list(self._measured(pb.Pixels.FromString(data)))
        if type_ == CHECKPOINT:
            self._waiting.append(pb.Checkpoint.FromString(data))
        elif type_ == SET_UP:
            said = pb.SetUp.FromString(data)
            self.set_ups[said.revision] = said.json
        return []

    def _measured(self, pixels: pb.Pixels) -> Iterator[Said]:
        frame = self._frame(pixels)
        split = self._split(frame)
        if self._stand(split[0], frame.scan):
            # What is known now may put the fields in another order.
            split = self._split(frame)
        if self.progress is None:
            self.unknown += 1
            return
        for picture in split:
            self._stand(picture, frame.scan)
            before = self._prepared(self.progress, picture, pixels)
            after, samples, events = step(before, picture, self._work)
            self.progress = after
            at_ns = picture.utc_ns or picture.t_ns
            for sample in zeroed(after, samples):
                yield _said_sample(sample)
            if not self._change.nothing:
                if after.set_up is not None and after.set_up is not before.set_up:
                    yield self._said_set_up(after.set_up, picture.seq, at_ns)
                for event in events:
                    yield self._said_event(event, picture)

    def _frame(self, pixels: pb.Pixels) -> Frame:
        t_ns = pixels.t_ns if self._times is None else self._times.of(pixels)
        return Frame(
            seq=pixels.frame_seq,
            stamp_ns=pixels.stamp_ns,
            t_ns=t_ns,
            sigma_t_ns=pixels.sigma_t_ns,
            utc_ns=pixels.utc_ns + t_ns - pixels.t_ns if pixels.utc_ns else 0,
            segment=pixels.segment,
            period_ns=pixels.period_ns,
            image=self._pasted(pixels),
            scan=Scan(pixels.scan),
            damage=Damage(pixels.damage),
            exposure_ns=pixels.exposure_ns,
            order_known=pixels.order_known,
        )

    def _pasted(self, pixels: pb.Pixels) -> Luma:
        """Return the picture, black where nothing was recorded; it lasts until the next one."""
        if self._image.shape != (pixels.height_px, pixels.width_px):
            self._image = np.zeros((pixels.height_px, pixels.width_px), np.uint8)
        try:
            convert.paste_pixels(pixels, self._image)
        except ValueError as error:
            raise ReplayError(f"frame {pixels.frame_seq} of the recording has {error}") from None
        return self._image

    def _split(self, frame: Frame) -> tuple[Picture, ...]:
        order = None if self.progress is None else self.progress.order
        return pictures(frame, self._sampling, order)

    def _stand(self, picture: Picture, scan: Scan) -> bool:
        """Go to where the log says that measuring stood before a picture of a frame; False if it
        says nothing."""
        number, pictures_of_a_frame = picture.seq, 1
        if not self._change.nothing:
            # Its pictures may be numbered otherwise than those that were recorded.
            number = picture.frame_seq
            whole = scan is Scan.PROGRESSIVE or (scan.interlaced and self._change.was == "frame")
            pictures_of_a_frame = 1 if whole else 2
        found = False
        while self._waiting and self._waiting[0].seq // pictures_of_a_frame <= number:
            said = self._waiting.popleft()
            self.progress = self.standing_at(said, self.progress)
            found = True
        return found

    def standing_at(self, said: pb.Checkpoint, now: Progress | None) -> Progress:
        """Return where measuring stands at a checkpoint; with a change, coming from `now`."""
        if now is not None and self._change.nothing and checkpoint(now) == said.json:
            return now
        text = self.set_ups.get(said.setup_revision)
        set_up = None if text is None else set_up_from_json(text)
        if self._change.nothing:
            return resumed(said.json, set_up, self._session)
        return _as_changed(outlined(said.json, set_up, self._session), now, self._change)

    def _prepared(self, progress: Progress, picture: Picture, pixels: pb.Pixels) -> Progress:
        """Return the run with the recorded places of the circles, where a change needs them."""
        if self._change.nothing or not progress.watches:
            return progress
        if picture.kind not in progress.watches[0].views:
            raise ReplayError(NO_STILLS)
        regions = recorded_regions(pixels)
        lost = [self.astray or lost_long(watch) for watch in progress.watches]
        places = {name: tuple(map(_middle, there)) for name, there in regions.items()}
        if any(lost) and not places:
            seen = find_markers(picture.image, progress.plan.shapes, picture.scan)
            places = {marker.name: marker.centres_px for marker in seen}
        watches = [
            _placed(watch, regions.get(shape.name), places.get(shape.name) if gone else None,
                    picture.t_ns, flagged=not self.astray)
            for shape, watch, gone in zip(progress.plan.shapes, progress.watches, lost, strict=True)
        ]  # fmt: skip
        self.astray = False
        return dataclasses.replace(progress, watches=tuple(watches))

    def _said_set_up(self, set_up: SetUp, seq: int, at_ns: int) -> Said:
        message = pb.SetUp(
            session=self._session,
            utc_ns=set_up.utc_ns,
            revision=set_up.revision,
            json=set_up_json(set_up),
            report=set_up_report(set_up),
            aims=[convert.aim_message(m.aim) for m in set_up.markers if m.aim is not None],
        )
        return Said(SET_UP, "", seq, at_ns, message.SerializeToString())

    def _said_event(self, event: Event, picture: Picture) -> Said:
        event = dataclasses.replace(event, t_ns=picture.t_ns, utc_ns=picture.utc_ns)
        at_ns = picture.utc_ns or picture.t_ns
        return Said(EVENT, "", picture.seq, at_ns, convert.event_bytes(event, self._session))


def standing(progress: Progress) -> tuple[str, str]:
    """Return what a piece can begin with. The run must have a set-up."""
    assert progress.set_up is not None
    return checkpoint(progress), set_up_json(progress.set_up)


def recorded_regions(pixels: pb.Pixels) -> dict[str, tuple[Region, ...]]:
    """Return where each marker's circles were recorded, in whole-frame pixels; nothing for a whole
    frame."""
    found: dict[str, list[Region]] = {}
    for patch in pixels.patches:
        if patch.marker:
            found.setdefault(patch.marker, []).append(
                Region(patch.x_px, patch.y_px, patch.width_px, patch.height_px * patch.row_step)
            )
    return {marker: tuple(regions) for marker, regions in found.items()}


def _placed(
    watch: Watch,
    regions: tuple[Region, ...] | None,
    centres_px: tuple[tuple[float, float], ...] | None,
    t_ns: int,
    *,
    flagged: bool,
) -> Watch:
    """Return a watch with its recorded regions, and its marker looked for at new centres."""
    if regions is not None and len(regions) == len(watch.regions):
        watch = dataclasses.replace(watch, regions=regions)
    if centres_px is not None and len(centres_px) == len(watch.regions):
        watch = dataclasses.replace(relocated(watch, centres_px, t_ns), relocated=flagged)
    return watch


def _as_changed(there: Progress, now: Progress | None, change: Change) -> Progress:
    """Return the run with a change, where the log says that measuring stood `there`.

    Before a reference the log leads: regions and stills are taken from there. After it the run goes
    on by itself; only what a person ordered is taken over: zeros and axes.
    """
    plan = there.plan
    if change.method is not None:
        plan = dataclasses.replace(plan, method=change.method)
    if change.lens is not None:
        plan = dataclasses.replace(plan, lens=change.lens)
    order = change.order or there.order
    if there.set_up is None or there.phase in (Phase.SEARCHING, Phase.STILLS):
        return dataclasses.replace(there, plan=plan, order=order, stills=())
    if now is None or now.set_up is None:
        set_up = _of_method(there.set_up, plan.method)
        watches = watches_of(set_up, plan, there.exposure_ns, there.period_ns)
        return dataclasses.replace(
            there, plan=plan, order=order, set_up=set_up, watches=watches, stills=()
        )
    markers = tuple(
        own.model_copy(update={"zero": said.zero, "axis_deg": said.axis_deg})
        for own, said in zip(now.set_up.markers, there.set_up.markers, strict=True)
    )
    set_up = now.set_up.model_copy(update={"markers": markers})
    plan = dataclasses.replace(now.plan, axes_deg=there.plan.axes_deg)
    return dataclasses.replace(now, plan=plan, set_up=set_up)


def _of_method(set_up: SetUp, method: str) -> SetUp:
    """Return a recorded set-up as a method without its stills can use it."""
    if set_up.method == method:
        return set_up
    if method == "smooth":
        raise ReplayError(NO_STILLS)
    markers = tuple(
        marker.model_copy(
            update={
                "fields": tuple(
                    field.model_copy(update={"appearance": None, "limits": None})
                    for field in marker.fields
                )
            }
        )
        for marker in set_up.markers
    )
    return set_up.model_copy(update={"method": method, "markers": markers})


def _middle(region: Region) -> tuple[float, float]:
    return region.x_px + (region.width_px - 1) / 2, region.y_px + (region.height_px - 1) / 2


def _said_sample(sample: Displacement) -> Said:
    return Said(
        SAMPLE,
        sample.marker,
        sample.seq,
        sample.utc_ns or sample.t_ns,
        convert.displacement_bytes(sample),
    )
