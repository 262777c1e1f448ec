"""The device's own adjustments: brightness and the like as configured, automatic ones off."""

from __future__ import annotations

import contextlib
import os

from vdms_rt.capture import v4l2_api as api
from vdms_rt.capture.v4l2_node import Node
from vdms_rt.config import V4l2
from vdms_rt.model import SourceError

ADJUSTMENTS = {
    "brightness": api.CID_BRIGHTNESS,
    "contrast": api.CID_CONTRAST,
    "saturation": api.CID_SATURATION,
    "hue": api.CID_HUE,
    "gain": api.CID_GAIN,
}
"""Control ids by the keys of the configuration."""

AUTOMATICS = {
    "automatic gain": (api.CID_AUTOGAIN, 0),
    "automatic brightness": (api.CID_AUTOBRIGHTNESS, 0),
    "automatic exposure": (api.CID_EXPOSURE_AUTO, api.EXPOSURE_MANUAL),
}
"""Control ids, and the values that switch them off."""

_UNUSABLE = api.CTRL_FLAG_DISABLED | api.CTRL_FLAG_READ_ONLY

Facts = tuple[tuple[str, str], ...]


def set_controls(node: Node, config: V4l2) -> tuple[Facts, tuple[str, ...]]:
    """Set the controls as configured; return what was read back, and warnings.

    Raises SourceError for a value that the device does not take.
    """
    facts: list[tuple[str, str]] = []
    warnings: list[str] = []
    if config.automatic == "off":
        _switch_off(node, facts, warnings)
    for name, control in ADJUSTMENTS.items():
        wanted: int | None = getattr(config, name)
        known = _description(node, control)
        if wanted is not None:
            _set(node, name, control, known, wanted)
        if known is None or (now := _value(node, control)) is None:
            continue
        facts.append((name, f"{now} of {known.minimum} to {known.maximum}"))
        if wanted is not None and now != wanted:
            warnings.append(
                f"{node.name} says {name} {now} after v4l2.{name} = {wanted} was set; some drivers "
                "forget what they set, so look in the picture which of them holds"
            )
    return tuple(facts), tuple(warnings)


def _switch_off(node: Node, facts: list[tuple[str, str]], warnings: list[str]) -> None:
    there = False
    for name, (control, off) in AUTOMATICS.items():
        if _description(node, control) is None:
            continue
        there = True
        with contextlib.suppress(OSError):  # What counts is what is read back.
            api.ioctl(node.fd, api.VIDIOC_S_CTRL, api.Control(control, off))
        if _value(node, control) == off:
            facts.append((name, "off"))
        else:
            facts.append((name, "on"))
            warnings.append(
                f"{name} of {node.name} cannot be switched off; keep the light steady while it "
                "measures"
            )
    if not there:
        warnings.append(
            f"{node.name} has no switch for automatic gain or exposure; switch them off at the "
            "camera, and keep the light steady while it measures"
        )


def _set(
    node: Node, name: str, control: int, known: api.ControlDescription | None, wanted: int
) -> None:
    if known is None:
        raise SourceError(
            f"{node.name} has no control for {name}; leave v4l2.{name} out of the configuration"
        )
    if not known.minimum <= wanted <= known.maximum:
        raise SourceError(
            f"{node.name} takes a {name} of {known.minimum} to {known.maximum}; v4l2.{name} = "
            f"{wanted} is beyond"
        )
    try:
        api.ioctl(node.fd, api.VIDIOC_S_CTRL, api.Control(control, wanted))
    except OSError as error:
        raise SourceError(
            f"{node.name} refuses v4l2.{name} = {wanted}: {os.strerror(error.errno or 0)}; leave "
            "it out of the configuration"
        ) from None


def _description(node: Node, control: int) -> api.ControlDescription | None:
    """Return what the device says of a control that can be set, None if it has none."""
    answer = api.ControlDescription(id=control)
    try:
        api.ioctl(node.fd, api.VIDIOC_QUERYCTRL, answer)
    except OSError:
        return None
    return None if answer.flags & _UNUSABLE else answer


def _value(node: Node, control: int) -> int | None:
    answer = api.Control(id=control)
    try:
        api.ioctl(node.fd, api.VIDIOC_G_CTRL, answer)
    except OSError:
        return None
    return answer.value
