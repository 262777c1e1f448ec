"""Where a circle's centre is in the picture."""

from __future__ import annotations

import math

import cv2
import numpy as np

from vdms_rt.model import Circle, CircleFlag, Luma, Region

MIN_CONTRAST_GREY = 15.0
"""Below this there is no circle: Otsu's two halves of mere noise lie 1.6 of its standard deviations
apart, 6 grey levels for the noisiest picture in use."""
MIN_AREA_PX = 20.0
MAX_AREA_PART = 0.8
"""Of the region. An ellipse that does not touch the border fills at most pi/4 of it."""

OTSU_MOVING_PX = 0.05
"""Standard deviation of a coordinate of `otsu_circle` while the circle moves across the pixels, for
circles of 30 to 80 px: each edge pixel counts whole or not at all."""

_INDEX = np.arange(8192, dtype=np.float64)


def otsu_circle(
    image: Luma, region: Region, white: bool, row_offset: int = 0, row_step: int = 1
) -> Circle:
    """Return the circle in a region as Lee, Cho and Sim (2015) measure it: the mean coordinates of
    the pixels on the circle's side of Otsu's threshold.

    `image` is a whole frame, or one field of it: its row r is then row `row_offset + r * row_step`
    of the frame. `region` and the result are in pixels of the whole frame; the area of a field's
    circle is its number of pixels times `row_step`. `white` says that the circle is brighter than
    its surroundings; `contrast` is the difference of the two classes' mean grey levels.

    A circle that is LOST (too little contrast, an area that no circle in the region has) has NaN
    coordinates. One with pixels in the outermost row or column of the region, or of the part of it
    that lies in the picture, is flagged BORDER: what was cut off moves the mean unseen.
    """
    left, right = max(region.x_px, 0), min(region.x_px + region.width_px, image.shape[1])
    top = max(-((row_offset - region.y_px) // row_step), 0)
    bottom = min(-((row_offset - region.y_px - region.height_px) // row_step), image.shape[0])
    if right - left < 3 or bottom - top < 3:
        return _lost(0.0, 0.0)
    view = image[top:bottom, left:right]
    kind = cv2.THRESH_BINARY if white else cv2.THRESH_BINARY_INV
    level, mask = cv2.threshold(view, 0, 1, kind | cv2.THRESH_OTSU)
    # Sums along one axis are the cheapest way to the first moments: exact integers below 2^53.
    columns = cv2.reduce(mask, 0, cv2.REDUCE_SUM, dtype=cv2.CV_32S)[0]
    rows = cv2.reduce(mask, 1, cv2.REDUCE_SUM, dtype=cv2.CV_32S)[:, 0]
    pixels = int(columns.sum())
    area_px = float(pixels * row_step)
    if pixels in (0, view.size):
        return _lost(area_px, 0.0)

    bright = cv2.threshold(view, level, 0, cv2.THRESH_TOZERO)[1]
    bright_sum, total = cv2.sumElems(bright)[0], cv2.sumElems(view)[0]
    bright_pixels = pixels if white else view.size - pixels
    contrast = bright_sum / bright_pixels - (total - bright_sum) / (view.size - bright_pixels)
    if contrast < MIN_CONTRAST_GREY or area_px < MIN_AREA_PX or pixels > MAX_AREA_PART * view.size:
        return _lost(area_px, contrast)

    at_border = columns[0] or columns[-1] or rows[0] or rows[-1]
    x = float(columns @ _INDEX[: right - left]) / pixels
    y = float(rows @ _INDEX[: bottom - top]) / pixels
    return Circle(
        x_px=left + x,
        y_px=row_offset + row_step * (top + y),
        area_px=area_px,
        contrast=contrast,
        flags=CircleFlag.BORDER if at_border else CircleFlag.NONE,
    )


def otsu_semi_axes(
    image: Luma, region: Region, white: bool, row_offset: int = 0, row_step: int = 1
) -> tuple[float, float]:
    """Return half the extent along x and along y of the circle's picture in a region, in pixels of
    the whole frame, from the second moments of the pixels on the circle's side of the threshold.

    The arguments are those of `otsu_circle`, which must have found the circle.
    """
    left, top = max(region.x_px, 0), max(-((row_offset - region.y_px) // row_step), 0)
    bottom = -((row_offset - region.y_px - region.height_px) // row_step)
    view = image[top : max(bottom, 0), left : max(region.x_px + region.width_px, 0)]
    kind = cv2.THRESH_BINARY if white else cv2.THRESH_BINARY_INV
    _, mask = cv2.threshold(view, 0, 1, kind | cv2.THRESH_OTSU)
    m = cv2.moments(mask, binaryImage=True)
    return (
        2 * math.sqrt(max(m["mu20"] / m["m00"], 0.25)),
        2 * row_step * math.sqrt(max(m["mu02"] / m["m00"], 0.25)),
    )


def _lost(area_px: float, contrast: float) -> Circle:
    return Circle(math.nan, math.nan, area_px, contrast, CircleFlag.LOST)
