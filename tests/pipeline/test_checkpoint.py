"""A run that goes on from a checkpoint gives the same numbers, bit for bit."""

from collections.abc import Callable

import numpy as np
import pytest

from vdms_rt.capture.table import TableSource
from vdms_rt.config import Config, parse_config
from vdms_rt.measure.gate import Workspace
from vdms_rt.measure.marker import find_markers
from vdms_rt.model import Frame, Luma, Scan
from vdms_rt.process.checkpoint import CheckpointError, checkpoint, resumed
from vdms_rt.process.pictures import pictures
from vdms_rt.process.progress import Phase, Plan, Progress
from vdms_rt.process.step import begin, found, step
from vdms_rt.setup import set_up_from_json, set_up_json
from vdms_rt.wire.convert import displacement_bytes

PERIOD_NS = 33_366_667
FRAMES = 90


def written_and_read(progress: Progress) -> Progress:
    set_up = progress.set_up
    return resumed(
        checkpoint(progress),
        None if set_up is None else set_up_from_json(set_up_json(set_up)),
        progress.session,
    )


def measured(
    config: Config,
    frames: list[Luma],
    scan: Scan,
    between: Callable[[int, Progress], Progress],
) -> list[bytes]:
    """Return the samples of all pictures; `between` is called before each."""
    progress = begin(Plan.of(config), 7, 720, 480, exposure_ns=5_000_000, period_ns=PERIOD_NS)
    work = Workspace()
    samples = []
    for n, image in enumerate(frames):
        t_ns = 10**9 + n * PERIOD_NS
        frame = Frame(n, t_ns, t_ns, 4000, 0, 0, PERIOD_NS, image, scan, 0, 5_000_000)
        for picture in pictures(frame, config.process.sampling, progress.order):
            if progress.searched:
                progress, _ = found(progress, find_markers(image, progress.plan.shapes, scan), t_ns)
            progress = between(picture.seq, progress)
            progress, given, _ = step(progress, picture, work)
            samples += [displacement_bytes(sample) for sample in given]
    assert progress.phase is Phase.MEASURING
    return samples


@pytest.mark.parametrize(
    ("scan", "settings"),
    [
        ("bottom-first", ""),
        ("bottom-first", "[process]\nmethod = 'otsu'\nsampling = 'frame'"),
        ("progressive", "[lens]\nk1 = -0.01\n[[marker]]\naxis_deg = 3.0"),
    ],
)
def test_a_run_goes_on_from_every_checkpoint_with_the_same_bits(scan: str, settings: str) -> None:
    config = parse_config(
        f"source = 'table'\n[table]\npace = 'fast'\nrest_s = 1.2\nscan = '{scan}'\n"
        f"{settings}\n[setup]\nreference_pictures = 15",
        "test",
    )
    source = TableSource(config.table, [m.shape for m in config.marker], lambda truth: None)
    frames = []
    for n in range(FRAMES):
        image = np.empty((480, 720), np.uint8)
        assert source.read(image, 10) is not None
        if 50 <= n < 62:
            image[:, 300:] = 60  # out of sight, and then found again
        frames.append(image)
    source.close()
    straight = measured(config, frames, source.info.scan, lambda seq, progress: progress)
    halting = measured(
        config,
        frames,
        source.info.scan,
        lambda seq, progress: progress if seq % 7 else written_and_read(progress),
    )
    assert halting == straight


def test_what_is_no_checkpoint_is_told() -> None:
    with pytest.raises(CheckpointError, match="not one of this version"):
        resumed("{}", None, 1)


def test_a_checkpoint_without_its_set_up_is_told() -> None:
    config = parse_config("", "test")
    progress = begin(Plan.of(config), 1, 720, 480)
    text = checkpoint(progress).replace('"has_set_up":false', '"has_set_up":true')
    with pytest.raises(CheckpointError, match="set-up of revision 0 stands in no readable part"):
        resumed(text, None, 1)
