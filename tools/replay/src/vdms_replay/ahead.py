"""Reading ahead, so that unpacking a chunk does not hold up what is due."""

from __future__ import annotations

import queue
import threading
from collections.abc import Iterable, Iterator
from types import TracebackType
from typing import Generic, Self, TypeVar

Item = TypeVar("Item")
POLL_S = 0.2


class Ahead(Generic[Item]):
    """An iterator whose items are taken from `items` by a thread of its own, up to `most` ahead."""

    def __init__(self, items: Iterable[Item], most: int) -> None:
        self._items = items
        self._ready: queue.Queue[Item | BaseException | None] = queue.Queue(most)
        self._stop = threading.Event()
        self._over = False
        self._thread = threading.Thread(target=self._fill, name="read ahead", daemon=True)
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def __iter__(self) -> Iterator[Item]:
        return self

    def __next__(self) -> Item:
        """Return the next item; raises what `items` raised."""
        if self._over:
            raise StopIteration
        item = self._ready.get()
        if item is None:
            self._over = True
            raise StopIteration
        if isinstance(item, BaseException):
            self._over = True
            raise item
        return item

    def close(self) -> None:
        """Take no more; return when the thread has ended."""
        self._stop.set()
        self._thread.join()

    def _fill(self) -> None:
        try:
            for item in self._items:
                if not self._put(item):
                    return
            self._put(None)
        except BaseException as error:  # noqa: BLE001 - raised again by whoever takes the items
            self._put(error)

    def _put(self, item: Item | BaseException | None) -> bool:
        while not self._stop.is_set():
            try:
                self._ready.put(item, timeout=POLL_S)
            except queue.Full:
                continue
            return True
        return False
