"""What a reference says of itself: figures that the samples then keep, words, and the topic."""

import dataclasses
import json

import numpy as np
import pytest
from table_run import Measured, table

from vdms_rt.model import Aim
from vdms_rt.process.progress import Phase
from vdms_rt.report import set_up_report
from vdms_rt.setup import SetUp, set_up_from_json, set_up_json
from vdms_rt.wire import convert
from vdms_rt.wire import vdms_pb2 as pb

STILL = "[table.motion]\nkind = 'still'\n"
GROUND = """
[[table.sheet]]
marker = "m1"
at_mm = [-125.0, 0.0]
[[table.sheet]]
marker = "ground"
at_mm = [125.0, 0.0]
moves = false
[[marker]]
name = "m1"
[[marker]]
name = "ground"
fixed = true
"""


def aim_of(run: Measured, marker: int = 0) -> Aim:
    assert run.progress.set_up is not None
    aim = run.progress.set_up.markers[marker].aim
    assert aim is not None
    return aim


@pytest.mark.parametrize(
    ("text", "extra", "frames"),
    [
        ("", "", 340),
        ("angle_deg = 50\nroll_deg = 10\nnoise_grey = 4.0", "", 340),
        ("scan = 'progressive'\nblur_x_px = 1.5\nblur_y_px = 1.5", "", 640),
        ("fill = 0.58", GROUND, 340),
    ],
    ids=["fields", "aslant", "frames", "beside a fixed one"],
)
def test_the_resolution_is_the_scatter_of_the_samples(text: str, extra: str, frames: int) -> None:
    run = Measured(table(text, STILL + extra), frames)
    aim = aim_of(run)
    samples = [s for s in run.samples["m1"] if s.valid]
    assert len(samples) > 550
    assert np.std([s.x_mm for s in samples]) == pytest.approx(aim.sigma_x_mm, rel=0.1)
    assert np.std([s.y_mm for s in samples]) == pytest.approx(aim.sigma_y_mm, rel=0.1)


def test_the_resolution_of_the_papers_method_is_that_of_a_moving_marker() -> None:
    run = Measured(table("scan = 'progressive'", "[process]\nmethod = 'otsu'\n"), 160)
    error, _, true_x = run.errors_mm()
    moving = error[true_x != 0]
    assert np.std(moving) == pytest.approx(aim_of(run).sigma_x_mm, rel=0.3)


@pytest.fixture(scope="module")
def reference() -> SetUp:
    set_up = Measured(table("angle_deg = -30\nroll_deg = 3", STILL), 60).progress.set_up
    assert set_up is not None
    return set_up


def test_the_report_is_in_short_lines(reference: SetUp) -> None:
    lines = set_up_report(reference).splitlines()
    assert max(map(len, lines)) < 80
    assert lines[0] == "set-up 1: 720 x 480 px, bottom field first, method smooth"
    assert lines[1] == "marker m1"
    words = {line[:14].strip(): line[14:] for line in lines[2:]}
    assert list(words) == [
        "scale", "angle", "roll", "focus", "exposure", "noise", "resolution", "room",
    ]  # fmt: skip
    assert words["angle"] == "30.0 +- 1.0 deg (30.0 about the vertical, left side farther)"
    assert words["roll"] == "3.0 deg counter-clockwise"
    assert words["exposure"].endswith(", none saturated")


def test_what_to_do_comes_last(reference: SetUp) -> None:
    (marker,) = reference.markers
    assert marker.aim is not None
    aim = dataclasses.replace(marker.aim, advice=("turn the iris down", "zoom in"), turn_deg=0.01)
    advised = reference.model_copy(update={"markers": (marker.model_copy(update={"aim": aim}),)})
    assert set_up_report(advised).splitlines()[-2:] == [
        "  to do       turn the iris down",
        "              zoom in",
    ]


def test_the_file_and_the_topic_carry_every_figure(reference: SetUp) -> None:
    assert set_up_from_json(set_up_json(reference)) == reference
    aim = reference.markers[0].aim
    assert aim is not None
    message = convert.aim_message(aim)
    assert convert.aim_from(pb.Aim.FromString(message.SerializeToString())) == aim
    assert {f.name for f in message.DESCRIPTOR.fields} == {f.name for f in dataclasses.fields(aim)}


def test_a_set_up_from_before_there_was_an_aim_is_still_read(reference: SetUp) -> None:
    (marker,) = reference.markers
    document = json.loads(set_up_json(reference))
    del document["markers"][0]["aim"]
    old = set_up_from_json(json.dumps(document))
    assert old.markers[0] == marker.model_copy(update={"aim": None})
    assert set_up_report(old).splitlines()[-1] == "marker m1"


@pytest.mark.parametrize(
    ("change", "phase"),
    [
        ({}, Phase.MEASURING),
        ({"shift": 0.3}, Phase.MEASURING),
        ({"shift": 0.7}, Phase.STALE),
        ({"turn": 0.05}, Phase.MEASURING),
        ({"turn": 0.15}, Phase.STALE),
    ],
)
def test_a_shift_may_be_larger_than_a_turn(
    reference: SetUp, change: dict[str, float], phase: Phase
) -> None:
    (marker,) = reference.markers
    centre = np.mean(marker.reference_px, axis=0)
    fields = []
    for field in marker.fields:
        at_px = np.array(field.reference_px)
        arms = at_px - centre
        arms = np.column_stack((-arms[:, 1], arms[:, 0])) / np.abs(arms).max()
        moved = at_px + change.get("shift", 0.0) + change.get("turn", 0.0) * arms
        fields.append(field.model_copy(update={"reference_px": tuple(map(tuple, moved.tolist()))}))
    stored = reference.model_copy(
        update={"markers": (marker.model_copy(update={"fields": tuple(fields)}),)}
    )
    run = Measured(table("angle_deg = -30\nroll_deg = 3", STILL), 40, stored=stored)
    assert run.progress.phase is phase
    assert run.events == ["set-up-stale" if phase is Phase.STALE else "set-up-confirmed"]
