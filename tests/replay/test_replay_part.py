"""A part of a recording: the right samples in few bytes, and not more than a limit."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from replaying import PERIOD_NS, write_recording

from vdms_replay import part
from vdms_replay.cli import run
from vdms_replay.load import read
from vdms_replay.part import Part, read_part
from vdms_replay.report_content import NEEDED
from vdms_rt.wire import vdms_pb2 as pb


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """Ten seconds of two markers."""
    return write_recording(
        tmp_path_factory.mktemp("part") / "a.mcap",
        range(600),
        lost=range(100, 105),
        status={7: pb.NOT_FOUND, 9: pb.SATURATED},
        markers=("m1", "m2"),
        truth=True,
    )


@pytest.fixture
def small_batches(monkeypatch):
    monkeypatch.setattr(part, "ROWS_AT_ONCE", 64)


@pytest.mark.parametrize(("from_s", "to_s"), [(-np.inf, np.inf), (2.0, 7.0), (9.9, np.inf)])
def test_it_is_what_the_whole_recording_has_there(recording, small_batches, from_s, to_s):
    found = read_part(recording, part=Part(NEEDED, "m2", from_s, to_s))
    whole = read(recording).of_marker("m2")
    expected = whole[(whole["time_s"] >= from_s) & (whole["time_s"] <= to_s)]
    assert len(found.samples) == len(expected) > 5
    for name in NEEDED:
        values = found.samples[name].astype(expected[name].dtype)
        np.testing.assert_array_equal(values, expected[name], err_msg=name)
    assert found.markers == ("m1", "m2")
    assert found.about.station == "lab"
    assert len(found.health) == 1
    assert found.truth.empty


def test_texts_take_a_byte_or_two(recording):
    held = read_part(recording, part=Part(NEEDED, "m2")).samples
    assert held.memory_usage(index=False, deep=True).sum() < 130 * len(held) + 2000


def told(capsys, *arguments):
    assert run([*map(str, arguments)]) == 1
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    return error


def orders(recording, folder):
    reference = folder / "ldv.csv"
    time_s = np.arange(0, 12, 1 / 500)
    pd.DataFrame({"time_s": time_s, "x_mm": 10 * np.sin(2 * np.pi * time_s)}).to_csv(
        reference, index=False
    )
    yield ("derive", recording, "--modes")
    yield ("report", recording, "--out", folder / "a.pdf")
    yield ("compare", recording, "--reference", reference)


def test_more_than_the_limit_is_refused_and_a_part_of_it_is_not(
    recording, tmp_path, capsys, monkeypatch, small_batches
):
    monkeypatch.setattr(part, "MOST_SAMPLES", 400)
    for order in orders(recording, tmp_path):
        error = told(capsys, *order, "--marker", "m1")
        assert "marker m1 has 595 samples, and 400 are the most that are taken at once" in error
        assert "choose a part with --from-s and --to-s, here of 6.7" in error
        error = told(capsys, *order, "--marker", "m1", "--from-s", 1)
        assert "marker m1 has more than 400 samples after 1 s, and 400 are the most" in error
        inside = ("--marker", "m1", "--from-s", 3, "--to-s", 9)
        assert run([*map(str, (*order, *inside))]) == 0
    assert not [path.name for path in tmp_path.iterdir() if path.suffix == ".part"]


def test_a_file_without_an_end_is_counted_as_it_is_read(tmp_path, capsys, monkeypatch):
    path = write_recording(tmp_path / "a.mcap", range(300), finish=False)
    monkeypatch.setattr(part, "MOST_SAMPLES", 100)
    monkeypatch.setattr(part, "ROWS_AT_ONCE", 64)
    assert "more than 100 samples" in told(capsys, "derive", path, "--modes")


def test_derive_takes_the_samples_between_two_times_alone(recording, tmp_path):
    tables = {}
    for name, options in (("whole", ()), ("part", ("--from-s", "4", "--to-s", "8"))):
        out = tmp_path / f"{name}.csv"
        order = ["derive", str(recording), "--marker", "m1", "--to", "csv", "--out", str(out)]
        assert run([*order, *options]) == 0
        tables[name] = pd.read_csv(out, comment="#")
    time_s = tables["part"]["time_s"]
    assert (time_s.min(), time_s.max()) == pytest.approx((4, 8), abs=2e-9 * PERIOD_NS)
    whole = np.interp(time_s, tables["whole"]["time_s"], tables["whole"]["x_mm"])
    np.testing.assert_allclose(tables["part"]["x_mm"], whole, atol=0.02)


def test_a_part_without_samples_is_said(recording, capsys):
    error = told(capsys, "derive", recording, "--modes", "--marker", "m1", "--from-s", 100)
    assert "no sample of marker m1 lies after 100 s; it has samples from 0.0 to 10.0 s" in error
    error = told(capsys, "derive", recording, "--modes")
    assert "has the markers m1, m2; choose one with --marker" in error
