"""Reading and repairing files that were cut off or damaged."""

from __future__ import annotations

import os
import random

import pytest
from logbook import SAMPLES, files, read_whole, rerun, sample_bytes, samples_in
from mcap.reader import make_reader

from vdms_rt.logfile.reader import LogFileError, LogReader, StoredMessage
from vdms_rt.logfile.repair import copy_readable, repair, repair_directory
from vdms_rt.logfile.writer import LogAttachment, LogMessage, LogWriter
from vdms_rt.wire import vdms_pb2 as pb

CHUNKS, PER_CHUNK = 20, 25


def written(directory, *, complete):
    """Return a file of 20 chunks with 25 samples each, and what stands before each one's end."""
    directory.mkdir(exist_ok=True)
    log = LogWriter(directory / "log.mcap")
    log.add_metadata("vdms", {"station": "lab"})
    log.attach(LogAttachment("reference.png", "image/png", 1, b"picture" * 100), 0)
    ends = []
    for chunk in range(CHUNKS):
        for seq in range(chunk * PER_CHUNK, (chunk + 1) * PER_CHUNK):
            log.add(LogMessage(SAMPLES, pb.Displacement, seq, seq, seq, sample_bytes(seq)))
        log.sync()
        ends.append(log.length)
    if complete:
        log.close()
        return log.path, ends
    log.abandon()
    return log.part_path, ends


def read_seqs(path):
    with LogReader(path) as reader:
        seqs = [r.message.sequence for r in reader if isinstance(r, StoredMessage)]
        return seqs, reader


def test_a_complete_file_is_read_whole(tmp_path):
    path, _ = written(tmp_path, complete=True)
    seqs, reader = read_seqs(path)
    assert seqs == list(range(CHUNKS * PER_CHUNK))
    assert reader.complete
    assert not reader.faults
    assert reader.dropped_bytes == 0


def test_cut_off_anywhere_every_whole_chunk_is_read_and_repaired(tmp_path):
    path, ends = written(tmp_path / "whole", complete=False)
    data = path.read_bytes()
    cuts = [random.Random(1).randrange(1, len(data)) for _ in range(200)] + ends
    for number, cut in enumerate(cuts):
        part = tmp_path / "cut.mcap.part"
        part.write_bytes(data[:cut])
        # A chunk is readable from its own end on; its index comes after it.
        whole = sum(end <= cut for end in ends)
        if cut < 8:
            (left,) = repair_directory(tmp_path)
            assert left.path == part
            assert part.read_bytes() == data[:cut]
            continue
        seqs, reader = read_seqs(part)
        assert not reader.complete
        assert seqs == list(range(len(seqs)))
        assert whole * PER_CHUNK <= len(seqs) <= (whole + 1) * PER_CHUNK
        if number % 5:
            continue
        repaired = repair(part)
        assert repaired.messages == len(seqs)
        assert samples_in(repaired.path) == seqs
        repaired.path.unlink()


def test_damage_in_the_middle_costs_the_chunk_it_hits_and_no_other(tmp_path):
    path, ends = written(tmp_path, complete=True)
    data = path.read_bytes()
    everything = list(range(CHUNKS * PER_CHUNK))
    chance = random.Random(2)
    for _ in range(500):
        at = chance.randrange(8, ends[-1])
        damaged = bytearray(data)
        damaged[at] ^= 1 << chance.randrange(8)
        (tmp_path / "damaged.mcap").write_bytes(damaged)
        seqs, _ = read_seqs(tmp_path / "damaged.mcap")
        assert set(seqs) <= set(everything)
        assert seqs == sorted(seqs)
        assert len(seqs) >= (CHUNKS - 1) * PER_CHUNK, f"bit flipped in byte {at}"


def test_what_is_recovered_from_a_damaged_file_is_a_complete_one_to_others(tmp_path):
    path, ends = written(tmp_path, complete=True)
    damaged = bytearray(path.read_bytes())
    for chunk in (0, 7):  # the first holds the schema and the channel
        damaged[ends[chunk] - 600] ^= 0xFF
    path.write_bytes(damaged)
    out = tmp_path / "out.mcap"
    with LogReader(path) as reader, out.open("wb") as file:
        assert copy_readable(reader, file) == (CHUNKS - 2) * PER_CHUNK
    expected = [s for s in range(CHUNKS * PER_CHUNK) if s // PER_CHUNK not in (0, 7)]
    assert samples_in(out) == expected
    with out.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        indexed = reader.iter_messages(topics=[SAMPLES], starting_at=300, ending_before=310)
        assert [message.sequence for _, _, message in indexed] == list(range(300, 310))
        assert [a.data for a in reader.iter_attachments()] == [b"picture" * 100]
        metadata = {m.name: m.metadata for m in reader.iter_metadata()}
    assert metadata["vdms"] == {"station": "lab"}
    assert metadata["repair"]["dropped_bytes"] != "0"
    info = rerun(tmp_path, "mcap", "info", str(out))
    assert "Summary                  embedded" in info.stdout
    check = rerun(tmp_path, "mcap", "check", "--full", str(out))
    assert check.returncode == 0, check.stdout


def test_messages_whose_channel_is_lost_are_left_out_and_counted(tmp_path):
    path, ends = written(tmp_path, complete=False)
    damaged = bytearray(path.read_bytes())
    damaged[ends[0] - 600] ^= 0xFF
    path.write_bytes(damaged)
    seqs, reader = read_seqs(path)
    assert seqs == []
    assert "channel" in reader.faults[-1]
    assert reader.dropped_bytes > 0


def test_repair_keeps_the_original_until_the_new_file_is_on_the_disk(tmp_path, monkeypatch):
    path, _ = written(tmp_path, complete=False)
    data = path.read_bytes()
    monkeypatch.setattr(os, "fsync", lambda fd: (_ for _ in ()).throw(OSError(28, "No space")))
    with pytest.raises(OSError, match="No space"):
        repair(path)
    assert files(tmp_path) == [path]
    assert path.read_bytes() == data


def test_repair_says_what_it_did(tmp_path):
    path, ends = written(tmp_path, complete=False)
    with path.open("r+b") as file:
        file.truncate(ends[-1] - 400)
    (repaired,) = repair_directory(tmp_path)
    assert files(tmp_path) == [tmp_path / "log.mcap"]
    assert repaired.sentence == (
        f"{tmp_path / 'log.mcap'}: repaired, {repaired.messages} messages, "
        f"{repaired.dropped_bytes} unreadable bytes left out"
    )
    assert repair_directory(tmp_path) == []


def test_repair_overwrites_nothing(tmp_path):
    written(tmp_path, complete=False)
    (tmp_path / "log.mcap").write_bytes(b"another")
    (repaired,) = repair_directory(tmp_path)
    assert repaired.path == tmp_path / "log-2.mcap"
    assert (tmp_path / "log.mcap").read_bytes() == b"another"
    assert len(read_whole(repaired.path)) == CHUNKS * PER_CHUNK


def test_a_complete_file_that_only_lacks_its_name_is_kept_whole(tmp_path):
    path, _ = written(tmp_path, complete=True)
    path.rename(tmp_path / "log.mcap.part")
    (repaired,) = repair_directory(tmp_path)
    assert repaired.dropped_bytes == 0
    assert len(read_whole(repaired.path)) == CHUNKS * PER_CHUNK


def test_files_with_nothing_in_them(tmp_path):
    (tmp_path / "a.mcap.part").write_bytes(b"")
    (tmp_path / "b.mcap.part").write_bytes(bytes(4096))
    empty, zeros = repair_directory(tmp_path)
    assert empty.sentence == f"{tmp_path}/a.mcap.part: removed, nothing had reached the disk"
    assert "stays" in zeros.sentence
    assert "not an MCAP file" in zeros.sentence
    assert files(tmp_path) == [tmp_path / "b.mcap.part"]


def test_a_file_that_is_not_there_or_not_an_mcap(tmp_path):
    with pytest.raises(LogFileError, match="no such file"):
        LogReader(tmp_path / "none.mcap")
    with pytest.raises(LogFileError, match="is a directory"):
        LogReader(tmp_path)
    (tmp_path / "text.mcap").write_text("hello, this is text")
    with pytest.raises(LogFileError, match="not an MCAP file"):
        LogReader(tmp_path / "text.mcap")


def test_the_writer_overwrites_nothing(tmp_path):
    (tmp_path / "a.mcap").write_bytes(b"x")
    (tmp_path / "b.mcap.part").write_bytes(b"x")
    for name in ("a.mcap", "b.mcap"):
        with pytest.raises(FileExistsError):
            LogWriter(tmp_path / name)
    assert len(files(tmp_path)) == 2
