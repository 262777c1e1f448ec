import threading
import time
from collections.abc import Callable

import pytest

from vdms_rt.subscribe.inbox import QUICK_S, Inbox, Incoming
from vdms_rt.subscribe.samples import Arrived, Raw

DEADLINE_S = 20.0


def raw(number: int) -> Raw:
    return Raw("k", b"", 0, "", number, sequenced=True)


class Callback:
    """Notes what it is called with and by which thread, and can be held inside."""

    def __init__(self, *, held: bool = False) -> None:
        self.got: list[int] = []
        self.threads: list[int] = []
        self.inside = threading.Event()
        self.go_on = threading.Event()
        self.done = threading.Semaphore(0)
        if not held:
            self.go_on.set()

    def __call__(self, item: Incoming) -> None:
        self.inside.set()
        assert self.go_on.wait(DEADLINE_S)
        self.got.append(item.number if isinstance(item, Raw) else -1)
        self.threads.append(threading.get_ident())
        self.done.release()

    def wait(self, count: int) -> None:
        for _ in range(count):
            assert self.done.acquire(timeout=DEADLINE_S)


def started(target: Callable[[], object]) -> threading.Thread:
    thread = threading.Thread(target=target)
    thread.start()
    return thread


def test_a_quick_callback_is_called_by_the_thread_that_brings_the_sample() -> None:
    callback = Callback()
    inbox = Inbox(10, callback)
    inbox.put(raw(0), patient=True)
    assert (callback.got, callback.threads) == ([0], [threading.get_ident()])


def test_a_thread_of_zenoh_never_calls_back() -> None:
    callback = Callback(held=True)
    inbox = Inbox(10, callback)
    inbox.put(Arrived("s1"))
    inbox.put(raw(0), patient=True)
    server = started(inbox.serve)
    callback.go_on.set()
    callback.wait(2)
    assert (callback.got, set(callback.threads)) == ([-1, 0], {server.ident})
    inbox.close()
    server.join()


def test_what_comes_during_a_callback_waits_its_turn_and_holds_nobody_up() -> None:
    callback = Callback(held=True)
    inbox = Inbox(10, callback)
    server = started(inbox.serve)
    ear = started(lambda: inbox.put(raw(0), patient=True))
    assert callback.inside.wait(DEADLINE_S)
    for number in range(1, 6):
        inbox.put(raw(number), patient=True)
    assert callback.got == []
    callback.go_on.set()
    callback.wait(6)
    assert callback.got == list(range(6))
    inbox.close()
    ear.join()
    server.join()


def test_a_callback_that_was_slow_is_called_by_the_other_thread_until_it_is_quick_again() -> None:
    slow = [True, True]
    took: list[threading.Thread] = []
    done = threading.Semaphore(0)

    def at_once(_: Incoming) -> None:
        if slow:
            slow.pop()
            threading.Event().wait(2 * QUICK_S)
        took.append(threading.current_thread())
        done.release()

    inbox = Inbox(10, at_once)
    server = started(inbox.serve)
    here = threading.current_thread()
    until_s = time.monotonic() + DEADLINE_S
    while took[3:].count(here) == 0:
        assert time.monotonic() < until_s, took
        inbox.put(raw(len(took)), patient=True)
        assert done.acquire(timeout=DEADLINE_S)
    assert took[:3] == [here, server, server]
    inbox.close()
    server.join()


def test_beyond_the_limit_messages_are_dropped_and_notices_kept() -> None:
    callback = Callback(held=True)
    inbox = Inbox(2, callback)
    for number in range(5):
        inbox.put(raw(number))
    inbox.put(Arrived("s1"))
    callback.go_on.set()
    server = started(inbox.serve)
    callback.wait(3)
    assert callback.got == [0, 1, -1]
    inbox.close()
    server.join()


def test_a_callback_that_fails_closes_the_inbox() -> None:
    def at_once(_: Incoming) -> None:
        raise ZeroDivisionError

    inbox = Inbox(10, at_once)
    with pytest.raises(ZeroDivisionError):
        inbox.put(raw(0), patient=True)
    assert inbox.closed
    assert inbox.take(None) is None


def test_nothing_is_called_once_it_is_closed() -> None:
    callback = Callback()
    inbox = Inbox(10, callback)
    inbox.close()
    inbox.put(raw(0), patient=True)
    inbox.put(raw(1))
    inbox.serve()
    assert callback.got == []
