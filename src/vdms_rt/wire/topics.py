"""The one table of topics: what is said, under which key, how often, and how it travels."""

from __future__ import annotations

from dataclasses import dataclass

from google.protobuf.message import Message

from vdms_rt.wire import picture_pb2
from vdms_rt.wire import vdms_pb2 as pb


@dataclass(frozen=True, slots=True)
class Topic:
    name: str
    key: str
    """zenoh key with {station} and, where each marker has its own, {marker}."""
    message: type[Message]
    unit: str
    rate: str
    network: bool
    recorded: bool
    recovered: bool = False
    """Kept for subscribers whose link was down, and gaps are found and filled."""
    urgent: bool = False
    """Goes before the rest when the link is narrow."""
    latest: bool = False
    """A subscriber that comes late gets the last one."""


DISPLACEMENT = Topic(
    "displacement",
    "vdms/{station}/{marker}/displacement",
    pb.Displacement,
    "mm",
    "each picture",
    network=True,
    recorded=True,
    recovered=True,
    urgent=True,
)
TRUTH = Topic(
    "truth",
    "vdms/{station}/{marker}/truth",
    pb.Truth,
    "mm",
    "each picture of the virtual table",
    network=True,
    recorded=True,
)
HEALTH = Topic(
    "health",
    "vdms/{station}/health",
    pb.Health,
    "",
    "1 Hz",
    network=True,
    recorded=True,
    latest=True,
)
EVENT = Topic(
    "event",
    "vdms/{station}/event",
    pb.Event,
    "",
    "on change",
    network=True,
    recorded=True,
    recovered=True,
)
SETUP = Topic(
    "setup",
    "vdms/{station}/setup",
    pb.SetUp,
    "px, mm",
    "on change",
    network=True,
    recorded=True,
    recovered=True,
    latest=True,
)
RUN = Topic(
    "run", "vdms/{station}/run", pb.Run, "", "start of each file", network=False, recorded=True
)
END = Topic(
    "end", "vdms/{station}/end", pb.End, "", "end of each file", network=False, recorded=True
)
PIXELS = Topic(
    "pixels",
    "vdms/{station}/pixels",
    pb.Pixels,
    "grey level",
    "each frame",
    network=False,
    recorded=True,
)

PICTURE = Topic(
    "picture",
    "vdms/{station}/picture",
    picture_pb2.CompressedImage,
    "",
    "with each reference",
    network=False,
    recorded=True,
)
CHECKPOINT = Topic(
    "checkpoint",
    "vdms/{station}/checkpoint",
    pb.Checkpoint,
    "",
    "1 Hz and on change",
    network=False,
    recorded=True,
)

TOPICS = (DISPLACEMENT, TRUTH, HEALTH, EVENT, SETUP, RUN, END, PIXELS, PICTURE, CHECKPOINT)

ALIVE_KEY = "vdms/{station}/alive"
"""Liveliness token of a running daemon; it says that the process lives, not that it measures."""
