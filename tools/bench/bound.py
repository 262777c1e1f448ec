"""The Cramer-Rao bound: the smallest standard deviation that any unbiased method can reach.

The picture's derivatives with respect to the marker's x, y and rotation are taken numerically from
the picture without noise; the shape, the light and the blur count as known. The variance of a
pixel is sigma^2 + 1/12: its noise and its rounding to whole grey levels.
"""

from __future__ import annotations

import argparse
from functools import lru_cache
from math import sqrt

import numpy as np
from numpy.typing import NDArray

from tools.bench.picture import ANGLES_DEG, DISTANCES_M, Bench

_STEPS = ((0.05, 0, 0), (0, 0.05, 0), (0, 0, 0.5))
"""mm, mm, mrad: some hundredths of a pixel, where the derivative's error is below 1e-3."""


def bound(bench: Bench, noise_grey: float, rows: slice = slice(None)) -> NDArray[np.float64]:
    """Return the least covariance of x_mm, y_mm and rotation_mrad, (3, 3), from the `rows` of one
    picture."""
    return _inverse_information(bench, rows.start, rows.step) * (noise_grey**2 + 1 / 12)


@lru_cache(maxsize=64)
def _inverse_information(bench: Bench, first: int | None, step: int | None) -> NDArray[np.float64]:
    slopes = []
    for move in _STEPS:
        ahead = bench.still(*move)[first::step]
        behind = bench.still(*(-s for s in move))[first::step]
        slopes.append(((ahead - behind) / (2 * sum(move))).ravel())
    jacobian = np.array(slopes)
    return np.linalg.inv(jacobian @ jacobian.T)


def error_percent(sigma_mm: float, amplitude_mm: float) -> float:
    """Eq. 3.1 for a harmonic of that amplitude: 100 std(error) / std(motion)."""
    return 100 * sigma_mm / (amplitude_mm / sqrt(2))


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tools.bench.bound", description=__doc__)
    parser.add_argument("--noise-grey", type=float, default=2.0)
    parser.add_argument("--field", action="store_true", help="of one field's rows")
    args = parser.parse_args()
    rows = slice(0, None, 2) if args.field else slice(None)
    print("distance_m  angle_deg  x_um   y_um   rotation_urad  Eq.3.1_at_10_mm_percent")
    for distance in DISTANCES_M:
        for angle in ANGLES_DEG:
            x, y, turn = np.sqrt(np.diag(bound(Bench(distance, angle), args.noise_grey, rows)))
            print(
                f"{distance:10g} {angle:10g} {x * 1000:6.3f} {y * 1000:6.3f} {turn * 1000:10.3f}"
                f" {error_percent(x, 10):15.4f}"
            )


if __name__ == "__main__":
    main()
