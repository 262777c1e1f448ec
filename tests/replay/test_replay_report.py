"""The report: what it says, that it needs nothing else, and what it does without its parts."""

from __future__ import annotations

import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from pypdf import PdfReader
from replaying import write_recording
from table_recordings import record
from vibrometer import Vibrometer

from vdms_replay.chosen import choose
from vdms_replay.cli import run
from vdms_replay.figures import new_figure, plain_numbers
from vdms_replay.load import read
from vdms_replay.report_figures import lines_of


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("report")
    (path,) = record(directory, "lost_frames = 0.03", record='pixels = "none"')
    return path


def text_of(path: Path) -> str:
    return "\n".join(page.extract_text() for page in PdfReader(path).pages)


class Tags(HTMLParser):
    """Names of the elements, and whatever they would load."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.names: list[str] = []
        self.ids: list[str] = []
        self.loaded: list[str] = []
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.names.append(tag)
        for name, value in attrs:
            if name == "id":
                self.ids.append(value or "")
            if name in ("src", "href", "xlink:href"):
                self.loaded.append(value or "")


def test_a_report_with_a_comparison_says_everything(recording: Path, tmp_path: Path) -> None:
    reference = Vibrometer().write_csv(recording, tmp_path / "ldv.csv")
    out = tmp_path / "report.pdf"
    options = ["--reference", str(reference), "--find-clock-rate", "--title", "Table <7> & more"]
    assert run(["report", str(recording), "--out", str(out), *options, "--note", "A note."]) == 0
    text = text_of(out)
    for words in (
        "Table <7> & more", "A note.", "Station lab, marker m1", "Time history", "peak to peak",
        "Path and frequencies", "Comparison with the reference", "Eq. 3.1", "coherence",
        "Quality and uncertainty", "k = 1", "Gaps", "samples missing", "Set-up",
        "displacement, mm", "amplitude, mm", "page 1",
    ):  # fmt: skip
        assert words in text, words
    assert re.search(r"0\.0\d+ %: std\(reference - camera\)", text)


def test_plots_are_vectors_and_letters_are_embedded(recording: Path, tmp_path: Path) -> None:
    out = tmp_path / "report.pdf"
    assert run(["report", str(recording), "--out", str(out)]) == 0
    pages = PdfReader(out).pages
    pictures = [image.image.size for page in pages for image in page.images if image.image]
    assert len(pictures) == 1
    assert pictures[0] == (720, 480)
    drawn = [len(page.get_contents().get_data()) for page in pages]
    assert max(drawn) > 10_000


def test_an_html_report_needs_nothing_else(recording: Path, tmp_path: Path) -> None:
    out = tmp_path / "report.html"
    assert run(["report", str(recording), "--out", str(out), "--title", "A <b> & c"]) == 0
    page = out.read_text(encoding="utf-8")
    tags = Tags(page)
    assert tags.names.count("svg") == 4
    assert "script" not in tags.names
    assert len(tags.ids) == len(set(tags.ids))
    assert all(loaded.startswith(("#", "data:")) for loaded in tags.loaded)
    assert "A &lt;b&gt; &amp; c" in page
    assert "url(http" not in page


def test_a_sine_shows_its_amplitude_in_the_spectrum(recording: Path) -> None:
    lines = lines_of(choose(read(recording)))
    ((frequency_hz, x_mm, y_mm),) = lines.peaks()
    assert frequency_hz == pytest.approx(1.0, abs=0.02)
    assert x_mm == pytest.approx(10, rel=0.05)
    assert y_mm < 0.01
    assert lines.filled > 0


@pytest.mark.parametrize("suffix", [".pdf", ".html"])
def test_a_recording_without_picture_gaps_or_reasons(tmp_path: Path, suffix: str) -> None:
    path = write_recording(tmp_path / "lab.mcap", range(300))
    out = tmp_path / f"report{suffix}"
    assert run(["report", str(path), "--out", str(out)]) == 0
    text = text_of(out) if suffix == ".pdf" else out.read_text(encoding="utf-8")
    assert "samples in 0 gaps" not in text
    assert "samples missing" not in text


def test_an_unfinished_recording_with_lost_and_covered_samples(tmp_path: Path) -> None:
    path = write_recording(
        tmp_path / "lab.mcap", range(300), lost=(50, 51), finish=False,
        status=dict.fromkeys(range(100, 110), 2),
    )  # fmt: skip
    out = tmp_path / "report.pdf"
    assert run(["report", str(path), "--out", str(out)]) == 0
    text = text_of(out)
    assert "2 samples in 1 gap\n" in text
    assert "10 marker not found" in text
    assert "unfinished" in text
    assert "without an end: cut off" in text


def test_a_long_recording_stays_small(tmp_path: Path) -> None:
    path = write_recording(tmp_path / "lab.mcap", range(20000))
    out = tmp_path / "report.pdf"
    assert run(["report", str(path), "--out", str(out)]) == 0
    assert out.stat().st_size < 1_500_000


def test_several_markers_are_told_apart(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = write_recording(tmp_path / "lab.mcap", range(200), markers=("m1", "m2"))
    out = tmp_path / "report.html"
    assert run(["report", str(path), "--out", str(out)]) == 1
    assert "has the markers m1, m2; choose one with --marker" in capsys.readouterr().err
    assert run(["report", str(path), "--out", str(out), "--marker", "m2"]) == 0
    assert "marker m2" in out.read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["--out", "report.doc"], "report.doc: a report is a .pdf or an .html file, not .doc"),
        (["--out", "no/such/folder/r.pdf"], "no/such/folder/r.pdf: cannot be written"),
        (["--out", "no/such/folder/r.html"], "no/such/folder/r.html: cannot be written"),
        (["--out", "r.pdf", "--from-s", "99"], "no sample of marker m1 lies after 99 s"),
        (["--out", "r.pdf", "--reference", "ldv.csv"], "ldv.csv: cannot be read: no such file"),
    ],
)
def test_what_cannot_be_reported_is_one_sentence(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    options: list[str],
    sentence: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    path = write_recording(tmp_path / "lab.mcap", range(100))
    assert run(["report", str(path), *options]) == 1
    told = capsys.readouterr().err
    assert sentence in told
    assert len(told.splitlines()) == 1


def test_a_recording_without_a_valid_sample_is_one_sentence(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write_recording(tmp_path / "lab.mcap", range(50), status=dict.fromkeys(range(50), 2))
    assert run(["report", str(path), "--out", str(tmp_path / "r.pdf")]) == 1
    assert "marker m1 has no valid sample" in capsys.readouterr().err
    assert np.isnan(read(path).samples["x_mm"]).all()


@pytest.mark.parametrize(
    ("end", "told"), [(500.0, ["1", "2", "5", "10", "20"]), (5000.0, ["1", "10", "100", "1000"])]
)
def test_numbers_of_a_logarithmic_axis_do_not_run_into_each_other(
    end: float, told: list[str]
) -> None:
    axes = new_figure(3.0).subplots()
    axes.loglog([1.0, end], [1.0, 2.0])
    axes.set_xlim(1.0, end)
    plain_numbers(axes.xaxis)
    labels = axes.xaxis.get_major_formatter()
    shown = [labels(at) for at in axes.xaxis.get_majorticklocs() if 1 <= at <= end]
    assert shown[: len(told)] == told
