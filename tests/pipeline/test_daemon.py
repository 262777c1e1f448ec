"""The whole program as a person starts it: a process, a configuration file, signals."""

import json
import math
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader

from vdms_rt.model import Status
from vdms_rt.wire import vdms_pb2 as pb

PROGRAM = [sys.executable, "-m", "vdms_rt"]
DEADLINE_S = 60


def free_port() -> int:
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return int(s.getsockname()[1])


def table_config(
    directory: Path, extra: str = "", table: str = "", port: int | None = None
) -> Path:
    path = directory / "vdms.toml"
    path.write_text(
        f"""
source = "table"
[station]
name = "lab"
[table]
stamp_jitter_ms = 1.0
rest_s = 4.0
{table}
[setup]
directory = "{directory}"
reference_pictures = 30
[publish]
listen = ["tcp/127.0.0.1:{port or free_port()}"]
[record]
directory = "{directory / "recordings"}"
{extra}
"""
    )
    return path


def run(*arguments: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [*PROGRAM, *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=DEADLINE_S,
        check=False,
    )


def messages(path: Path, topic: str) -> Iterator[object]:
    kinds = {"displacement": pb.Displacement, "truth": pb.Truth, "health": pb.Health}
    kinds |= {"event": pb.Event, "setup": pb.SetUp, "run": pb.Run, "end": pb.End}
    kinds |= {"pixels": pb.Pixels}
    with path.open("rb") as file:
        for _, channel, message in make_reader(file).iter_messages(log_time_order=False):
            if channel.topic.endswith(f"/{topic}"):
                yield kinds[topic].FromString(message.data)


def only_recording(directory: Path) -> Path:
    (path,) = (directory / "recordings").iterdir()
    assert path.suffix == ".mcap"
    return path


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> tuple[subprocess.CompletedProcess[str], Path]:
    directory = tmp_path_factory.mktemp("demo")
    # Room for all frames of the run, lest a busy machine overwrites some.
    config = table_config(directory, extra="[process]\nring_slots = 320")
    done = run("run", "--config", config, "--seconds", 9)
    return done, only_recording(directory)


def test_a_run_ends_by_itself_with_its_summary(
    demo: tuple[subprocess.CompletedProcess[str], Path],
) -> None:
    done, recording = demo
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    assert "reference taken from 60 pictures" in done.stderr
    assert "\nmarker m1\n  scale       1.56" in done.stderr
    assert "\n  resolution  0.9 um in x, 0.9 um in y (one sigma of a sample)\n" in done.stderr
    assert str(recording) in done.stderr.splitlines()[-1]


def test_every_frame_has_its_displacement(
    demo: tuple[subprocess.CompletedProcess[str], Path],
) -> None:
    samples = list(messages(demo[1], "displacement"))
    (end,) = messages(demo[1], "end")
    # A busy machine comes too late for a frame, or has not measured the last ones when it stops;
    # both is counted, and nothing else may be missing.
    missed = end.health.missed
    assert len(samples) == 2 * (end.health.captured - end.health.overwritten)
    assert len(samples) > 100
    seqs = [s.seq for s in samples]
    assert seqs == sorted(set(seqs))
    assert seqs[-1] + 1 - seqs[0] - len(seqs) <= 2 * missed
    flags = [bool(s.status & Status.SET_UP) for s in samples]
    first = flags.index(False)
    assert all(flags[:first])
    assert not any(flags[first:])
    assert missed or all(s.valid for s in samples[first:])
    assert all(math.isnan(s.x_mm) and not s.valid for s in samples[:first])
    assert len({s.session for s in samples}) == 1


def error_3_1(recording: Path) -> float:
    """Lee, Cho and Sim (2015), Eq. 3.1, with the truth averaged over each exposure."""
    truth = {(t.stamp_ns, t.scan): t for t in messages(recording, "truth")}
    pairs = [(s, truth[s.stamp_ns, s.scan]) for s in messages(recording, "displacement") if s.valid]
    assert len(pairs) > 100
    x = np.array([s.x_mm for s, _ in pairs])
    true_x = np.array([t.mean_x_mm for _, t in pairs])
    assert np.ptp(true_x) > 15
    assert abs(np.mean(x - true_x)) < 0.1
    assert np.std([s.y_mm for s, _ in pairs]) < 0.05
    return float(np.std(x - true_x) / np.std(true_x))


def test_the_displacement_agrees_with_the_truth(
    demo: tuple[subprocess.CompletedProcess[str], Path],
) -> None:
    assert error_3_1(demo[1]) < 0.0005


def test_the_sigma_of_a_resting_marker_is_true(
    demo: tuple[subprocess.CompletedProcess[str], Path],
) -> None:
    truth = {(t.stamp_ns, t.scan): t for t in messages(demo[1], "truth")}
    rest = [
        s
        for s in messages(demo[1], "displacement")
        if s.valid and truth[s.stamp_ns, s.scan].x_mm == 0
    ]
    assert len(rest) > 20
    assert np.std([s.x_mm for s in rest]) == pytest.approx(
        np.mean([s.sigma_x_mm for s in rest]), rel=0.5
    )


def test_the_papers_method_agrees_with_the_truth(tmp_path: Path) -> None:
    config = table_config(tmp_path, extra="[process]\nmethod = 'otsu'\nsampling = 'frame'")
    assert run("run", "--config", config, "--seconds", 9).returncode == 0
    assert error_3_1(only_recording(tmp_path)) < 0.007


def test_the_recording_tells_all_about_itself(
    demo: tuple[subprocess.CompletedProcess[str], Path],
) -> None:
    (header,) = messages(demo[1], "run")
    assert header.station == "lab"
    assert 'source = "table"' in header.config_text
    assert json.loads(header.effective_config)["setup"]["reference_pictures"] == 30
    (end,) = messages(demo[1], "end")
    assert end.reason == "the time was up"
    assert end.health.measured > 100
    set_ups = list(messages(demo[1], "setup"))
    assert [s.revision for s in set_ups] == [1, 2]
    assert [(a.marker, a.focus, list(a.advice)) for a in set_ups[1].aims] == [("m1", "sharp", [])]
    assert set_ups[1].aims[0].scale_x_px_per_mm == pytest.approx(1.56, rel=0.01)
    assert {"source", "marker-found", "reference", "field-order"} <= {
        e.code for e in messages(demo[1], "event")
    }
    assert len(list(messages(demo[1], "health"))) >= 7
    pixels = list(messages(demo[1], "pixels"))
    assert len(pixels) > 150
    assert all(len(p.patches) == 4 for p in pixels)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_stops_in_order(tmp_path: Path, number: signal.Signals) -> None:
    process = subprocess.Popen(
        [*PROGRAM, "run", "--config", str(table_config(tmp_path))],
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stderr is not None
    for line in process.stderr:
        if "reference taken" in line:
            break
    process.send_signal(number)
    # The product's promise: a stop takes less than 3 s; the rest is a loaded machine.
    rest = process.stderr.read()
    assert process.wait(DEADLINE_S) == 0, rest
    process.stderr.close()
    (end,) = messages(only_recording(tmp_path), "end")
    assert end.reason == f"stopped by {number.name}"


def test_a_clip_at_full_pace_gives_the_same_numbers_bit_for_bit(tmp_path: Path) -> None:
    clip = tmp_path / "clip"
    write_clip(clip, 300)
    numbers = []
    for name in ("one", "two"):
        directory = tmp_path / name
        directory.mkdir()
        config = directory / "clip.toml"
        config.write_text(
            f"""
source = "clip"
[clip]
path = "{clip}"
pace = "fast"
field_order = "bottom-first"
[setup]
directory = "{directory}"
[publish]
enabled = false
[record]
directory = "{directory / "recordings"}"
"""
        )
        done = run("run", "--config", config)
        assert done.returncode == 0, done.stderr
        samples = list(messages(only_recording(directory), "displacement"))
        assert [s.seq for s in samples] == list(range(600))
        assert sum(s.valid for s in samples) > 400
        for sample in samples:
            sample.session = 0
        numbers.append([s.SerializeToString() for s in samples])
    assert numbers[0] == numbers[1]


def write_clip(folder: Path, frames: int) -> None:
    from vdms_rt import codec
    from vdms_rt.capture.table import TableSource
    from vdms_rt.config import Marker, Table

    folder.mkdir()
    table = Table(pace="fast", rest_s=2.0)
    source = TableSource(table, [Marker().shape], lambda truth: None)
    image = np.empty((480, 720), np.uint8)
    for n in range(frames):
        assert source.read(image, 10) is not None
        (folder / f"frame{n}.png").write_bytes(codec.png(image))
    source.close()


def test_a_stored_set_up_is_confirmed_by_the_next_run(tmp_path: Path) -> None:
    config = table_config(tmp_path, table="[table.motion]\nkind = 'still'")
    assert run("run", "--config", config, "--seconds", 4).returncode == 0
    again = run("run", "--config", config, "--seconds", 4)
    assert again.returncode == 0
    assert "the stored set-up, revision 1, holds" in again.stderr


@pytest.mark.parametrize(
    ("before", "after", "says"),
    [
        ("roll_deg = 0.0", "roll_deg = 0.2", "moved by 0.3"),
        ("angle_deg = 30.0", "angle_deg = 30.2", "moved by 0.1"),
    ],
)
def test_a_camera_that_was_turned_makes_the_stored_set_up_stale(
    tmp_path: Path, before: str, after: str, says: str
) -> None:
    config = table_config(tmp_path, table=f"{before}\n[table.motion]\nkind = 'still'")
    assert run("run", "--config", config, "--seconds", 4).returncode == 0
    old = {p.name for p in (tmp_path / "recordings").iterdir()}
    config.write_text(config.read_text().replace(before, after))
    again = run("run", "--config", config, "--seconds", 4)
    assert "the stored set-up does not match the picture: a marker's circles have" in again.stderr
    assert says in again.stderr
    assert "start with setup.load = false to take a new reference" in again.stderr
    (path,) = [p for p in (tmp_path / "recordings").iterdir() if p.name not in old]
    samples = list(messages(path, "displacement"))
    checked = [bool(s.status & Status.SET_UP_STALE) for s in samples]
    first = checked.index(True)
    assert all(checked[first:])
    assert all(s.status & Status.SET_UP for s in samples[:first])
    assert not any(s.valid for s in samples)


def test_without_a_marker_it_says_so_and_measures_nothing(tmp_path: Path) -> None:
    config = table_config(
        tmp_path, table="black_grey = 100.0\nwhite_grey = 100.0\n[table.motion]\nkind = 'still'"
    )
    done = run("run", "--config", config, "--seconds", 3)
    assert "no marker in sight" in done.stderr
    assert not any(s.valid for s in messages(only_recording(tmp_path), "displacement"))


def test_a_port_in_use_is_one_sentence(tmp_path: Path) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        done = run("run", "--config", table_config(tmp_path, port=port), "--seconds", 2)
    assert done.returncode == 1
    assert f"tcp/127.0.0.1:{port} is in use" in done.stderr
    assert "Traceback" not in done.stderr


def test_a_region_outside_the_picture_is_a_configuration_error(tmp_path: Path) -> None:
    regions = (
        "[[700, 10, 120, 120], [300, 10, 120, 120], [100, 300, 120, 120], [300, 300, 120, 120]]"
    )
    config = table_config(tmp_path, extra=f'[[marker]]\nfind = "regions"\nregions_px = {regions}\n')
    done = run("run", "--config", config, "--seconds", 2)
    assert done.returncode == 78
    assert "region 1 (700, 10, 120 x 120)" in done.stderr
    assert "Traceback" not in done.stderr


def test_a_grabber_that_is_not_there_is_one_sentence(tmp_path: Path) -> None:
    config = tmp_path / "vdms.toml"
    config.write_text(
        f"""
[v4l2]
device = "/dev/video77"
[publish]
enabled = false
[record]
directory = "{tmp_path / "recordings"}"
"""
    )
    done = run("run", "--config", config, "--seconds", 2)
    assert done.returncode == 1
    assert done.stderr.count("/dev/video77") == 1
    assert "Traceback" not in done.stderr


def test_a_read_only_directory_is_one_sentence(tmp_path: Path) -> None:
    config = table_config(tmp_path)
    (tmp_path / "recordings").write_text("a file is in the way")
    done = run("run", "--config", config, "--seconds", 2)
    assert done.returncode == 1
    assert str(tmp_path / "recordings") in done.stderr
    assert "Traceback" not in done.stderr


def test_a_wrong_configuration_ends_with_78(tmp_path: Path) -> None:
    config = tmp_path / "vdms.toml"
    config.write_text("[stationn]\nname = 'a'")
    for verb in (["check-config"], ["run", "--config"]):
        done = run(*verb, config)
        assert done.returncode == 78
        assert "did you mean station?" in done.stderr


def test_a_second_signal_ends_at_once(tmp_path: Path) -> None:
    process = subprocess.Popen(
        [*PROGRAM, "run", "--config", str(table_config(tmp_path))],
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONUNBUFFERED": "1"},
    )
    assert process.stderr is not None
    for line in process.stderr:
        if "recording into" in line:
            break
    # Both are there before it can do anything about the first.
    process.send_signal(signal.SIGSTOP)
    process.send_signal(signal.SIGTERM)
    process.send_signal(signal.SIGINT)
    process.send_signal(signal.SIGCONT)
    rest = process.stderr.read()
    assert process.wait(DEADLINE_S) == 1
    assert rest.endswith("vdms-rt: forced to end\n")
    process.stderr.close()
    (left,) = (tmp_path / "recordings").iterdir()
    assert left.suffix == ".part"
