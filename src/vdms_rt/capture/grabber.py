"""Which video devices there are, and which of them a person means."""

from __future__ import annotations

import glob
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from vdms_rt.capture import v4l2_api as api
from vdms_rt.capture.v4l2_node import DeviceGone, open_error
from vdms_rt.model import SourceError

PIXEL_FORMATS = ("YUYV", "UYVY", "GREY", "MJPG")
"""What vdms-rt reads, the best first: as the converter sends it, then luma alone, then lossy."""

ANALOGUE_DRIVERS = ("stk1160", "usbtv", "em28xx", "cx231xx")
"""Kernel drivers of USB grabbers for composite and S-Video."""

GRABBERS = {
    "05e1:0408": "stk1160",
    "1b71:3002": "usbtv",
    "1f71:3301": "usbtv",
    "1f71:3306": "usbtv",
    "eb1a:2860": "em28xx",
    "eb1a:2861": "em28xx",
    "eb1a:2863": "em28xx",
    "eb1a:5051": "em28xx",
    "1b80:e302": "em28xx",
    "1b80:e304": "em28xx",
    "1b80:e309": "em28xx",
    "1b80:e349": "em28xx",
    "2304:0207": "em28xx",
    "2304:021a": "em28xx",
    "0fd9:0033": "em28xx",
    "2040:c200": "cx231xx",
    "0fd9:0037": "cx231xx",
    "1f4d:0102": "cx231xx",
    "1f4d:0237": "cx231xx",
    "1d19:6108": "cx231xx",
    "1d19:6109": "cx231xx",
    "534d:0021": "uvcvideo",
}
"""Kernel drivers of known USB grabbers, by USB id."""

LEAST_MBIT_S = 480.0
"""The link that pictures need: 720 x 480 at 29.97 Hz in YUYV are 166 Mbit/s. USB 1.1 has 12."""

NO_DEVICE = (
    "no video device on this computer; plug the frame grabber in, and see with `lsusb` and "
    "`dmesg` whether the kernel knows it"
)

SYSFS = Path("/sys")
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
    built_in: bool = False
    """It cannot be unplugged: the computer's own camera."""
    trouble: str = ""
    """Why it could not be asked, in a sentence."""

    @property
    def usable(self) -> bool:
        return self.capture and any(f in PIXEL_FORMATS for f in self.formats) and not self.slow

    @property
    def slow(self) -> bool:
        """It is on a link of USB 1.1."""
        return self.speed_mbit_s is not None and self.speed_mbit_s < LEAST_MBIT_S

    @property
    def grabber(self) -> bool:
        """It is a known frame grabber."""
        return self.driver in ANALOGUE_DRIVERS or self.usb_id in GRABBERS

    @property
    def title(self) -> str:
        """The node and, where it could be asked, its name."""
        return f"{self.node} ({self.card})" if self.card else self.node

    def same_as(self, other: DeviceInfo) -> bool:
        """Whether this may be that device come back, perhaps as another node or at another port."""
        if not other.usb_id:
            return (self.driver, self.bus_info) == (other.driver, other.bus_info)
        return (self.usb_id, self.serial) == (other.usb_id, other.serial)


def list_devices(sysfs: Path = SYSFS) -> list[DeviceInfo]:
    """Return every video node of this computer in the order of their numbers."""
    found = _matching(sysfs / "class" / "video4linux", "video*")
    entries = sorted((len(entry.name), entry) for entry in found)
    return [_describe(f"/dev/{entry.name}", _usb_facts(entry / "device")) for _, entry in entries]


def choose_device(
    text: str,
    devices: Sequence[DeviceInfo] | None = None,
    before: DeviceInfo | None = None,
    sysfs: Path = SYSFS,
) -> DeviceInfo:
    """Return the device that `v4l2.device` means: a path, "auto", a VID:PID, a serial or a port.

    `devices` are those to choose from, of this computer by default. "auto" is the first usable
    analogue grabber, else another known grabber, else the first usable device that is not the
    computer's own camera, else that.
    With `before`, the device that was in use, it means that one alone: the reference is of its
    pictures. So does a path that has gone, for the kernel may give another number.
    Raises DeviceGone when none fits that may still come, SourceError when none is usable or more
    than one fits.
    """
    devices = list_devices(sysfs) if devices is None else devices
    if text.startswith("/"):
        return _at_path(text, devices, before)
    if text == "auto" and before is not None:
        return _come_back(before, devices)
    if not devices:
        raise DeviceGone(no_device(sysfs))
    if text == "auto":
        return _first_usable(devices, sysfs)
    fitting = [d for d in devices if _means(text, d)]
    if not fitting:
        kind = "with USB id" if _USB_ID.fullmatch(text) else "with serial or USB port"
        raise DeviceGone(
            f"no video device {kind} {text}; plug it in, or set v4l2.device to one of those here: "
            f"{_titles(devices)}"
        )
    usable = [d for d in fitting if d.usable]
    if not usable:
        raise SourceError(_no_use(fitting))
    return _only(usable, f"are {text}")


def no_device(sysfs: Path = SYSFS) -> str:
    """Return why there is no video device, and what to do."""
    return _unbound(sysfs) or NO_DEVICE


def better_device(text: str, now: DeviceInfo, sysfs: Path = SYSFS) -> bool:
    """Return whether "auto", now that `now` is in use, would rather take a known grabber that was
    plugged in since. Opens no device."""
    if text != "auto" or now.grabber:
        return False
    found = _matching(sysfs / "class" / "video4linux", "video*")
    return any(_usb_facts(entry / "device").get("id") in GRABBERS for entry in found)


def setting_for(device: DeviceInfo, devices: Sequence[DeviceInfo]) -> str:
    """Return what to write as `v4l2.device` for this device among those of the computer: its
    serial or USB id where no other has the same, else its port; for no USB device its node."""
    usable = [d for d in devices if d.usable]
    for text in (device.serial, device.usb_id):
        if text and {d.usb_port for d in usable if _means(text, d)} == {device.usb_port}:
            return text
    return device.usb_port or device.node


def why_unusable(device: DeviceInfo) -> str:
    """Return why a device is not usable, as the rest of a sentence."""
    if not device.capture:
        return "is not a capture device"
    if device.slow:
        return (
            f"is on a USB 1.1 link of {device.speed_mbit_s:g} Mbit/s, and its pictures need "
            f"{LEAST_MBIT_S:g}; plug it into a USB 2.0 port without an old hub or cable between"
        )
    return f"has only {', '.join(device.formats) or 'no format'}"


def _at_path(path: str, devices: Sequence[DeviceInfo], before: DeviceInfo | None) -> DeviceInfo:
    # A link, as udev makes them, leads to another node after the device was plugged in anew.
    node = os.path.realpath(path)
    device = next((d for d in devices if d.node == node), DeviceInfo(node))
    if before is not None and device not in devices:
        return _come_back(before, devices)
    if device.slow:
        raise SourceError(f"{device.title} {why_unusable(device)}")
    return replace(device, node=path) if path != node else device


def _come_back(before: DeviceInfo, devices: Sequence[DeviceInfo]) -> DeviceInfo:
    fitting = [d for d in devices if d.usable and d.same_as(before)]
    at_port = [d for d in fitting if d.usb_port == before.usb_port]
    if fitting:
        return at_port[0] if at_port else _only(fitting, "are like the one that was in use")
    # A node that cannot be opened yet does not say what it is.
    for device in devices:
        if device.trouble and before.usb_id and device.usb_id == before.usb_id:
            raise SourceError(device.trouble)
        if device.slow and device.same_as(before):
            raise SourceError(f"{device.title} {why_unusable(device)}")
    raise DeviceGone(
        f"{before.title} is not there; plug it in again, or start vdms-rt anew to use another"
    )


def _means(text: str, device: DeviceInfo) -> bool:
    # Most devices have no serial, and some lie on no USB port.
    named = text in (device.serial, device.usb_port) or text.lower() == device.usb_id
    return named and text != ""


def _only(usable: Sequence[DeviceInfo], what: str) -> DeviceInfo:
    # One device may have several nodes; two devices are two ports.
    if len({d.usb_port for d in usable}) > 1:
        raise SourceError(
            f"{len(usable)} video devices {what}: {_titles(usable)}; set v4l2.device to the "
            f"USB port of one: {', '.join(d.usb_port for d in usable)}"
        )
    return usable[0]


def _first_usable(devices: Sequence[DeviceInfo], sysfs: Path) -> DeviceInfo:
    def rank(device: DeviceInfo) -> tuple[bool, bool, bool]:
        return device.driver not in ANALOGUE_DRIVERS, not device.grabber, device.built_in

    usable = [device for device in devices if device.usable]
    if not usable:
        why = _unbound(sysfs)
        raise SourceError(why or _no_use(devices))
    return min(usable, key=rank)


def _unbound(sysfs: Path) -> str:
    """Return a sentence on a known grabber that no driver has taken; empty if there is none."""
    for directory in sorted(_matching(sysfs / "bus" / "usb" / "devices", "*-*")):
        usb_id = f"{_read(directory / 'idVendor')}:{_read(directory / 'idProduct')}"
        driver = GRABBERS.get(usb_id)
        if driver and not _matching(directory, "*/video4linux/video*"):
            return (
                f"the frame grabber {usb_id} at USB port {directory.name} has no driver; load it "
                f"with `sudo modprobe {driver}`, and see with `dmesg` what the kernel says"
            )
    return ""


def _no_use(devices: Sequence[DeviceInfo]) -> str:
    for device in devices:
        if device.trouble:
            return device.trouble
    for device in devices:
        if device.slow:
            return f"{device.title} {why_unusable(device)}"
    reasons = "; ".join(f"{d.title} {why_unusable(d)}" for d in devices)
    return f"no video device gives pictures that vdms-rt reads: {reasons}; plug in a frame grabber"


def _titles(devices: Sequence[DeviceInfo]) -> str:
    return ", ".join(device.title for device in devices)


def _describe(node: str, usb: dict[str, str]) -> DeviceInfo:
    known = DeviceInfo(
        node=node,
        usb_id=usb.get("id", ""),
        serial=usb.get("serial", ""),
        usb_port=usb.get("port", ""),
        speed_mbit_s=_number(usb.get("speed", "")),
        built_in=usb.get("removable") == "fixed",
    )
    try:
        fd = api.open_node(node)
    except OSError as error:
        return replace(known, trouble=str(open_error(node, error)))
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
    """Return what sysfs says of the USB device that a device lies in, {} if it lies in none."""
    try:
        resolved = device.resolve()
    except OSError:  # it was pulled at this moment
        return {}
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
        "removable": _read(directory / "removable"),
    }
    return {name: value for name, value in facts.items() if value}


def _matching(directory: Path, pattern: str) -> list[Path]:
    """Return the paths that match, [] without the directory; some may be pulled at this moment,
    which Path.glob reports as an error."""
    return [directory / name for name in glob.glob(pattern, root_dir=directory)]  # noqa: PTH207


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
