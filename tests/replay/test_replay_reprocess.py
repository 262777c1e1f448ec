"""Measuring recorded pixels again: the same bits, or with what was asked to be otherwise."""

from __future__ import annotations

import contextlib
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from replaying import write_recording
from table_recordings import record

import vdms_replay.pieces
from vdms_replay import read
from vdms_replay.cli import run
from vdms_replay.reprocess import reprocess
from vdms_replay.source import TYPES, ReplayError, Source
from vdms_rt.logfile.reader import LogReader, StoredMessage
from vdms_rt.logfile.writer import LogMessage, LogWriter
from vdms_rt.wire import vdms_pb2 as pb


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("fields")
    (path,) = record(directory, "stamp_jitter_ms = 2.0\nlost_frames = 0.02")
    return path


@pytest.fixture(autouse=True)
def short_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(vdms_replay.pieces, "PIECE_FRAMES", 60)


def samples(path: Path) -> list[bytes]:
    """Return the serialised samples of a recording, in the order of the file."""
    return [
        item.value.SerializeToString()
        for item in Source([path]).items(("vdms.Displacement",))
        if hasattr(item, "value")
    ]


def error_mm(path: Path) -> np.ndarray:
    """Return the errors of x of all valid samples against the table's truth."""
    found = read(path)
    both = found.samples[found.samples["valid"]].merge(
        found.truth, on=["marker", "stamp_ns", "scan"], suffixes=("", "_true")
    )
    assert len(both) > 100
    return (both["x_mm"] - both["mean_x_mm"]).to_numpy()


@pytest.mark.parametrize("jobs", [1, 2])
def test_the_numbers_are_those_of_the_live_run_bit_for_bit(
    recording: Path, tmp_path: Path, jobs: int
) -> None:
    out = tmp_path / "again.mcap"
    account = reprocess(recording, out=out, jobs=jobs)
    assert (account.other, account.without_pixels, account.unknown) == (0, 0, 0)
    assert account.same == account.samples > 400
    assert "all the same as recorded, bit for bit" in "\n".join(account.sentences())
    again, live = samples(out), samples(recording)
    assert again == live[len(live) - len(again) :]


def test_the_new_recording_says_what_it_is(recording: Path, tmp_path: Path) -> None:
    out = tmp_path / "again.mcap"
    reprocess(recording, out=out, jobs=1, method="otsu")
    found, was = read(out), read(recording)
    facts = {fact.name: fact.value for fact in found.about.run.facts}
    assert facts["measured again"] == "method otsu"
    assert found.about.config["process"]["method"] == "otsu"
    assert found.about.ends[0].reason == "measured again"
    assert len(found.truth) == len(was.truth)
    assert found.about.attachments == was.about.attachments
    assert found.damage[0].complete


@pytest.mark.slow
@pytest.mark.parametrize(
    "options", [{"method": "otsu"}, {"sampling": "frame"}, {"refit_time": True}]
)
def test_a_change_gives_the_same_numbers_for_any_number_of_processes(
    recording: Path, tmp_path: Path, options: dict[str, str]
) -> None:
    numbers = []
    for jobs in (1, 2):
        out = tmp_path / f"{jobs}.mcap"
        assert reprocess(recording, out=out, jobs=jobs, **options).samples > 200
        numbers.append(samples(out))
    assert numbers[0] == numbers[1]


def test_another_method_measures_the_same_motion(recording: Path, tmp_path: Path) -> None:
    out = tmp_path / "otsu.mcap"
    account = reprocess(recording, out=out, jobs=1, method="otsu")
    assert account.changed
    assert account.status_other == 0
    assert 0.001 < np.std(error_mm(out)) < 0.05
    assert np.std(error_mm(recording)) < 0.005


def test_another_sampling_takes_its_reference_from_the_same_stills(
    recording: Path, tmp_path: Path
) -> None:
    out = tmp_path / "frames.mcap"
    reprocess(recording, out=out, jobs=1, sampling="frame")
    valid = read(out).samples.query("valid")
    assert set(valid["scan"].astype(str)) == {"bottom-first"}
    assert np.std(error_mm(out)) < 0.02
    (one, *_) = read(out).about.set_ups.values()
    assert one.set_up().stills == 15


def test_times_are_refitted_from_both_sides(recording: Path, tmp_path: Path) -> None:
    out = tmp_path / "refitted.mcap"
    reprocess(recording, out=out, jobs=1, refit_time=True)

    def off_ns(path: Path) -> np.ndarray:
        found = read(path)
        both = found.samples.query("valid").merge(
            found.truth, on=["marker", "stamp_ns", "scan"], suffixes=("", "_true")
        )
        return (both["t_ns"] - both["t_ns_true"]).to_numpy()

    assert np.abs(off_ns(out)).max() < 60_000
    assert np.std(off_ns(out)) < np.std(off_ns(recording))


def test_another_lens_moves_the_numbers(recording: Path, tmp_path: Path) -> None:
    lens = tmp_path / "lens.toml"
    lens.write_text("[lens]\nk1 = -0.02\n")
    account = reprocess(recording, out=tmp_path / "out.mcap", jobs=1, lens=lens)
    assert account.worst_mm > 0.001


@pytest.mark.slow
def test_a_part_from_the_middle_of_a_run_has_the_same_bits(tmp_path: Path) -> None:
    parts = record(tmp_path, record="rotate_mb = 5")
    assert len(parts) >= 2
    account = reprocess(parts[1], out=tmp_path / "part.mcap", jobs=1)
    assert account.other == 0
    assert account.same > 30
    assert account.unknown <= 31
    whole = reprocess(*parts, out=tmp_path / "whole.mcap", jobs=1)
    assert (whole.other, whole.unknown, whole.without_pixels) == (0, 0, 0)


@pytest.mark.slow
def test_small_circles_that_move_fast_have_the_same_bits(tmp_path: Path) -> None:
    """Their windows are larger than their regions."""
    (path,) = record(tmp_path, "fill = 0.15\n[table.motion]\namplitude_mm = 30\nfrequency_hz = 4")
    account = reprocess(path, out=tmp_path / "again.mcap", jobs=1)
    assert (account.other, account.without_pixels) == (0, 0)
    assert account.same > 400


@pytest.mark.slow
def test_a_marker_that_was_covered_and_searched_again_has_the_same_bits(tmp_path: Path) -> None:
    """The table carries the marker out of the picture and back."""
    (path,) = record(tmp_path, "[table.motion]\namplitude_mm = 300\nfrequency_hz = 0.3")
    found = read(path).samples
    assert not found["valid"].iloc[-200:].all()
    account = reprocess(path, out=tmp_path / "again.mcap", jobs=1)
    assert account.other == 0
    assert account.same > 400


@pytest.mark.slow
def test_checkpoints_of_another_version_are_no_obstacle(recording: Path, tmp_path: Path) -> None:
    other = tmp_path / "other.mcap"
    with LogReader(recording) as old, contextlib.closing(LogWriter(other)) as new:
        for record_ in old:
            if isinstance(record_, StoredMessage):
                assert record_.schema is not None
                type_ = TYPES[record_.schema.name]
                value = type_.FromString(record_.message.data)
                if isinstance(value, pb.Checkpoint):
                    value.json = value.json.replace('"slow":', '"slow_figures":')
                    value.json = value.json.replace('"evidence":', '"proof":')
                at_ns = record_.message.log_time
                data = value.SerializeToString()
                new.add(LogMessage(record_.channel.topic, type_, 0, at_ns, at_ns, data))
    account = reprocess(other, out=tmp_path / "again.mcap", jobs=1)
    assert account.worst_mm < 1e-3
    assert (account.status_other, account.without_pixels) == (0, 0)
    told = "\n".join(account.sentences())
    assert "of another version of vdms-rt; it was measured from its reference on" in told


def test_the_command_line(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = Path(shutil.copy(recording, tmp_path / "run.mcap"))
    assert run(["reprocess", str(path), "--jobs", "1"]) == 0
    printed = capsys.readouterr().out
    assert "x real time, 1 process\n" in printed
    assert f"written into {tmp_path / 'run-again.mcap'}" in printed
    assert run(["reprocess", str(path)]) == 1
    assert "run-again.mcap: exists; name another with --out, or overwrite it with --force" in (
        capsys.readouterr().err
    )


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["--lens", "no.toml"], "no.toml: cannot be read"),
        (["--out", "no/such/folder/x.mcap"], "no/such/folder/x.mcap: cannot be written"),
    ],
)
def test_what_cannot_be_used_is_one_sentence(
    recording: Path,
    capsys: pytest.CaptureFixture[str],
    options: list[str],
    sentence: str,
) -> None:
    assert run(["reprocess", str(recording), *options]) == 1
    told = capsys.readouterr().err
    assert sentence in told
    assert len(told.splitlines()) == 1


def test_a_recording_without_pixels_is_one_sentence(tmp_path: Path) -> None:
    path = write_recording(tmp_path / "lab.mcap")
    with pytest.raises(ReplayError, match="holds no pixels, so nothing can be measured again"):
        reprocess(path, out=tmp_path / "out.mcap", jobs=1)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["lab.mcap"]


def test_a_part_shorter_than_a_second_is_one_sentence(tmp_path: Path) -> None:
    path = write_recording(tmp_path / "lab.mcap", range(30), pixels=True)
    with pytest.raises(ReplayError, match="holds no checkpoint to begin from"):
        reprocess(path, out=tmp_path / "out.mcap", jobs=1)


@pytest.mark.slow
def test_a_part_without_stills_cannot_change_its_sampling(tmp_path: Path) -> None:
    parts = record(tmp_path, record="rotate_mb = 4")
    with pytest.raises(ReplayError, match="no pictures of the marker at rest"):
        reprocess(parts[1], out=tmp_path / "out.mcap", jobs=1, sampling="frame")
    assert json.loads(read(parts[1]).about.run.effective_config)["process"]["sampling"] == "auto"
    account = reprocess(parts[1], out=tmp_path / "otsu.mcap", jobs=1, method="otsu")
    assert account.samples > 30


def test_the_recording_itself_is_never_written_over(tmp_path: Path) -> None:
    path = write_recording(tmp_path / "lab.mcap", range(90), pixels=True)
    before = path.read_bytes()
    (tmp_path / "alias.mcap").symlink_to(path)
    for name in ("lab.mcap", "alias.mcap"):
        with pytest.raises(ReplayError, match=f"{name}: is the recording itself"):
            reprocess(path, out=tmp_path / name, jobs=1, force=True)
    assert path.read_bytes() == before
