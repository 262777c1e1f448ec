"""The states of a device, on a clock of the test's own."""

import itertools

import pytest

from vdms_rt.capture import states
from vdms_rt.capture.states import DeviceStates, Remedy
from vdms_rt.model import State


class Bench:
    """A device's states with a clock that the test turns."""

    def __init__(self) -> None:
        self.now_s = 1000.0
        self.states = DeviceStates()
        self.said: list[str] = []

    @property
    def state(self) -> State:
        return self.states.state

    def note(self, change) -> None:
        if change is not None:
            assert change.state is self.state
            self.said.append(f"{change.state.value}: {change.text}")

    def open(self) -> bool:
        return self.states.opened(self.now_s, "usbtv")

    def frames(self, seconds: float, nothing: str = "", *, sure: bool = False) -> None:
        for _ in range(round(seconds * 30)):
            self.now_s += 1 / 30
            self.note(self.states.frame(self.now_s, nothing, sure=sure))

    def silence(self, seconds: float, nothing: str = "") -> list[Remedy]:
        remedies = []
        for _ in range(round(seconds * 2)):
            self.now_s += 0.5
            self.note(self.states.silence(self.now_s, nothing))
            if (remedy := self.states.remedy(self.now_s)) is not Remedy.NONE:
                remedies.append(remedy)
        return remedies

    def refuse(self, why: str, *, gone: bool) -> None:
        self.note(self.states.not_opened(self.now_s, why, gone=gone))


@pytest.fixture
def bench() -> Bench:
    return Bench()


@pytest.fixture
def streaming(bench: Bench) -> Bench:
    bench.open()
    bench.frames(1.0)
    bench.said.clear()
    return bench


def test_from_no_device_to_streaming(bench):
    for _ in range(3):
        bench.refuse("plug one in", gone=True)
        bench.now_s += states.RETRY_S
    assert bench.state is State.NO_DEVICE
    bench.refuse("no permission yet", gone=False)
    bench.refuse("no permission", gone=False)
    bench.refuse("no permission", gone=False)
    assert bench.open()
    assert bench.state is State.STARTING
    bench.frames(2.0)
    assert bench.state is State.STREAMING
    assert bench.said == [
        "no device: plug one in",
        "no device: no permission",
        "streaming: frames come from usbtv",
    ]


def test_a_device_that_starts_slowly_is_not_stalled(bench):
    bench.open()
    assert bench.silence(states.START_S - 0.5) == []
    assert bench.state is State.STARTING
    bench.silence(0.5)
    assert bench.state is State.STALLED


def test_unplugged_is_lost_until_it_is_back(streaming):
    streaming.note(streaming.states.failed(streaming.now_s, "was unplugged", gone=True))
    for _ in range(5):
        streaming.now_s += 1.0
        streaming.refuse("is not there", gone=True)
    assert streaming.state is State.LOST
    streaming.open()
    assert streaming.state is State.STARTING
    streaming.frames(0.5)
    assert streaming.said == [
        "lost: was unplugged",
        "streaming: frames come from usbtv again, after 5.0 s",
    ]


def test_lost_device_that_another_program_takes(streaming):
    streaming.note(streaming.states.failed(streaming.now_s, "was unplugged", gone=True))
    streaming.refuse("is in use", gone=False)
    streaming.refuse("is in use", gone=False)
    assert streaming.said == ["lost: was unplugged", "lost: is in use"]


def test_one_bad_look_is_no_lost_signal(streaming):
    streaming.frames(states.NO_SIGNAL_S - 0.1, "blank")
    assert streaming.state is State.STREAMING
    streaming.frames(1.0)
    assert streaming.said == []


def test_signal_off_and_on(streaming):
    streaming.frames(2.0, "blank")
    assert streaming.state is State.NO_SIGNAL
    streaming.frames(1.0, "noise")
    streaming.frames(states.SIGNAL_S - 0.1)
    assert streaming.state is State.NO_SIGNAL
    streaming.frames(0.2)
    assert streaming.state is State.STREAMING
    assert streaming.said[0] == "no signal: blank"
    assert streaming.said[1].startswith("streaming: frames come from usbtv again, after 3.")
    assert len(streaming.said) == 2


def test_the_drivers_own_word_is_taken_at_once(streaming):
    streaming.frames(0.1, "the driver says so", sure=True)
    assert streaming.said == ["no signal: the driver says so"]


def test_silence_with_the_drivers_word_is_no_signal_and_no_reason_for_a_remedy(streaming):
    assert streaming.silence(120.0, "the driver says so") == []
    assert streaming.said == ["no signal: the driver says so"]
    # The signal is there again, but the frames are not.
    streaming.silence(0.5)
    assert streaming.state is State.STALLED


def test_a_stall_is_told_once_and_mended_at_a_bounded_pace(streaming):
    streaming.silence(0.5)
    assert streaming.state is State.STREAMING
    streaming.silence(0.5)
    assert streaming.state is State.STALLED
    stalled_s = streaming.now_s
    times_s, kinds = [], []
    while streaming.now_s < stalled_s + 200:
        if remedies := streaming.silence(0.5):
            kinds += remedies
            times_s.append(streaming.now_s - stalled_s)
            assert not streaming.open()  # It stays stalled until a frame comes.
    assert kinds == list(
        itertools.islice(itertools.cycle((Remedy.REOPEN, Remedy.RESET)), len(kinds))
    )
    waits_s = [b - a for a, b in itertools.pairwise(times_s)]
    assert times_s[0] == states.REMEDY_S
    # No remedy before the one before it had the time to help.
    assert min(waits_s) >= states.START_S
    assert waits_s[-3:] == [states.REMEDY_LONGEST_S] * 3
    assert len(streaming.said) == 1
    assert streaming.said[0].startswith("stalled: usbtv gives no frames; look whether")
    streaming.frames(0.1)
    assert streaming.state is State.STREAMING


def test_remedies_begin_anew_only_after_steady_streaming(streaming):
    assert streaming.silence(4.0) == [Remedy.REOPEN]
    streaming.open()
    streaming.frames(1.0)
    # It stalls again at once: the next remedy is the stronger one, and waits longer.
    assert streaming.silence(4.5) == []
    assert streaming.silence(1.0) == [Remedy.RESET]
    streaming.open()
    streaming.frames(states.STEADY_S + 1)
    assert streaming.silence(4.0) == [Remedy.REOPEN]


def test_after_a_reset_it_has_some_time_to_come_back(streaming):
    while Remedy.RESET not in streaming.silence(0.5):
        pass
    streaming.said.clear()
    streaming.refuse("is not there", gone=True)
    assert streaming.state is State.STALLED
    streaming.now_s += states.RETURN_S + 1
    streaming.refuse("is not there", gone=True)
    assert streaming.state is State.LOST
    assert streaming.said == ["lost: is not there"]


def test_a_stream_that_fails_is_stalled_and_mended(streaming):
    for _ in range(4):
        streaming.note(streaming.states.failed(streaming.now_s, "I/O error", gone=False))
        streaming.now_s += 1.0
        streaming.open()
    assert streaming.said == ["stalled: I/O error"]
    assert streaming.states.remedy(streaming.now_s) is Remedy.REOPEN
