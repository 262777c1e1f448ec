"""Where a marker will be in the next picture, from where it was in the last ones."""

from __future__ import annotations

from typing import NamedTuple

Pose = tuple[float, float, float]
"""x_mm, y_mm, rotation_mrad from the reference pose."""

REST: Pose = (0.0, 0.0, 0.0)
KEEP_S = 0.25
"""Older poses say nothing about the next."""
FIRST_SLACK_PX = 6.0
"""How far off the marker may be when nothing is known of its velocity."""


class Track(NamedTuple):
    """The last poses, oldest first, at most three. Immutable."""

    poses: tuple[tuple[int, Pose], ...] = ()
    """(t_ns, pose)"""

    def with_pose(self, t_ns: int, pose: Pose) -> Track:
        """Return the track with one pose more."""
        return Track((*self.poses, (t_ns, pose))[-3:])

    def at(self, t_ns: int) -> tuple[Pose, Pose, float]:
        """Return the pose and velocity (the same per second) to expect, and how far off, in
        pixels, they may be: a parabola through the last three poses, or what there is."""
        poses = [p for p in self.poses if t_ns - p[0] <= KEEP_S * 1e9]
        if not poses:
            return (self.poses[-1][1] if self.poses else REST), REST, FIRST_SLACK_PX
        if len(poses) == 1:
            return poses[0][1], REST, FIRST_SLACK_PX
        (t1, p1), (t2, p2) = poses[-2:]
        ahead_s, step_s = (t_ns - t2) / 1e9, (t2 - t1) / 1e9
        if step_s <= 0 or ahead_s <= 0:
            return p2, REST, FIRST_SLACK_PX
        slope = [(b - a) / step_s for a, b in zip(p1, p2, strict=True)]
        bend = [0.0, 0.0, 0.0]
        if len(poses) == 3:
            t0, p0 = poses[0]
            before_s = (t1 - t0) / 1e9
            if 0 < before_s < 4 * step_s:
                bend = [
                    (v - (b - a) / before_s) / (step_s + before_s)
                    for a, b, v in zip(p0, p1, slope, strict=True)
                ]
        pose = [
            p + v * ahead_s + b * ahead_s * (ahead_s + step_s)
            for p, v, b in zip(p2, slope, bend, strict=True)
        ]
        velocity = [v + b * (2 * ahead_s + step_s) for v, b in zip(slope, bend, strict=True)]
        return (pose[0], pose[1], pose[2]), (velocity[0], velocity[1], velocity[2]), 0.0
