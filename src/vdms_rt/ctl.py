"""`vdms-rt ctl`: asks a running station, and says what it answered."""

from __future__ import annotations

import argparse
import getpass
import math
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from vdms_rt.model import VdmsError
from vdms_rt.status import not_recorded

if TYPE_CHECKING:
    from vdms_rt.control.client import Credentials
    from vdms_rt.wire import control_pb2 as control

# zenoh and protobuf are loaded when something is asked, not for the help.

DEFAULT_ADDRESS = "tcp/127.0.0.1:7447"

Fields: TypeAlias = dict[str, Any]
Add: TypeAlias = Callable[[str, str, Callable[[argparse.Namespace], Fields]], Any]


class CtlError(VdmsError):
    """The station refused, or the request cannot be made."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options and the verbs of a station to the parser of `vdms-rt ctl`."""
    parser.add_argument(
        "--connect",
        default=DEFAULT_ADDRESS,
        metavar="ADDRESS",
        help=f"where the station listens (default: {DEFAULT_ADDRESS})",
    )
    parser.add_argument("--station", metavar="NAME", help="where several answer at the address")
    add_credentials(parser)
    parser.add_argument("--json", action="store_true", help="print the answer as JSON")
    verbs = parser.add_subparsers(metavar="REQUEST", required=True)

    def add(name: str, help_text: str, fields: Callable[[argparse.Namespace], Fields]) -> Any:
        verb = verbs.add_parser(
            name, help=help_text, description=f"{help_text[0].upper()}{help_text[1:]}."
        )
        verb.set_defaults(request=name, fields=fields)
        return verb

    _add_questions(add)
    _add_commands(add)


def add_credentials(parser: argparse.ArgumentParser) -> None:
    """Add what a station on another computer asks for; `credentials` reads it."""
    parser.add_argument(
        "--keys",
        type=Path,
        metavar="FOLDER",
        help="that `vdms-rt keys client` made, for a tls address",
    )
    parser.add_argument("--user", metavar="NAME", help="for a station that asks for a password")
    parser.add_argument(
        "--password-file", type=Path, metavar="FILE", help="instead of asking for the password"
    )


def _add_questions(add: Add) -> None:
    add("status", "say how the station is", lambda _: {})
    verb = add("preview", "take a picture of what the camera sees", lambda _: {})
    verb.add_argument(
        "--out", type=Path, default=Path("preview.jpg"), metavar="JPEG", help="(preview.jpg)"
    )
    add("recordings", "list the recordings", lambda _: {})
    verb = add(
        "stroke",
        "find the table's axis and check the scale from the last seconds of motion",
        lambda a: {"marker": a.marker, "stroke_mm": a.stroke_mm, "last_s": a.last_s},
    )
    verb.add_argument("stroke_mm", type=_number, metavar="MM", help="true length of the stroke")
    verb.add_argument("--last-s", type=_number, default=30.0, metavar="S", help="(30)")
    _marker(verb)


def _add_commands(add: Add) -> None:
    add("find", "look for the marker again, and take a new reference", lambda _: {})
    verb = add(
        "regions",
        "say the regions in use, or measure in these and take a new reference",
        lambda a: {"marker": a.marker, "regions": a.regions},
    )
    verb.add_argument(
        "regions", nargs="*", type=_region, metavar="LEFT,TOP,WIDTH,HEIGHT", help="one a circle"
    )
    _marker(verb)
    verb = add("reference", "take a new reference", lambda a: {"stills": a.stills})
    verb.add_argument("--stills", type=int, default=0, metavar="N", help="(as configured)")
    verb = add(
        "zero", "count displacement from where the marker rests", lambda a: {"marker": a.marker}
    )
    _marker(verb)
    verb = add(
        "axis",
        "measure x along this direction, from the marker's x towards its y",
        lambda a: {"marker": a.marker, "axis_deg": a.axis_deg},
    )
    verb.add_argument("axis_deg", type=_number, metavar="DEG")
    _marker(verb)
    orders = {"auto": 0, "top-first": 1, "bottom-first": 2}
    verb = add(
        "field-order",
        "say which field of a frame is exposed first",
        lambda a: {"order": orders[a.order]},
    )
    verb.add_argument("order", choices=orders)
    verb = add(
        "marker",
        "say how large the marker is printed, and take a new reference",
        lambda a: {
            "marker": a.marker,
            "spacing_mm": a.spacing_mm,
            "diameter_mm": a.diameter_mm,
        },
    )
    verb.add_argument("--spacing-mm", type=_number, required=True, metavar="MM")
    verb.add_argument("--diameter-mm", type=_number, required=True, metavar="MM")
    _marker(verb)
    actions = {"start": 1, "stop": 2, "mark": 3}
    verb = add(
        "record",
        "start a run by name, stop it, or put a note into the log",
        lambda a: {"action": actions[a.action], "text": " ".join(a.text)},
    )
    verb.add_argument("action", choices=actions)
    verb.add_argument("text", nargs="*", metavar="TEXT", help="the run's name, or the note")


def run_ctl(arguments: argparse.Namespace) -> int:
    """Ask what the command line says, print the answer, and return the exit status, 0.

    Raises VdmsError with what the station said if it refused, or why it could not be asked.
    """
    from google.protobuf.json_format import MessageToJson

    from vdms_rt.control.client import Controller

    with Controller(
        arguments.connect, station=arguments.station, credentials=credentials(arguments)
    ) as station:
        answer = station.ask(arguments.request, **arguments.fields(arguments))
    if not answer.done:
        raise CtlError(answer.text)
    if answer.HasField("preview"):
        _save(arguments.out, answer.preview.jpeg)
        answer.preview.jpeg = b""
    if arguments.json:
        text = MessageToJson(answer, preserving_proto_field_name=True)
    else:
        text = _text(arguments, answer)
    sys.stdout.write(f"{text}\n")
    return 0


def _text(arguments: argparse.Namespace, answer: control.Answer) -> str:
    if answer.HasField("status"):
        return _status_text(answer.status)
    if answer.HasField("preview"):
        seen = [m for m in answer.preview.markers if m.regions]
        lines = [f"{arguments.out}: {answer.preview.state}, seq {answer.preview.seq}"]
        lines += [f"{m.marker}: {a}" for m in seen for a in m.aim.advice]
        return "\n".join(lines)
    if answer.HasField("recordings"):
        return _recordings_text(answer.recordings)
    if answer.regions:
        return "\n".join(
            f"{m.marker}  " + " ".join(f"{r.x_px},{r.y_px},{r.width_px},{r.height_px}" for r in own)
            for m in answer.regions
            if (own := m.regions)
        )
    return answer.text + (f" (from seq {answer.seq})" if answer.applied else "")


def _status_text(status: control.Status) -> str:
    health = status.health
    rows = [
        ("state", health.state),
        ("version", status.version),
        ("device", health.device),
        ("rate", f"{health.frame_rate_hz:.2f} frames/s"),
        ("lost", f"{health.missed + health.overwritten} frames, {health.invalid} samples invalid"),
        ("recording", health.record_trouble or health.recording or "no"),
        ("run", status.run or "none"),
        ("disk", f"{health.disk_free_bytes / 1e9:.1f} GB free" if health.recording else "not used"),
        ("clock", f"{health.utc_state}, {health.clock_sigma_us:.0f} us"),
    ]
    if health.not_recorded:
        left_out = not_recorded(health.not_recorded, health.pixels_left_out)
        rows.insert(6, ("left out", left_out))
    lines = [f"{name:<11}{value}" for name, value in rows]
    if status.HasField("set_up"):
        lines += status.set_up.report.splitlines()
    return "\n".join(lines)


def _recordings_text(recordings: control.Recordings) -> str:
    lines = [
        f"{time.strftime('%Y-%m-%d %H:%M:%S', time.localtime(r.begin_utc_ns / 1e9))}  "
        f"{r.length_s:9.1f} s  {r.size_bytes / 1e6:9.1f} MB  {r.name}"
        f"{'  being written' if r.open else ''}"
        for r in recordings.recordings
    ]
    free = f"{recordings.directory}: {recordings.disk_free_bytes / 1e9:.1f} GB free"
    return "\n".join([*lines, free])


def credentials(arguments: argparse.Namespace) -> Credentials:
    """Return what `add_credentials` reads, asking for a password. Raises CtlError."""
    from vdms_rt.control.client import Credentials

    password = ""
    if arguments.password_file is not None:
        try:
            password = arguments.password_file.read_text(encoding="utf-8").strip()
        except OSError as error:
            raise CtlError(
                f"{arguments.password_file}: cannot be read: {error.strerror}; "
                "write the password into it"
            ) from None
    elif arguments.user:
        password = getpass.getpass(f"password of {arguments.user}: ")
    return Credentials(keys=arguments.keys, user=arguments.user or "", password=password)


def _save(path: Path, data: bytes) -> None:
    try:
        path.write_bytes(data)
    except OSError as error:
        raise CtlError(f"{path}: cannot be written: {error.strerror}; name another --out") from None


def _marker(verb: argparse.ArgumentParser) -> None:
    verb.add_argument("--marker", default="", metavar="NAME", help="where there are several")


def _number(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"{text!r} is not a number")
    return value


def _region(text: str) -> dict[str, int]:
    try:
        left, top, width, height = (int(part) for part in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(
            f"{text!r} is not a region: write left,top,width,height in pixels"
        ) from None
    return {"x_px": left, "y_px": top, "width_px": width, "height_px": height}
