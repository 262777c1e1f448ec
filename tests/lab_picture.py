"""Pictures of markers in a cluttered laboratory, drawn by oversampling: nothing here is shared with
the estimator or with the virtual table."""

import math
from dataclasses import dataclass

import cv2
import numpy as np

from vdms_rt.model import MarkerShape, Scan

SQUARE = MarkerShape("m1", ((-60.0, 60.0), (60.0, 60.0), (-60.0, -60.0), (60.0, -60.0)), 50.0)
FINE = 4
"""Drawn pixels across one pixel of the picture."""
SHIFT = 8


@dataclass(frozen=True)
class View:
    """Where a marker hangs before the camera."""

    shape: MarkerShape = SQUARE
    distance_m: float = 8.0
    angle_deg: float = 0.0
    pitch_deg: float = 0.0
    """Second turn, about the marker's horizontal."""
    roll_deg: float = 0.0
    px_per_mm: float = 1.418
    """Along a column at angle 0; 1.418 fills 0.65 of 480 rows with the 220 mm sheet."""
    aspect: float = 1.1
    at_px: tuple[float, float] = (360.0, 240.0)
    margin: float = 0.5
    """Sheet beyond its outermost circles, in diameters."""

    def project(self, points_mm):
        """Pixels of marker-plane points; the camera looks at the marker's zero."""
        turn, pitch, roll = np.radians([self.angle_deg, self.pitch_deg, self.roll_deg])
        about_y = np.array(
            [[math.cos(turn), 0, -math.sin(turn)], [0, 1, 0], [math.sin(turn), 0, math.cos(turn)]]
        )
        about_x = np.array(
            [
                [1, 0, 0],
                [0, math.cos(pitch), -math.sin(pitch)],
                [0, math.sin(pitch), math.cos(pitch)],
            ]
        )
        about_z = np.array(
            [[math.cos(roll), -math.sin(roll), 0], [math.sin(roll), math.cos(roll), 0], [0, 0, 1]]
        )
        points = np.column_stack((points_mm, np.zeros(len(points_mm))))
        x, y, z = about_z @ about_y @ about_x @ points.T
        f = self.px_per_mm * self.distance_m * 1000
        depth = self.distance_m * 1000 + z
        return np.column_stack(
            (self.at_px[0] + self.aspect * f * x / depth, self.at_px[1] - f * y / depth)
        )

    def outlines(self, shift_mm=(0.0, 0.0)):
        """The outline of each circle's picture, (n, 256, 2)."""
        around = 2 * np.pi * np.arange(256) / 256
        rim = self.shape.diameter_mm / 2 * np.column_stack((np.cos(around), np.sin(around)))
        return np.array([self.project(rim + c + shift_mm) for c in np.array(self.shape.circles_mm)])

    def centres(self, shift_mm=(0.0, 0.0)):
        """The centroid of the area of each circle's picture, (n, 2)."""
        result = []
        for outline in self.outlines(shift_mm):
            after = np.roll(outline, -1, axis=0)
            cross = outline[:, 0] * after[:, 1] - outline[:, 1] * after[:, 0]
            result.append(((outline + after) * cross[:, None]).sum(axis=0) / (3 * cross.sum()))
        return np.array(result)

    def sheet(self, shift_mm=(0.0, 0.0)):
        circles = np.array(self.shape.circles_mm) + shift_mm
        beyond = (0.5 + self.margin) * self.shape.diameter_mm
        (left, bottom), (right, top) = circles.min(axis=0) - beyond, circles.max(axis=0) + beyond
        return self.project(np.array([(left, top), (right, top), (right, bottom), (left, bottom)]))


@dataclass(frozen=True)
class Lab:
    """Everything about a picture beside its markers."""

    width: int = 720
    height: int = 480
    clutter: int | None = 1
    """Seed of the things around, None for an even wall."""
    black: float = 30.0
    white: float = 200.0
    noise: float = 2.0
    blur_px: tuple[float, float] = (0.85, 0.6)
    gradient: float = 0.1
    gradient_deg: float = 0.0
    scan: Scan = Scan.PROGRESSIVE
    seed: int = 0


def picture(views=(), lab=Lab(), shift_mm=(0.0, 0.0), velocity_mm=(0.0, 0.0)):
    """The picture, uint8. An interlaced one shows the markers at `shift_mm` -+ a quarter of
    `velocity_mm` (millimetres in a frame period) in its earlier and later field."""
    if lab.scan in (Scan.TOP_FIRST, Scan.BOTTOM_FIRST):
        earlier = 0 if lab.scan == Scan.TOP_FIRST else 1
        light = np.empty((lab.height, lab.width))
        for rows, sign in ((earlier, -1), (1 - earlier, 1)):
            at = np.add(shift_mm, np.multiply(velocity_mm, sign / 4))
            light[rows::2] = _light(views, lab, at)[rows::2]
    else:
        light = _light(views, lab, shift_mm)
        if lab.scan in (Scan.TOP, Scan.BOTTOM):
            light = light[int(lab.scan == Scan.BOTTOM) :: 2]
    noisy = light + np.random.default_rng([lab.seed, 1]).normal(0, lab.noise, light.shape)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


def _light(views, lab, shift_mm):
    canvas = np.full(
        (lab.height * FINE, lab.width * FINE), 0.5 * (lab.black + lab.white), np.float32
    )
    if lab.clutter is not None:
        Clutter(canvas, lab).draw()
    for view in views:
        ground, ink = lab.black, lab.white
        if not view.shape.white_on_black:
            ground, ink = ink, ground
        polygon(canvas, view.sheet(shift_mm), ground)
        for outline in view.outlines(shift_mm):
            polygon(canvas, outline, ink)
    light = cv2.resize(canvas, (lab.width, lab.height), interpolation=cv2.INTER_AREA)
    if min(lab.blur_px) > 0:
        light = cv2.GaussianBlur(light, (0, 0), lab.blur_px[0], sigmaY=lab.blur_px[1])
    y, x = np.mgrid[0 : lab.height, 0 : lab.width]
    way = math.radians(lab.gradient_deg)
    along = (x / lab.width - 0.5) * math.cos(way) + (y / lab.height - 0.5) * math.sin(way)
    return light * (1 + lab.gradient * along)


def _fine(points_px):
    return np.rint(((np.asarray(points_px) + 0.5) * FINE - 0.5) * 2**SHIFT).astype(np.int32)


def polygon(canvas, points_px, grey):
    cv2.fillPoly(canvas, [_fine(points_px)], float(grey), cv2.LINE_8, SHIFT)


def ellipse(canvas, centre_px, semi_axes_px, turn_deg, grey):
    around = 2 * np.pi * np.arange(128) / 128
    turn = math.radians(turn_deg)
    x, y = semi_axes_px[0] * np.cos(around), semi_axes_px[1] * np.sin(around)
    points = np.column_stack(
        (x * math.cos(turn) - y * math.sin(turn), x * math.sin(turn) + y * math.cos(turn))
    )
    polygon(canvas, points + centre_px, grey)


class Clutter:
    """A laboratory: boxes, posters, shelves, cables, bolts, lamps and things that try to look like
    a marker."""

    def __init__(self, canvas, lab):
        self.canvas, self.lab = canvas, lab
        self.rng = np.random.default_rng([lab.clutter, 77])

    def draw(self):
        kinds = (
            [self.box] * 14
            + [self.poster] * 3
            + [self.cable] * 7
            + [self.bolts] * 4
            + [self.lamp] * 5
            + [self.plate] * 2
            + [self.shelf]
            + [self.ring] * 3
            + [self.checkers]
            + [self.wrong_quadrilateral] * 2
            + [self.panel_of_lamps]
        )
        for i in self.rng.permutation(len(kinds)):
            kinds[i]()

    def place(self):
        return self.rng.uniform((0, 0), (self.lab.width, self.lab.height))

    def grey(self, low=10, high=245):
        return float(self.rng.uniform(low, high))

    def box(self):
        centre, (w, h) = self.place(), self.rng.uniform(15, 130, 2)
        turn = math.radians(self.rng.normal(0, 8))
        corners = np.array([(-w, -h), (w, -h), (w, h), (-w, h)])
        rotation = np.array([[math.cos(turn), math.sin(turn)], [-math.sin(turn), math.cos(turn)]])
        polygon(self.canvas, centre + corners @ rotation, self.grey())
        if self.rng.random() < 0.5:
            polygon(self.canvas, centre + 0.85 * corners @ rotation, self.grey())

    def poster(self):
        centre = self.place()
        paper, ink = self.grey(150, 240), self.grey(10, 90)
        w, h = self.rng.uniform(50, 110, 2)
        polygon(self.canvas, centre + np.array([(-w, -h), (w, -h), (w, h), (-w, h)]), paper)
        letters = np.zeros(self.canvas.shape, np.uint8)
        for row in np.arange(-h + 12, h - 6, 16):
            text = "".join(self.rng.choice(list("oOQ08B. LAB-vdms%"), 14))
            at = _fine(np.add(centre, (-w + 4, row))) >> SHIFT
            scale = FINE * float(self.rng.uniform(0.35, 0.7))
            cv2.putText(letters, text, at.tolist(), cv2.FONT_HERSHEY_SIMPLEX, scale, 255, 2 * FINE)
        self.canvas[letters > 127] = ink

    def cable(self):
        ends = self.rng.uniform((-50, -50), (self.lab.width + 50, self.lab.height + 50), (4, 2))
        t = np.linspace(0, 1, 80)[:, None]
        curve = sum(math.comb(3, k) * t**k * (1 - t) ** (3 - k) * ends[k] for k in range(4))
        width = int(self.rng.integers(1, 6) * FINE)
        cv2.polylines(self.canvas, [_fine(curve)], False, self.grey(), width, cv2.LINE_8, SHIFT)

    def bolts(self):
        start, step = self.place(), self.rng.uniform(12, 60)
        turn = self.rng.uniform(0, 2 * math.pi)
        radius, bright = self.rng.uniform(3, 12), self.grey(120, 245)
        for i in range(int(self.rng.integers(2, 6))):
            at = start + i * step * np.array([math.cos(turn), math.sin(turn)])
            ellipse(self.canvas, at, (radius * 1.7,) * 2, 0, self.grey(10, 70))
            ellipse(self.canvas, at, (radius,) * 2, 0, bright)
            if self.rng.random() < 0.5:
                ellipse(self.canvas, at, (radius * 0.4,) * 2, 0, self.grey(10, 70))

    def lamp(self):
        centre, radius = self.place(), self.rng.uniform(6, 45)
        surround = self.grey(10, 120)
        ellipse(self.canvas, centre, (radius * 2.2, radius * 2.0), 0, surround)
        for part in np.linspace(1.5, 1, 6):
            glow = surround + (250 - surround) * (1.6 - part) / 0.6
            ellipse(self.canvas, centre, (radius * part, radius * part * 0.95), 20, glow)

    def plate(self):
        centre, radius = self.place(), self.rng.uniform(20, 70)
        squash = self.rng.uniform(0.4, 1)
        for part, grey in zip((1.4, 1.0, 0.6), self.grey_list(3), strict=True):
            ellipse(self.canvas, centre, (radius * part, radius * part * squash), 0, grey)

    def grey_list(self, n):
        return [self.grey() for _ in range(n)]

    def shelf(self):
        y, dark, light = self.place()[1], self.grey(10, 60), self.grey(120, 220)
        polygon(
            self.canvas, [(0, y), (self.lab.width, y), (self.lab.width, y + 60), (0, y + 60)], dark
        )
        for x in np.arange(20, self.lab.width, self.rng.uniform(25, 60)):
            radius = self.rng.uniform(6, 14)
            ellipse(self.canvas, (x, y + 30), (radius, radius), 0, light)

    def ring(self):
        centre, radius = self.place(), self.rng.uniform(8, 40)
        ellipse(self.canvas, centre, (radius, radius), 0, self.grey(150, 245))
        ellipse(self.canvas, centre, (radius * 0.7,) * 2, 0, self.grey(10, 80))

    def checkers(self):
        start, side = self.place(), self.rng.uniform(8, 30)
        for i in range(6):
            for j in range(5):
                a = start + np.array([i, j]) * side
                grey = 220 if (i + j) % 2 else 25
                polygon(self.canvas, a + side * np.array([(0, 0), (1, 0), (1, 1), (0, 1)]), grey)

    def wrong_quadrilateral(self):
        """Four even discs on black, but in no view of the square sheet."""
        centre, size = self.place(), self.rng.uniform(25, 80)
        ratio = self.rng.choice([0.14, 0.27, 0.6])  # of radius to half spacing; the sheet has 0.42
        corners = size * np.array([(-1.0, -1), (1, -1), (-1, 1), (1, 1)])
        if self.rng.random() < 0.6:  # right size then, but a corner out of place
            ratio = 0.42
            corners[self.rng.integers(4)] *= self.rng.uniform((0.2, 1.3), (0.5, 1.7))
        reach = size * 2.4
        polygon(
            self.canvas,
            centre + np.array([(-reach, -reach), (reach, -reach), (reach, reach), (-reach, reach)]),
            self.lab.black,
        )
        for corner in corners:
            ellipse(self.canvas, centre + corner, (ratio * size,) * 2, 0, self.lab.white)

    def panel_of_lamps(self):
        """Many equal discs on black in a loose pattern: something fits anything, almost."""
        centre, pitch = self.place(), self.rng.uniform(25, 60)
        reach = 2.2 * pitch
        polygon(
            self.canvas,
            centre + np.array([(-reach, -reach), (reach, -reach), (reach, reach), (-reach, reach)]),
            self.grey(10, 60),
        )
        radius, bright = pitch * self.rng.uniform(0.12, 0.3), self.grey(140, 250)
        for i in range(-1, 2):
            for j in range(-1, 2):
                if self.rng.random() < 0.75:
                    at = centre + pitch * (np.array([i, j]) + self.rng.uniform(-0.35, 0.35, 2))
                    ellipse(self.canvas, at, (radius, radius), 0, bright)
