"""The ring from which browsers are served."""

import numpy as np
from loopback import displacement

from vdms_rt.model import Status
from vdms_rt.view.history import CAPACITY, SPAN_S, History, message

PERIOD_NS = 16_683_333


def fill(history: History, seqs: range, **values: object) -> None:
    for seq in seqs:
        t_ns = PERIOD_NS * seq
        utc_ns = 1_800_000_000_000_000_000 + t_ns
        history.append(displacement(seq, **{"t_ns": t_ns, "utc_ns": utc_ns} | values), 0.0)


def test_each_reader_gets_every_sample_at_its_own_pace() -> None:
    history = History()
    fill(history, range(100))
    place, last_seq, got = 0, None, []
    while len((rows := history.after(place, last_seq, 7)).rows):
        assert rows.skipped is None
        got += list(rows.rows["seq"])
        place, last_seq = rows.next, int(rows.rows["seq"][-1])
    assert got == list(range(100))


def test_what_is_older_than_the_span_is_told_as_skipped() -> None:
    history = History()
    many = int(SPAN_S / PERIOD_NS * 1e9) + 500
    fill(history, range(many))
    rows = history.after(10, 9, 5)
    oldest = int(rows.rows["seq"][0])
    assert rows.skipped == (10, oldest - 1)
    assert many - oldest == int(SPAN_S / PERIOD_NS * 1e9) + 1
    assert rows.next == oldest + 5


def test_a_fast_camera_keeps_what_there_is_room_for() -> None:
    history = History()
    for seq in range(CAPACITY + 50):
        history.append(displacement(seq, t_ns=seq * 1_000_000, utc_ns=0), 1.8e9)
    assert history.place_after(-1) == 50
    assert len(history.after(0, None, CAPACITY * 2).rows) == CAPACITY


def test_a_browser_that_comes_back_goes_on_where_it_was() -> None:
    history = History()
    fill(history, range(0, 40, 2))
    assert list(history.after(history.place_after(30), 30, 99).rows["seq"]) == [32, 34, 36, 38]
    assert list(history.after(history.place_after(31), 31, 2).rows["seq"]) == [32, 34]
    assert len(history.after(history.place_after(38), 38, 99).rows) == 0


def test_a_new_session_and_a_clock_that_is_set_begin_anew() -> None:
    history = History()
    fill(history, range(10), session=1)
    stretch = history.stretch
    fill(history, range(3), session=2)
    assert history.stretch == stretch + 1
    assert list(history.after(history.place_after(-1), None, 99).rows["seq"]) == [0, 1, 2]
    fill(history, range(3, 5), session=2, utc_ns=1_900_000_000_000_000_000)
    assert history.stretch == stretch + 2
    assert list(history.after(history.place_after(-1), None, 99).rows["seq"]) == [3, 4]


def test_invalid_samples_have_no_position_in_the_message() -> None:
    history = History()
    fill(history, range(1))
    fill(history, range(1, 2), status=Status.RESIDUAL)
    data = message(5, history.after(0, None, 9).rows)
    assert np.frombuffer(data, "<u4", 2).tolist() == [5, 2]
    assert np.frombuffer(data, "<f8", 2, 8 + 16).tolist() == [0.0, 1.0]
    x_mm = np.frombuffer(data, "<f4", 2, 8 + 32)
    assert x_mm[0] == 0.0
    assert np.isnan(x_mm[1])
    assert len(data) == 8 + 2 * 40
    assert np.frombuffer(data, "<u4", 2, len(data) - 8).tolist() == [0, int(Status.RESIDUAL)]
