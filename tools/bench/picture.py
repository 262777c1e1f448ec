"""Pictures for the accuracy benches, made by nothing that measures them.

The marker: discs of radius 25 mm at (+-60, +-60) mm on a sheet of 200 mm, which fills 65 % of 480
rows whatever the distance. A pinhole camera sees it under an angle about the vertical. Each pixel
is the exact integral of the disc's picture over its own area, after a Gaussian blur: the circle's
image is a conic, its chord along a row is integrated in closed form, and across the rows by a
quadrature that converges geometrically (the chord's ends are smooth in the parametric angle).
A part of the picture, a `Window`, is drawn without the rest of it.

Coordinates are those of the product: pixels from the centre of the top-left one, x right, y down;
millimetres in the marker plane, x right, y up, and z away from the camera at 0 deg; rotation
counter-clockwise.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from functools import lru_cache
from math import ceil, cos, erf, floor, hypot, pi, radians, sin, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Grey = NDArray[np.float64]

DISTANCES_M = (4.0, 8.0, 12.0, 16.0, 20.0)
ANGLES_DEG = (0.0, 15.0, 30.0, 45.0, 60.0)
DISTURBANCES = ("glare", "specks", "wire", "shadow", "gradient", "cut")

_REACH = 7.0
"""Standard deviations after which a Gaussian is nothing (3e-12)."""
_FINE = 1024
"""Steps in a pixel of the tables, between which a straight line is right to 1e-7."""
_NODES = 0.8
"""Blurs from node to node of the quadrature, which leave an error of exp(-2 pi^2 / 0.8^2)."""

Pose = tuple[float, float, float]
"""x_mm, y_mm, rotation_mrad."""


class Window(NamedTuple):
    """A rectangle of pixels."""

    left: int
    top: int
    width: int
    height: int


@dataclass(frozen=True)
class Bench:
    """The camera, the marker and their light."""

    distance_m: float = 8.0
    angle_deg: float = 0.0
    roll_deg: float = 0.0
    width_px: int = 720
    height_px: int = 480
    pixel_aspect: float = 1.1
    fill: float = 0.65
    sheet_mm: float = 200.0
    half_spacing_mm: float = 60.0
    radius_mm: float = 25.0
    black_grey: float = 30.0
    white_grey: float = 200.0
    blur_x_px: float = 0.85
    blur_y_px: float = 0.6

    @property
    def circles_mm(self) -> NDArray[np.float64]:
        """Top left, top right, bottom left, bottom right."""
        h = self.half_spacing_mm
        return np.array([(-h, h), (h, h), (-h, -h), (h, -h)])

    @property
    def background_grey(self) -> float:
        """Of the picture without the marker."""
        return self.black_grey

    @property
    def homography(self) -> NDArray[np.float64]:
        """Marker plane in millimetres -> pixels, (3, 3), for the marker at rest."""
        return self.moved()

    def moved(
        self, x_mm: float = 0.0, y_mm: float = 0.0, rotation_mrad: float = 0.0, z_mm: float = 0.0
    ) -> NDArray[np.float64]:
        """Plane of the moved marker in millimetres -> pixels, (3, 3)."""
        distance_mm = self.distance_m * 1000
        focal = self.fill * self.height_px * distance_mm / self.sheet_mm
        turn, roll = radians(self.angle_deg), radians(self.roll_deg)
        rolled = np.array([[cos(roll), -sin(roll), 0], [sin(roll), cos(roll), 0], [0, 0, 1]])
        lens = np.array(
            [
                [focal * self.pixel_aspect, 0, (self.width_px - 1) / 2],
                [0, -focal, (self.height_px - 1) / 2],
                [0, 0, 1],
            ]
        )
        right = np.array([cos(turn), 0, sin(turn)])
        up = np.array([0, 1, 0])
        away = np.array([-sin(turn), 0, cos(turn)])
        c, s = cos(rotation_mrad / 1000), sin(rotation_mrad / 1000)
        place = x_mm * right + y_mm * up + z_mm * away + (0, 0, distance_mm)
        pose = np.column_stack([c * right + s * up, c * up - s * right, place])
        return lens @ rolled @ pose

    def centres_px(
        self, x_mm: float = 0.0, y_mm: float = 0.0, rotation_mrad: float = 0.0
    ) -> NDArray[np.float64]:
        """Centres of the ellipses (not the pictures of the circles' centres), (4, 2)."""
        return np.array([e.centre for e in self._ellipses(self.moved(x_mm, y_mm, rotation_mrad))])

    def boxes_px(
        self, x_mm: float = 0.0, y_mm: float = 0.0, rotation_mrad: float = 0.0, z_mm: float = 0.0
    ) -> NDArray[np.float64]:
        """Left, top, right and bottom of each disc's edge, (4, 4)."""
        return np.array(
            [e.box for e in self._ellipses(self.moved(x_mm, y_mm, rotation_mrad, z_mm))]
        )

    def _ellipses(self, homography: NDArray[np.float64]) -> list[Ellipse]:
        return [Ellipse.of(homography, c, self.radius_mm) for c in self.circles_mm]

    def still(
        self,
        x_mm: float = 0.0,
        y_mm: float = 0.0,
        rotation_mrad: float = 0.0,
        z_mm: float = 0.0,
        window: Window | None = None,
    ) -> Grey:
        """The picture without noise, in grey levels, (height, width); of a window, or whole."""
        window = window or Window(0, 0, self.width_px, self.height_px)
        cover = np.zeros((window.height, window.width))
        for ellipse in self._ellipses(self.moved(x_mm, y_mm, rotation_mrad, z_mm)):
            ellipse.add(cover, window, self.blur_x_px, self.blur_y_px)
        return self.black_grey + (self.white_grey - self.black_grey) * cover


def exposure_nodes(exposure_s: float, count: int) -> tuple[Grey, Grey]:
    """Times about the middle of an exposure and their weights (Gauss-Legendre), each (count,)."""
    nodes, weights = np.polynomial.legendre.leggauss(count)
    return nodes * exposure_s / 2, weights / 2


def grabbed(clean: Grey, noise_grey: float, rng: np.random.Generator) -> NDArray[np.uint8]:
    """The 8-bit picture of `clean` with white noise of that standard deviation."""
    noisy = clean + noise_grey * rng.standard_normal(clean.shape)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


def woven(first: Grey, second: Grey, bottom_first: bool = True) -> Grey:
    """An interlaced frame of two pictures: rows 1, 3, ... of the earlier and 0, 2, ... of the
    later one, or the other way round."""
    top, bottom = (second, first) if bottom_first else (first, second)
    frame = top.copy()
    frame[1::2] = bottom[1::2]
    return frame


def disturbed(
    clean: Grey,
    bench: Bench,
    kind: str,
    circles: tuple[int, ...],
    rng: np.random.Generator,
    pose: Pose = (0.0, 0.0, 0.0),
    window: Window | None = None,
) -> Grey:
    """`clean`, the picture in `window` (or the whole one), with a disturbance of `kind` on each of
    `circles` of the marker at `pose`, drawn from `rng`.

    glare: a bright spot near the edge. specks: two to five black or white dots of dirt near the
    edge. wire: a dark or bright line across the disc. shadow: half of the disc in 30..80 % of the
    light. gradient: light that changes by 5..30 % from the disc's centre to its edge, alike on all
    `circles`. cut: 20 % of the disc covered by black.
    """
    left, top, width, height = window or Window(0, 0, bench.width_px, bench.height_px)
    y, x = np.mgrid[top : top + height, left : left + width].astype(np.float64)
    out = clean.copy()
    slope, heading = rng.uniform(0.05, 0.3), rng.uniform(0, 2 * pi)
    homography = bench.moved(*pose)
    for i in circles:
        ellipse = Ellipse.of(homography, bench.circles_mm[i], bench.radius_mm)
        # In these coordinates the disc is the unit circle.
        v = (y - ellipse.centre[1]) / ellipse.half_height
        u = (x - ellipse.centre[0] - ellipse.lean * (y - ellipse.centre[1])) / ellipse.half_chord
        pixel = 1 / sqrt(ellipse.half_height * ellipse.half_chord)
        at = rng.uniform(0, 2 * pi)
        across = u * cos(at) + v * sin(at)
        # Nothing of it reaches the next disc.
        here = np.maximum(abs(u), abs(v)) < 1.6
        match kind:
            case "glare":
                r, size = rng.uniform(0.6, 1.1), rng.uniform(0.1, 0.4)
                spot = (u - r * cos(at)) ** 2 + (v - r * sin(at)) ** 2
                out += rng.uniform(60, 300) * np.exp(-spot / (2 * size * size))
            case "specks":
                for _ in range(rng.integers(2, 6)):
                    at, r = rng.uniform(0, 2 * pi), rng.uniform(0.8, 1.1)
                    level = bench.black_grey if rng.random() < 0.5 else bench.white_grey
                    spot = np.hypot(u - r * cos(at), v - r * sin(at))
                    out += (level - out) * _soft(rng.uniform(0.05, 0.15) - spot, pixel)
            case "wire":
                off, width = rng.uniform(-0.8, 0.8), rng.uniform(1.0, 5.0) * pixel
                level = rng.choice([bench.black_grey, 0.5 * bench.white_grey, bench.white_grey])
                out += (level - out) * here * _soft(width / 2 - abs(across - off), pixel)
            case "shadow":
                lit = _soft(across - rng.uniform(-0.6, 0.6), pixel * rng.uniform(1, 6))
                out *= np.where(here, 1 - rng.uniform(0.2, 0.7) * (1 - lit), 1)
            case "gradient":
                out *= np.where(here, 1 + slope * (u * cos(heading) + v * sin(heading)), 1)
            case "cut":
                # The chord that cuts off 20 % of a circle lies at 0.4920 of its radius.
                out += (bench.black_grey - out) * here * _soft(across - 0.4920, pixel)
            case _:
                raise ValueError(f"no disturbance is called {kind}; known: {DISTURBANCES}")
    return out


def _soft(inside: Grey, width: float) -> Grey:
    """0 to 1 where `inside` goes from below to above 0, over about `width`."""
    return 0.5 + 0.5 * np.tanh(np.clip(inside / width, -20, 20))


@dataclass(frozen=True)
class Ellipse:
    """The picture of a circle."""

    centre: NDArray[np.float64]
    half_height: float
    """Rows from the centre to the top."""
    half_chord: float
    """Half the length of the chord along the row of the centre."""
    lean: float
    """Pixels by which the chords' middles move to the right for each row down."""

    @staticmethod
    def of(
        homography: NDArray[np.float64], centre_mm: NDArray[np.float64], radius_mm: float
    ) -> Ellipse:
        x, y = centre_mm
        circle = np.array([[1, 0, -x], [0, 1, -y], [-x, -y, x * x + y * y - radius_mm**2]])
        back = np.linalg.inv(homography)
        conic = back.T @ circle @ back
        (a, b), (_, c) = conic[:2, :2]
        centre = np.linalg.solve(conic[:2, :2], -conic[:2, 2])
        level = -(conic[2, 2] + conic[2, :2] @ centre)
        return Ellipse(
            centre,
            half_height=sqrt(level * a / (a * c - b * b)),
            half_chord=sqrt(level / a),
            lean=-b / a,
        )

    @property
    def box(self) -> tuple[float, float, float, float]:
        """Left, top, right and bottom."""
        (x, y), half_width = self.centre, hypot(self.half_chord, self.lean * self.half_height)
        return x - half_width, y - self.half_height, x + half_width, y + self.half_height

    def add(self, out: Grey, window: Window, blur_x_px: float, blur_y_px: float) -> None:
        """Add to `out` the part of each pixel's light in the window that comes from the disc."""
        edge, line = _Edge.of(blur_x_px), _Edge.of(blur_y_px)
        left, top, right, bottom = self.box
        columns = np.arange(floor(left) - edge.reach_px, ceil(right) + edge.reach_px + 1)
        rows = np.arange(floor(top) - line.reach_px, ceil(bottom) + line.reach_px + 1)
        seen_columns = columns[(window.left <= columns) & (columns < window.left + window.width)]
        seen_rows = rows[(window.top <= rows) & (rows < window.top + window.height)]
        if not len(seen_columns) or not len(seen_rows):
            return
        finest = min(blur_y_px, blur_x_px * self.half_height / self.half_chord)
        nodes = ceil(pi * self.half_height / (_NODES * finest)) + 8
        t = pi * ((np.arange(nodes) + 0.5) / nodes - 0.5)
        drop = self.half_height * np.sin(t)
        weight = self.half_height * np.cos(t) * pi / nodes
        middle = self.centre[0] + self.lean * drop
        half = self.half_chord * np.cos(t)
        # Each node lights up its share of the rows, and in them the columns of its chord.
        down = np.zeros((nodes, len(rows)))
        line.write(down, rows, self.centre[1] + drop, line.within)
        along = np.zeros((2, nodes, len(columns)))
        for beyond, end in zip(along, (middle - half, middle + half), strict=True):
            beyond[columns > end[:, None]] = 1
            edge.write(beyond, columns, end, edge.beyond)
        cover = (down.T * weight) @ (along[0] - along[1])
        shown = np.ix_(seen_rows - rows[0], seen_columns - columns[0])
        out[np.ix_(seen_rows - window.top, seen_columns - window.left)] += cover[shown]


class _Edge(NamedTuple):
    """What a pixel sees of an edge and of a line, over its distance d from them in pixels."""

    reach_px: int
    """Beyond it, nothing changes any more."""
    beyond: Grey
    """Its part beyond the edge: 0 for d = -reach_px - 1, 1 for d = reach_px + 1."""
    within: Grey
    """Its part of a line's light."""

    @staticmethod
    @lru_cache
    def of(blur_px: float) -> _Edge:
        reach_px = ceil(_REACH * blur_px + 0.5)
        d = np.arange(-(reach_px + 1) * _FINE, (reach_px + 1) * _FINE + 2) / _FINE
        low, high = (d - 0.5) / blur_px, (d + 0.5) / blur_px
        return _Edge(reach_px, blur_px * (_ramp(high) - _ramp(low)), _phi(high) - _phi(low))

    def write(self, out: Grey, pixels: NDArray[np.int64], places: Grey, table: Grey) -> None:
        """Write into each line of `out`, which begins at `pixels[0]`, what those around its place
        have in `table`."""
        at = np.floor(places).astype(np.int64)[:, None] + np.arange(
            -self.reach_px, self.reach_px + 1
        )
        fine = (at - places[:, None] + self.reach_px + 1) * _FINE
        i = fine.astype(np.int32)
        low = table.take(i)
        out[np.arange(len(out))[:, None], at - pixels[0]] = low + (fine - i) * (
            table.take(i + 1) - low
        )


def _phi(u: Grey) -> Grey:
    return np.array([0.5 * (1 + erf(v / sqrt(2))) for v in u])


def _ramp(u: Grey) -> Grey:
    """The integral of `_phi`."""
    return u * _phi(u) + np.exp(-u * u / 2) / sqrt(2 * pi)


def main() -> None:
    import cv2

    parser = argparse.ArgumentParser(prog="python -m tools.bench.picture", description=__doc__)
    parser.add_argument("--out", default="bench.png", help="PNG to write")
    parser.add_argument("--distance-m", type=float, default=8.0)
    parser.add_argument("--angle-deg", type=float, default=0.0)
    parser.add_argument("--roll-deg", type=float, default=0.0)
    parser.add_argument("--noise-grey", type=float, default=2.0)
    parser.add_argument("--x-mm", type=float, default=0.0)
    parser.add_argument("--disturb", choices=DISTURBANCES, help="on the first disc")
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    bench = Bench(distance_m=args.distance_m, angle_deg=args.angle_deg, roll_deg=args.roll_deg)
    rng = np.random.default_rng(args.seed)
    clean = bench.still(args.x_mm)
    if args.disturb:
        clean = disturbed(clean, bench, args.disturb, (0,), rng)
    cv2.imwrite(args.out, grabbed(clean, args.noise_grey, rng))
    print(args.out)


if __name__ == "__main__":
    main()
