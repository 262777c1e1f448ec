"""The command line: each verb is a module of its own with `add_parser` and `run`."""

from __future__ import annotations

import argparse
import os
import signal
import sys
from collections.abc import Sequence

import vdms_replay
from vdms_replay import compare, derive, export, info, play, recover, report, reprocess
from vdms_rt.model import VdmsError

EXIT_DONE = 0
EXIT_FAILED = 1
EXIT_INTERRUPTED = 128 + signal.SIGINT

VERBS = (
    info,
    recover,
    play,
    reprocess,
    export,
    derive,
    compare,
    report,
)


def run(arguments: Sequence[str]) -> int:
    """Carry out one command line and return the exit status."""
    parsed = parser().parse_args(arguments)
    try:
        return int(parsed.run(parsed))
    except VdmsError as error:
        for line in str(error).splitlines():
            print(f"vdms-replay: {line}", file=sys.stderr)
        return EXIT_FAILED
    except KeyboardInterrupt:
        return EXIT_INTERRUPTED
    except BrokenPipeError:
        # Whoever read us has gone; the interpreter must not flush into it again.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return EXIT_FAILED
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        print(f"vdms-replay: {where}{(error.strerror or str(error)).lower()}", file=sys.stderr)
        return EXIT_FAILED


def parser() -> argparse.ArgumentParser:
    """Return the parser of all verbs; `run` of what it parses is the verb's body."""
    top = argparse.ArgumentParser(
        prog="vdms-replay",
        description=vdms_replay.__doc__,
        epilog="exit status: 0 done, 1 failed, 2 wrong command line",
    )
    top.add_argument(
        "--version", action="version", version=f"vdms-replay {vdms_replay.__version__}"
    )
    verbs = top.add_subparsers(metavar="VERB", required=True)
    for verb in VERBS:
        verb.add_parser(verbs)
    return top
