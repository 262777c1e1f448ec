"""The named alternative: four ArUco tags in the places of the discs, measured by OpenCV alone.

Their corners, refined to sub-pixels by `cv2.aruco`, go through the homography of the mean corners
at rest, as the discs' centres do in the paper; the displacement is the mean over the sixteen.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tools.bench.picture import Bench, Grey, Window

TAG_MM = 60.0
"""Side of a tag with its black rim."""
BITS = 6
FINE = 4
"""Rays for each pixel along x and along y."""


@dataclass(frozen=True)
class Tags:
    """The bench's sheet in white, with tags for discs."""

    bench: Bench

    @property
    def width_px(self) -> int:
        return self.bench.width_px

    @property
    def height_px(self) -> int:
        return self.bench.height_px

    @property
    def background_grey(self) -> float:
        return self.bench.white_grey

    def corners_px(
        self, x_mm: float = 0.0, y_mm: float = 0.0, rotation_mrad: float = 0.0, z_mm: float = 0.0
    ) -> Grey:
        """The tags' corners from the top left one clockwise, (4, 4, 2)."""
        around = TAG_MM / 2 * np.array([(-1, 1), (1, 1), (1, -1), (-1, -1)])
        corners = (self.bench.circles_mm[:, None] + around).reshape(-1, 2)
        seen = np.c_[corners, np.ones(16)] @ self.bench.moved(x_mm, y_mm, rotation_mrad, z_mm).T
        return (seen[:, :2] / seen[:, 2:]).reshape(4, 4, 2)

    def boxes_px(
        self, x_mm: float = 0.0, y_mm: float = 0.0, rotation_mrad: float = 0.0, z_mm: float = 0.0
    ) -> Grey:
        corners = self.corners_px(x_mm, y_mm, rotation_mrad, z_mm)
        return np.concatenate([corners.min(axis=1), corners.max(axis=1)], axis=1)

    def still(
        self,
        x_mm: float = 0.0,
        y_mm: float = 0.0,
        rotation_mrad: float = 0.0,
        z_mm: float = 0.0,
        window: Window | None = None,
    ) -> Grey:
        """The picture without noise; pixels are means of FINE x FINE rays, then blurred."""
        bench = self.bench
        left, top, width, height = window or Window(0, 0, self.width_px, self.height_px)
        # Drawn with what the blur brings in from beyond.
        pad = 6
        left, top, width, height = left - pad, top - pad, width + 2 * pad, height + 2 * pad
        to_fine = np.array(
            [
                [FINE, 0, (FINE - 1) / 2 - FINE * left],
                [0, FINE, (FINE - 1) / 2 - FINE * top],
                [0, 0, 1],
            ]
        )
        size = (width * FINE, height * FINE)
        canvas = np.full(size[::-1], bench.white_grey, np.float32)
        seen = to_fine @ bench.moved(x_mm, y_mm, rotation_mrad, z_mm)
        for grey, (x, y) in zip(_tags(), bench.circles_mm, strict=True):
            drawn = (bench.black_grey + (bench.white_grey - bench.black_grey) * grey).astype("f4")
            dot = TAG_MM / len(grey)
            to_mm = np.array(
                [
                    [dot, 0, x - TAG_MM / 2 + dot / 2],
                    [0, -dot, y + TAG_MM / 2 - dot / 2],
                    [0, 0, 1],
                ]
            )
            cv2.warpPerspective(
                drawn,
                seen @ to_mm,
                size,
                dst=canvas,
                flags=cv2.INTER_LINEAR,
                borderMode=cv2.BORDER_TRANSPARENT,
            )
        light = cv2.resize(canvas, (width, height), interpolation=cv2.INTER_AREA)
        light = cv2.GaussianBlur(light, (0, 0), bench.blur_x_px, sigmaY=bench.blur_y_px)
        return light[pad:-pad, pad:-pad].astype(np.float64)


def _dictionary() -> cv2.aruco.Dictionary:
    return cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)


def _tags() -> list[Grey]:
    """Four tags with values from 0 to 1."""
    return [
        cv2.aruco.generateImageMarker(_dictionary(), tag, 20 * BITS) / 255.0 for tag in range(4)
    ]


class Corners:
    """Measures the displacement by the tags' corners."""

    def __init__(self, tags: Tags, windows: list[Window], stills: int) -> None:
        parameters = cv2.aruco.DetectorParameters()
        parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
        self._detector = cv2.aruco.ArucoDetector(_dictionary(), parameters)
        self._windows = windows
        self._stills = stills
        self._at_rest: list[Grey] = []
        around = TAG_MM / 2 * np.array([(-1, 1), (1, 1), (1, -1), (-1, -1)])
        self._corners_mm = (tags.bench.circles_mm[:, None] + around).reshape(-1, 2)
        self._back: Grey | None = None

    @property
    def measuring(self) -> bool:
        return self._back is not None

    def show(self, image: NDArray[np.uint8]) -> tuple[float, float] | None:
        """Return x_mm and y_mm; None before the reference, or where a tag is not found."""
        corners = self._found(image)
        if corners is None:
            return None
        if self._back is None:
            self._at_rest.append(corners)
            if len(self._at_rest) == self._stills:
                mean = np.mean(self._at_rest, axis=0)
                self._back = cv2.findHomography(mean, self._corners_mm, 0)[0]
                self._zero_mm = self._to_mm(mean)
            return None
        x, y = (self._to_mm(corners) - self._zero_mm).mean(axis=0).tolist()
        return x, y

    def _to_mm(self, points_px: Grey) -> Grey:
        assert self._back is not None
        return cv2.perspectiveTransform(points_px[None], self._back)[0]

    def _found(self, image: NDArray[np.uint8]) -> Grey | None:
        corners = []
        for tag, (left, top, width, height) in enumerate(self._windows):
            view = image[top : top + height, left : left + width]
            seen, ids, _ = self._detector.detectMarkers(view)
            found = [] if ids is None else ids.ravel().tolist()
            if tag not in found:
                return None
            own = seen[found.index(tag)][0]
            corners.append(own.astype(np.float64) + np.array([left, top]))
        return np.concatenate(corners)
