"""The one table of topics: what is said, under which key, how often, and how it travels."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from google.protobuf.message import Message

from vdms_rt.wire import picture_pb2
from vdms_rt.wire import vdms_pb2 as pb


class Recovery(Enum):
    """What a subscriber gets of what was said while it was not there."""

    NONE = "none"
    LATEST = "the last message"
    ALL = "every message of the last publish.recover_s; gaps are found and filled"


class Priority(Enum):
    """What goes first when a link is narrow."""

    HIGH = "high"
    NORMAL = "normal"


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
    recovery: Recovery = Recovery.NONE
    priority: Priority = Priority.NORMAL


DISPLACEMENT = Topic(
    "displacement",
    "vdms/{station}/{marker}/displacement",
    pb.Displacement,
    "mm",
    "each picture",
    network=True,
    recorded=True,
    recovery=Recovery.ALL,
    priority=Priority.HIGH,
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
    recovery=Recovery.LATEST,
)
EVENT = Topic(
    "event",
    "vdms/{station}/event",
    pb.Event,
    "",
    "on change",
    network=True,
    recorded=True,
    recovery=Recovery.ALL,
)
SETUP = Topic(
    "setup",
    "vdms/{station}/setup",
    pb.SetUp,
    "px, mm",
    "on change",
    network=True,
    recorded=True,
    recovery=Recovery.ALL,
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
