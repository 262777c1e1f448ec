"""Which video devices there are, and which of them a person means."""

from __future__ import annotations

import errno
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from vdms_rt.capture import v4l2_api as api
from vdms_rt.model import SourceError

PIXEL_FORMATS = ("YUYV", "UYVY", "GREY", "MJPG")
"""What vdms-rt reads, the best first: as the converter sends it, then luma alone, then lossy."""

ANALOGUE_DRIVERS = ("stk1160", "usbtv", "em28xx", "cx231xx")
"""Kernel drivers of USB grabbers for composite and S-Video."""

UVC_GRABBERS = ("534d:0021",)
"""USB ids of grabbers that say to be a UVC camera."""

NO_DEVICE = (
    "no video device on this computer; plug the frame grabber in, and see with `lsusb` and "
    "`dmesg` whether the kernel knows it"
)

_SYSFS = Path("/sys/class/video4linux")
_USB_ID = re.compile(r"[0-9a-fA-F]{4}:[0-9a-fA-F]{4}")


@dataclass(frozen=True, slots=True)
class DeviceInfo:
    """One video node. What could not be learnt is empty or None."""

    node: str
    driver: str = ""
    card: str = ""
    bus_info: str = ""
    usb_id: str = ""
    """Vendor and product, such as `1b71:3002`."""
    serial: str = ""
    usb_port: str = ""
    """Where it is plugged in, such as `1-1.3`: bus 1, port 1, port 3 of the hub there."""
    speed_mbit_s: float | None = None
    inputs: tuple[str, ...] = ()
    standards: tuple[str, ...] = ()
    """By their names in the configuration."""
    formats: tuple[str, ...] = ()
    capture: bool = False
    """It gives pictures by streaming."""
    trouble: str = ""
    """Why it could not be asked, in a sentence."""

    @property
    def usable(self) -> bool:
        return self.capture and any(f in PIXEL_FORMATS for f in self.formats)

    @property
    def title(self) -> str:
        """The node and, where it could be asked, its name."""
        return f"{self.node} ({self.card})" if self.card else self.node


def list_devices(sysfs: Path = _SYSFS) -> list[DeviceInfo]:
    """Return every video node of this computer in the order of their numbers."""
    try:
        entries = [entry for entry in sysfs.iterdir() if entry.name.startswith("video")]
    except FileNotFoundError:
        return []
    entries.sort(key=lambda entry: (len(entry.name), entry.name))
    return [_describe(f"/dev/{entry.name}", _usb_facts(entry / "device")) for entry in entries]


def choose_device(text: str, devices: Sequence[DeviceInfo] | None = None) -> str:
    """Return the node that `v4l2.device` means: a path, "auto", a VID:PID, a serial or a port.

    `devices` are those to choose from, of this computer by default. "auto" is the first usable
    analogue grabber, else the first usable UVC grabber, else the first usable node. A path is
    returned as it is. Raises SourceError when nothing or more than one device fits.
    """
    if text.startswith("/"):
        return text
    devices = list_devices() if devices is None else devices
    if not devices:
        raise SourceError(NO_DEVICE)
    if text == "auto":
        return _first_usable(devices)
    fitting = [d for d in devices if _means(text, d)]
    usable = [d for d in fitting if d.usable]
    if not usable:
        if fitting:
            raise SourceError(_no_use(fitting))
        kind = "with USB id" if _USB_ID.fullmatch(text) else "with serial or USB port"
        raise SourceError(
            f"no video device {kind} {text}; plug it in, or set v4l2.device to one of those here: "
            f"{_titles(devices)}"
        )
    # One device may have several nodes; two devices are two ports.
    if len({d.usb_port for d in usable}) > 1:
        raise SourceError(
            f"{len(usable)} video devices are {text}: {_titles(usable)}; set v4l2.device to the "
            f"USB port of one: {', '.join(d.usb_port for d in usable)}"
        )
    return usable[0].node


def _means(text: str, device: DeviceInfo) -> bool:
    # Most devices have no serial, and some lie on no USB port.
    named = text in (device.serial, device.usb_port) or text.lower() == device.usb_id
    return named and text != ""


def devices_table(devices: Sequence[DeviceInfo]) -> str:
    """Return the devices as text for a person, or one sentence when there are none."""
    if not devices:
        return NO_DEVICE[0].upper() + NO_DEVICE[1:] + "."
    return "\n\n".join(_paragraph(device) for device in devices)


def _paragraph(device: DeviceInfo) -> str:
    rows = [("driver", device.driver), ("bus", device.bus_info)]
    if device.usb_id:
        speed = f", {device.speed_mbit_s:g} Mbit/s" if device.speed_mbit_s else ""
        serial = f", serial {device.serial}" if device.serial else ""
        rows.append(("USB", f"{device.usb_id}{serial}, port {device.usb_port}{speed}"))
    if device.capture:
        names = [f"{index} {name}" for index, name in enumerate(device.inputs)]
        rows.append(("inputs", ", ".join(names)))
        rows.append(("standards", ", ".join(device.standards)))
        rows.append(("formats", ", ".join(device.formats)))
    if device.trouble:
        rows.append(("trouble", device.trouble))
    elif not device.usable:
        rows.append(("no use", _why_unusable(device)))
    return "\n".join([device.title, *(f"  {name:<10}{text}" for name, text in rows if text)])


def _first_usable(devices: Sequence[DeviceInfo]) -> str:
    def rank(device: DeviceInfo) -> int:
        if device.driver in ANALOGUE_DRIVERS:
            return 0
        return 1 if device.usb_id in UVC_GRABBERS else 2

    usable = [device for device in devices if device.usable]
    if not usable:
        raise SourceError(_no_use(devices))
    return min(usable, key=rank).node


def _no_use(devices: Sequence[DeviceInfo]) -> str:
    for device in devices:
        if device.trouble:
            return device.trouble
    reasons = "; ".join(f"{d.title} {_why_unusable(d)}" for d in devices)
    return f"no video device gives pictures that vdms-rt reads: {reasons}; plug in a frame grabber"


def _why_unusable(device: DeviceInfo) -> str:
    if not device.capture:
        return "is not a capture device"
    return f"has only {', '.join(device.formats) or 'no format'}"


def _titles(devices: Sequence[DeviceInfo]) -> str:
    return ", ".join(device.title for device in devices)


def open_sentence(node: str, error: OSError) -> str:
    """Return why a node could not be opened and how to mend it."""
    if error.errno in (errno.EACCES, errno.EPERM):
        return (
            f"no permission to open {node}; add the user to the group video "
            "(sudo usermod -aG video USER) and log in again"
        )
    if error.errno in (errno.ENOENT, errno.ENODEV, errno.ENXIO):
        return (
            f"{node} is not there; plug the device in, or set v4l2.device to another "
            "(`vdms-rt devices` lists them)"
        )
    if error.errno == errno.EBUSY:
        return busy_sentence(node)
    return f"cannot open {node}: {error.strerror}; set v4l2.device to a video capture node"


def busy_sentence(name: str) -> str:
    """Return that another program has the device, and how to learn which."""
    return (
        f"{name} is in use by another program; end it (`fuser -v /dev/video*` names it), or set "
        "v4l2.device to another"
    )


def _describe(node: str, usb: dict[str, str]) -> DeviceInfo:
    known = DeviceInfo(
        node=node,
        usb_id=usb.get("id", ""),
        serial=usb.get("serial", ""),
        usb_port=usb.get("port", ""),
        speed_mbit_s=_number(usb.get("speed", "")),
    )
    try:
        fd = api.open_node(node)
    except OSError as error:
        return replace(known, trouble=open_sentence(node, error))
    try:
        about = api.capability(fd)
        capture = about.of_node & api.CAP_VIDEO_CAPTURE and about.of_node & api.CAP_STREAMING
        inputs = api.inputs(fd) if capture else []
        offered = 0
        for one in inputs:
            offered |= one.std
        return replace(
            known,
            driver=api.text(about.driver),
            card=api.text(about.card),
            bus_info=api.text(about.bus_info),
            inputs=tuple(api.text(one.name) for one in inputs),
            standards=tuple(name for name, bits in api.STANDARDS.items() if bits & offered),
            formats=tuple(api.pixel_formats(fd)) if capture else (),
            capture=bool(capture),
        )
    except OSError as error:
        return replace(known, trouble=f"{node} does not answer: {error.strerror}; plug it in anew")
    finally:
        os.close(fd)


def _usb_facts(device: Path) -> dict[str, str]:
    """Return id, serial, port and speed of the USB device that a sysfs device lies in, or {}."""
    resolved = device.resolve()
    for directory in (resolved, *resolved.parents):
        if (directory / "idVendor").exists():
            break
    else:
        return {}
    facts = {
        "id": f"{_read(directory / 'idVendor')}:{_read(directory / 'idProduct')}",
        "serial": _read(directory / "serial"),
        "port": directory.name,
        "speed": _read(directory / "speed"),
    }
    return {name: value for name, value in facts.items() if value}


def _number(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None


def _read(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8", errors="replace").strip()
    except OSError:
        return ""
