"""A recording beside a vibrometer: the paper's experiment on the virtual table."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from table_recordings import record
from vibrometer import Vibrometer

from vdms_replay.cli import run

Case = tuple[Path, Path]


@pytest.fixture(scope="module")
def frames(tmp_path_factory: pytest.TempPathFactory) -> Case:
    directory = tmp_path_factory.mktemp("frames")
    (recording,) = record(directory, 'scan = "progressive"', record='pixels = "none"')
    return recording, Vibrometer().write_csv(recording, directory / "ldv.csv")


@pytest.fixture(scope="module")
def fields(tmp_path_factory: pytest.TempPathFactory) -> Case:
    directory = tmp_path_factory.mktemp("fields")
    (recording,) = record(directory, "angle_deg = 30", record='pixels = "none"')
    return recording, Vibrometer().write_csv(recording, directory / "ldv.csv")


@pytest.fixture(scope="module")
def woven(tmp_path_factory: pytest.TempPathFactory) -> Case:
    directory = tmp_path_factory.mktemp("woven")
    (recording,) = record(
        directory,
        "exposure_ms = 8.0\n[table.motion]\nfrequency_hz = 3.0",
        extra="[process]\nsampling = 'frame'",
        record='pixels = "none"',
    )
    return recording, Vibrometer().write_csv(recording, directory / "ldv.csv")


def compared(capsys: pytest.CaptureFixture[str], case: Case, *options: str) -> dict:
    recording, reference = case
    status = run(["compare", str(recording), "--reference", str(reference), "--json", *options])
    printed = capsys.readouterr()
    assert status == 0, printed.err
    return json.loads(printed.out)


def test_frames_beside_a_vibrometer(frames: Case, capsys: pytest.CaptureFixture[str]) -> None:
    found = compared(capsys, frames, "--find-clock-rate", "--paper")
    assert found["offset_s"] == pytest.approx(1.234, abs=1e-4)
    assert found["clock_rate_ppm"] == pytest.approx(50, abs=5)
    assert found["error_percent"] <= 0.03
    assert found["paper_error_percent"] == pytest.approx(0.4, abs=0.04)
    assert found["sampling"] == "progressive"
    assert found["gain"] == pytest.approx(1, abs=1e-4)
    (line,) = found["frequencies"]
    assert line["frequency_hz"] == pytest.approx(1.0, abs=0.02)
    assert abs(line["amplitude_error_percent"]) < 0.02
    assert abs(line["phase_error_deg"]) < 0.02
    assert found["other_offset_s"] is None


def test_fields_beside_a_vibrometer(fields: Case, capsys: pytest.CaptureFixture[str]) -> None:
    found = compared(capsys, fields, "--find-clock-rate", "--paper")
    assert found["offset_s"] == pytest.approx(1.234, abs=1e-4)
    assert found["error_percent"] <= 0.03
    assert found["paper_error_percent"] == pytest.approx(0.1, abs=0.02)
    assert found["sampling"] == "field"
    assert (found["distance_m"], found["angle_deg"]) == (8.0, 30.0)


@pytest.mark.slow
def test_a_woven_frame_is_compared_with_the_mean_over_both_fields(
    woven: Case, capsys: pytest.CaptureFixture[str]
) -> None:
    found = compared(capsys, woven, "--find-clock-rate")
    assert found["sampling"] == "frame"
    assert found["exposure_ms"] == pytest.approx(8.0)
    # The two fields lie a quarter of a period off, which damps 3 Hz by 1.2 %.
    assert found["gain"] == pytest.approx(1, abs=3e-4)
    # Their exposure damps it by sin(x) / x of x = pi 3 Hz 8 ms.
    sharp = compared(capsys, woven, "--find-clock-rate", "--exposure-ms", "0")
    assert sharp["gain"] - found["gain"] == pytest.approx(-9.5e-4, abs=5e-5)


def test_clocks_that_differ_are_hinted_at(fields: Case, capsys: pytest.CaptureFixture[str]) -> None:
    found = compared(capsys, fields)
    assert found["clock_rate_ppm"] == 0
    assert any("--find-clock-rate" in note for note in found["notes"])


def test_the_page_names_the_figures(fields: Case, capsys: pytest.CaptureFixture[str]) -> None:
    recording, reference = fields
    assert run(["compare", str(recording), "--reference", str(reference)]) == 0
    page = capsys.readouterr().out
    for words in ("Eq. 3.1", "RMS difference", "peak to peak", "drift", "6000 Hz", "coherence"):
        assert words in page


def test_several_recordings_make_a_plot_over_distance_and_angle(
    frames: Case, fields: Case, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plot = tmp_path / "cases.pdf"
    files = [str(frames[0]), str(fields[0])]
    references = [str(frames[1]), str(fields[1])]
    options = ["--find-clock-rate", "--plot", str(plot)]
    assert run(["compare", *files, "--reference", *references, *options]) == 0
    page = capsys.readouterr().out
    assert len(page.splitlines()) == 5
    assert plot.read_bytes().startswith(b"%PDF")


def test_a_plot_of_one_recording(fields: Case, tmp_path: Path) -> None:
    plot = tmp_path / "one.svg"
    recording, reference = fields
    options = ["--reference", str(reference), "--plot", str(plot)]
    assert run(["compare", str(recording), *options]) == 0
    assert "<svg" in plot.read_text()


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (("--column", "z_mm"), "has no column z_mm; it has x_mm"),
        (("--marker", "m9"), "has no marker m9; it has m1"),
        (("--from-s", "500"), "no sample of marker m1 lies after 500 s"),
        (("--offset", "300"), "no common motion within 0.5 s of the offset 300 s"),
        (("--plot", "plot.doc"), "a plot is a .pdf, .svg or .png file, not .doc"),
    ],
)
def test_what_cannot_be_compared_is_one_sentence(
    fields: Case, capsys: pytest.CaptureFixture[str], options: tuple[str, str], sentence: str
) -> None:
    recording, reference = fields
    assert run(["compare", str(recording), "--reference", str(reference), *options]) == 1
    told = capsys.readouterr().err
    assert sentence in told
    assert len(told.splitlines()) == 1


def test_a_reference_of_another_time_is_one_sentence(
    fields: Case, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    flat = tmp_path / "flat.csv"
    flat.write_text("time_s,x_mm\n" + "".join(f"{n / 1000},{n % 2 * 1e-3}\n" for n in range(9000)))
    assert run(["compare", str(fields[0]), "--reference", str(flat), "--axis-deg", "90"]) == 1
    assert "show no common motion" in capsys.readouterr().err


def test_references_are_one_for_all_or_one_for_each(
    fields: Case, capsys: pytest.CaptureFixture[str]
) -> None:
    recording, reference = map(str, fields)
    assert run(["compare", *[recording] * 3, "--reference", reference, reference]) == 1
    assert "--reference: 2 given for 3 files" in capsys.readouterr().err
