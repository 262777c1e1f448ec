"""The page and its server for an hour on the demo: neither grows.

`pytest -m soak tests/view -s --soak-seconds 180` is the same in short.
"""

import sys
import time
from pathlib import Path
from typing import NamedTuple

import pytest
from browsing import Server, opened, server, station
from playwright.sync_api import Browser, CDPSession, expect

SECONDS = 3600
SAMPLES = 30
SETTLED = 3
"""Parts of the time until everything that has a limit has reached it: 20 of 60 minutes, for 10
minutes of samples."""
MOST_MB = 4.0
MOST_NODES = 300


class Size(NamedTuple):
    at_s: float
    server_mb: float
    heap_mb: float
    arrays_mb: float
    nodes: int

    def __str__(self) -> str:
        return (
            f"{self.at_s:6.0f} s  server {self.server_mb:6.1f} MB  page's heap "
            f"{self.heap_mb:5.2f} MB  its arrays {self.arrays_mb:5.2f} MB  nodes {self.nodes}"
        )


def size(begin_s: float, running: Server, session: CDPSession) -> Size:
    assert running.process is not None
    status = Path(f"/proc/{running.process.pid}/status").read_text()
    (resident,) = (line for line in status.splitlines() if line.startswith("VmRSS:"))
    session.send("HeapProfiler.collectGarbage")
    heap = session.send("Runtime.getHeapUsage")
    nodes = session.send("Memory.getDOMCounters")["nodes"]
    return Size(
        time.monotonic() - begin_s,
        int(resident.split()[1]) / 1024,
        heap["usedSize"] / 1e6,
        heap["backingStorageSize"] / 1e6,
        nodes,
    )


@pytest.mark.soak
@pytest.mark.timeout(3 * SECONDS)
def test_neither_page_nor_server_grows(
    chrome: Browser, tmp_path: Path, pytestconfig: pytest.Config
) -> None:
    seconds = float(pytestconfig.getoption("--soak-seconds", default=None) or SECONDS)
    with (
        station(tmp_path, moving=True) as demo,
        server(tmp_path, demo.endpoint) as running,
        opened(chrome, running.url) as page,
    ):
        expect(page.locator("#peaks li").first).to_contain_text("Hz")
        page.get_by_role("radio", name="10 min").click()
        session = page.context.new_cdp_session(page)
        begin_s = time.monotonic()
        sizes = [size(begin_s, running, session)]
        for n in range(1, SAMPLES + 1):
            page.wait_for_timeout(max(begin_s + n * seconds / SAMPLES - time.monotonic(), 0) * 1000)
            sizes.append(size(begin_s, running, session))
            sys.stdout.write(f"\n{sizes[-1]}")
        expect(page.locator("#state")).to_have_text("measuring")
        expect(page.locator("#facts")).to_contain_text("has every sample")
    settled, last = sizes[SAMPLES // SETTLED], sizes[-1]
    assert last.server_mb - settled.server_mb < MOST_MB, sizes
    assert last.heap_mb - settled.heap_mb < MOST_MB, sizes
    assert last.arrays_mb - settled.arrays_mb < MOST_MB, sizes
    assert last.nodes - settled.nodes < MOST_NODES, sizes
