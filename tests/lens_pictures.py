"""Where a camera with a lens sees the discs of a moving marker: outlines through an exact lens,
which share nothing with the estimator but the definition of the distortion."""

from __future__ import annotations

import numpy as np

from vdms_rt.model import MarkerShape

SQUARE_MM = np.array([(-60.0, 60.0), (60.0, 60.0), (-60.0, -60.0), (60.0, -60.0)])
SHAPE = MarkerShape("m1", tuple((x, y) for x, y in SQUARE_MM.tolist()), 50.0)
WIDTH_PX, HEIGHT_PX, ASPECT = 720, 480, 1.1
MIDDLE_PX = (359.5, 239.5)
HALF_DIAGONAL_PX = float(np.hypot(WIDTH_PX / 2 / ASPECT, HEIGHT_PX / 2))
AROUND = 2 * np.pi * np.arange(64) / 64


def bent_px(ideal_px, k1, k2=0.0, centre_px=MIDDLE_PX):
    """The seen place of ideal points, by bisection on the seen radius."""
    offsets = (ideal_px - np.array(centre_px)) / [ASPECT, 1.0]
    ideal = np.hypot(offsets[..., 0], offsets[..., 1]) / HALF_DIAGONAL_PX
    low, high = np.zeros_like(ideal), np.full_like(ideal, 1.2)
    for _ in range(60):
        middle = (low + high) / 2
        short = middle * (1 - k1 * middle**2 - k2 * middle**4) < ideal
        low, high = np.where(short, middle, low), np.where(short, high, middle)
    stretch = (low + high) / 2 / np.maximum(ideal, 1e-12)
    return centre_px + offsets * stretch[..., None] * [ASPECT, 1.0]


def centroid_px(outlines):
    """The centroids of polygons (..., points, 2)."""
    after = np.roll(outlines, -1, axis=-2)
    cross = outlines[..., 0] * after[..., 1] - outlines[..., 1] * after[..., 0]
    sums = ((outlines + after) * cross[..., None]).sum(axis=-2)
    return sums / (3 * cross.sum(axis=-1))[..., None]


def project_px(points_mm, angle_deg=0.0, px_per_mm=1.418, distance_mm=8000.0):
    """Ideal pixels of points of the marker plane; the camera looks at its zero."""
    turn = np.radians(angle_deg)
    x = points_mm[..., 0] * np.cos(turn)
    depth = distance_mm + points_mm[..., 0] * np.sin(turn)
    scale = px_per_mm * distance_mm / depth
    return np.stack(
        [MIDDLE_PX[0] + ASPECT * scale * x, MIDDLE_PX[1] - scale * points_mm[..., 1]], -1
    )


def path_mm(pictures, amplitude_mm):
    """A way across the picture in all directions, (pictures, 2), that begins at zero."""
    t = np.linspace(0, 2 * np.pi, pictures)
    return amplitude_mm * np.column_stack([np.sin(3 * t), np.sin(2 * t)])


def seen_px(
    k1,
    k2=0.0,
    centre_px=MIDDLE_PX,
    angle_deg=20.0,
    amplitude_mm=60.0,
    pictures=250,
    noise_px=0.01,
    print_mm=0.0,
    turn_mrad=0.0,
    seed=0,
):
    """Seen centroids of the discs, (pictures, 4, 2)."""
    rng = np.random.default_rng(seed)
    printed = SQUARE_MM + rng.normal(0, print_mm, SQUARE_MM.shape)
    turn = turn_mrad / 1000 * np.sin(np.linspace(0, 20, pictures))
    c, s = np.cos(turn), np.sin(turn)
    rotations = np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], -2)
    centres = printed @ rotations.transpose(0, 2, 1) + path_mm(pictures, amplitude_mm)[:, None]
    rim = SHAPE.diameter_mm / 2 * np.column_stack([np.cos(AROUND), np.sin(AROUND)])
    outlines = project_px(centres[:, :, None] + rim, angle_deg)
    seen = centroid_px(bent_px(outlines, k1, k2, centre_px))
    return seen + rng.normal(0, noise_px, seen.shape)
