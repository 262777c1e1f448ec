"""Lens, axis and scale out of recordings, as the verbs print them."""

from __future__ import annotations

import dataclasses
import json
import subprocess
import sys

import numpy as np
import pytest
from lens_pictures import HEIGHT_PX, SHAPE, SQUARE_MM, WIDTH_PX, seen_px
from logbook import SESSION, running
from mcap.writer import Writer

from vdms_rt.calibrate import CalibrateError, lens_from_recording, stroke_from_recording
from vdms_rt.cli import run
from vdms_rt.config import Record, effective_values, parse_config
from vdms_rt.measure.homography import homography
from vdms_rt.model import Circle, CircleFlag, Displacement, Region, Scan, Status
from vdms_rt.record import Recorder
from vdms_rt.setup import FieldSetUp, MarkerSetUp, SetUp, set_up_json
from vdms_rt.wire import convert, topics
from vdms_rt.wire import vdms_pb2 as pb

PERIOD_NS = 33_366_667
START_NS = 5_000_000_000


def sample(n, marker="m1", xy_mm=(0.0, 0.0), circles=(), status=Status.OK, revision=1):
    t_ns = START_NS + n * PERIOD_NS
    return Displacement(
        session=SESSION,
        marker=marker,
        seq=n,
        frame_seq=n,
        scan=Scan.PROGRESSIVE,
        segment=0,
        stamp_ns=t_ns,
        t_ns=t_ns,
        sigma_t_ns=0,
        utc_ns=0,
        setup_revision=revision,
        x_mm=float(xy_mm[0]),
        y_mm=float(xy_mm[1]),
        rotation_mrad=0.0,
        sigma_x_mm=0.003,
        sigma_y_mm=0.003,
        residual_mm=0.0,
        status=status,
        circles=circles,
    )


def set_up(revision=1, reference_px=None, fixed=()):
    seen = seen_px(0.0, pictures=1, noise_px=0.0)[0] if reference_px is None else reference_px
    markers = [
        MarkerSetUp(
            shape=dataclasses.replace(SHAPE, name=name, fixed=name in fixed),
            regions=tuple(Region(round(x) - 50, round(y) - 50, 100, 100) for x, y in seen),
            noise_px=0.01,
            homography=tuple(tuple(row) for row in homography(SQUARE_MM, seen).tolist()),
            fields=(
                FieldSetUp(
                    kind=Scan.PROGRESSIVE,
                    reference_px=tuple(tuple(c) for c in seen.tolist()),
                    area_px=(4000.0,) * 4,
                    contrast=(170.0,) * 4,
                ),
            ),
        )
        for name in ("m1", *fixed)
    ]
    return SetUp(
        revision=revision,
        utc_ns=0,
        width_px=WIDTH_PX,
        height_px=HEIGHT_PX,
        scan=Scan.PROGRESSIVE,
        method="smooth",
        stills=30,
        markers=tuple(markers),
    )


def record(directory, samples, set_ups, config=""):
    """Write a recording as the daemon does and return its path."""
    values = effective_values(parse_config(config, "lab.toml"))
    recorder = Recorder(
        Record(directory=str(directory)),
        "lab",
        False,
        lambda: pb.Run(session=SESSION, effective_config=values).SerializeToString(),
        lambda reason: pb.End(session=SESSION, reason=reason).SerializeToString(),
        lambda event: None,
    )
    with running(recorder):
        for kept in set_ups:
            data = pb.SetUp(session=SESSION, revision=kept.revision, json=set_up_json(kept))
            recorder.put(topics.SETUP, "vdms/lab/setup", START_NS, data.SerializeToString())
        for s in samples:
            key = f"vdms/lab/{s.marker}/displacement"
            recorder.put(topics.DISPLACEMENT, key, s.t_ns, convert.displacement_bytes(s))
    (path,) = directory.glob("*.mcap")
    return path


def seen_samples(seen, first=0, **fields):
    for n, picture in enumerate(seen, first):
        circles = tuple(Circle(x, y, 4000.0, 170.0, CircleFlag.NONE) for x, y in picture.tolist())
        yield sample(n, circles=circles, **fields)


def stroke_samples(angle_deg, length_mm=50.0, first=0, **fields):
    rng = np.random.default_rng(2)
    part = np.clip((np.arange(300) - 60) / 180, 0, 1)
    way = length_mm * part**3 * (10 - 15 * part + 6 * part**2)
    a = np.radians(angle_deg)
    for n, u in enumerate(way, first):
        xy_mm = u * np.array([np.cos(a), np.sin(a)]) + rng.normal(0, 0.003, 2)
        yield sample(n, xy_mm=xy_mm, **fields)


def printed(capsys, *arguments):
    status = run([str(a) for a in arguments])
    out, err = capsys.readouterr()
    assert (status, err) == (0, "")
    return out


def refused(capsys, *arguments):
    status = run([str(a) for a in arguments])
    out, err = capsys.readouterr()
    assert (status, out) == (1, "")
    assert err.startswith("vdms-rt: ")
    assert err.count("\n") == 1
    return err


def test_what_the_lens_verb_prints_is_a_configuration_and_a_lens_file(tmp_path, capsys):
    path = record(tmp_path, seen_samples(seen_px(-0.05, centre_px=(371.0, 233.0))), [set_up()])
    text = printed(capsys, "lens", path)
    lens = parse_config(text, "printed").lens
    assert lens.k1 == pytest.approx(-0.05, abs=3e-4)
    assert lens.centre_px == pytest.approx((371.0, 233.0), abs=1.5)
    assert (lens.k2, lens.pixel_aspect) == (0.0, 1.1)
    assert "250 pictures in" in text
    assert "mm rms without the lens" in text
    assert "effect on a displacement: up to 0." in text
    file = tmp_path / "lens.toml"
    file.write_text(text)
    assert parse_config(f'[lens]\nfile = "{file}"', "lab.toml").lens == lens


def test_the_pixel_aspect_is_that_of_the_recording_unless_said_otherwise(tmp_path, capsys):
    seen = seen_px(-0.05)
    seen[..., 0] *= 1 / 1.1
    path = record(tmp_path, seen_samples(seen), [set_up()], "[lens]\npixel_aspect = 1.0")
    assert parse_config(printed(capsys, "lens", path), "printed").lens.pixel_aspect == 1.0
    text = printed(capsys, "lens", path, "--pixel-aspect", "1.2")
    assert parse_config(text, "printed").lens.pixel_aspect == 1.2


def test_a_lens_that_bends_nothing_is_told_so(tmp_path, capsys):
    path = record(tmp_path, seen_samples(seen_px(0.0)), [set_up()])
    assert "# that is not told from a lens that bends nothing: leave" in printed(
        capsys, "lens", path
    )


def test_only_circles_that_are_seen_and_samples_of_one_reference_count(tmp_path):
    cut = seen_px(-0.05, seed=1)
    cut[:, 2] += 5.0
    other = seen_px(-0.05, pictures=100, seed=2) + 7.0
    mixed = [
        *seen_samples(seen_px(-0.05), status=Status.RESIDUAL | Status.NOT_FOUND),
        *(
            dataclasses.replace(
                s,
                circles=tuple(
                    dataclasses.replace(c, flags=CircleFlag.BORDER if n == 2 else CircleFlag.AREA)
                    for n, c in enumerate(s.circles)
                ),
            )
            for s in seen_samples(cut, first=250)
        ),
        *seen_samples(other, first=500, revision=2),
        *seen_samples(other, first=600, status=Status.SET_UP),
    ]
    path = record(tmp_path, mixed, [set_up(), set_up(2, seen_px(0.0, pictures=1)[0] + 7.0)])
    text = lens_from_recording(path)
    assert "500 pictures" in text
    assert parse_config(text, "printed").lens.k1 == pytest.approx(-0.05, abs=2e-4)


def test_a_set_up_that_only_proved_the_field_order_is_the_same_reference(tmp_path):
    seen = seen_px(-0.05)
    samples = [*seen_samples(seen[:120]), *seen_samples(seen[120:], first=120, revision=2)]
    path = record(tmp_path, samples, [set_up(1), set_up(2)])
    assert "250 pictures" in lens_from_recording(path)


def test_too_little_motion_for_a_lens_is_refused(tmp_path, capsys):
    path = record(tmp_path, seen_samples(seen_px(-0.05, amplitude_mm=2.0)), [set_up()])
    assert "marker m1: the marker stood in" in refused(capsys, "lens", path)


def test_motion_that_tells_the_lens_too_bluntly_is_refused(tmp_path, capsys):
    blunt = seen_px(-0.05, amplitude_mm=9.0, noise_px=0.12, pictures=80)
    path = record(tmp_path, seen_samples(blunt), [set_up()])
    assert "move the marker slowly as far across the picture" in refused(capsys, "lens", path)


def test_what_the_stroke_verb_prints_is_a_configuration(tmp_path, capsys):
    path = record(tmp_path, stroke_samples(12.0), [set_up()])
    text = printed(capsys, "stroke", path, "--stroke-mm", "50")
    (marker,) = parse_config(text, "printed").marker
    assert marker.name == "m1"
    assert marker.axis_deg == pytest.approx(12.0, abs=0.002)
    assert "300 samples in 10.0 s, 2 rests" in text
    assert "scale 1.000" in text
    assert "% off" not in text


def test_the_axis_adds_to_the_one_that_was_recorded(tmp_path):
    config = '[[marker]]\nname = "m1"\naxis_deg = 170.0'
    path = record(tmp_path, stroke_samples(15.0), [set_up()], config)
    text = stroke_from_recording(path, None, 50.0)
    assert parse_config(text, "printed").marker[0].axis_deg == pytest.approx(-175.0, abs=0.002)
    assert "axis_deg = 170, to which it adds" in text


def test_a_scale_that_is_off_points_to_the_print(tmp_path):
    path = record(tmp_path, stroke_samples(0.0, length_mm=50.0), [set_up()])
    text = stroke_from_recording(path, None, 50.5)
    assert "the scale is 1.00 % off" in text
    assert "times 1.0100" in text


def test_seconds_cut_the_stroke_out(tmp_path, capsys):
    sideways = stroke_samples(90.0, length_mm=80.0, first=310)
    path = record(tmp_path, [*stroke_samples(12.0), *sideways], [set_up()])
    text = printed(capsys, "stroke", path, "--stroke-mm", "50", "--to-s", "10")
    assert parse_config(text, "printed").marker[0].axis_deg == pytest.approx(12.0, abs=0.002)
    assert "that is not straight" in stroke_from_recording(path, None, 50.0)
    said = refused(capsys, "stroke", path, "--stroke-mm", "50", "--from-s", "21")
    assert (
        "no sample of marker m1 lies between 21 and inf s; it has samples from 0 to 20.3 s" in said
    )


def test_the_marker_is_chosen_by_name_and_a_fixed_one_is_no_choice(tmp_path, capsys):
    moving = [*stroke_samples(12.0), *(sample(n, "wall") for n in range(300))]
    path = record(tmp_path, moving, [set_up(fixed=("wall",))])
    assert 'name = "m1"' in stroke_from_recording(path, None, 50.0)
    with pytest.raises(CalibrateError, match="marker wall: the marker did not move"):
        stroke_from_recording(path, "wall", 50.0)
    said = refused(capsys, "stroke", path, "--stroke-mm", "50", "--marker", "m7")
    assert "has no marker m7; it has m1, wall" in said


def test_of_two_moving_markers_one_must_be_chosen(tmp_path, capsys):
    both = [*stroke_samples(12.0), *stroke_samples(12.0, marker="m2")]
    path = record(tmp_path, both, [set_up()])
    said = refused(capsys, "stroke", path, "--stroke-mm", "50")
    assert "has the markers m1, m2; choose one with --marker" in said


def not_there(directory):
    return directory / "absent.mcap"


def text_file(directory):
    path = directory / "notes.mcap"
    path.write_text("not a recording")
    return path


def foreign(directory):
    path = directory / "other.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("other.Thing", "jsonschema", b"{}")
        channel = writer.register_channel("things", "json", schema)
        writer.add_message(channel, 1, json.dumps({}).encode(), 1)
        writer.finish()
    return path


@pytest.mark.parametrize(
    ("made", "said"),
    [
        (not_there, "no such file or directory; name a recording of vdms-rt"),
        (text_file, "not an MCAP file; name a recording of vdms-rt"),
        (foreign, "an MCAP, but not one that vdms-rt recorded"),
        (lambda d: record(d, [], [set_up()]), "holds no displacement"),
        (
            lambda d: record(d, (sample(n, status=Status.SET_UP) for n in range(50)), [set_up()]),
            "marker m1 has no valid sample; wait for the state measuring",
        ),
        (lambda d: record(d, (sample(n) for n in range(50)), []), "has no valid sample"),
    ],
)
def test_what_is_no_recording_of_a_marker_is_refused_in_one_sentence(tmp_path, capsys, made, said):
    path = made(tmp_path)
    for verb in (["lens"], ["stroke", "--stroke-mm", "50"]):
        error = refused(capsys, *verb, path)
        assert error.startswith(f"vdms-rt: {path}: ")
        assert said in error


@pytest.mark.slow
def test_a_stroke_of_the_virtual_table_through_the_whole_program(tmp_path):
    times_s = np.arange(0, 6.01, 0.05)
    part = np.clip((times_s - 0.5) / 4, 0, 1)
    way = np.column_stack([times_s, 30 * part**3 * (10 - 15 * part + 6 * part**2)])
    stroke = tmp_path / "stroke.csv"
    np.savetxt(stroke, way, fmt="%.6f", delimiter=",", header="time_s,x_mm", comments="")
    config = tmp_path / "table.toml"
    config.write_text(
        f"""
source = "table"
[table]
pace = "fast"
frames = 300
angle_deg = 20.0
[table.motion]
kind = "record"
file = "{stroke}"
direction_deg = 12.0
[setup]
load = false
store = false
[publish]
enabled = false
[record]
directory = "{tmp_path / "recordings"}"
pixels = "none"
"""
    )
    program = [sys.executable, "-m", "vdms_rt"]
    subprocess.run([*program, "run", "--config", str(config)], check=True, timeout=100)
    (path,) = (tmp_path / "recordings").iterdir()
    text = stroke_from_recording(path, None, 30.0)
    assert parse_config(text, "printed").marker[0].axis_deg == pytest.approx(12.0, abs=0.03)
    scale = float(text.split(": scale ")[1].split()[0])
    assert scale == pytest.approx(1.0, abs=5e-4)
