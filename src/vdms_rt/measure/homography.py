"""The map between the marker plane in millimetres and the picture in pixels."""

from __future__ import annotations

import math
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from vdms_rt.model import Points, VdmsError

Matrix: TypeAlias = NDArray[np.float64]
"""Shape (3, 3), float64: homogeneous marker plane (x right, y up, mm) to homogeneous whole-frame
pixels (x right, y down)."""

Rows: TypeAlias = tuple[tuple[float, ...], ...]
"""A matrix as tuples of its rows."""

MIN_INDEPENDENCE = 1e-3
"""Least ratio of the eighth to the first singular value of the equations, both planes scaled to
unit spread along their principal axes. The corners of a parallelogram have 0.36; four points of
which the third leaves the line of two others by a thousandth of their distance have 0.0008."""


class GeometryError(VdmsError):
    """The circles do not fix a map between the marker and the picture."""


def homography(marker_mm: Points, image_px: Points) -> Matrix:
    """Return the map from the marker plane to the picture, as Lee, Cho and Sim (2015) find it.

    Two rows a point (their Eq. 2.2 to 2.5), A h = 0 with A of shape (2n, 9), and h the right
    singular vector of the smallest singular value. The result has unit Frobenius norm and the sign
    that makes the third coordinate of the marker's points positive.

    Raises GeometryError when the points are too few or lie on a line.
    """
    check_points(marker_mm, image_px)
    return _facing(_solve(_equations(marker_mm, image_px)), marker_mm)


def homography_normalised(marker_mm: Points, image_px: Points) -> Matrix:
    """Return the same map from equations that are scaled first (Hartley 1997).

    With four points it is the same map as `homography` to rounding. With more it weighs their
    errors alike whatever the units are.
    """
    check_points(marker_mm, image_px)
    marker_scaling, image_scaling = _scaling(marker_mm), _scaling(image_px)
    scaled = _solve(_equations(_apply(marker_scaling, marker_mm), _apply(image_scaling, image_px)))
    h = np.linalg.solve(image_scaling, scaled @ marker_scaling)
    return _facing(h / np.linalg.norm(h), marker_mm)


def check_points(marker_mm: Points, image_px: Points) -> None:
    """Raise GeometryError unless the points fix a homography."""
    n = len(marker_mm)
    if n != len(image_px):
        raise GeometryError(
            f"{n} circles of the marker and {len(image_px)} in the picture do not pair up; "
            "give one picture position for each circle"
        )
    if n < 4:
        raise GeometryError(f"{n} circles cannot fix the map to millimetres; at least 4 are needed")
    if not (np.isfinite(marker_mm).all() and np.isfinite(image_px).all()):
        raise GeometryError("a circle has no position; all circles must be seen")
    for points, place in ((marker_mm, "on the marker"), (image_px, "in the picture")):
        if independence(points) < MIN_INDEPENDENCE:
            raise GeometryError(
                f"{'three of the' if n == 4 else 'all but one of the'} circles lie on one line "
                f"{place}, so they cannot fix the map to millimetres; "
                "at least four are needed of which no three are in a line"
            )


def independence(points: Points) -> float:
    """Return how far the points are from not fixing a homography: 0 when three of four (or all but
    one) lie on one line, 0.36 for the corners of any parallelogram; no unit."""
    centred = points - points.mean(axis=0)
    _, spread, axes = np.linalg.svd(centred, full_matrices=False)
    if spread[1] <= 1e-12 * max(spread[0], 1e-300):
        return 0.0
    even = centred @ axes.T / spread * math.sqrt(len(points))
    values = np.linalg.svd(_equations(even, even), compute_uv=False)
    return float(values[7] / values[0])


def inverse(h: Matrix) -> Matrix:
    """Return the map from whole-frame pixels to the marker plane."""
    return np.asarray(np.linalg.inv(h), dtype=np.float64)


def to_image_px(h: Matrix, points_mm: Points) -> Points:
    """Return where points of the marker plane lie in the picture, (n, 2)."""
    return _apply(h, points_mm)


def to_marker_mm(h: Matrix, points_px: Points) -> Points:
    """Return where points of the picture lie in the marker plane, (n, 2)."""
    return _apply(inverse(h), points_px)


def to_marker(
    back: Rows, x_px: float, y_px: float
) -> tuple[tuple[float, float], tuple[float, float, float, float]]:
    """Return one point of the picture in the marker plane, (x, y) in mm, and d(mm)/d(px) there, row
    by row: `to_marker_mm` and `jacobian_mm_per_px` in plain floats, for where time counts.

    `back` are the rows of `inverse(h)`.
    """
    (a, b, c), (d, e, f), (g, h, i) = back
    depth = g * x_px + h * y_px + i
    x, y = (a * x_px + b * y_px + c) / depth, (d * x_px + e * y_px + f) / depth
    return (x, y), (
        (a - x * g) / depth,
        (b - x * h) / depth,
        (d - y * g) / depth,
        (e - y * h) / depth,
    )


def jacobian_px_per_mm(h: Matrix, points_mm: Points) -> NDArray[np.float64]:
    """Return d(px)/d(mm) at points of the marker plane, (n, 2, 2): row = px axis, column = mm."""
    return _jacobian(h, points_mm)


def jacobian_mm_per_px(h: Matrix, points_px: Points) -> NDArray[np.float64]:
    """Return d(mm)/d(px) at points of the picture, (n, 2, 2): row = mm axis, column = px."""
    return _jacobian(inverse(h), points_px)


def reference_sensitivity(marker_mm: Points, reference_px: Points, points_px: Points) -> Matrix:
    """Return how an error of each reference centre moves each mapped point, (m, n, 2, 2): mm of
    point m (row) for each px of centre n (column), to first order.

    It is that of `homography_normalised`, so of `homography` too when there are four circles. From
    A h = 0 follows dh = -pinv(A) dA h, and dA h is minus the third coordinate times the error.
    """
    marker_scaling, image_scaling = _scaling(marker_mm), _scaling(reference_px)
    marker, reference = _apply(marker_scaling, marker_mm), _apply(image_scaling, reference_px)
    equations = _equations(marker, reference)
    h = _facing(_solve(equations), marker)
    depth = _homogeneous(marker) @ h[2]
    dh = np.linalg.pinv(equations, rcond=1e-9) * np.repeat(depth, 2)

    image = _apply(image_scaling, points_px)
    back = inverse(h)
    plane = _homogeneous(_apply(back, image))
    dimage = np.zeros((len(image), 2, 9))
    dimage[:, 0, 0:3] = dimage[:, 1, 3:6] = plane
    dimage[:, :, 6:9] = -image[:, :, None] * plane[:, None, :]
    dimage /= (plane @ h[2])[:, None, None]
    moved = -_jacobian(back, image) @ (dimage @ dh)
    moved *= image_scaling[0, 0] / marker_scaling[0, 0]
    result: Matrix = moved.reshape(len(image), 2, len(marker), 2).transpose(0, 2, 1, 3)
    return result


def reference_covariance_mm2(
    marker_mm: Points,
    reference_px: Points,
    reference_covariance_px2: NDArray[np.float64],
    points_px: Points,
) -> NDArray[np.float64]:
    """Return the covariance of mapped points that comes from the errors of the reference centres,
    (m, 2, 2).

    `reference_covariance_px2` is (n, 2, 2), one for each centre, which err independently. The
    points' own errors come on top: `jacobian_mm_per_px` turns those into millimetres.
    """
    moved = reference_sensitivity(marker_mm, reference_px, points_px)
    total: NDArray[np.float64] = np.einsum(
        "mnij,njk,mnlk->mil", moved, reference_covariance_px2, moved
    )
    return total


def scale_px_per_mm(h: Matrix, at_mm: tuple[float, float] = (0.0, 0.0)) -> tuple[float, float]:
    """Return how many pixels long a millimetre along the marker's x and one along its y are."""
    along_x, along_y = _jacobian(h, np.array([at_mm]))[0].T
    return float(np.hypot(*along_x)), float(np.hypot(*along_y))


def viewing_angle_deg(
    h: Matrix, pixel_aspect: float, at_mm: tuple[float, float] = (0.0, 0.0)
) -> float:
    """Return the angle between the marker's normal and the line of sight, 0 to 90 degrees.

    Foreshortening alone tells it, so near 0 it is blunt: 1 % of error in `pixel_aspect` (pixels
    per unit length along a row over pixels along a column) looks like 8 degrees there, and like
    0.3 degrees at 60.
    """
    square = _jacobian(h, np.array([at_mm]))[0] / [[pixel_aspect], [1.0]]
    long, short = np.linalg.svd(square, compute_uv=False)
    return math.degrees(math.acos(min(1.0, float(short / long))))


def roll_deg(h: Matrix, pixel_aspect: float, at_mm: tuple[float, float] = (0.0, 0.0)) -> float:
    """Return how far the marker appears turned counter-clockwise, -180 to 180 degrees.

    It is the rotation of the polar decomposition of the local map, so a view from the side does not
    count as a turn.
    """
    j = _jacobian(h, np.array([at_mm]))[0] / [[pixel_aspect], [-1.0]]
    return math.degrees(math.atan2(j[1, 0] - j[0, 1], j[0, 0] + j[1, 1]))


def _equations(plane: Points, image: Points) -> NDArray[np.float64]:
    rows = np.zeros((2 * len(plane), 9))
    source = _homogeneous(plane)
    rows[0::2, 0:3] = rows[1::2, 3:6] = source
    rows[0::2, 6:9] = -image[:, :1] * source
    rows[1::2, 6:9] = -image[:, 1:] * source
    return rows


def _solve(equations: NDArray[np.float64]) -> Matrix:
    return np.asarray(np.linalg.svd(equations)[2][8].reshape(3, 3), dtype=np.float64)


def _facing(h: Matrix, marker_mm: Points) -> Matrix:
    depth = _homogeneous(marker_mm) @ h[2]
    if (depth > 0).all():
        return h
    if (depth < 0).all():
        return -h
    raise GeometryError(
        "the circles in the picture are in an order that no view of the marker has; "
        "give them in the order of the marker's own list"
    )


def _scaling(points: Points) -> Matrix:
    """Return the similarity that puts the centroid at 0 and the mean square distance at 2."""
    centre = points.mean(axis=0)
    scale = math.sqrt(2 / float(((points - centre) ** 2).sum(axis=1).mean()))
    return np.array([[scale, 0, -scale * centre[0]], [0, scale, -scale * centre[1]], [0, 0, 1]])


def _homogeneous(points: Points) -> NDArray[np.float64]:
    return np.column_stack((points, np.ones(len(points))))


def _apply(h: Matrix, points: Points) -> Points:
    mapped = _homogeneous(points) @ h.T
    return mapped[:, :2] / mapped[:, 2:]


def _jacobian(h: Matrix, points: Points) -> NDArray[np.float64]:
    mapped = _homogeneous(points) @ h.T
    image = mapped[:, :2] / mapped[:, 2:]
    top = h[:2, :2][None] - image[:, :, None] * h[2, :2][None, None]
    result: NDArray[np.float64] = top / mapped[:, 2][:, None, None]
    return result
