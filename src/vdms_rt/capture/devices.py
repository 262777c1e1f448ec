"""The computer's video devices as `vdms-rt devices` shows them."""

from __future__ import annotations

import dataclasses
import json
import time
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass

import numpy as np
from rich.console import Console
from rich.table import Table

from vdms_rt.capture.grabber import DeviceInfo, no_device, setting_for, why_unusable
from vdms_rt.capture.signal import Word, blank
from vdms_rt.capture.v4l2 import V4l2Source
from vdms_rt.config import V4l2
from vdms_rt.model import SourceError

LOOK_S = 4.0
"""For the first picture: a UVC camera takes up to 3 s to wake up."""
LOOKED_AT = 5
"""Pictures: the first ones of a converter that locks may be blank."""
NARROW = 80
"""Columns where the width of the terminal is not known."""


@dataclass(frozen=True, slots=True)
class Shown:
    """A device with what only a look through it tells."""

    device: DeviceInfo
    signal: str
    setting: str
    """What to write as `v4l2.device`; empty for one that is of no use."""


def look_through(devices: Sequence[DeviceInfo]) -> list[Shown]:
    """Return the devices with the signal that each has now. A device that is free streams for a
    moment, at its first input; one in use is left alone."""
    return [Shown(d, signal_now(d), setting_for(d, devices) if d.usable else "") for d in devices]


def signal_now(device: DeviceInfo) -> str:
    """Return in words whether a device has a signal; empty where that cannot be asked."""
    if not device.usable:
        return ""
    try:
        with closing(V4l2Source(V4l2(automatic="leave"), device=device)) as source:
            word = source.signal()
            image = np.empty((source.info.height_px, source.info.width_px), np.uint8)
            deadline_s = time.monotonic() + LOOK_S
            seen = 0
            while seen < LOOKED_AT and (left_s := deadline_s - time.monotonic()) > 0:
                seen += source.read(image, left_s) is not None
    except SourceError as error:
        return str(error)
    if word.word is Word.ABSENT:
        return "none, says the driver"
    if not seen:
        return f"none: no picture came in {LOOK_S:g} s"
    if why := blank(image):
        return f"none: {why}"
    standard = f"{word.standard}, " if word.standard else ""
    return f"{standard}a picture, mean grey level {image.mean():.0f}"


def devices_json(shown: Sequence[Shown]) -> str:
    """Return the devices as JSON, a list of objects."""
    rows = [
        {
            **dataclasses.asdict(one.device),
            "usable": one.device.usable,
            "signal": one.signal,
            "setting": one.setting,
        }
        for one in shown
    ]
    return json.dumps(rows, indent=1)


def devices_table(shown: Sequence[Shown], width: int = NARROW) -> str:
    """Return the devices as a table for a person, one column each, or one sentence when there are
    none. Nodes without pictures are listed below it."""
    if not shown:
        why = no_device()
        return f"{why[0].upper()}{why[1:]}."
    own = [one for one in shown if one.device.usable]
    others = [one.device for one in shown if not one.device.usable]
    parts = []
    if own:
        parts.append(_table(own, width))
        settings = [f'device = "{one.setting}"' for one in own]
        if len(own) == 1:
            settings.insert(0, 'device = "auto"')
        lines = "\n".join(f"    {line}" for line in settings)
        parts.append(f"To use one of them write into the section [v4l2]:\n{lines}")
    for device in others:
        why = device.trouble or f"{device.title} {why_unusable(device)}"
        parts.append(f"Of no use: {why}.")
    return "\n".join(parts)


def _table(shown: Sequence[Shown], width: int) -> str:
    table = Table(box=None, pad_edge=False, show_header=False)
    table.add_column(no_wrap=True)
    for _ in shown:
        table.add_column(overflow="fold", ratio=1)
    for name, cells in _rows(shown):
        if any(cells):
            table.add_row(name, *cells)
    console = Console(width=width, no_color=True, highlight=False)
    with console.capture() as captured:
        console.print(table)
    return "\n".join(line.rstrip() for line in captured.get().splitlines())


def _rows(shown: Sequence[Shown]) -> list[tuple[str, list[str]]]:
    all_of = [one.device for one in shown]
    return [
        ("node", [d.node for d in all_of]),
        ("driver", [d.driver for d in all_of]),
        ("name", [d.card for d in all_of]),
        ("USB id", [d.usb_id for d in all_of]),
        ("serial", [d.serial for d in all_of]),
        ("port", [d.usb_port for d in all_of]),
        ("speed", [f"{d.speed_mbit_s:g} Mbit/s" if d.speed_mbit_s else "" for d in all_of]),
        ("inputs", [", ".join(f"{n} {name}" for n, name in enumerate(d.inputs)) for d in all_of]),
        ("standards", [", ".join(d.standards) for d in all_of]),
        ("formats", [", ".join(d.formats) for d in all_of]),
        ("signal now", [one.signal for one in shown]),
        ("device =", [f'"{one.setting}"' for one in shown]),
    ]
