"""`vdms-replay export`: a recording in the format of another program."""

from __future__ import annotations

import argparse
import contextlib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from vdms_replay.columns import MEANINGS, UNITS, Clock, Samples
from vdms_replay.formats import FORMATS, FormatError, Writer
from vdms_replay.load import ROWS_AT_ONCE, About, Once, iso, metadata
from vdms_replay.source import SAMPLE, Entry, PathLike, ReplayError, Source, keep
from vdms_replay.verb import Verbs, make_parser, progress
from vdms_rt.wire import vdms_pb2 as pb

ABOUT = ("vdms.Run", "vdms.SetUp", "vdms.Event", "vdms.End")
SI = {"mm": ("m", 1e-3), "mrad": ("rad", 1e-3)}


def add_parser(verbs: Verbs) -> None:
    parser = make_parser(
        verbs,
        "export",
        run,
        "write a recording in the format of another program",
        "All samples of all markers (or of one), numbers unchanged, units in the names, times as "
        "UTC and as seconds from the first sample, with what the recording says about itself. "
        "It takes no more memory for a longer recording. uff58 holds the valid samples, each "
        "stretch without a gap as a function of its own.",
    )
    parser.add_argument("files", nargs="+", type=Path, metavar="FILE")
    parser.add_argument("--to", required=True, choices=tuple(FORMATS))
    parser.add_argument("--marker", metavar="NAME", help="this marker alone")
    parser.add_argument(
        "--si", action="store_true", help="metres and radians instead of mm and mrad"
    )
    add_output_options(parser)


def add_output_options(parser: argparse.ArgumentParser) -> None:
    """Add `--out` and `--force`."""
    parser.add_argument(
        "--out", type=Path, metavar="FILE", help="(default: the recording's name, beside it)"
    )
    parser.add_argument("--force", action="store_true", help="overwrite FILE")


def run(arguments: argparse.Namespace) -> int:
    source = Source(arguments.files)
    with progress("exporting", 2 * source.size_bytes) as advance:
        sentences = export(
            *arguments.files,
            to=arguments.to,
            out=arguments.out,
            marker=arguments.marker,
            si=arguments.si,
            force=arguments.force,
            advance=advance,
        )
    print("\n".join(sentences))
    return 0


def export(
    *files: PathLike,
    to: str,
    out: PathLike | None = None,
    marker: str | None = None,
    si: bool = False,
    force: bool = False,
    advance: Callable[[int], None] | None = None,
) -> list[str]:
    """Write a recording in the format `to` and return sentences that say what was written.

    Raises ReplayError.
    """
    source = Source(files)
    target = target_path(source.paths, to, out)
    keep_existing(target, force=force)
    about = About()
    clock = Clock()
    for item in source.items(ABOUT, advance):
        about.take(item)
    start = next(_batches(source, clock, None, 1), None)
    if start is None:
        raise ReplayError(
            f"{source.paths[0]}: holds no displacement, so there is nothing to export"
        )
    meta = metadata(about, source.paths, list(source.damage.values()))
    meta |= {
        "start": iso(clock.start_ns or 0) if clock.utc else "",
        "units": {
            si_name(name) if si else name: si_unit(u) if si else u for name, u in UNITS.items()
        },
        "meanings": {si_name(name) if si else name: text for name, text in MEANINGS.items()},
    }
    counts: dict[str, int] = {}
    with writing(target, to, meta, force=force) as writer:
        for table in _batches(source, Clock(), advance, ROWS_AT_ONCE):
            for name, part in table.groupby("marker", sort=False):
                if marker is None or name == marker:
                    counts[str(name)] = counts.get(str(name), 0) + len(part)
                    writer.add(str(name), to_si(part) if si else part)
        if not counts:
            raise ReplayError(f"the recording has no marker {marker}")
    many = ", ".join(f"{count} samples of marker {name}" for name, count in counts.items())
    sentences = [f"{target}: {many}, {_size(target)}"]
    sentences += [f"{target}: {note}" for note in writer.notes]
    return [*sentences, *meta["not_readable"]]


def _batches(
    source: Source, clock: Clock, advance: Callable[[int], None] | None, size: int
) -> Iterator[pd.DataFrame]:
    samples, once = Samples(clock), Once()
    for item in source.items((SAMPLE,), advance):
        if (
            isinstance(item, Entry)
            and isinstance(item.value, pb.Displacement)
            and once.is_new(item.value)
        ):
            samples.add(item.value)
            if len(samples) >= size:
                yield samples.take()
    if len(samples):
        yield samples.take()


def target_path(recordings: Sequence[Path], to: str, out: PathLike | None) -> Path:
    """Return where the file goes: `out`, or the first recording's name with the format's ending.

    Raises ReplayError if that is a recording itself.
    """
    stem = recordings[0].name.partition(".mcap")[0]
    target = Path(out) if out is not None else recordings[0].with_name(stem + FORMATS[to][0])
    keep(recordings, target)
    return target


def keep_existing(path: Path, *, force: bool) -> None:
    """Raise ReplayError if a file is there that may not be overwritten."""
    if path.exists() and not force:
        raise ReplayError(f"{path}: is there already; choose another --out, or --force")


@contextlib.contextmanager
def writing(path: Path, to: str, meta: dict[str, Any], *, force: bool) -> Iterator[Writer]:
    """Give a writer of the file; it gets its name when it is complete. Raises ReplayError."""
    keep_existing(path, force=force)
    begun = path.with_name(path.name + ".part")
    try:
        # Here, since not every library says what is wrong with a place.
        begun.touch()
        begun.unlink()
        writer = FORMATS[to][1](begun, meta)
        try:
            yield writer
        except BaseException:
            with contextlib.suppress(FormatError, OSError):
                writer.discard()
            raise
        writer.close()
        begun.replace(path)
    except FormatError as error:
        raise ReplayError(f"{path}: {error}") from None
    except OSError as error:
        raise ReplayError(f"{path}: {(error.strerror or str(error)).lower()}") from None
    finally:
        with contextlib.suppress(OSError):
            begun.unlink(missing_ok=True)


def _size(path: Path) -> str:
    size = path.stat().st_size
    return f"{size / 1e6:.1f} MB" if size >= 1e6 else f"{size / 1e3:.1f} kB"


def to_si(table: pd.DataFrame) -> pd.DataFrame:
    """Return the table with metres and radians for millimetres and milliradians; names follow."""
    converted = {
        name: table[name] * SI[unit][1] for name in table.columns if (unit := _unit(name)) in SI
    }
    return table.assign(**converted).rename(columns=si_name)


def si_name(name: str) -> str:
    """Return a column's name in SI units: `x_m` for `x_mm`."""
    return "_".join(SI[word][0] if word in SI else word for word in name.split("_"))


def si_unit(unit: str) -> str:
    """Return a unit in SI: `m/s` for `mm/s`."""
    return "/".join(SI[word][0] if word in SI else word for word in unit.split("/"))


def _unit(name: str) -> str:
    return next((word for word in name.split("_") if word in SI), "")
