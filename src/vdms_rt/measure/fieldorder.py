"""Which field of an interlaced frame was exposed first, told from a marker that moves.

If the top field comes first, the bottom field of frame n lies in time midway between the top fields
of frames n and n + 1; if the bottom field comes first, between those of n - 1 and n. So the
position in each bottom field is compared with both interpolations between top fields; the squared
misfits of the right one stay small, those of the wrong one grow with the square of the velocity.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from vdms_rt.model import Scan

Point = tuple[float, float]

FORGET = 1 / 64
"""Weight of one frame: evidence older than some seconds fades, so that a wrong order shows."""
LEAST_WEIGHT = 8.0
"""Frames with motion in them, at least, before anything is said."""
SURE = 12.0
"""Log-odds from which an order counts as proved: a wrong answer in 160,000."""
INTERPOLATED_VARIANCE = 1 + 2 * (9 * 9 + 1) / 256
"""Of a misfit in units of one position's variance: the bottom field's own and the cubic's."""


@dataclass(frozen=True, slots=True)
class OrderEvidence:
    """What the frames so far say. Immutable."""

    frame_seq: int = -1
    tops: tuple[Point, ...] = ()
    """Positions in the top fields of the last successive frames, newest last, at most 4."""
    bottoms: tuple[Point, ...] = ()
    half: tuple[Scan, Point] | None = None
    """The first seen field of the frame in work."""
    weight: float = 0.0
    top_first_mm2: float = 0.0
    """Sum of squared misfits if the top field comes first."""
    bottom_first_mm2: float = 0.0

    @property
    def log_odds(self) -> float:
        """Log-odds that the top field comes first; 0 knows nothing. The likelihood ratio of two
        Gaussian models of unknown variance."""
        if self.weight < LEAST_WEIGHT:
            return 0.0
        return self.weight / 2 * math.log(self.bottom_first_mm2 / self.top_first_mm2)

    @property
    def order(self) -> Scan | None:
        """TOP_FIRST or BOTTOM_FIRST once it is proved, else None."""
        if self.log_odds >= SURE:
            return Scan.TOP_FIRST
        if self.log_odds <= -SURE:
            return Scan.BOTTOM_FIRST
        return None

    @property
    def how_sure(self) -> str:
        """The proof in words."""
        exponent = min(99, int(abs(self.log_odds) / math.log(10)))
        return f"the odds are 1 : 10^{exponent} against the other order"


def with_field(
    evidence: OrderEvidence, frame_seq: int, scan: Scan, at_mm: Point, sigma_mm: float
) -> OrderEvidence:
    """Return the evidence with one field's position more.

    `scan` is TOP or BOTTOM; `at_mm` is relative to that field's own reference, in any frame of
    coordinates; `sigma_mm` is its standard deviation. Fields of one frame come one after the other,
    in any order; a missing one starts the comparison anew, and keeps what was learnt.
    """
    if evidence.half is None or evidence.frame_seq != frame_seq or evidence.half[0] is scan:
        follows = evidence.half is None and frame_seq == evidence.frame_seq + 1
        return replace(
            evidence,
            frame_seq=frame_seq,
            half=(scan, at_mm),
            tops=evidence.tops if follows else (),
            bottoms=evidence.bottoms if follows else (),
        )
    top, bottom = (at_mm, evidence.half[1]) if scan is Scan.TOP else (evidence.half[1], at_mm)
    tops, bottoms = (*evidence.tops, top)[-5:], (*evidence.bottoms, bottom)[-5:]
    evidence = replace(evidence, half=None, tops=tops, bottoms=bottoms)
    if len(tops) < 5:
        return evidence
    middle = bottoms[2]
    top_first = _misfit_mm2(middle, tops[1:5])
    bottom_first = _misfit_mm2(middle, tops[0:4])
    floor = 2 * INTERPOLATED_VARIANCE * sigma_mm**2
    # Frames in which the two differ by noise alone say nothing, and would only dilute the others.
    if max(top_first, bottom_first) < 9 * floor:
        return evidence
    keep = 1 - FORGET
    return replace(
        evidence,
        weight=keep * evidence.weight + 1,
        top_first_mm2=keep * evidence.top_first_mm2 + top_first + floor,
        bottom_first_mm2=keep * evidence.bottom_first_mm2 + bottom_first + floor,
    )


def _misfit_mm2(at: Point, between: tuple[Point, ...]) -> float:
    a, b, c, d = between
    dx = at[0] - (9 * (b[0] + c[0]) - a[0] - d[0]) / 16
    dy = at[1] - (9 * (b[1] + c[1]) - a[1] - d[1]) / 16
    return dx * dx + dy * dy
