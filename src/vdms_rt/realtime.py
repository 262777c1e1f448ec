"""What the kernel does so that measuring is not held up: memory that stays, and priority."""

from __future__ import annotations

import ctypes
import os
import resource

_MCL_CURRENT, _MCL_FUTURE, _MCL_ONFAULT = 1, 2, 4

_POLICIES = {os.SCHED_OTHER: "other", os.SCHED_FIFO: "fifo", os.SCHED_RR: "rr"}


def lock_memory() -> bool:
    """Keep every page that is touched in memory, mlockall(2), and return whether that is so.

    Done only where RLIMIT_MEMLOCK is unlimited, as in the service: below a limit, allocations
    would fail later.
    """
    if resource.getrlimit(resource.RLIMIT_MEMLOCK)[0] != resource.RLIM_INFINITY:
        return False
    # Not the untouched part of each thread's stack, which would cost 8 MB a thread.
    flags = _MCL_CURRENT | _MCL_FUTURE | _MCL_ONFAULT
    return bool(ctypes.CDLL(None).mlockall(flags) == 0)


def scheduling() -> str:
    """Return the process's scheduling policy and priority, such as `fifo 10`."""
    policy = _POLICIES.get(os.sched_getscheduler(0), "unusual")
    return f"{policy} {os.sched_getparam(0).sched_priority}"
