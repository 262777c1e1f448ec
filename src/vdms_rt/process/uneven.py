"""What is left between a marker's two fields at rest.

Each field has a reference of its own, with the noise of its own stills. That noise would stay in
all samples as a line at half their rate: +b in one field, -b in the other. So b is learnt on, from
the samples of a marker that rests; a mean over n of them leaves no more of the line than the noise
of n samples shows anyway. In motion nothing is learnt.
"""

from __future__ import annotations

from typing import NamedTuple

from vdms_rt.measure.rigid import Spread
from vdms_rt.model import Scan
from vdms_rt.process.track import Pose, Track

STILLS = 15
"""How many samples the references count as, whose fields differ by 0 on average."""
MOST = 20_000
"""Samples that the mean goes back over: five minutes."""
REST_SIGMAS = 4.0


class Uneven(NamedTuple):
    """The mean of b over the samples at rest. Immutable."""

    samples: int = 0
    x_mm: float = 0.0
    y_mm: float = 0.0

    def of(self, kind: Scan) -> tuple[float, float]:
        """Return what to take off the position in a picture of this kind; nothing off a frame."""
        sign = _sign(kind)
        return sign * self.x_mm, sign * self.y_mm

    def after(
        self, kind: Scan, t_ns: int, pose: Pose, track: Track, covariance_mm2: Spread
    ) -> Uneven:
        """Return what is known after one field more, which lies at `pose` with b taken off.

        `track` holds the poses before. Three fields at a steady pace show b in their second
        difference, which is 4 b; they count if they show no motion beyond their noise.
        """
        sign = _sign(kind)
        if not sign or len(track.poses) < 2:
            return self
        (t0, (x0, y0, _)), (t1, (x1, y1, _)) = track.poses[-2:]
        if abs(t_ns - 2 * t1 + t0) > 0.1 * (t1 - t0):
            return self
        x, y, _ = pose
        xx, _, yy = covariance_mm2
        # Variances: 2 of the difference of one kind, 6 of the second difference.
        limit = REST_SIGMAS * REST_SIGMAS
        bend_x, bend_y = x - 2 * x1 + x0, y - 2 * y1 + y0
        if (
            (x - x0) ** 2 > 2 * limit * xx
            or (y - y0) ** 2 > 2 * limit * yy
            or bend_x**2 > 6 * limit * xx
            or bend_y**2 > 6 * limit * yy
        ):
            return self
        samples = min(self.samples + 1, MOST)
        part = sign / (4 * (STILLS + samples))
        return Uneven(samples, self.x_mm + part * bend_x, self.y_mm + part * bend_y)


NO_UNEVEN = Uneven()


def _sign(kind: Scan) -> int:
    if kind is Scan.TOP:
        return 1
    return -1 if kind is Scan.BOTTOM else 0
