"""What is asked of the kernel so that measuring is not held up."""

import contextlib
import os
import threading
from pathlib import Path

import pytest

from vdms_rt.realtime import claimed_cpu, stay_on


@pytest.mark.skipif(len(os.sched_getaffinity(0)) < 2, reason="needs two CPUs")
@pytest.mark.parametrize("name", ["cpu_capacity", "cpufreq/cpuinfo_max_freq"])
def test_threads_share_the_fastest_cpu(name: str, tmp_path: Path) -> None:
    slow, fast, *others = sorted(os.sched_getaffinity(0))
    for cpu, speed in {fast: 1024, slow: 512, **dict.fromkeys(others, 512)}.items():
        file = tmp_path / f"cpu{cpu}" / name
        file.parent.mkdir(parents=True)
        file.write_text(f"{speed}\n")
    (tmp_path / "cpu99" / name).parent.mkdir(parents=True)
    (tmp_path / "cpu99" / name).write_text("9999\n")
    with claimed_cpu(tmp_path) as cpu, claimed_cpu(tmp_path) as second:
        assert cpu == fast
        assert second == fast


@pytest.mark.skipif(len(os.sched_getaffinity(0)) < 2, reason="needs two CPUs")
def test_each_station_has_another_cpu_while_there_are_some(tmp_path: Path) -> None:
    last_first = sorted(os.sched_getaffinity(0), reverse=True)
    with contextlib.ExitStack() as claims:
        cpus = [claims.enter_context(claimed_cpu(tmp_path)) for _ in last_first]
        assert cpus == last_first
        with claimed_cpu(tmp_path) as one_too_many:
            assert one_too_many == last_first[0]
    with claimed_cpu(tmp_path) as free_again:
        assert free_again == last_first[0]


def test_a_thread_stays_where_it_is_put_and_no_other_does() -> None:
    before = os.sched_getaffinity(0)
    seen: list[object] = []

    def body() -> None:
        seen.append(stay_on(max(before)))
        seen.append(os.sched_getaffinity(0))
        with claimed_cpu() as cpu:
            seen.append(cpu)

    thread = threading.Thread(target=body)
    thread.start()
    thread.join()
    assert seen == [True, {max(before)}, None]
    assert os.sched_getaffinity(0) == before


def test_a_cpu_that_may_not_be_used_is_no_error() -> None:
    before = os.sched_getaffinity(0)
    assert not stay_on(1000)
    assert os.sched_getaffinity(0) == before
