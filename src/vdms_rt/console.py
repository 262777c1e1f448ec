"""The run as a terminal shows it: log lines above, one quiet status line below."""

from __future__ import annotations

import logging
import os
import shutil
import sys

ERASE_TO_END = "\x1b[K"


class Console(logging.Handler):
    """Writes log records to stderr and, on a terminal, keeps one status line under them.

    Under systemd, which stamps each line of the journal itself, lines carry no time of their own.
    """

    def __init__(self) -> None:
        super().__init__()
        self._terminal = sys.stderr.isatty()
        self._line = ""
        stamped = "JOURNAL_STREAM" not in os.environ
        self.setFormatter(
            logging.Formatter("%(asctime)s %(message)s" if stamped else "%(message)s", "%H:%M:%S")
        )

    def emit(self, record: logging.LogRecord) -> None:
        """Write one record; logging holds the handler's lock."""
        erase = f"\r{ERASE_TO_END}" if self._line else ""
        sys.stderr.write(f"{erase}{self.format(record)}\n{self._line}")
        sys.stderr.flush()

    def status(self, text: str) -> None:
        """Show this under the log lines; an empty text takes the line away."""
        if not self._terminal:
            return
        self.acquire()
        try:
            width = shutil.get_terminal_size().columns
            self._line = text[: width - 1]
            sys.stderr.write(f"\r{self._line}{ERASE_TO_END}")
            sys.stderr.flush()
        finally:
            self.release()

    def block(self, text: str) -> None:
        """Write text as it is, in place of the status line."""
        self.status("")
        sys.stderr.write(text + "\n")
        sys.stderr.flush()
