"""What each request does: checked, handed to whom it concerns, told, and answered."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from concurrent.futures import TimeoutError as NotInTime
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from google.protobuf import text_format
from google.protobuf.message import Message
from pydantic import ValidationError

import vdms_rt
from vdms_rt.command import (
    Applied,
    Command,
    Find,
    Look,
    Refused,
    SetZero,
    Snapshot,
    TakeReference,
    UseAxis,
    UseOrder,
    UseRegions,
    UseSize,
)
from vdms_rt.config import Marker
from vdms_rt.control.picture import marker_regions, preview
from vdms_rt.logfile.listing import list_recordings
from vdms_rt.measure.axis import StrokeError, measure_stroke
from vdms_rt.model import Displacement, Event, Region, Scan, Severity, State
from vdms_rt.setup import SetUp
from vdms_rt.wire import control_pb2 as control
from vdms_rt.wire import vdms_pb2 as pb
from vdms_rt.wire.verbs import Request

APPLY_S = 2.0
"""For the process thread to come to the end of a frame: longer only while no frames come."""
REST_S = 2.0
"""For a marker to have rested as long as a zero needs, after a new reference."""
AGAIN_S = 0.1
STROKE_S = 30.0
MOST_STILLS = 1000
LONGEST_TEXT = 500
LONGEST_NAME = 64
QUALITY = 80


class Runs(Protocol):
    """Where runs are recorded."""

    @property
    def run_name(self) -> str: ...

    def start_run(self, name: str) -> None: ...

    def stop_run(self) -> None: ...


class Station(Protocol):
    """What was said last, and where events are said."""

    @property
    def session(self) -> int: ...

    @property
    def newest_health(self) -> pb.Health | None: ...

    @property
    def newest_set_up(self) -> SetUp | None: ...

    @property
    def newest_set_up_message(self) -> pb.SetUp | None: ...

    def recent(self, marker: str) -> Sequence[Displacement]: ...

    def event(self, event: Event) -> None: ...


@dataclass(frozen=True, slots=True)
class Desk:
    """Used by the control thread alone."""

    station: Station
    state: Callable[[], State]
    """Of the daemon, this moment."""
    submit: Callable[[Command], Future[Applied | Snapshot]]
    markers: tuple[Marker, ...]
    pixel_aspect: float
    """Of the lens."""
    runs: Runs | None
    """None where nothing is recorded."""
    directory: Path
    """Of the recordings."""

    def answer(self, verb: str, request: Request, way: str) -> control.Answer:
        """Carry out a request that came in such a way ("on this computer"); return its answer."""
        try:
            answer = self._carried_out(request)
            answer.done = True
        except Refused as refused:
            answer = control.Answer(code=refused.code, text=str(refused))
        answer.session = self.station.session
        if _changes(request):
            self._tell(verb, request, way, answer)
        return answer

    def _carried_out(self, request: Request) -> control.Answer:
        match request:
            case control.StatusRequest():
                return self._status()
            case control.PreviewRequest():
                return self._preview(request)
            case control.RecordRequest():
                return self._record(request)
            case control.RecordingsRequest():
                return self._recordings()
            case control.StrokeRequest():
                return self._stroke(request)
            case control.RegionsRequest() if not request.regions:
                return self._regions_in_use(request.marker)
        applied = self._applied(self._command(request))
        return control.Answer(text=applied.text, applied=True, seq=applied.seq)

    def _command(self, request: Request) -> Command:
        """Return what the process thread is to do. Raises Refused."""
        match request:
            case control.FindRequest():
                return Find()
            case control.RegionsRequest():
                regions = (Region(r.x_px, r.y_px, r.width_px, r.height_px) for r in request.regions)
                return UseRegions(self._marker(request.marker).name, tuple(regions))
            case control.ReferenceRequest():
                _within("stills", request.stills, 0, MOST_STILLS)
                return TakeReference(request.stills or None)
            case control.ZeroRequest():
                return SetZero(request.marker)
            case control.AxisRequest():
                _within("axis_deg", request.axis_deg, -180, 180)
                return UseAxis(self._marker(request.marker).name, request.axis_deg)
            case control.FieldOrderRequest():
                if request.order not in (pb.PROGRESSIVE, pb.TOP_FIRST, pb.BOTTOM_FIRST):
                    raise Refused("order", "order is TOP_FIRST, BOTTOM_FIRST or PROGRESSIVE (auto)")
                return UseOrder(Scan(request.order) if request.order else None)
            case control.MarkerRequest():
                return self._size(request)
            case _:
                raise AssertionError(request)

    def _applied(self, command: Command) -> Applied:
        """Have a command carried out, with patience where only time is missing. Raises Refused."""
        until_s = time.monotonic() + REST_S
        while True:
            try:
                applied = self._ask(command)
            except Refused as refused:
                if refused.code != "few-samples" or time.monotonic() > until_s:
                    raise
                time.sleep(AGAIN_S)
                continue
            assert isinstance(applied, Applied)
            return applied

    def _ask(self, command: Command) -> Applied | Snapshot:
        """Hand a command to the process thread and wait for its end. Raises Refused."""
        future = self.submit(command)
        try:
            return future.result(APPLY_S)
        except NotInTime:
            if future.cancel():
                raise Refused(
                    "no-pictures",
                    f"no pictures come ({self.state().value}), so nothing was done; ask again when "
                    "they do",
                ) from None
            # It has begun, and no command takes longer than a frame.
            return future.result()

    def _look(self) -> Snapshot:
        snapshot = self._ask(Look())
        assert isinstance(snapshot, Snapshot)
        return snapshot

    def _status(self) -> control.Answer:
        status = control.Status(version=vdms_rt.__version__)
        if self.runs is not None:
            status.run = self.runs.run_name
        health = self.station.newest_health
        if health is None:
            raise Refused("starting", "the station has just started; ask again in a second")
        status.health.CopyFrom(health)
        status.health.state = self.state().value
        if (set_up := self.station.newest_set_up_message) is not None:
            status.set_up.CopyFrom(set_up)
        return control.Answer(text=status.health.state, status=status)

    def _preview(self, request: control.PreviewRequest) -> control.Answer:
        _within("quality", request.quality, 0, 100)
        snapshot = self._look()
        picture = preview(
            snapshot,
            [m.shape for m in self.markers],
            self.pixel_aspect,
            request.quality or QUALITY,
            request.most_width_px,
        )
        return control.Answer(text=picture.state, preview=picture)

    def _regions_in_use(self, marker: str) -> control.Answer:
        names = [self._marker(marker).name] if marker else [m.name for m in self.markers]
        told = [
            marker_regions(m.name, regions)
            for m, regions in zip(self.markers, self._look().regions, strict=False)
            if m.name in names
        ]
        if not told:
            raise Refused("searching", "no marker is found yet, so there are no regions")
        return control.Answer(text="the regions in use", regions=told)

    def _size(self, request: control.MarkerRequest) -> UseSize:
        marker = self._marker(request.marker)
        if marker.circles_mm:
            raise Refused(
                "circles",
                f"marker {marker.name} has circles_mm of its own in the configuration; change them "
                "there",
            )
        size = {"spacing_mm": request.spacing_mm, "diameter_mm": request.diameter_mm}
        try:
            shape = Marker(**(marker.model_dump() | size)).shape
        except ValidationError as error:
            fault = error.errors()[0]
            where = ".".join(map(str, fault["loc"])) or "size"
            why = fault["msg"].removeprefix("Value error, ")
            raise Refused("size", f"{where}: {why}") from None
        return UseSize(marker.name, shape.circles_mm, shape.diameter_mm)

    def _record(self, request: control.RecordRequest) -> control.Answer:
        if self.runs is None:
            raise Refused("not-recording", "nothing is recorded here: record.enabled is false")
        match request.action:
            case control.RecordRequest.START:
                if self.runs.run_name:
                    raise Refused("run", f"run {self.runs.run_name} is recorded; stop it first")
                name = _run_name(request.text)
                self.runs.start_run(name)
                return control.Answer(text=f"run {name} begins, in files of its own")
            case control.RecordRequest.STOP:
                if not (name := self.runs.run_name):
                    raise Refused("no-run", "no run was started; `record start NAME` does")
                self.runs.stop_run()
                return control.Answer(text=f"run {name} ends; recording goes on outside a run")
            case control.RecordRequest.MARK:
                note = _printable(request.text, LONGEST_TEXT)
                if not note:
                    raise Refused("note", "a mark needs a note: say what happened")
                newest = max(
                    (s[-1].seq for m in self.markers if (s := self._samples(m))), default=0
                )
                self.station.event(
                    Event(Severity.INFO, "mark", note, facts=(("seq", f"{newest}"),))
                )
                return control.Answer(text=f"marked at seq {newest}: {note}", seq=newest)
            case _:
                raise Refused("action", "action is START, STOP or MARK")

    def _recordings(self) -> control.Answer:
        health = self.station.newest_health
        listed = [
            control.Recording(
                name=r.name,
                run=r.run,
                begin_utc_ns=r.begin_utc_ns,
                length_s=r.length_s,
                size_bytes=r.size_bytes,
                open=r.open,
            )
            for r in list_recordings(self.directory)
        ]
        return control.Answer(
            text=f"{len(listed)} recordings in {self.directory}",
            recordings=control.Recordings(
                recordings=listed,
                directory=str(self.directory),
                disk_free_bytes=health.disk_free_bytes if health is not None else 0,
            ),
        )

    def _stroke(self, request: control.StrokeRequest) -> control.Answer:
        marker = self._marker(request.marker)
        _within("stroke_mm", request.stroke_mm, 0.01, 10000)
        _within("last_s", request.last_s, 0, 3600)
        good = [d for d in self._samples(marker) if d.valid]
        since_ns = good[-1].t_ns - (request.last_s or STROKE_S) * 1e9 if good else 0
        good = [d for d in good if d.t_ns >= since_ns]
        good = [d for d in good if d.setup_revision == good[-1].setup_revision]
        try:
            stroke = measure_stroke(
                np.array([d.t_ns for d in good], dtype=np.int64),
                np.array([(d.x_mm, d.y_mm) for d in good]).reshape(-1, 2),
                request.stroke_mm,
            )
        except StrokeError as error:
            raise Refused("no-stroke", f"marker {marker.name}: {error}") from None
        axis_deg = (self._axis_deg(marker) + stroke.angle_deg + 180) % 360 - 180
        return control.Answer(
            text=f"the table's axis is at {axis_deg:.4f} +- {stroke.sigma_angle_deg:.4f} deg, and "
            f"true over measured is {stroke.scale:.5f} +- {stroke.sigma_scale:.5f}",
            stroke=control.Stroke(
                length_mm=stroke.length_mm,
                sigma_length_mm=stroke.sigma_length_mm,
                axis_deg=axis_deg,
                sigma_axis_deg=stroke.sigma_angle_deg,
                scale=stroke.scale,
                sigma_scale=stroke.sigma_scale,
                straightness_mm=stroke.straightness_mm,
            ),
        )

    def _samples(self, marker: Marker) -> Sequence[Displacement]:
        return self.station.recent(marker.name)

    def _axis_deg(self, marker: Marker) -> float:
        """Return the direction of a marker's x in force."""
        set_up = self.station.newest_set_up
        own = [m.axis_deg for m in set_up.markers if m.shape.name == marker.name] if set_up else []
        return own[0] if own else marker.axis_deg

    def _marker(self, name: str) -> Marker:
        named = [m for m in self.markers if m.name == name or not name]
        if len(named) == 1:
            return named[0]
        names = ", ".join(m.name for m in self.markers)
        if named:
            raise Refused("which-marker", f"there are several markers, name one of {names}")
        raise Refused("unknown-marker", f'there is no marker "{name}" here; there is {names}')

    def _tell(self, verb: str, request: Request, way: str, answer: control.Answer) -> None:
        """Say who asked for what, when, and what came of it."""
        who = _printable(request.who, LONGEST_NAME) or "somebody"
        asked: Message = type(request).FromString(request.SerializeToString())
        asked.ClearField("who")
        words = text_format.MessageToString(asked, as_one_line=True).strip()
        facts = [("verb", verb), ("who", who), ("way", way), ("request", words)]
        if answer.applied:
            facts.append(("seq", str(answer.seq)))
        severity, code, what = Severity.INFO, "command", answer.text
        if not answer.done:
            severity, code, what = Severity.WARNING, "command-refused", f"refused: {answer.text}"
            facts.append(("code", answer.code))
        self.station.event(
            Event(severity, code, f"{verb} by {who} {way}: {what}", facts=tuple(facts))
        )


def _changes(request: Request) -> bool:
    """Return whether a request is a command, and not only a question."""
    match request:
        case control.RegionsRequest():
            return bool(request.regions)
        case (
            control.StatusRequest()
            | control.PreviewRequest()
            | control.RecordingsRequest()
            | control.StrokeRequest()
        ):
            return False
        case _:
            return True


def _within(name: str, value: float, least: float, most: float) -> None:
    if not least <= value <= most:
        raise Refused("bounds", f"{name} = {value:g} is not between {least:g} and {most:g}")


def _printable(text: str, most: int) -> str:
    """Return a text for one line of a log."""
    return "".join(c if c.isprintable() else " " for c in text).strip()[:most]


def _run_name(text: str) -> str:
    name = re.sub(r"\s+", "-", text.strip())
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}", name):
        raise Refused(
            "name",
            f'"{_printable(text, LONGEST_NAME)}" cannot name a file; use letters, digits, "_", "." '
            'and "-", at most 64',
        )
    return name
