"""What a `reader_loop` in another process has seen so far."""

from __future__ import annotations

import subprocess
import threading
from dataclasses import dataclass, field

DEADLINE_S = 90.0


@dataclass
class Seen:
    """Everything, in the order in which it came."""

    samples: dict[int, list[int]] = field(default_factory=dict)
    """Numbers by session."""
    missed: list[tuple[int, ...]] = field(default_factory=list)
    """(session, first, last, on the way)."""
    words: list[str] = field(default_factory=list)
    """Notices and other messages."""


class Reader:
    """Reads the lines of a `reader_loop` in a thread."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self.process = process
        self.seen = Seen()
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._read, name="reader")
        self._thread.start()

    def newest(self, session: int) -> int:
        with self._changed:
            return self._newest(session)

    def wait(self, session: int, seq: int, deadline_s: float = DEADLINE_S) -> None:
        """Wait until a sample of this number or a later one has come."""
        with self._changed:
            came = self._changed.wait_for(lambda: self._newest(session) >= seq, deadline_s)
            assert came, f"{seq} never came, only {self._newest(session)}: {self.seen.words}"

    def end(self) -> Seen:
        self.process.kill()
        self._thread.join()
        self.process.wait()
        return self.seen

    def _newest(self, session: int) -> int:
        return self.seen.samples.get(session, [-1])[-1]

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            word, *numbers = line.split()
            with self._changed:
                if word == "sample":
                    session, seq = map(int, numbers)
                    self.seen.samples.setdefault(session, []).append(seq)
                elif word == "missed":
                    self.seen.missed.append(tuple(map(int, numbers)))
                else:
                    self.seen.words.append(" ".join((word, *numbers)))
                self._changed.notify_all()
        self.process.stdout.close()
