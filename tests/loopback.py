"""Stations, readers and broken cables on this computer's loopback."""

from __future__ import annotations

import contextlib
import selectors
import socket
import threading
from collections.abc import Iterator

from vdms_rt.config import Publish
from vdms_rt.model import Circle, CircleFlag, Displacement, Scan, Status
from vdms_rt.publish import Publisher
from vdms_rt.subscribe import Missed, Notice, Sample, Subscription
from vdms_rt.wire import convert, topics

DEADLINE_S = 20.0
"""How long a test waits for what must come; reached only when it fails."""


def free_endpoint() -> str:
    """Return an address on which nobody listens."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def displacement(
    seq: int, *, session: int = 7, marker: str = "m1", **values: object
) -> Displacement:
    """Return a sample whose x is its number; every value is exact in the message."""
    sample = {
        "session": session,
        "marker": marker,
        "seq": seq,
        "frame_seq": seq,
        "scan": Scan.PROGRESSIVE,
        "segment": 0,
        "stamp_ns": 1_000_000 * seq,
        "t_ns": 1_000_000 * seq,
        "sigma_t_ns": 1000,
        "utc_ns": 1_800_000_000_000_000_000 + 1_000_000 * seq,
        "setup_revision": 1,
        "x_mm": float(seq),
        "y_mm": -0.5,
        "rotation_mrad": 0.25,
        "sigma_x_mm": 0.0078125,
        "sigma_y_mm": 0.015625,
        "residual_mm": 0.00390625,
        "status": Status.OK,
        "circles": (Circle(1.5, 2.5, 300.0, 170.0, CircleFlag.NONE),) * 4,
    }
    return Displacement(**(sample | values))  # type: ignore[arg-type]


def publisher(endpoint: str, station: str = "s1", **config: object) -> Publisher:
    """Return a station that keeps a minute of 60 Hz, not entered yet."""
    return Publisher(
        Publish(listen=(endpoint,), **config),  # type: ignore[arg-type]
        station,
        ["m1", "m2"],
        sample_rate_hz=60.0,
    )


def say(station: Publisher, *seqs: int, marker: str = "m1", session: int = 7) -> None:
    """Publish the samples of these numbers."""
    for seq in seqs:
        sample = displacement(seq, session=session, marker=marker)
        assert station.put(topics.DISPLACEMENT, marker, convert.displacement_bytes(sample))


def receive(
    subscription: Subscription[Sample] | Subscription[Sample | Notice], last_seq: int
) -> tuple[list[Displacement], list[Notice]]:
    """Return displacements up to the one of this number, and the notices between them."""
    samples: list[Displacement] = []
    notices: list[Notice] = []
    while not samples or samples[-1].seq != last_seq:
        item = subscription.get(DEADLINE_S)
        assert item is not None, f"nothing after {samples[-1:]}, {notices}"
        if not isinstance(item, Sample):
            notices.append(item)
        elif isinstance(item.value, Displacement):
            samples.append(item.value)
    return samples, notices


def missed(notices: list[Notice]) -> list[Missed]:
    return [notice for notice in notices if isinstance(notice, Missed)]


class Cable:
    """Carries TCP between its own `endpoint` and `to`, until it is pulled."""

    def __init__(self, to: str) -> None:
        host, port = to.removeprefix("tcp/").rsplit(":", 1)
        self._to = host, int(port)
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.endpoint = f"tcp/127.0.0.1:{self._listener.getsockname()[1]}"
        self._pairs: list[tuple[socket.socket, socket.socket]] = []
        self._plugged = True
        self._lock = threading.Lock()
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._listener, selectors.EVENT_READ)
        self._bell, self._ring = socket.socketpair()
        self._selector.register(self._bell, selectors.EVENT_READ)
        self._thread = threading.Thread(target=self._carry, name="cable")
        self._thread.start()

    def pull(self) -> None:
        """Break every connection, and refuse new ones."""
        with self._lock:
            self._plugged = False
            for pair in self._pairs:
                self._drop(pair)
            self._pairs.clear()

    def plug(self) -> None:
        with self._lock:
            self._plugged = True

    def close(self) -> None:
        self._ring.send(b"x")
        self._thread.join()
        self.pull()
        for part in (self._listener, self._bell, self._ring):
            part.close()
        self._selector.close()

    def _carry(self) -> None:
        while True:
            for key, _ in self._selector.select():
                if key.fileobj is self._bell:
                    return
                with self._lock:
                    if key.fileobj is self._listener:
                        self._accept()
                    else:
                        self._forward(key.data)

    def _accept(self) -> None:
        near, _ = self._listener.accept()
        if not self._plugged:
            near.close()
            return
        far = socket.create_connection(self._to)
        pair = near, far
        self._pairs.append(pair)
        self._selector.register(near, selectors.EVENT_READ, (near, far, pair))
        self._selector.register(far, selectors.EVENT_READ, (far, near, pair))

    def _forward(
        self, ends: tuple[socket.socket, socket.socket, tuple[socket.socket, socket.socket]]
    ) -> None:
        source, sink, pair = ends
        if pair not in self._pairs:
            return
        try:
            data = source.recv(65536)
            if data:
                sink.sendall(data)
                return
        except OSError:
            pass
        self._pairs.remove(pair)
        self._drop(pair)

    def _drop(self, pair: tuple[socket.socket, socket.socket]) -> None:
        for end in pair:
            with contextlib.suppress(KeyError):
                self._selector.unregister(end)
            end.close()


@contextlib.contextmanager
def cable(to: str) -> Iterator[Cable]:
    line = Cable(to)
    try:
        yield line
    finally:
        line.close()
