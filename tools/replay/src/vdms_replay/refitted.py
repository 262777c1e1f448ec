"""The times of a recording once more, each from the stamps before and after it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from fractions import Fraction

import numpy as np

from vdms_replay.remeasure import Times
from vdms_replay.source import ReplayError
from vdms_rt.capture.clock import mid_exposure_ns
from vdms_rt.capture.refit import refit
from vdms_rt.model import (
    NTSC_FRAME_PERIOD_S,
    PAL_FRAME_PERIOD_S,
    Scan,
    SourceInfo,
    StampEvent,
)
from vdms_rt.wire import vdms_pb2 as pb

SAME_PERIOD = 1e-3
"""A recorded period is a standard's if it is within this part of it."""


@dataclass(slots=True)
class Stamps:
    """The stamps of one session's images, in the order of the log."""

    rows: list[tuple[int, int, int, int, int]] = field(default_factory=list)
    """stamp_ns, frame_seq, scan, segment, t_ns of an image that was measured whole, or of the
    middle between its two fields."""
    _half: pb.Displacement | None = None

    def add(self, sample: pb.Displacement) -> None:
        """Take a sample; one with the same stamp as the one before is its other field."""
        if self.rows and self.rows[-1][0] == sample.stamp_ns:
            stamp_ns, frame, scan, segment, t_ns = self.rows[-1]
            if sample.scan != scan and sample.scan in (pb.TOP, pb.BOTTOM):
                both = pb.BOTTOM_FIRST if scan == pb.BOTTOM else pb.TOP_FIRST
                self.rows[-1] = stamp_ns, frame, both, segment, (t_ns + sample.t_ns) // 2
            return
        self.rows.append(
            (sample.stamp_ns, sample.frame_seq, sample.scan, sample.segment, sample.t_ns)
        )


def refitted(rows: Sequence[tuple[int, int, int, int, int]], exposure_ns: int, delay_ns: int
) -> Times:  # fmt: skip
    """Return the times of a session's images from its `Stamps.rows`.

    `exposure_ns` is of each field or frame, `delay_ns` the configured delay of the chain. Raises
    ReplayError where the stamps are times of exposure already, or fit no kind of driver.
    """
    stamp_ns, frame, scan, segment, t_ns = np.array(rows, np.int64).T
    alternating = bool(np.isin(scan, (Scan.TOP, Scan.BOTTOM)).all())
    fields = 2 if alternating else 1
    index = frame
    if alternating:
        index = 2 * frame + np.concatenate([[0], np.diff(frame) == 0])
    period_s = _period_s(index, t_ns) * fields
    line_ns = refit(stamp_ns, index, period_s / fields, 0, segment)
    one = Scan(int(scan[0]))
    delays_ns = {
        event: mid_exposure_ns(_source(period_s, one, exposure_ns, event), 0, delay_ns, one)
        for event in StampEvent
    }
    shift_ns = float(np.median(t_ns - line_ns))
    event = min(delays_ns, key=lambda e: abs(delays_ns[e] - shift_ns))
    if event is StampEvent.MID_EXPOSURE:
        raise ReplayError(
            "the recording's stamps are times of exposure already, as a clip's are; there is "
            "nothing to refit"
        )
    if abs(delays_ns[event] - shift_ns) > float(period_s) * 1e9 / 8:
        raise ReplayError(
            "the recorded times do not follow from the driver's stamps; was "
            "camera.exposure_ms or camera.chain_delay_ms another? Leave --refit-time out"
        )
    order = np.argsort(stamp_ns, kind="stable")
    return Times(stamp_ns[order], (line_ns + delays_ns[event])[order])


def _period_s(index: np.ndarray, t_ns: np.ndarray) -> Fraction:
    """Return the time from image to image: a standard's where it is one."""
    steps = np.diff(index)
    measured = float(np.median(np.diff(t_ns)[steps > 0] / steps[steps > 0])) / 1e9
    for standard_s in (NTSC_FRAME_PERIOD_S, PAL_FRAME_PERIOD_S):
        for known_s in (standard_s, standard_s / 2):
            if abs(measured / float(known_s) - 1) < SAME_PERIOD:
                return known_s
    return Fraction(round(measured * 1e9), 10**9)


def _source(period_s: Fraction, scan: Scan, exposure_ns: int, event: StampEvent) -> SourceInfo:
    return SourceInfo(
        kind="",
        name="",
        width_px=0,
        height_px=0,
        frame_period_s=period_s,
        scan=scan,
        live=False,
        stamp_event=event,
        sequence_counts_lost=False,
        exposure_ns=exposure_ns,
    )
