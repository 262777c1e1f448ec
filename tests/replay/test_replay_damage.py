"""The damaged-file corpus: cut off at 200 places, bytes flipped at 500. Nothing raises or hangs,
every sample outside of the damage is there and unchanged, and what is missing is told."""

from __future__ import annotations

import contextlib
import random

import pytest
from logbook import read_whole
from replaying import t_ns_of, write_recording, x_mm_of

from vdms_replay.cli import run
from vdms_replay.info import info
from vdms_replay.load import read
from vdms_replay.recover import recover
from vdms_replay.source import ReplayError
from vdms_replay.track import Programme
from vdms_rt.logfile.reader import LogReader, StoredMessage
from vdms_rt.wire import vdms_pb2 as pb

SAMPLES = 120
CUTS = 200
FLIPS = 500


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A recording with pixels, truth, health, events and an attachment; each chunk's extent and
    samples."""
    path = write_recording(
        tmp_path_factory.mktemp("whole") / "a.mcap",
        range(SAMPLES),
        truth=True,
        pixels=True,
        sync_every=10,
    )
    chunks = []
    with LogReader(path) as reader:
        for block in reader.blocks():
            seqs = {
                pb.Displacement.FromString(record.message.data).seq
                for record in block.records
                if isinstance(record, StoredMessage) and record.schema.name == "vdms.Displacement"
            }
            if seqs:
                chunks.append((block.offset, block.offset + 9 + len(block.content), seqs))
    assert len(chunks) > 10
    assert set().union(*(seqs for _, _, seqs in chunks)) == set(range(SAMPLES))
    return path.read_bytes(), chunks


def attempt(path):
    """Return the recording and nothing, or nothing and the sentence."""
    try:
        return read(path), ""
    except ReplayError as error:
        return None, str(error)


def check(path, expected, *, must_tell=False, all_ways=True):
    """Every way to read the file gives at least the expected samples, unchanged."""
    recording, refusal = attempt(path)
    if recording is None:
        assert not expected, f"not read although samples are left: {refusal}"
        assert refusal.startswith(str(path))
        return
    table = recording.samples
    seqs = list(table["seq"])
    assert seqs == sorted(set(seqs))
    assert expected <= set(seqs) <= set(range(SAMPLES))
    assert list(table["x_mm"]) == [x_mm_of(seq) for seq in seqs]
    assert list(table["t_ns"]) == [t_ns_of(seq) for seq in seqs]
    assert set(table["marker"]) <= {"m1"}
    told = [sentence for one in recording.damage for sentence in one.sentences()]
    assert told or not (must_tell or len(seqs) < SAMPLES)
    if not all_ways:
        return
    assert info(path)["markers"].get("m1", {"samples": 0})["samples"] == len(seqs)
    out = path.with_name("out.mcap")
    recover(path, out)
    recovered = [m.seq for topic, _, m in read_whole(out) if topic.endswith("displacement")]
    assert recovered == seqs
    out.unlink()
    if seqs:
        programme = Programme([path], lambda _: None)
        assert programme.samples == len(seqs)
        programme.close()


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_cut_off_anywhere(whole, tmp_path):
    data, chunks = whole
    chance = random.Random(1)
    path = tmp_path / "cut.mcap"
    lengths = [*range(12), *(chance.randrange(len(data)) for _ in range(CUTS - 12))]
    for number, length in enumerate(lengths):
        path.write_bytes(data[:length])
        expected = set().union(*(seqs for _, end, seqs in chunks if end <= length))
        check(path, expected, must_tell=True, all_ways=number % 4 == 0)


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_byte_flipped_anywhere(whole, tmp_path):
    data, chunks = whole
    chance = random.Random(2)
    path = tmp_path / "flipped.mcap"
    for number in range(FLIPS):
        at = chance.randrange(8, len(data)) if number else 3
        damaged = bytearray(data)
        damaged[at] ^= 1 << chance.randrange(8) if number % 2 else chance.randrange(1, 256)
        path.write_bytes(damaged)
        expected = set().union(*(seqs for start, end, seqs in chunks if not start <= at < end))
        check(path, expected if number else set(), all_ways=number % 10 == 0)


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_garbage_in_the_middle_and_at_both_ends(whole, tmp_path):
    data, chunks = whole
    chance = random.Random(3)
    path = tmp_path / "garbage.mcap"
    for _ in range(60):
        start = chance.randrange(8, len(data))
        end = min(start + chance.randrange(1, 20_000), len(data))
        path.write_bytes(data[:start] + chance.randbytes(end - start) + data[end:])
        expected = set().union(*(s for a, b, s in chunks if b <= start or a >= end))
        check(path, expected)


def test_every_verb_says_in_a_sentence_that_nothing_is_readable(tmp_path, capsys):
    path = tmp_path / "torn.mcap"
    write_recording(tmp_path / "a.mcap", range(30))
    path.write_bytes((tmp_path / "a.mcap").read_bytes()[:60])
    for arguments in (
        ["info", path],
        ["export", path, "--to", "csv"],
        ["play", path],
    ):
        assert run([str(argument) for argument in arguments]) == 1
        error = capsys.readouterr().err
        assert error.startswith("vdms-replay: ")
        assert error.count("\n") == 1


def test_a_missing_end_is_told(tmp_path):
    path = write_recording(tmp_path / "a.mcap", range(30))
    assert info(path)["not_readable"] == []
    path.write_bytes(path.read_bytes()[:-20])
    assert "unfinished" in info(path)["not_readable"][0]
    with pytest.raises(ReplayError, match="file exists"):
        recover(path, path)


def test_recovering_tells_how_far_it_is(tmp_path, monkeypatch):
    part = write_recording(tmp_path / "lab.mcap", range(120), finish=False)
    told = []

    @contextlib.contextmanager
    def bar(text, total):
        told.append([text, total, 0])

        def advance(amount):
            told[-1][2] += amount

        yield advance

    monkeypatch.setattr("vdms_replay.recover.progress", bar)
    recover(part, tmp_path / "copy.mcap")
    size_bytes = part.stat().st_size
    recover(part)
    recover(tmp_path / "lab.mcap")
    assert [text for text, _, _ in told] == [
        "recovering lab.mcap.part",
        "recovering lab.mcap.part",
        "checking lab.mcap",
    ]
    assert all(0.5 * total < done <= total for _, total, done in told)
    assert told[0][1] == size_bytes
