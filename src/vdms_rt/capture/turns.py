"""Which field begins a frame, where each comes in a buffer of its own."""

from __future__ import annotations

from vdms_rt.model import Scan


class FieldTurns:
    """The turns of an alternating source's fields. V4L2 gives the two of one frame the same
    sequence number."""

    def __init__(self) -> None:
        self._first: Scan | None = None
        self._before: tuple[int, int, Scan] | None = None

    def missed(self, place: int, missed: int, scan: Scan) -> int:
        """Return the number missed before a field with which it comes in its turn; `place` is
        what it has if none is missing, even for a frame's first field."""
        if self._first is not None:
            odd = scan is not self._first
        elif self._before is not None:
            # Whichever begins a frame, two of a kind have another between them.
            odd = (self._before[0] + (scan is not self._before[2])) % 2 == 1
        else:
            return missed
        if (place + missed) % 2 == odd:
            return missed
        return missed - 1 if missed else 1

    def shift(self, place: int, sequence: int, scan: Scan) -> int:
        """Take the next field; return 1 if it and all later ones must move up by a place, so that
        every frame begins with an even one, else 0. Known from two fields without a gap on."""
        before, self._before = self._before, (place, sequence, scan)
        if self._first is not None or before is None:
            return 0
        if place != before[0] + 1 or scan is before[2]:
            return 0
        paired = sequence == before[1]
        self._first = before[2] if paired else scan
        return (place - 1 if paired else place) % 2
