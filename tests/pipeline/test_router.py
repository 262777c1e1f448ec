"""Whole stations that are reached through a zenoh router, by configuration alone."""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import zenoh
from loopback import DEADLINE_S, free_endpoint

from vdms_rt.control.client import ControlError, Controller
from vdms_rt.model import Displacement
from vdms_rt.subscribe import Arrived, Left, Missed, Notice, Sample, Subscription, subscribe
from vdms_rt.wire.session import SESSION

pytestmark = pytest.mark.slow

PATIENCE_S = 60.0


@contextlib.contextmanager
def router(endpoint: str) -> Iterator[None]:
    config = zenoh.Config()
    for name, value in {**SESSION, "mode": "router", "listen/endpoints": [endpoint]}.items():
        config.insert_json5(name, json.dumps(value))
    with zenoh.open(config):
        yield


@contextlib.contextmanager
def station(folder: Path, name: str, endpoint: str, sections: str = "") -> Iterator[Path]:
    folder.mkdir()
    config = folder / "vdms.toml"
    config.write_text(f"""
source = "table"
station.name = "{name}"
setup.directory = "{folder}"
record.directory = "{folder / "recordings"}"
[table]
width_px = 360
height_px = 240
[table.motion]
kind = "still"
[publish]
mode = "client"
connect = ["{endpoint}"]
{sections}
""")
    with (folder / "log").open("w") as log:
        process = subprocess.Popen(
            [sys.executable, "-m", "vdms_rt", "run", "--config", str(config)], stderr=log
        )
        try:
            yield folder / "log"
        finally:
            process.terminate()
            assert process.wait(PATIENCE_S) == 0, (folder / "log").read_text()


class Heard:
    """What came through the router, station by station."""

    def __init__(self, items: Subscription[Sample | Notice]) -> None:
        self._items = items
        self.samples: dict[str, list[int]] = {}
        self.missed: list[Missed] = []
        self.present: set[str] = set()

    def listen(self) -> None:
        item = self._items.get(PATIENCE_S)
        match item:
            case Sample(value=Displacement() as d):
                self.samples.setdefault(item.station, []).append(d.seq)
            case Missed():
                self.missed.append(item)
            case Arrived():
                self.present.add(item.station)
            case Left():
                self.present.discard(item.station)
            case _:
                raise AssertionError(f"nothing more: {item}, {self.present}")

    def until(self, station: str, seq: int) -> None:
        while self.samples.get(station, [-1])[-1] < seq:
            self.listen()


def test_stations_survive_the_router_s_death_and_return(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    with (
        station(tmp_path / "north", "north", endpoint),
        station(tmp_path / "south", "south", endpoint),
        subscribe(connect=endpoint, notices=True) as items,
    ):
        heard = Heard(items)
        for _ in range(2):
            with router(endpoint):
                for name in ("north", "south"):
                    heard.until(name, heard.samples.get(name, [0])[-1] + 90)
                assert heard.present == {"north", "south"}
            while heard.present:
                heard.listen()
    for name in ("north", "south"):
        seqs = heard.samples[name]
        gaps = [(m.first_seq, m.last_seq) for m in heard.missed if m.station == name]
        assert all(m.on_the_way == 0 for m in heard.missed)
        lost = {seq for first, last in gaps for seq in range(first, last + 1)}
        assert sorted({*seqs, *lost}) == list(range(seqs[0], seqs[-1] + 1))
        assert seqs == sorted(set(seqs))


@pytest.mark.parametrize("allowed", [False, True])
def test_through_a_router_control_is_only_by_permission(tmp_path: Path, allowed: bool) -> None:
    endpoint = free_endpoint()
    sections = "[control]\nthrough_router = true\n" if allowed else ""
    with router(endpoint), station(tmp_path / "lab", "lab", endpoint, sections):
        with subscribe("vdms/lab/health", endpoint) as health:
            assert health.get(PATIENCE_S) is not None
        with Controller(endpoint, station="lab") as ask:
            if allowed:
                assert ask.ask("status", timeout_s=DEADLINE_S).done
            else:
                with pytest.raises(ControlError, match="station lab takes no requests from here"):
                    ask.ask("status")
