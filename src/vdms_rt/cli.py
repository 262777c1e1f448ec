"""The command line: verbs, their help, exit codes; no logic."""

from __future__ import annotations

import argparse
import faulthandler
import getpass
import logging
import math
import secrets
import shutil
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import vdms_rt
from vdms_rt import ctl
from vdms_rt.config import effective_values, load_config
from vdms_rt.console import Console, fault_text
from vdms_rt.model import ConfigError, MarkerShape, VdmsError

EXIT_STOPPED = 0
EXIT_FAILED = 1
EXIT_CONFIG = 78
"""EX_CONFIG of sysexits.h; the service is not restarted on it."""


def run(arguments: Sequence[str]) -> int:
    """Carry out one command line and return the exit status."""
    parsed = _parser().parse_args(arguments)
    try:
        return int(parsed.verb(parsed))
    except ConfigError as error:
        print(fault_text(error), file=sys.stderr)
        return EXIT_CONFIG
    except VdmsError as error:
        print(fault_text(error), file=sys.stderr)
        return EXIT_FAILED
    except KeyboardInterrupt:
        return EXIT_STOPPED


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="vdms-rt",
        description=vdms_rt.__doc__,
        epilog="exit status: 0 stopped, 1 failed, 78 bad configuration",
    )
    parser.add_argument("--version", action="version", version=f"vdms-rt {vdms_rt.__version__}")
    verbs = parser.add_subparsers(metavar="VERB", required=True)

    verb = _verb(
        verbs,
        "run",
        _run,
        "measure, publish and record until stopped",
        "Take frames from the source of the configuration, find the marker, wait until it rests, "
        "take the reference, and from then on publish and record its displacement in millimetres. "
        "Ctrl-C ends the run in order; a second one at once.",
    )
    verb.add_argument(
        "--config",
        type=Path,
        metavar="FILE",
        help="TOML file; without it the first grabber is used",
    )
    verb.add_argument(
        "--seconds",
        type=_seconds,
        default=0.0,
        metavar="N",
        help="end N seconds after the first frame (0, the default: go on)",
    )

    verb = _verb(
        verbs,
        "check-config",
        _check_config,
        "check a configuration file and say all that is wrong with it",
        "Read the file, check every key and bound, and print either every fault, one a line with "
        "file, key, value and rule, or (with --show) all values in force.",
    )
    verb.add_argument("file", type=Path, metavar="FILE")
    verb.add_argument("--show", action="store_true", help="print every value in force, as JSON")

    verb = _verb(
        verbs,
        "devices",
        _devices,
        "list the grabbers and cameras of this computer",
        "For each video device: node, driver, USB identity, inputs, standards, formats, signal, "
        "and what to write into the configuration to use it. A device that no program uses "
        "streams for a moment. Exit status 1 if there is none.",
    )
    verb.add_argument("--json", action="store_true", help="for programs: a list of objects")

    verb = _verb(
        verbs,
        "find",
        _find,
        "find the marker in a picture or clip",
        "Search the marker in a picture (PNG, PGM, JPEG), the first frame of a clip, or a folder "
        "of pictures; print its regions as configuration and write the picture with the regions "
        "drawn. Exit status 1 if no marker is there.",
    )
    verb.add_argument("path", type=Path, metavar="PICTURE|CLIP")
    verb.add_argument(
        "--config", type=Path, metavar="FILE", help="for other markers than the default sheet"
    )
    verb.add_argument(
        "--out",
        type=Path,
        metavar="PNG",
        help="the drawn picture (default: found.png)",
        default=Path("found.png"),
    )

    verb = _verb(
        verbs,
        "marker",
        _marker,
        "make the printable marker sheet",
        "Write a true-to-scale sheet with four circles and a ruler to check the print by. Measure "
        "the ruler after printing: a scaled print is a scaled displacement.",
    )
    verb.add_argument(
        "--spacing-mm",
        type=_millimetres,
        default=120.0,
        metavar="MM",
        help="between neighbouring centres (default: 120)",
    )
    verb.add_argument(
        "--diameter-mm",
        type=_millimetres,
        default=50.0,
        metavar="MM",
        help="of each circle (default: 50)",
    )
    verb.add_argument(
        "--black-on-white", action="store_true", help="black circles on a white sheet"
    )
    verb.add_argument(
        "--out",
        type=Path,
        default=Path("marker.pdf"),
        metavar="FILE",
        help=".pdf or .svg (default: marker.pdf)",
    )

    verb = _verb(
        verbs,
        "lens",
        _lens,
        "find what the lens bends, from a recording",
        "Record while the marker is moved slowly in its own plane, as far across the picture as it "
        "goes, also up and down, before a camera that stands still. Prints the distortion, how "
        "sure it is, what it does in millimetres, and the section [lens] for the configuration.",
    )
    verb.add_argument("file", type=Path, metavar="RECORDING")
    verb.add_argument("--marker", metavar="NAME", help="where several markers moved")
    verb.add_argument(
        "--pixel-aspect",
        type=_pixel_aspect,
        metavar="N",
        help="pixels along a row over pixels along a column for the same length (default: as "
        "configured for the recording)",
    )

    verb = _verb(
        verbs,
        "stroke",
        _stroke,
        "find the table's axis and check the scale, from a recording",
        "Record a slow stroke of known length from one rest to another, half a second or more at "
        "each end, to and fro if you like. Prints the angle of the axis, the scale with its "
        "standard error, and the key axis_deg for the configuration.",
    )
    verb.add_argument("file", type=Path, metavar="RECORDING")
    verb.add_argument(
        "--stroke-mm",
        type=_stroke_mm,
        required=True,
        metavar="MM",
        help="true distance between the rests at both ends",
    )
    verb.add_argument("--marker", metavar="NAME", help="where several markers moved")
    verb.add_argument(
        "--from-s",
        type=_seconds,
        default=0.0,
        metavar="S",
        help="begin so long after the first sample",
    )
    verb.add_argument(
        "--to-s", type=_seconds, default=math.inf, metavar="S", help="end so long after it"
    )

    verb = _verb(
        verbs,
        "watch",
        _watch,
        "show the displacement of running stations in this terminal",
        "Connect to a station, here or on another computer, or to several, or to the router where "
        "they all are, and show numbers, states and moving plots; with --csv also write every "
        "sample. A station that stops and comes back is picked up again. Ctrl-C ends it.",
    )
    verb.add_argument(
        "--connect",
        action="append",
        metavar="ADDRESS",
        help="where a station or a router listens; once for each of several "
        f"(default: {ctl.DEFAULT_ADDRESS})",
    )
    verb.add_argument("--csv", type=Path, metavar="FILE", help="write every sample to this file")
    verb.add_argument(
        "--seconds", type=_seconds, default=0.0, metavar="N", help="end after N seconds"
    )

    _add_view(verbs)

    verb = _verb(
        verbs,
        "ctl",
        ctl.run_ctl,
        "ask a running station, or tell it what to do",
        "What changes the measurement is applied between two frames; the answer names the first "
        "sample that it affects. Exit status 1, with the reason, if the station refused.",
    )
    ctl.add_arguments(verb)

    verb = _verb(
        verbs,
        "keys",
        _keys,
        "make keys or a password for controlling a station from elsewhere",
        "By default only the station's own computer controls it. `keys server HOST...` makes a "
        "certificate for the station, `keys client NAME` one for somebody who may control it, "
        "`keys password NAME` lets somebody in by a password; each says what to do next.",
    )
    verb.add_argument("kind", choices=("server", "client", "password"))
    verb.add_argument(
        "names",
        nargs="+",
        metavar="NAME",
        help="of the station's computer, and its addresses; or who may control",
    )
    verb.add_argument(
        "--folder",
        type=Path,
        default=Path("keys"),
        metavar="FOLDER",
        help="where all of it is kept (default: keys)",
    )
    verb.add_argument(
        "--ask", action="store_true", help="ask for the password instead of making one up"
    )
    return parser


def _add_view(verbs: Any) -> None:
    verb = _verb(
        verbs,
        "view",
        _view,
        "serve a page to look at stations, set them up and start runs",
        "Connect to one or several stations, here or on other computers, and serve a page for the "
        "browser, by default to this computer alone. With --host 0.0.0.0 the whole network may "
        "look, at the camera's picture too; with --token who has it may also control. "
        "Ctrl-C ends it.",
    )
    verb.add_argument(
        "--connect",
        action="append",
        metavar="ADDRESS",
        help=f"where a station listens, may be given again (default: {ctl.DEFAULT_ADDRESS})",
    )
    verb.add_argument(
        "--control",
        action="append",
        metavar="ADDRESS",
        help="where it takes requests, if that is another address",
    )
    verb.add_argument(
        "--host", default="127.0.0.1", metavar="ADDRESS", help="to serve at (default: 127.0.0.1)"
    )
    verb.add_argument(
        "--port", type=_port, default=8080, metavar="N", help="to serve at (default: 8080)"
    )
    verb.add_argument(
        "--token",
        nargs="?",
        const=True,
        default="",
        metavar="TEXT",
        help="what a browser needs to control; without TEXT one is made up and printed",
    )
    ctl.add_credentials(verb)
    verb.add_argument(
        "--seconds", type=_seconds, default=0.0, metavar="N", help="end after N seconds"
    )


def _verb(
    verbs: Any, name: str, body: Callable[[argparse.Namespace], int], short: str, long: str
) -> argparse.ArgumentParser:
    parser: argparse.ArgumentParser = verbs.add_parser(
        name, help=short, description=f"{short[0].upper()}{short[1:]}. {long}"
    )
    parser.set_defaults(verb=body)
    return parser


def _seconds(text: str) -> float:
    return _number(text, 0.0, 1e9, "seconds, 0 or more")


def _port(text: str) -> int:
    if not text.isdecimal() or int(text) > 65535:
        raise argparse.ArgumentTypeError(f"{text!r} is not a port: 0 (any free one) to 65535")
    return int(text)


def _millimetres(text: str) -> float:
    return _number(text, 1.0, 10000.0, "millimetres, between 1 and 10000")


def _stroke_mm(text: str) -> float:
    return _number(text, 0.01, 10000.0, "millimetres, between 0.01 and 10000")


def _pixel_aspect(text: str) -> float:
    return _number(text, 0.5, 2.0, "0.5 to 2")


def _number(text: str, least: float, most: float, rule: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not least <= value <= most:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number of {rule}")
    return value


def _run(arguments: argparse.Namespace) -> int:
    from vdms_rt.daemon import Daemon

    # A crash, and the watchdog's SIGABRT, leave on standard error where each thread was.
    faulthandler.enable()
    config, text = load_config(arguments.config)
    console = Console()
    logging.basicConfig(level=logging.INFO, handlers=[console])
    return Daemon(config, text, console).run(arguments.seconds)


def _check_config(arguments: argparse.Namespace) -> int:
    config, _ = load_config(arguments.file)
    print(effective_values(config) if arguments.show else f"{arguments.file}: correct")
    return EXIT_STOPPED


def _devices(arguments: argparse.Namespace) -> int:
    from vdms_rt.capture.devices import devices_json, devices_table, look_through
    from vdms_rt.capture.grabber import list_devices

    shown = look_through(list_devices())
    width = shutil.get_terminal_size().columns
    print(devices_json(shown) if arguments.json else devices_table(shown, width))
    return EXIT_STOPPED if shown else EXIT_FAILED


def _find(arguments: argparse.Namespace) -> int:
    from vdms_rt.look import look

    config, _ = load_config(arguments.config)
    text, found = look(arguments.path, config, arguments.out)
    print(text)
    return EXIT_STOPPED if found else EXIT_FAILED


def _marker(arguments: argparse.Namespace) -> int:
    from vdms_rt.sheet import write_sheet

    half_mm = arguments.spacing_mm / 2
    shape = MarkerShape(
        name="m1",
        circles_mm=(
            (-half_mm, half_mm),
            (half_mm, half_mm),
            (-half_mm, -half_mm),
            (half_mm, -half_mm),
        ),
        diameter_mm=arguments.diameter_mm,
        white_on_black=not arguments.black_on_white,
    )
    print(write_sheet(shape, arguments.out))
    return EXIT_STOPPED


def _lens(arguments: argparse.Namespace) -> int:
    from vdms_rt.calibrate import lens_from_recording

    print(lens_from_recording(arguments.file, arguments.marker, arguments.pixel_aspect))
    return EXIT_STOPPED


def _stroke(arguments: argparse.Namespace) -> int:
    from vdms_rt.calibrate import stroke_from_recording

    print(
        stroke_from_recording(
            arguments.file,
            arguments.marker,
            arguments.stroke_mm,
            arguments.from_s,
            arguments.to_s,
        )
    )
    return EXIT_STOPPED


def _keys(arguments: argparse.Namespace) -> int:
    from vdms_rt import keys

    if arguments.kind == "server":
        print(keys.make_server(arguments.folder, arguments.names))
        return EXIT_STOPPED
    for name in arguments.names:
        if arguments.kind == "client":
            print(keys.make_client(arguments.folder, name))
        else:
            password = getpass.getpass(f"password for {name}: ") if arguments.ask else ""
            print(keys.make_password(arguments.folder, name, password))
    return EXIT_STOPPED


def _watch(arguments: argparse.Namespace) -> int:
    from vdms_rt.watch import run_watch

    return run_watch(
        arguments.connect or ctl.DEFAULT_ADDRESS, arguments.csv, seconds=arguments.seconds
    )


def _view(arguments: argparse.Namespace) -> int:
    from vdms_rt.view import run_view

    connect = arguments.connect or [ctl.DEFAULT_ADDRESS]
    token = secrets.token_urlsafe(12) if arguments.token is True else arguments.token
    return run_view(
        connect,
        arguments.control or connect,
        host=arguments.host,
        port=arguments.port,
        token=token,
        credentials=ctl.credentials(arguments),
        seconds=arguments.seconds,
    )
