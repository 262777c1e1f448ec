"""A recording cut into pieces that can be measured again each by itself, wherever they are cut:
the same pieces, and so the same numbers, for any number of processes."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import NamedTuple

from vdms_replay.remeasure import (
    CHECKPOINT,
    PIXELS,
    SET_UP,
    Change,
    Piece,
    Result,
    Said,
    Times,
    Walk,
    standing,
)
from vdms_rt.process.progress import Phase, Progress
from vdms_rt.wire import vdms_pb2 as pb

PIECE_FRAMES = 300
"""Ten seconds of NTSC: much longer than a piece takes to be handed over."""
WARM_UP_FRAMES = 60
"""Before a piece that does not begin with a checkpoint: two seconds, in which the track fills and
the slow figures settle."""
BEFORE_REFERENCE = (Phase.SEARCHING.value, Phase.STILLS.value)


class Terms(NamedTuple):
    """On what terms a session is measured again."""

    session: int
    sampling: str
    change: Change
    times: Times | None


class AsItWas:
    """Cuts at checkpoints, which give the state bit for bit."""

    def __init__(self, terms: Terms) -> None:
        self._terms = terms
        self._set_ups: dict[int, str] = {}
        self._known: dict[int, str] = {}
        """Set-ups that stood in the log before the piece in work."""
        self._messages: list[tuple[str, bytes]] = []
        self._frames = 0
        self._cut: int | None = None
        """Where the piece can end, if the next picture shows so."""
        self._known_at_cut: dict[int, str] = {}
        self._said = pb.Checkpoint()

    def take(self, type_: str, data: bytes) -> Iterator[Piece | Result]:
        """Take the next message of the log; give the piece that it ends."""
        if type_ == SET_UP:
            said = pb.SetUp.FromString(data)
            self._set_ups[said.revision] = said.json
        elif type_ == CHECKPOINT and self._frames >= PIECE_FRAMES:
            self._cut, self._known_at_cut = len(self._messages), dict(self._set_ups)
            self._said = pb.Checkpoint.FromString(data)
        elif type_ == PIXELS:
            if self._cut is not None and _begins(self._said, pb.Pixels.FromString(data)):
                yield self._piece(self._cut)
            self._cut = None
            self._frames += 1
        self._messages.append((type_, data))

    def end(self) -> Iterator[Piece | Result]:
        """Give the last piece."""
        if self._messages:
            yield self._piece(len(self._messages))

    def _piece(self, end: int) -> Piece:
        t = self._terms
        piece = Piece(
            t.session, t.sampling, t.change, t.times, self._known, None, 0, self._messages[:end]
        )
        self._messages = self._messages[end:]
        self._known = self._known_at_cut
        self._frames = 0
        return piece


def _begins(said: pb.Checkpoint, pixels: pb.Pixels) -> bool:
    """Return whether a checkpoint stands before the first picture of a frame."""
    if pixels.scan in (pb.TOP, pb.BOTTOM):
        return said.seq // 2 == pixels.frame_seq
    return said.seq in (pixels.frame_seq, 2 * pixels.frame_seq)


class Changed:
    """Measures in turn up to each reference, and cuts what follows into pieces that overlap."""

    def __init__(self, terms: Terms) -> None:
        self._terms = terms
        self._leader = self._walk()
        self._base: Progress | None = None
        """From which the next piece begins; None while the leader has not taken its reference."""
        self._led: list[Said] = []
        self._led_frames = 0
        self._messages: list[tuple[str, bytes]] = []
        self._begin: tuple[str, str] | None = None
        self._warm_up = 0
        self._frames = 0

    def take(self, type_: str, data: bytes) -> Iterator[Piece | Result]:
        """Take the next message of the log; give the piece that it ends, or what was measured."""
        if type_ == SET_UP:
            self._leader.take(type_, data)
        if self._base is None:
            yield from self._lead(type_, data)
            return
        if type_ == CHECKPOINT:
            said = pb.Checkpoint.FromString(data)
            if json.loads(said.json)["phase"] in BEFORE_REFERENCE:
                yield from self.end()
                self._base, self._begin = None, None
                self._leader.progress = None
                self._leader.take(type_, data)
                return
            self._base = self._leader.standing_at(said, self._base)
        self._messages.append((type_, data))
        if type_ == PIXELS:
            self._frames += 1
            if self._frames - self._warm_up >= PIECE_FRAMES:
                yield self._piece()
                self._overlap()

    def end(self) -> Iterator[Piece | Result]:
        """Give what is left."""
        if self._led_frames:
            yield self._result()
        if self._frames > self._warm_up:
            yield self._piece()
        self._messages, self._frames, self._warm_up = [], 0, 0

    def _walk(self) -> Walk:
        t = self._terms
        return Walk(t.session, t.sampling, t.change, t.times, {})

    def _lead(self, type_: str, data: bytes) -> Iterator[Piece | Result]:
        if type_ != SET_UP:
            self._led += self._leader.take(type_, data)
        if type_ != PIXELS:
            return
        self._led_frames += 1
        now = self._leader.progress
        if now is not None and now.phase in (Phase.MEASURING, Phase.STALE):
            self._base = now
            self._begin = standing(now)
            yield self._result()

    def _result(self) -> Result:
        result = Result(self._led, self._led_frames, self._leader.unknown)
        self._led, self._led_frames, self._leader.unknown = [], 0, 0
        return result

    def _piece(self) -> Piece:
        t = self._terms
        assert self._begin is not None
        return Piece(
            t.session,
            t.sampling,
            t.change,
            t.times,
            dict(self._leader.set_ups),
            self._begin,
            self._warm_up,
            self._messages,
        )

    def _overlap(self) -> None:
        """Begin the next piece with the last frames of this one."""
        assert self._base is not None
        self._begin = standing(self._base)
        frames = 0
        for first in range(len(self._messages) - 1, -1, -1):
            frames += self._messages[first][0] == PIXELS
            if frames == WARM_UP_FRAMES:
                break
        self._messages = self._messages[first:]
        self._frames = self._warm_up = frames
