import json

import numpy as np
import pytest

from tools.bench import speed


@pytest.fixture(scope="module")
def scene():
    return speed.Scene.drawn(cycle_frames=12)


def test_every_method_measures_every_frame(scene):
    table = speed.rows(scene)
    spent_us = speed.timed(table, rounds=2)
    assert spent_us.shape == (2, len(table))
    assert (spent_us > 0).all()
    names = [row.name for row in table]
    assert len(set(names)) == len(names)
    assert "moments" in names[0]


def test_a_method_that_misses_the_marker_stops_the_bench(scene):
    def blind(image):
        return np.add(speed.opencv_moments(image, binary=True), (1.0, 0.0))

    table = [speed.rows(scene)[0], speed.of_centres("blind", scene.whole, blind)]
    with pytest.raises(SystemExit, match="blind does not find the marker"):
        speed.timed(table, rounds=1)


def test_the_table_and_its_json_hold_the_same_rows(scene, monkeypatch, capsys):
    monkeypatch.setattr(speed.Scene, "drawn", lambda: scene)
    monkeypatch.setattr(speed.cv2, "setNumThreads", lambda _: None)
    speed.main(["--rounds", "1", "--json"])
    told = json.loads(capsys.readouterr().out)
    assert told["rows"][0]["ratio"] == 1.0
    speed.main(["--rounds", "1"])
    printed = capsys.readouterr().out
    for row in told["rows"]:
        assert row["method"] in printed
        assert row["us_per_frame"] > 0
    assert told["machine"]["opencv"] in printed
