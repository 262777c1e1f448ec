"""`vdms-replay play`: a recording said again on the network, as if it were live."""

from __future__ import annotations

import argparse
import contextlib
import signal
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

from vdms_replay.player import FASTEST, SLOWEST, Player, lateness
from vdms_replay.source import ReplayError, by_station
from vdms_replay.track import Programme
from vdms_replay.verb import Verbs, make_parser, number, progress
from vdms_rt.config import Publish
from vdms_rt.wire.session import DEFAULT_ENDPOINT

HISTORY_S = 60.0
"""Of the recording, for receivers that come late: as much as a station keeps."""


def add_parser(verbs: Verbs) -> None:
    parser = make_parser(
        verbs,
        "play",
        run,
        "publish a recording again, at its own pace",
        "Every sample is published at its own time under vdms/<station>@replay/..., so that "
        "`vdms-rt watch` shows it like a live station and nobody takes it for one. The files of "
        "several stations run on one clock. Keys: space pauses, the arrows seek, + and - change "
        "the speed, q ends it; other programs ask vdms/<station>@replay/control/replay/<verb>.",
    )
    parser.add_argument("files", nargs="+", type=Path, metavar="FILE")
    parser.add_argument(
        "--speed",
        type=number(SLOWEST, FASTEST, f"a number from {SLOWEST:g} to {FASTEST:g}"),
        default=1.0,
        metavar="N",
        help=f"times real time, {SLOWEST:g} to {FASTEST:g} (default: 1)",
    )
    parser.add_argument("--loop", action="store_true", help="begin again at the end")
    parser.add_argument(
        "--from",
        dest="from_",
        metavar="WHEN",
        help="seconds from the start, or UTC as 2026-05-04T12:00:00Z",
    )
    parser.add_argument("--to", metavar="WHEN", help="end there")
    parser.add_argument("--paused", action="store_true", help="wait for space, or for `resume`")
    parser.add_argument(
        "--listen",
        action="append",
        metavar="ADDRESS",
        help=f"where receivers connect (default: {DEFAULT_ENDPOINT}, as of a station)",
    )
    parser.add_argument(
        "--connect", action="append", metavar="ADDRESS", help="publish by a router instead"
    )


def run(arguments: argparse.Namespace) -> int:
    from vdms_replay.keys import steering
    from vdms_replay.stage import Stage

    paths = [path for files in by_station(arguments.files).values() for path in files]
    with progress("reading", sum(path.stat().st_size for path in paths)) as advance:
        programme = Programme(paths, advance)
    with contextlib.ExitStack() as stack:
        stack.callback(programme.close)
        from_ns = moment(arguments.from_, "--from", programme, programme.start_ns)
        to_ns = moment(arguments.to, "--to", programme, programme.end_ns)
        if from_ns >= to_ns:
            raise ReplayError("--from is not before --to; there is nothing between them")
        stage = stack.enter_context(Stage(programme, _network(arguments), arguments.speed))
        player = Player(
            programme,
            stage.say,
            speed=arguments.speed,
            loop=arguments.loop,
            from_ns=from_ns,
            to_ns=to_ns,
            paused=arguments.paused,
        )
        print(f"{', '.join(stage.stations)}: {programme.seconds:.2f} s, {stage.state}", flush=True)
        stack.enter_context(_signals(player))
        stack.enter_context(stage.controlled_by(player))
        stage.tell(f"replay of {', '.join(path.name for path in paths)}")
        with steering(player):
            player.run()
        stage.tell("the replay has ended")
    print(_account(player))
    return 0


def _network(arguments: argparse.Namespace) -> Publish:
    recover_s = min(max(HISTORY_S / arguments.speed, 1.0), 600.0)
    if arguments.connect:
        if arguments.listen:
            raise ReplayError("--listen and --connect exclude each other; give one of them")
        return Publish(mode="client", connect=tuple(arguments.connect), recover_s=recover_s)
    return Publish(listen=tuple(arguments.listen or (DEFAULT_ENDPOINT,)), recover_s=recover_s)


def moment(text: str | None, option: str, programme: Programme, otherwise_ns: int) -> int:
    """Return the moment of the programme that `text` names: seconds from its start, or UTC.

    Raises ReplayError if it is neither, or lies outside.
    """
    if text is None:
        return otherwise_ns
    try:
        at_ns = programme.start_ns + round(float(text) * 1e9)
    except ValueError:
        try:
            when = datetime.fromisoformat(text)
        except ValueError:
            raise ReplayError(
                f"{option} {text!r}: neither seconds from the start nor a time such as "
                "2026-05-04T12:00:00Z"
            ) from None
        when = when if when.tzinfo else when.replace(tzinfo=UTC)
        at_ns = round(when.timestamp() * 1e6) * 1000
    if not programme.start_ns <= at_ns <= programme.end_ns:
        raise ReplayError(
            f"{option} {text}: outside of the recording, which is {programme.seconds:.2f} s long"
        )
    return at_ns


@contextlib.contextmanager
def _signals(player: Player) -> Iterator[None]:
    """Ctrl-C and SIGTERM end the play in order."""
    before = {
        number: signal.signal(number, lambda *_: player.quit())
        for number in (signal.SIGINT, signal.SIGTERM)
    }
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _account(player: Player) -> str:
    late = lateness(player)
    if not late["count"]:
        return "nothing was published"
    return (
        f"{late['count']} messages published; late by {late['median_ms']:.3f} ms in the median, "
        f"{late['p99_ms']:.3f} ms at 99 %, {late['most_ms']:.3f} ms at most"
    )
