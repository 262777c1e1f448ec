"""A device on its cable: its coming, by the kernel's word (pyudev), and its reset (pyusb)."""

from __future__ import annotations

import contextlib
import errno
import threading
import time
from pathlib import Path

import pyudev
import usb.core
import usb.util

from vdms_rt.model import SourceError

_SLICE_S = 0.2
"""So prompt is a stop while waiting."""
_SYSFS = Path("/sys/bus/usb/devices")


class Arrivals:
    """Waits for video devices to appear."""

    def __init__(self) -> None:
        self._monitor: pyudev.Monitor | None = None
        # A sandbox may forbid netlink sockets; then only the pace of `wait` finds what is new.
        with contextlib.suppress(OSError):
            # The kernel's own messages: they also come where no udev daemon runs.
            self._monitor = pyudev.Monitor.from_netlink(pyudev.Context(), source="kernel")
            self._monitor.filter_by("video4linux")
            self._monitor.start()

    def wait(self, timeout_s: float, stop: threading.Event) -> None:
        """Return when one has appeared, `stop` is set, or after `timeout_s`."""
        deadline_s = time.monotonic() + timeout_s
        while not stop.is_set() and (left_s := deadline_s - time.monotonic()) > 0:
            slice_s = min(left_s, _SLICE_S)
            if self._monitor is None:
                stop.wait(slice_s)
                continue
            device = self._monitor.poll(slice_s)
            if device is not None and device.action == "add":
                return


def reset_usb(port: str) -> None:
    """Reset the USB device at a port such as `1-1.3`; nobody may have it open.

    Its driver lets go of it, and its nodes come back, perhaps under other numbers. Raises
    SourceError.
    """
    try:
        bus, address = (int((_SYSFS / port / name).read_text()) for name in ("busnum", "devnum"))
    except (OSError, ValueError):
        raise SourceError(f"no USB device is at port {port} any more; plug it in again") from None
    try:
        device = usb.core.find(bus=bus, address=address)
        if device is None:
            raise SourceError(f"the USB device at port {port} cannot be found; plug it in again")
        try:
            device.reset()
        finally:
            usb.util.dispose_resources(device)
    except usb.core.NoBackendError:
        raise SourceError(
            "a USB device cannot be reset without libusb; install it: sudo apt install libusb-1.0-0"
        ) from None
    except usb.core.USBError as error:
        if error.errno in (errno.EACCES, errno.EPERM):
            raise SourceError(
                f"no permission to reset the USB device at port {port}; `sudo make install` gives "
                "it to the service"
            ) from None
        # It comes back as a new device, as it should.
        if error.errno not in (errno.ENODEV, errno.ENOENT):
            raise SourceError(
                f"the USB device at port {port} was not reset: {error.strerror}; plug it in anew"
            ) from None
