"""When the virtual table gives its frames, what it says of them, and the truth beside them."""

import math
from fractions import Fraction

import numpy as np
import pytest

from vdms_rt.capture import table as table_module
from vdms_rt.capture.table import BUFFERS, TableSource
from vdms_rt.config import Marker, Motion, Table, TableSheet
from vdms_rt.model import Grab, Scan, SourceEnded, StampEvent, Truth

SMALL = {"width_px": 96, "height_px": 64, "clutter": False}
PERIOD_NS = Fraction(1001, 30000) * 10**9


class Clock:
    """The monotonic clock, moved by hand and by sleeping."""

    def __init__(self) -> None:
        self.now_ns = 5_000_000_000

    def monotonic_ns(self) -> int:
        return self.now_ns

    def sleep(self, seconds: float) -> None:
        self.now_ns += math.ceil(seconds * 1e9)


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(table_module, "time", clock)
    return clock


class Reader:
    def __init__(self, **keys: object) -> None:
        self.table = Table(**{**SMALL, **keys})
        self.truths: list[Truth] = []
        shapes = [Marker().shape, Marker(name="wall", fixed=True).shape]
        self.source = TableSource(self.table, shapes, self.truths.append)
        self.out = np.zeros((self.table.height_px, self.table.width_px), np.uint8)

    def read(self, timeout_s: float = 1.0) -> Grab:
        grab = self.source.read(self.out, timeout_s)
        assert grab is not None
        return grab


def ends_ns(start_ns: int, indices: range, period_ns: Fraction = PERIOD_NS) -> list[int]:
    return [start_ns + round((n + 1) * period_ns) for n in indices]


def test_it_says_what_it_is() -> None:
    info = Reader(exposure_ms=2.5).source.info
    assert (info.kind, info.width_px, info.height_px) == ("table", 96, 64)
    assert info.frame_period_s == Fraction(1001, 30000)
    assert info.scan is Scan.BOTTOM_FIRST
    assert not info.scan_known
    assert info.live
    assert info.stamp_event is StampEvent.END_OF_FRAME
    assert info.exposure_ns == 2_500_000
    assert not info.sequence_counts_lost
    info = Reader(scan="progressive", pace="fast", sequence_counts_lost=True).source.info
    assert info.scan_known
    assert not info.live
    assert info.sequence_counts_lost


def test_a_frame_comes_at_its_end_and_not_before(clock: Clock) -> None:
    start_ns = clock.now_ns
    reader = Reader()
    stamps = []
    for _ in range(10):
        grab = reader.read()
        assert grab.stamp_ns <= clock.now_ns < grab.stamp_ns + 1000
        stamps.append(grab.stamp_ns)
    assert stamps == ends_ns(start_ns, range(10))


def test_a_short_timeout_gives_nothing_and_loses_nothing(clock: Clock) -> None:
    reader = Reader()
    start_ns = clock.now_ns
    for _ in range(3):
        assert reader.source.read(reader.out, 0.01) is None
    assert clock.now_ns == pytest.approx(start_ns + 30_000_000, abs=1000)
    assert reader.read(0.01).stamp_ns == ends_ns(start_ns, range(1))[0]
    assert {t.frame for t in reader.truths} == {0}


def test_at_full_pace_it_never_waits(clock: Clock) -> None:
    reader = Reader(pace="fast")
    start_ns = clock.now_ns
    stamps = [reader.read().stamp_ns for _ in range(40)]
    assert clock.now_ns == start_ns
    assert stamps == ends_ns(start_ns, range(40))


def test_it_ends_after_its_frames() -> None:
    reader = Reader(pace="fast", frames=3)
    for _ in range(3):
        reader.read()
    for _ in range(2):
        with pytest.raises(SourceEnded, match=r"its 3 frames of table\.frames"):
            reader.read()
    reader.source.close()
    reader.source.close()


def test_a_late_reader_gets_what_the_buffers_held_and_then_the_present(clock: Clock) -> None:
    reader = Reader(motion=Motion(kind="still"))
    start_ns = clock.now_ns
    reader.read()
    clock.now_ns = start_ns + 100 * 1_000_000_000 + 7_000_000
    stamps = [reader.read().stamp_ns for _ in range(BUFFERS)]
    assert stamps == ends_ns(start_ns, range(1, 1 + BUFFERS))
    filling = math.floor((clock.now_ns - start_ns) / PERIOD_NS)
    grab = reader.read()
    assert grab.stamp_ns == ends_ns(start_ns, range(filling, filling + 1))[0]
    assert grab.sequence == BUFFERS + 1
    assert reader.truths[-1].frame == filling


def test_a_slow_reader_loses_frames_but_never_the_time(clock: Clock) -> None:
    reader = Reader(motion=Motion(kind="still"), sequence_counts_lost=True)
    start_ns = clock.now_ns
    for _ in range(8 * BUFFERS):
        grab = reader.read()
        clock.now_ns += round(1.5 * PERIOD_NS)
    assert grab.stamp_ns == ends_ns(start_ns, range(grab.sequence, grab.sequence + 1))[0]
    assert grab.sequence > 10 * BUFFERS
    assert clock.now_ns - grab.stamp_ns < (1.5 * BUFFERS + 2) * PERIOD_NS


def test_jitter_is_even_and_late_and_lost_frames_leave_no_gap_in_the_sequence() -> None:
    reader = Reader(pace="fast", stamp_jitter_ms=5.0, lost_frames=0.2, motion=Motion(kind="still"))
    grabs = [reader.read() for _ in range(1500)]
    frames = [truth.frame for truth in reader.truths if truth.scan is Scan.BOTTOM_FIRST]
    start_ns = reader.truths[0].t_ns - round(frames[0] * PERIOD_NS)
    assert [grab.sequence for grab in grabs] == list(range(1500))
    assert frames[-1] == pytest.approx(1500 / 0.8, rel=0.05)
    late_ms = (
        np.array(
            [
                grab.stamp_ns - start_ns - float((frame + 1) * PERIOD_NS)
                for grab, frame in zip(grabs, frames, strict=True)
            ]
        )
        / 1e6
    )
    assert late_ms.min() > -1e-5
    assert late_ms.max() < 5.00001
    assert late_ms.mean() == pytest.approx(2.5, abs=0.2)
    assert late_ms.std() == pytest.approx(5 / math.sqrt(12), rel=0.05)


def test_a_sequence_that_counts_lost_frames_is_the_frame_number() -> None:
    reader = Reader(pace="fast", lost_frames=0.3, sequence_counts_lost=True)
    sequences = [reader.read().sequence for _ in range(200)]
    frames = [truth.frame for truth in reader.truths if truth.scan is Scan.BOTTOM_FIRST]
    assert sequences == frames
    assert sequences[-1] > 220


def test_what_is_lost_and_late_follows_from_the_seed(clock: Clock) -> None:
    keys = {"pace": "fast", "lost_frames": 0.2, "stamp_jitter_ms": 3.0}
    readers = [Reader(seed=seed, **keys) for seed in (1, 1, 2)]
    first, again, other = ([r.read().stamp_ns for _ in range(30)] for r in readers)
    assert first == again != other


@pytest.mark.parametrize("ppm", [50.0, -120.0])
def test_a_positive_clock_error_brings_frames_early(ppm: float, clock: Clock) -> None:
    start_ns = clock.now_ns
    reader = Reader(pace="fast", clock_error_ppm=ppm, motion=Motion(kind="still"))
    for _ in range(300):
        grab = reader.read()
    assert grab.stamp_ns - start_ns == pytest.approx(300 * PERIOD_NS * (1 - ppm / 1e6), abs=1)


MOTION = Motion(amplitude_mm=10.0, frequency_hz=2.0, direction_deg=90.0)


def expected_mm(t_s: float, rest_s: float) -> float:
    return 10 * math.sin(2 * math.pi * 2.0 * max(0.0, t_s - rest_s))


def expected_mean_mm(middle_s: float, exposure_s: float, rest_s: float) -> float:
    t = middle_s + exposure_s * ((np.arange(20000) + 0.5) / 20000 - 0.5)
    return float(np.mean(10 * np.sin(4 * math.pi * np.maximum(0, t - rest_s))))


@pytest.mark.parametrize("ppm", [0.0, 400.0])
@pytest.mark.parametrize("exposure_ms", [0.0, 12.0])
def test_the_truth_of_a_progressive_frame(exposure_ms: float, ppm: float, clock: Clock) -> None:
    start_ns = clock.now_ns
    reader = Reader(
        pace="fast",
        scan="progressive",
        exposure_ms=exposure_ms,
        rest_s=0.05,
        clock_error_ppm=ppm,
        motion=MOTION,
        stamp_jitter_ms=2.0,
    )
    grabs = [reader.read() for _ in range(20)]
    assert len(reader.truths) == 20
    for n, (grab, truth) in enumerate(zip(grabs, reader.truths, strict=True)):
        middle_s = n * float(PERIOD_NS) * (1 - ppm / 1e6) / 1e9 - exposure_ms / 2000
        assert (truth.marker, truth.frame, truth.scan) == ("m1", n, Scan.PROGRESSIVE)
        assert truth.stamp_ns == grab.stamp_ns
        assert truth.t_ns - start_ns == pytest.approx(middle_s * 1e9, abs=2)
        assert (truth.x_mm, truth.mean_x_mm) == pytest.approx((0, 0), abs=1e-12)
        assert truth.y_mm == pytest.approx(expected_mm(middle_s, 0.05), abs=1e-9)
        mean_mm = expected_mean_mm(middle_s, exposure_ms / 1000, 0.05)
        assert truth.mean_y_mm == pytest.approx(mean_mm, abs=1e-6)


@pytest.mark.parametrize(
    ("scan", "order"),
    [
        ("top-first", (Scan.TOP, Scan.BOTTOM, Scan.TOP_FIRST)),
        ("bottom-first", (Scan.BOTTOM, Scan.TOP, Scan.BOTTOM_FIRST)),
    ],
)
def test_the_truth_of_an_interlaced_frame_is_its_two_fields_and_their_mean(
    scan: str, order: tuple[Scan, ...], clock: Clock
) -> None:
    start_ns = clock.now_ns
    reader = Reader(pace="fast", scan=scan, exposure_ms=10.0, rest_s=0.05, motion=MOTION)
    for n in range(8):
        reader.truths.clear()
        grab = reader.read()
        assert grab.scan is order[2]
        assert tuple(truth.scan for truth in reader.truths) == order
        assert {(t.frame, t.stamp_ns) for t in reader.truths} == {(n, grab.stamp_ns)}
        first, second, whole = reader.truths
        for k, truth in enumerate((first, second)):
            middle_s = float((n + Fraction(k, 2)) * PERIOD_NS) / 1e9 - 0.005
            assert truth.t_ns - start_ns == pytest.approx(middle_s * 1e9, abs=2)
            assert truth.y_mm == pytest.approx(expected_mm(middle_s, 0.05), abs=1e-9)
            mean_mm = expected_mean_mm(middle_s, 0.01, 0.05)
            assert truth.mean_y_mm == pytest.approx(mean_mm, abs=1e-6)
        assert whole.t_ns == pytest.approx((first.t_ns + second.t_ns) / 2, abs=2)
        assert grab.stamp_ns - whole.t_ns == pytest.approx(0.75 * PERIOD_NS + 5e6, abs=2)
        assert whole.y_mm == pytest.approx((first.y_mm + second.y_mm) / 2, abs=1e-12)
        assert whole.mean_y_mm == pytest.approx((first.mean_y_mm + second.mean_y_mm) / 2)


def test_a_sheet_that_hangs_still_has_a_truth_of_its_own_and_shake_has_none() -> None:
    sheets = (TableSheet(), TableSheet(marker="wall", at_mm=(300.0, 0.0), moves=False))
    reader = Reader(pace="fast", rest_s=0.0, sheet=sheets, shake_mm=5.0, motion=MOTION)
    for _ in range(5):
        reader.read()
    moving = [t for t in reader.truths if t.marker == "m1"]
    still = [t for t in reader.truths if t.marker == "wall"]
    assert len(moving) == len(still) == 15
    assert [t.t_ns for t in moving] == [t.t_ns for t in still]
    assert {(t.x_mm, t.y_mm, t.mean_x_mm, t.mean_y_mm, t.rotation_mrad) for t in still} == {
        (0.0, 0.0, 0.0, 0.0, 0.0)
    }
    quiet = Reader(pace="fast", rest_s=0.0, sheet=sheets, motion=MOTION)
    for _ in range(5):
        quiet.read()
    assert [t.y_mm for t in moving] == [t.y_mm for t in quiet.truths if t.marker == "m1"]
