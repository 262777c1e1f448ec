"""An open video node, and what the kernel's errors on it mean."""

from __future__ import annotations

import errno
import os

from vdms_rt.capture import v4l2_api as api
from vdms_rt.model import SourceError


class DeviceGone(SourceError):
    """The device is not there: unplugged, or not plugged in yet."""


def open_error(node: str, error: OSError) -> SourceError:
    """Return why a node could not be opened and how to mend it."""
    if error.errno in (errno.EACCES, errno.EPERM):
        return SourceError(
            f"no permission to open {node}; add the user to the group video "
            "(sudo usermod -aG video USER) and log in again"
        )
    if error.errno in (errno.ENOENT, errno.ENODEV, errno.ENXIO):
        return DeviceGone(
            f"{node} is not there; plug the device in, or set v4l2.device to another "
            "(`vdms-rt devices` lists them)"
        )
    if error.errno == errno.EBUSY:
        return SourceError(busy_sentence(node))
    return SourceError(
        f"cannot open {node}: {error.strerror}; set v4l2.device to a video capture node"
    )


def busy_sentence(name: str) -> str:
    """Return that another program has the device, and how to learn which."""
    return (
        f"{name} is in use by another program; end it (`fuser -v /dev/video*` names it), or set "
        "v4l2.device to another"
    )


class Node:
    """An open video node, which turns the kernel's errors into sentences."""

    def __init__(self, path: str) -> None:
        """Raises SourceError if there is no such node, or it gives no pictures."""
        self.path = path
        self.name = path
        try:
            self.fd = api.open_node(path)
        except OSError as error:
            raise open_error(path, error) from None
        try:
            about = self._about()
        except BaseException:
            self.close()
            raise
        self.driver = api.text(about.driver)
        self.card = api.text(about.card)
        self.bus = api.text(about.bus_info)
        self.name = f"{path} ({self.card})"

    def call(self, request: int, argument: api.Argument, doing: str) -> None:
        """Ask the driver, which fills `argument`; raises SourceError. `doing` names the attempt."""
        try:
            api.ioctl(self.fd, request, argument)
        except OSError as error:
            raise self.error(error, doing) from None

    def offers(self, request: int, argument: api.Argument, doing: str) -> bool:
        """Ask the driver as `call` does; False if it has no such thing."""
        try:
            api.ioctl(self.fd, request, argument)
        except OSError as error:
            if error.errno in api.NOT_OFFERED:
                return False
            raise self.error(error, doing) from None
        return True

    def error(self, error: OSError, doing: str) -> SourceError:
        """Return what an error of the driver's means and how to mend it."""
        if error.errno in (errno.ENODEV, errno.ENXIO):
            return DeviceGone(f"{self.name} was unplugged; plug it in again")
        if error.errno == errno.EBUSY:
            return SourceError(busy_sentence(self.name))
        if error.errno == errno.ENOSPC:
            return SourceError(
                f"the USB bus has no room for the pictures of {self.name}; plug it into a port of "
                "its own, without a hub"
            )
        return SourceError(
            f"{self.name} failed while {doing}: {os.strerror(error.errno or 0)}; check the cables "
            "and plug it in anew"
        )

    def close(self) -> None:
        """Give the node back; may be called twice."""
        if self.fd >= 0:
            os.close(self.fd)
            self.fd = -1

    def _about(self) -> api.Capability:
        try:
            about = api.capability(self.fd)
        except OSError as error:
            if error.errno in api.NOT_OFFERED:
                raise SourceError(
                    f"{self.path} is not a video device; set v4l2.device to a node that "
                    "`vdms-rt devices` lists"
                ) from None
            raise self.error(error, "being asked what it is") from None
        if not about.of_node & api.CAP_VIDEO_CAPTURE or not about.of_node & api.CAP_STREAMING:
            raise SourceError(
                f"{self.path} ({api.text(about.card)}) is not a capture device that streams; set "
                "v4l2.device to one that `vdms-rt devices` lists with its formats"
            )
        return about
