"""Pictures for people: PNG and JPEG, arrays to bytes and back.

Region pixels in the log need no codec of their own: `wire.convert.pixels_bytes` copies them, and
the log's chunks compress them (docs/decisions/0001-region-pixels.md).
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from vdms_rt.model import Luma

# A picture that cannot be read is told in our own words.
cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_ERROR)


def png(image: NDArray[np.uint8]) -> bytes:
    """Return `image`, (height, width) grey or (height, width, 3) blue-green-red, as a PNG."""
    return _encoded(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 6])


def jpeg(image: NDArray[np.uint8], quality: int) -> bytes:
    """Return `image`, (height, width) grey or (height, width, 3) blue-green-red, as a JPEG.

    `quality` is 0 to 100.
    """
    return _encoded(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])


def narrowed(image: Luma, most_width_px: int) -> Luma:
    """Return the picture, made smaller if it is wider than `most_width_px` (0: as it is)."""
    height_px, width_px = image.shape
    if not 0 < most_width_px < width_px:
        return image
    size = most_width_px, max(round(height_px * most_width_px / width_px), 1)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


def picture_from(data: bytes) -> Luma | None:
    """Return the luma (height, width) of a picture file's bytes, or None if they are not one."""
    decoded = decode_picture(data)
    return None if decoded is None else decoded[0]


def decode_picture(data: bytes) -> tuple[Luma, bool] | None:
    """Return the luma (height, width) of a picture file's bytes and whether it is as it stands in
    the file; None if they are not a picture.

    Eight-bit grey comes back as it is. Colour becomes luma by Rec. 601 (.299 R + .587 G + .114 B,
    as OpenCV rounds it), and 16 bits become 8 by division by 257, to the nearest level.
    """
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED) if data else None
    if image is None:
        return None
    if image.dtype not in (np.uint8, np.uint16):
        return None
    return luma(image), image.ndim == 2 and image.dtype == np.uint8


def luma(image: NDArray[Any]) -> Luma:
    """Return the luma (height, width) of a grey or blue-green-red(-alpha) image of 8 or 16 bits."""
    if image.dtype == np.uint16:
        image = ((image.astype(np.uint32) + 128) // 257).astype(np.uint8)
    if image.ndim == 3:
        from_colour = cv2.COLOR_BGRA2GRAY if image.shape[2] == 4 else cv2.COLOR_BGR2GRAY
        image = cv2.cvtColor(image, from_colour)
    return np.asarray(image, np.uint8)


def _encoded(suffix: str, image: NDArray[np.uint8], settings: list[int]) -> bytes:
    done, data = cv2.imencode(suffix, image, settings)
    assert done
    return data.tobytes()
