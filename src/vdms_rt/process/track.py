"""Where a marker will be in the next picture and how it moves, from where it was in the last."""

from __future__ import annotations

import itertools
import math
from typing import NamedTuple

Pose = tuple[float, float, float]
"""x_mm, y_mm, rotation_mrad from the reference pose."""

REST: Pose = (0.0, 0.0, 0.0)
KEEP_S = 0.25
"""Older poses say nothing about the next."""
FIRST_SLACK_PX = 6.0
"""How far off the marker may be when nothing is known of its velocity."""
MOST_POSES = 7
EVEN = 0.02
"""Part of a period by which pictures may come early or late and still count as evenly spaced."""

# Newton's series in the backward differences of evenly spaced poses: what the k-th adds to the
# slope and the bend at the last pose, and one step after it (there it adds 1 to the value itself).
_SLOPE_NOW = [0.0, *(1 / k for k in range(1, MOST_POSES))]
_SLOPE_AHEAD = [sum(_SLOPE_NOW[: k + 1]) for k in range(MOST_POSES)]
_SQUARES = [sum(s * s for s in _SLOPE_NOW[: k + 1]) for k in range(MOST_POSES)]
_BEND_AHEAD = [a * a - s for a, s in zip(_SLOPE_AHEAD, _SQUARES, strict=True)]
_BEND_NOW = [0.0, *(2 * _SLOPE_AHEAD[k - 1] / k for k in range(1, MOST_POSES))]


class Course(NamedTuple):
    """Where a marker is and how it moves: mm and mrad, per second, per second^2."""

    pose: Pose
    velocity: Pose = REST
    acceleration: Pose = REST
    doubt: Pose = REST
    """How far the acceleration may be off: about the last terms of its series."""
    slack_px: float = 0.0
    """How far off the pose may be, beyond the margin of a gate."""


class Track(NamedTuple):
    """The last poses, oldest first. Immutable."""

    poses: tuple[tuple[int, Pose], ...] = ()
    """(t_ns, pose), at most MOST_POSES"""

    def with_pose(self, t_ns: int, pose: Pose) -> Track:
        """Return the track with one pose more."""
        return Track((*self.poses, (t_ns, pose))[-MOST_POSES:])

    def ahead(self, t_ns: int) -> Course:
        """Return what to expect at `t_ns`, after the last pose.

        One step after evenly spaced poses it is Newton's series, as far as its terms get smaller,
        so that a harmonic of 5 Hz is met within half a millimetre; after a gap it is a parabola,
        which does not run away.
        """
        poses = _before(self.poses, t_ns)
        if len(poses) < 2:
            return Course(self.poses[-1][1] if self.poses else REST, slack_px=FIRST_SLACK_PX)
        t_last = poses[-1][0]
        step_ns = t_last - poses[-2][0]
        if abs(t_ns - t_last - step_ns) > EVEN * step_ns:
            return _parabola(poses[-3:], t_ns)
        per_s = 1e9 / step_ns
        series = _series(poses)
        return Course(
            _sums(series, [1.0] * MOST_POSES, 1.0),
            _sums(series, _SLOPE_AHEAD, per_s),
            _sums(series, _BEND_AHEAD, per_s * per_s),
        )

    def now(self, t_ns: int, pose: Pose) -> Course:
        """Return how the marker moves at `t_ns`, where it is at `pose`."""
        poses = _before(self.poses, t_ns)
        if not poses:
            return Course(pose)
        series = _series([*poses, (t_ns, pose)][-MOST_POSES:])
        per_s = 1e9 / (t_ns - poses[-1][0])
        return Course(
            pose,
            _sums(series, _SLOPE_NOW, per_s),
            _sums(series, _BEND_NOW, per_s * per_s),
            _doubts(series, per_s * per_s),
        )


def _before(poses: tuple[tuple[int, Pose], ...], t_ns: int) -> list[tuple[int, Pose]]:
    """Return the poses that lead up to `t_ns`, in the order of time: where the order of the fields
    is being corrected, times go back."""
    leading: list[tuple[int, Pose]] = []
    later_ns = t_ns
    for pose in reversed(poses):
        if pose[0] >= later_ns or t_ns - pose[0] > KEEP_S * 1e9:
            break
        leading.append(pose)
        later_ns = pose[0]
    return leading[::-1]


def _series(poses: list[tuple[int, Pose]]) -> tuple[list[float], list[float], list[float]]:
    """Return the terms of x, y and rotation. Only poses that are evenly spaced up to the last one
    count."""
    step_ns = poses[-1][0] - poses[-2][0]
    even = [poses[-1][1]]
    later_ns = poses[-1][0]
    for t_ns, pose in reversed(poses[:-1]):
        if abs(later_ns - t_ns - step_ns) > EVEN * step_ns:
            break
        even.append(pose)
        later_ns = t_ns
    x, y, r = ([*values] for values in zip(*even, strict=True))
    return _terms(x), _terms(y), _terms(r)


def _terms(row: list[float]) -> list[float]:
    """Return the first of the values, which is the latest, and its backward differences, as far as
    each is smaller than the larger of the two before it (any one of a harmonic's may be near 0):
    beyond that there is only noise. Two at most if none is."""
    terms = [row[0]]
    sizes = [math.inf, math.inf]
    while len(row) > 1:
        row = [later - earlier for later, earlier in itertools.pairwise(row)]
        size = abs(row[0])
        if size >= max(sizes[-2:]) and len(terms) > 2:
            break
        sizes.append(size)
        terms.append(row[0])
    return terms


def _sums(series: tuple[list[float], ...], factors: list[float], scale: float) -> Pose:
    x, y, r = (
        scale * sum(term * factor for term, factor in zip(terms, factors, strict=False))
        for terms in series
    )
    return x, y, r


def _doubts(series: tuple[list[float], ...], per_s2: float) -> Pose:
    """Return how large the first term of the bend that was left out may be. Any one term of a
    harmonic may be near 0, so it is told by two."""
    x, y, r = (
        max(abs(terms[-2]) / 2, abs(terms[-1])) * _BEND_NOW[len(terms) - 1] * per_s2
        for terms in series
    )
    return x, y, r


def _parabola(poses: list[tuple[int, Pose]], t_ns: int) -> Course:
    (t1, p1), (t2, p2) = poses[-2:]
    ahead_s, step_s = (t_ns - t2) / 1e9, (t2 - t1) / 1e9
    slope = [(b - a) / step_s for a, b in zip(p1, p2, strict=True)]
    bend = [0.0, 0.0, 0.0]
    if len(poses) == 3:
        t0, p0 = poses[0]
        before_s = (t1 - t0) / 1e9
        if before_s < 4 * step_s:
            bend = [
                (v - (b - a) / before_s) / (step_s + before_s)
                for a, b, v in zip(p0, p1, slope, strict=True)
            ]
    x, y, r = (
        p + v * ahead_s + b * ahead_s * (ahead_s + step_s)
        for p, v, b in zip(p2, slope, bend, strict=True)
    )
    vx, vy, vr = (v + b * (2 * ahead_s + step_s) for v, b in zip(slope, bend, strict=True))
    return Course((x, y, r), (vx, vy, vr), (2 * bend[0], 2 * bend[1], 2 * bend[2]))
