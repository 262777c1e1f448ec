"""What the kernel does so that measuring is not held up: memory that stays, priority, one CPU."""

from __future__ import annotations

import contextlib
import ctypes
import os
import resource
import socket
from collections.abc import Iterator
from pathlib import Path

CPUS = Path("/sys/devices/system/cpu")
_SPEEDS = ("cpu_capacity", "cpufreq/cpuinfo_max_freq")

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


@contextlib.contextmanager
def claimed_cpu(cpus: Path = CPUS) -> Iterator[int | None]:
    """Give the CPU where two threads that take turns should stay, or None without a choice.

    It is the fastest that the process may use by what `cpus` says, and of equals the last, because
    interrupts gather on the first. One that another station on this computer has claimed is left
    to it, unless all as fast are claimed.
    """
    allowed = os.sched_getaffinity(0)
    if len(allowed) < 2:
        yield None
        return
    speeds = {n: _speed(cpus / f"cpu{n}") for n in allowed}
    fastest = sorted((n for n in allowed if speeds[n] == max(speeds.values())), reverse=True)
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as claim:
        yield next((n for n in fastest if _bound(claim, cpus / f"cpu{n}")), fastest[0])


def stay_on(cpu: int) -> bool:
    """Keep the calling thread, and those that it starts later, on one CPU, sched_setaffinity(2);
    return whether the system allows it."""
    try:
        os.sched_setaffinity(0, {cpu})
    except OSError:
        return False
    return True


def _bound(claim: socket.socket, cpu: Path) -> bool:
    """Claim a CPU by a name in the abstract namespace, unix(7), which ends with its process."""
    try:
        claim.bind(f"\0vdms-rt {cpu}")
    except OSError:
        return False
    return True


def _speed(cpu: Path) -> int:
    for name in _SPEEDS:
        try:
            return int((cpu / name).read_text())
        except (OSError, ValueError):
            continue
    return 0
