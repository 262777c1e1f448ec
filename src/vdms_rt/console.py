"""The run as a terminal shows it: log lines above, one quiet status line below."""

from __future__ import annotations

import logging
import os
import shutil
import sys
import textwrap

ERASE_TO_END = "\x1b[K"

TIME_COLUMNS = 9
"""Of the time before a log line, and of what goes on under it."""

_PRIORITIES = {logging.INFO: 6, logging.WARNING: 4, logging.ERROR: 3, logging.CRITICAL: 2}
"""Of the journal, sd-daemon(3)."""


def in_journal() -> bool:
    """Return whether standard error goes straight into systemd's journal, systemd.exec(5)."""
    try:
        stream = os.fstat(sys.stderr.fileno())
    except (OSError, ValueError):
        return False
    return os.environ.get("JOURNAL_STREAM") == f"{stream.st_dev}:{stream.st_ino}"


def fault_text(error: Exception) -> str:
    """Return an error's sentences as lines for standard error, ready for the journal if that is
    where they go."""
    prefix = f"<{_PRIORITIES[logging.ERROR]}>" if in_journal() else "vdms-rt: "
    return "\n".join(prefix + line for line in str(error).splitlines())


class Console(logging.Handler):
    """Writes log records to stderr and, on a terminal, keeps one status line under them.

    In the journal, which stamps each line itself, lines carry no time of their own but their
    priority, so that warnings and errors stand out.
    """

    def __init__(self) -> None:
        super().__init__()
        self._terminal = sys.stderr.isatty()
        self._journal = in_journal()
        self._line = ""
        form = "%(message)s" if self._journal else "%(asctime)s %(message)s"
        self.setFormatter(logging.Formatter(form, "%H:%M:%S"))

    def emit(self, record: logging.LogRecord) -> None:
        """Write one record; logging holds the handler's lock."""
        text = self.format(record)
        if self._journal:
            prefix = f"<{_PRIORITIES.get(record.levelno, 6)}>"
            text = "\n".join(prefix + line for line in text.splitlines())
        if self._terminal:
            text = wrapped(text, shutil.get_terminal_size().columns)
        erase = f"\r{ERASE_TO_END}" if self._line else ""
        sys.stderr.write(f"{erase}{text}\n{self._line}")
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


def wrapped(text: str, columns: int) -> str:
    """Return the text with its long lines broken at spaces, as far as words allow."""
    return "\n".join(
        part
        for line in text.splitlines()
        for part in textwrap.wrap(
            line,
            max(columns - 1, 2 * TIME_COLUMNS),
            subsequent_indent=" " * TIME_COLUMNS,
            break_long_words=False,
            break_on_hyphens=False,
        )
        or [""]
    )
