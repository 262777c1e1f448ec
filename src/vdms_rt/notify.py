"""What systemd is told of the service, sd_notify(3): a datagram to the socket that it names."""

from __future__ import annotations

import contextlib
import os
import socket
from types import TracebackType
from typing import Self

SEND_TIMEOUT_S = 1.0
"""systemd reads at once; when it does not, measuring is worth more than a word to it."""


class Notifier:
    """The line to the service manager, from `__enter__` to `__exit__`; without one it does
    nothing. One thread uses it."""

    def __init__(self) -> None:
        self._address = os.environ.get("NOTIFY_SOCKET", "")
        self._socket: socket.socket | None = None

    def __enter__(self) -> Self:
        if self._address:
            # A leading @ stands for the zero byte of an abstract address, unix(7).
            address = f"\0{self._address[1:]}" if self._address[0] == "@" else self._address
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
            self._socket.settimeout(SEND_TIMEOUT_S)
            with contextlib.suppress(OSError):
                self._socket.connect(address)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._socket is not None:
            self._socket.close()

    def ready(self) -> None:
        """Say that the service has started."""
        self._send("READY=1")

    def status(self, text: str) -> None:
        """Say, in one line, what `systemctl status` shows."""
        self._send(f"STATUS={text}")

    def progress(self) -> None:
        """Say that it goes on; the watchdog bites when this is not heard for WatchdogSec."""
        self._send("WATCHDOG=1")

    def busy(self, seconds: int) -> None:
        """Say, before the start or stop is complete, that it may take so much longer from now."""
        self._send(f"EXTEND_TIMEOUT_USEC={seconds * 1_000_000}")

    def stopping(self) -> None:
        """Say that the service ends by itself, or as it was told to."""
        self._send("STOPPING=1")

    def _send(self, text: str) -> None:
        if self._socket is not None:
            with contextlib.suppress(OSError):
                self._socket.send(text.encode())
