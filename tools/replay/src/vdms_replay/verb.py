"""What the verbs share: their parser, typed options, and the progress bar."""

from __future__ import annotations

import argparse
import contextlib
import math
import sys
from collections.abc import Callable, Iterator
from typing import Any, TypeAlias

from rich.console import Console
from rich.progress import (
    BarColumn,
    DownloadColumn,
    Progress,
    TaskProgressColumn,
    TextColumn,
    TimeRemainingColumn,
)

Verbs: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"
Advance: TypeAlias = Callable[[int], None]
"""Called with how much of the work is done since the last call."""


def make_parser(
    verbs: Verbs, name: str, run: Callable[[argparse.Namespace], int], short: str, long: str
) -> argparse.ArgumentParser:
    """Return a verb's parser: `short` is its line in the list of verbs, `long` its help."""
    parser = verbs.add_parser(
        name, help=short, description=f"{short[0].upper()}{short[1:]}. {long}"
    )
    parser.set_defaults(run=run)
    return parser


def number(least: float, most: float, rule: str) -> Callable[[str], float]:
    """Return a type for argparse: a number between `least` and `most`; `rule` says it in words."""

    def parse(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not least <= value <= most:
            raise argparse.ArgumentTypeError(f"{text!r} is not {rule}")
        return value

    return parse


@contextlib.contextmanager
def progress(text: str, total: int, *, in_bytes: bool = True) -> Iterator[Advance]:
    """Show a bar on stderr, if that is a terminal, while the work goes on."""
    console = Console(stderr=True)
    columns: list[Any] = [TextColumn("{task.description}"), BarColumn(), TaskProgressColumn()]
    if in_bytes:
        columns.append(DownloadColumn())
    columns.append(TimeRemainingColumn())
    with Progress(
        *columns, console=console, transient=True, disable=not sys.stderr.isatty()
    ) as bar:
        task = bar.add_task(text, total=total)
        yield lambda amount: bar.advance(task, amount)
