"""The example in another language, against a station."""

import math
import shutil
import subprocess
import time

import pytest
from hosts import ROOT
from loopback import DEADLINE_S, displacement, free_endpoint, publisher

from vdms_rt.model import Status
from vdms_rt.publish import Publisher
from vdms_rt.wire import convert, topics

EXAMPLE = ROOT / "examples" / "node" / "follow.mjs"


def put(station: Publisher, seq: int, **values: object) -> None:
    data = convert.displacement_bytes(displacement(seq, session=2**63 + 7, **values))
    assert station.put(topics.DISPLACEMENT, "m1", data)


@pytest.mark.skipif(shutil.which("node") is None, reason="the example needs Node.js")
def test_node_prints_what_a_station_says() -> None:
    endpoint = free_endpoint()
    with publisher(endpoint) as station:
        process = subprocess.Popen(
            ["node", EXAMPLE, "127.0.0.1", endpoint.rsplit(":", 1)[1]],
            stdout=subprocess.PIPE,
            text=True,
        )
        assert process.stdout is not None
        try:
            until_s = time.monotonic() + DEADLINE_S
            while not station.links:
                assert time.monotonic() < until_s
                time.sleep(0.01)
            for _ in range(50):  # until its subscription has arrived
                put(station, 0)
                time.sleep(0.01)
            put(station, 1, x_mm=-12.125, y_mm=3.5)
            put(station, 2, x_mm=math.nan, status=Status.NOT_FOUND)
            put(station, 2**40)
            lines = []
            while not lines or f" {2**40} " not in lines[-1]:
                lines.append(process.stdout.readline().strip())
                assert lines[-1], "it ended"
        finally:
            process.kill()
            process.communicate()
    assert lines[-3:] == [
        f"{2**63 + 7} m1 1 -12.125 3.5 true",
        f"{2**63 + 7} m1 2 NaN -0.5 false",
        f"{2**63 + 7} m1 {2**40} {2**40} -0.5 true",
    ]
    assert set(lines[:-3]) == {f"{2**63 + 7} m1 0 0 -0.5 true"}
