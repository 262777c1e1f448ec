"""What the page's server knows of the stations."""

import tracemalloc

from loopback import displacement

from vdms_rt.subscribe import Notice, Sample
from vdms_rt.view.board import Board


def sample(seq: int, marker: str = "m1") -> Sample | Notice:
    return Sample("s1", marker, "displacement", 0, displacement(seq))


def test_each_marker_has_a_history_of_its_own() -> None:
    board = Board()
    board.take([sample(0), sample(0, "m2"), sample(1)])
    for marker, seqs in (("m1", [0, 1]), ("m2", [0])):
        history = board.history("s1", marker)
        assert history is not None
        assert list(history.after(0, None, 10).rows["seq"]) == seqs
    assert board.history("s1", "m3") is None


def test_a_further_sample_takes_no_new_history() -> None:
    board = Board()
    board.take([sample(0)])
    tracemalloc.start()
    try:
        board.take([sample(seq) for seq in range(1, 10)])
        _, most_bytes = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert most_bytes < 100_000
