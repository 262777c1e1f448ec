"""`vdms-rt find`: what a person reads of a picture, and what of it is configuration."""

import dataclasses
import tomllib
from pathlib import Path

from lab_picture import Lab, View, picture

from vdms_rt import codec
from vdms_rt.config import Config, parse_config
from vdms_rt.look import look
from vdms_rt.model import Scan

LAB = Lab(clutter=None)


def told(tmp_path: Path, lab: Lab, view: View, config: Config | None = None) -> tuple[str, bool]:
    path = tmp_path / "picture.png"
    path.write_bytes(codec.png(picture([view], lab)))
    return look(path, config or Config(), tmp_path / "found.png")


def test_the_picture_is_told_with_its_figures_and_what_to_do(tmp_path: Path) -> None:
    lab = dataclasses.replace(LAB, white=260.0, blur_px=(1.5, 1.4))
    text, found = told(tmp_path, lab, View(angle_deg=30, roll_deg=5))
    assert found
    lines = text.splitlines()
    assert max(map(len, lines)) <= 81 or str(tmp_path) in max(lines, key=len)
    words = {line[4:16].strip(): line[16:] for line in lines if line.startswith("#   ")}
    assert words["scale"].startswith("1.35")
    assert words["scale"].endswith(" up")
    assert words["angle"].startswith(("30.0 +- 1.0", "29.9 +- 1.0", "30.1 +- 1.0"))
    assert words["angle"].endswith("about the vertical, right side farther)")
    assert words["roll"] == "5.0 deg counter-clockwise"
    assert words["focus"].startswith("a little soft: edges 1.4")
    assert "% saturated" in words["exposure"]
    assert words["resolution"].startswith("at best ")
    assert words["to do"].startswith("turn the iris down: ")
    assert (tmp_path / "found.png").stat().st_size > 1000


def test_what_is_printed_is_a_configuration(tmp_path: Path) -> None:
    text, _ = told(tmp_path, LAB, View())
    config = parse_config(text, "test")
    assert tomllib.loads(text)["marker"][0]["name"] == "m1"
    assert config.marker[0].find == "regions"
    assert len(config.marker[0].regions) == 4


def test_of_an_interlaced_picture_one_field_is_told_as_it_is_measured(tmp_path: Path) -> None:
    interlaced = dataclasses.replace(LAB, scan=Scan.TOP_FIRST)
    sigma = {}
    for sampling in ("field", "frame"):
        config = parse_config(
            f"[clip]\nfield_order = 'top-first'\n[process]\nsampling = '{sampling}'", "test"
        )
        text, _ = told(tmp_path, interlaced, View(), config)
        (line,) = [line for line in text.splitlines() if "resolution" in line]
        sigma[sampling] = float(line[16:].split()[0])
    assert 1.3 < sigma["field"] / sigma["frame"] < 1.6


def test_a_picture_without_a_marker_says_what_it_takes(tmp_path: Path) -> None:
    text, found = told(tmp_path, LAB, View(px_per_mm=0.02))
    assert not found
    assert "# not found: m1" in text
