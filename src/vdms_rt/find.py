"""The thread that searches a copied picture for the markers: measuring never waits for it."""

from __future__ import annotations

import threading
from collections.abc import Sequence

import numpy as np

from vdms_rt.measure.marker import find_markers
from vdms_rt.model import FoundMarker, Luma, MarkerShape, Scan


class Search:
    """A mailbox for one picture and its answer; used by the process and the find thread."""

    def __init__(self, shapes: Sequence[MarkerShape]) -> None:
        self.shapes: Sequence[MarkerShape] = tuple(shapes)
        """What is searched; may be changed between two pictures."""
        self._changed = threading.Condition()
        self._request: tuple[Luma, Scan] | None = None
        self._busy = False
        self._answer: tuple[FoundMarker, ...] | None = None

    def ask(self, image: Luma, scan: Scan) -> bool:
        """Hand over a copy of the picture; False, and nothing is done, if one is being searched."""
        with self._changed:
            if self._busy or self._answer is not None:
                return False
            self._request = (np.array(image), scan)
            self._busy = True
            self._changed.notify_all()
            return True

    def answer(self, timeout_s: float = 0.0) -> tuple[FoundMarker, ...] | None:
        """Return, once, what was found in the picture asked about; None if not yet known."""
        with self._changed:
            self._changed.wait_for(lambda: self._answer is not None or not self._busy, timeout_s)
            found, self._answer = self._answer, None
            return found

    @property
    def busy(self) -> bool:
        """A picture is being searched, or its answer lies ready."""
        return self._busy or self._answer is not None

    def run(self, stop: threading.Event) -> None:
        """Search what is asked until `stop` is set: the body of the find thread."""
        while not stop.is_set():
            with self._changed:
                self._changed.wait_for(lambda: self._request is not None, timeout=0.2)
                request, self._request = self._request, None
            if request is None:
                continue
            found = tuple(find_markers(request[0], self.shapes, request[1]))
            with self._changed:
                self._answer = found
                self._busy = False
                self._changed.notify_all()
