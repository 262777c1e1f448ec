"""`vdms-replay reprocess`: measures a recording's pixels again."""

from __future__ import annotations

import argparse
import os
import time
from pathlib import Path

from google.protobuf.message import DecodeError

from vdms_replay.account import Account
from vdms_replay.export import add_output_options
from vdms_replay.source import PathLike, ReplayError, Source, keep
from vdms_replay.verb import Advance, Verbs, make_parser, progress


def add_parser(verbs: Verbs) -> None:
    parser = make_parser(
        verbs,
        "reprocess",
        run,
        "measure a recording again from its pixels",
        "As it was, the numbers are those of the live run, bit for bit on the same machine, and "
        "that is checked. With another method, sampling or lens, or with times refitted from the "
        "stamps on both sides, the reference is taken again from the same pictures, and the "
        "circles are looked for where the log has them. Writes a recording without pixels.",
    )
    parser.add_argument("files", nargs="+", type=Path, metavar="FILE")
    parser.add_argument("--method", choices=("otsu", "smooth"), help="another one than live")
    parser.add_argument("--sampling", choices=("auto", "frame", "field"), help="likewise")
    parser.add_argument(
        "--lens", type=Path, metavar="TOML", help="a section [lens], as `vdms-rt lens` prints it"
    )
    parser.add_argument(
        "--refit-time",
        action="store_true",
        help="take each time from the stamps before and after it",
    )
    parser.add_argument(
        "--jobs", type=_jobs, metavar="N", help="processes (default: one for each core)"
    )
    add_output_options(parser)


def run(arguments: argparse.Namespace) -> int:
    source = Source(arguments.files)
    changed = any((arguments.method, arguments.sampling, arguments.lens, arguments.refit_time))
    total = source.size_bytes * (2 if changed else 1)
    with progress("measuring again", total) as advance:
        account = reprocess(
            *arguments.files,
            out=arguments.out,
            method=arguments.method,
            sampling=arguments.sampling,
            lens=arguments.lens,
            refit_time=arguments.refit_time,
            jobs=arguments.jobs,
            force=arguments.force,
            advance=advance,
        )
    for sentence in account.sentences():
        print(sentence)
    return 0


def reprocess(
    *files: PathLike,
    out: Path | None = None,
    method: str | None = None,
    sampling: str | None = None,
    lens: Path | None = None,
    refit_time: bool = False,
    jobs: int | None = None,
    force: bool = False,
    advance: Advance = lambda _: None,
) -> Account:
    """Measure the pixels of a recording again, write a recording of the samples, and return how
    it went.

    `files` are parts of one station's recording; None for `method`, `sampling` and `lens` (a TOML
    with a section [lens]) leaves what was recorded; `jobs` processes, one for each core for None.
    The numbers do not depend on `jobs`. Raises ReplayError with a sentence.
    """
    from vdms_replay.reprocessing import (
        Job,
        Settings,
        is_current,
        measuring,
        read_lens,
        survey,
        writing_log,
    )

    began_s = time.monotonic()
    source = Source(files)
    first = source.paths[0]
    out = out or first.with_name(f"{first.name.partition('.mcap')[0]}-again.mcap")
    keep(source.paths, out)
    settings = Settings(method, sampling, None if lens is None else read_lens(lens), refit_time)
    if not settings.changed and not is_current(source):
        settings = settings._replace(other_version=True)
    account = Account(out, jobs or len(os.sched_getaffinity(0)), settings.changed)
    known = survey(source, advance, times=refit_time) if settings.changed else {}
    try:
        with writing_log(out, force=force) as log, measuring(account.jobs) as measure:
            job = Job(source, log, account, settings, known, advance)
            for result in measure(job.work()):
                job.finish(result)
            job.end()
    except DecodeError:
        raise ReplayError(
            f"{first}: holds a message that cannot be decoded; was it recorded by a newer version "
            "of vdms-rt?"
        ) from None
    account.other_version = settings.other_version
    account.took_s = time.monotonic() - began_s
    account.damage = [s for one in source.damage.values() for s in one.sentences()]
    return account


def _jobs(text: str) -> int:
    if not text.isdecimal() or not 1 <= int(text) <= 1024:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number of processes, 1 to 1024")
    return int(text)
