"""The frame clock against simulated drivers."""

from __future__ import annotations

from fractions import Fraction

import numpy as np

from vdms_rt.capture.clock import FrameClock
from vdms_rt.model import NTSC_FRAME_PERIOD_S, Scan, SourceInfo, StampEvent

EXPOSURE_NS = 16_683_000


def source(**change: object) -> SourceInfo:
    values: dict[str, object] = {
        "kind": "v4l2",
        "name": "grabber",
        "width_px": 720,
        "height_px": 480,
        "frame_period_s": NTSC_FRAME_PERIOD_S,
        "scan": Scan.TOP_FIRST,
        "live": True,
        "stamp_event": StampEvent.END_OF_FRAME,
        "sequence_counts_lost": False,
    }
    return SourceInfo(**(values | change))  # type: ignore[arg-type]


def test_lost_frames_are_counted_and_times_settle() -> None:
    random = np.random.default_rng(1)
    clock = FrameClock(source(), EXPOSURE_NS)
    period_ns = Fraction(NTSC_FRAME_PERIOD_S * 10**9) * (1 - Fraction(50, 10**6))
    errors = []
    lost = random.uniform(size=2700) < 0.01
    lost[0] = False
    last = max(n for n in range(2700) if not lost[n])
    delivered = 0
    for n in range(2700):
        if lost[n]:
            continue
        truth_ns = 10**12 + n * period_ns
        tick = clock.tick(int(truth_ns) + int(random.uniform(0, 5e6)), delivered)
        delivered += 1
        assert tick.index == n
        if n > 1800:
            errors.append(float(tick.t_ns - truth_ns))
    assert clock.figures.missed == int(lost[:last].sum())
    assert np.std(errors) < 1e5


def test_a_clip_keeps_its_own_times() -> None:
    clock = FrameClock(
        source(kind="clip", live=False, stamp_event=StampEvent.MID_EXPOSURE), EXPOSURE_NS
    )
    stamps = [n * 100100000 // 3 for n in range(100)]
    ticks = [clock.tick(stamp, n) for n, stamp in enumerate(stamps)]
    assert [t.t_ns for t in ticks] == stamps
    assert [t.index for t in ticks] == list(range(100))
    assert {(t.sigma_t_ns, t.utc_ns, t.segment) for t in ticks} == {(0, 0, 0)}
