"""What is left between a resting marker's two fields, and that motion teaches nothing."""

import math

import numpy as np

from vdms_rt.model import Scan
from vdms_rt.process.track import Track
from vdms_rt.process.uneven import NO_UNEVEN, Uneven

STEP_NS = 16_683_333
SIGMA_MM = 0.001
COVARIANCE = (SIGMA_MM**2, 0.0, SIGMA_MM**2)


def followed(x_mm: np.ndarray, b_mm: float) -> tuple[np.ndarray, Uneven]:
    """Return the samples of a marker at x_mm whose top field lies b_mm to the right, and what was
    learnt of that."""
    rng = np.random.default_rng(1)
    track, uneven, seen = Track(), NO_UNEVEN, []
    for n, x in enumerate(x_mm.tolist()):
        kind = Scan.TOP if n % 2 else Scan.BOTTOM
        off_x, off_y = uneven.of(kind)
        there = x + (b_mm if kind is Scan.TOP else -b_mm)
        noise = SIGMA_MM * rng.standard_normal(2)
        pose = (there + noise[0] - off_x, noise[1] - off_y, 0.0)
        uneven = uneven.after(kind, n * STEP_NS, pose, track, COVARIANCE)
        track = track.with_pose(n * STEP_NS, pose)
        seen.append(pose[0])
    return np.array(seen), uneven


def line_over_floor(x_mm: np.ndarray) -> float:
    spectrum = np.abs(np.fft.rfft(x_mm - x_mm.mean())) ** 2
    return float(spectrum[-1] / spectrum[1:-1].mean())


def test_a_resting_marker_shows_no_line():
    samples, uneven = followed(np.zeros(4000), 0.3 * SIGMA_MM)
    assert abs(uneven.x_mm - 0.3 * SIGMA_MM) < 0.1 * SIGMA_MM
    # 360 without.
    assert line_over_floor(samples) < 9


def test_motion_teaches_nothing():
    t = np.arange(4000) * STEP_NS / 1e9
    _, uneven = followed(10 * np.sin(2 * math.pi * 5 * t), 0.0)
    assert uneven == NO_UNEVEN
    _, slow = followed(0.5 * np.sin(2 * math.pi * 0.3 * t), 0.0)
    assert abs(slow.x_mm) < 0.1 * SIGMA_MM


def test_a_whole_picture_has_no_other_field():
    known = Uneven(100, 0.5, 0.25)
    assert known.of(Scan.PROGRESSIVE) == (0, 0)
    assert known.of(Scan.TOP) == (0.5, 0.25)
    assert known.of(Scan.BOTTOM) == (-0.5, -0.25)
    track = Track().with_pose(0, (0.0, 0.0, 0.0)).with_pose(STEP_NS, (0.0, 0.0, 0.0))
    assert known.after(Scan.PROGRESSIVE, 2 * STEP_NS, (0.0, 0, 0), track, COVARIANCE) is known
