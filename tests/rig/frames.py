"""The pictures that the rig's devices show: the four-circle marker, at rest and moving.

    python tests/rig/frames.py FRAMES.yuyv

The first REST_FRAMES are the marker at rest, each with noise of its own; the PERIOD_FRAMES after
them are one period of its motion, interlaced with the bottom field first. Both are loops. Each
frame is WIDTH_PX x HEIGHT_PX in YUYV.
"""

import sys
from pathlib import Path

import numpy as np

WIDTH_PX, HEIGHT_PX = 720, 480
FRAME_BYTES = WIDTH_PX * HEIGHT_PX * 2
REST_FRAMES, PERIOD_FRAMES = 10, 30
AMPLITUDE_MM = 10.0
SPACING_MM, DIAMETER_MM = 120.0, 50.0
SHEET_MM = SPACING_MM + 2 * DIAMETER_MM
PX_PER_MM = np.array([1.56, 1.42])
CENTRE_PX = np.array([(WIDTH_PX - 1) / 2, (HEIGHT_PX - 1) / 2])
WALL, BLACK, WHITE, NOISE = 95.0, 30.0, 200.0, 2.0
_SUBSAMPLES = 8


def position_mm(frame: float) -> tuple[float, float]:
    """Return where the marker is, x right and y up, so many frames after its motion begins."""
    x_mm = AMPLITUDE_MM * np.sin(2 * np.pi * frame / PERIOD_FRAMES)
    return x_mm, 0.5 * x_mm


def picture(x_mm: float, y_mm: float) -> np.ndarray:
    """Return the grey levels of the marker at a place, (HEIGHT_PX, WIDTH_PX) float."""
    grey = np.full((HEIGHT_PX, WIDTH_PX), WALL)
    middle_px = CENTRE_PX + PX_PER_MM * (x_mm, -y_mm)
    left, top = np.round(middle_px - PX_PER_MM * SHEET_MM / 2).astype(int)
    right, bottom = np.round(middle_px + PX_PER_MM * SHEET_MM / 2).astype(int)
    grey[top:bottom, left:right] = BLACK
    half_px = PX_PER_MM * SPACING_MM / 2
    for side in ((-1, -1), (1, -1), (-1, 1), (1, 1)):
        _draw_disc(grey, middle_px + half_px * side, PX_PER_MM * DIAMETER_MM / 2)
    return grey


def _draw_disc(grey: np.ndarray, centre_px: np.ndarray, radii_px: np.ndarray) -> None:
    left, top = np.floor(centre_px - radii_px - 1).astype(int)
    right, bottom = np.ceil(centre_px + radii_px + 2).astype(int)
    inner = (np.arange(_SUBSAMPLES) + 0.5) / _SUBSAMPLES - 0.5
    x_px = (np.arange(left, right)[:, None] + inner).ravel()
    y_px = (np.arange(top, bottom)[:, None] + inner).ravel()
    across, down = (x_px - centre_px[0]) / radii_px[0], (y_px - centre_px[1]) / radii_px[1]
    inside = across[None, :] ** 2 + down[:, None] ** 2 <= 1
    blocks = inside.reshape(bottom - top, _SUBSAMPLES, right - left, _SUBSAMPLES)
    grey[top:bottom, left:right] += (WHITE - BLACK) * blocks.mean(axis=(1, 3))


def frame(number: int, rng: np.random.Generator) -> np.ndarray:
    """Return frame `number` in YUYV, (HEIGHT_PX, WIDTH_PX, 2)."""
    moved = number - REST_FRAMES
    if moved < 0:
        grey = picture(0.0, 0.0)
    else:
        grey = picture(*position_mm(moved))
        grey[0::2] = picture(*position_mm(moved + 0.5))[0::2]
    grey += rng.normal(0, NOISE, grey.shape)
    yuyv = np.full((HEIGHT_PX, WIDTH_PX, 2), 128, np.uint8)
    yuyv[..., 0] = np.clip(np.round(grey), 16, 235)
    return yuyv


class Film:
    """The order in which the frames are shown: at rest as long as it is held, then moving, from
    the motion's beginning on."""

    def __init__(self) -> None:
        self._rested = self._moved = 0

    def next(self, held: bool) -> int:
        """Return the number of the next frame."""
        if held:
            self._rested, self._moved = self._rested + 1, 0
            return self._rested % REST_FRAMES
        self._moved += 1
        return REST_FRAMES + (self._moved - 1) % PERIOD_FRAMES


def load(path: Path) -> np.ndarray:
    """Return the frames in a file, (frames, HEIGHT_PX, WIDTH_PX, 2)."""
    return np.fromfile(path, np.uint8).reshape(-1, HEIGHT_PX, WIDTH_PX, 2)


def main(path: Path) -> None:
    rng = np.random.default_rng(1)
    # Under its own name only when it is whole.
    part = path.with_suffix(".part")
    np.stack([frame(n, rng) for n in range(REST_FRAMES + PERIOD_FRAMES)]).tofile(part)
    part.replace(path)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
