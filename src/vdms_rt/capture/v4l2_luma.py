"""Luma out of a driver's buffer, without an allocation for a frame."""

from __future__ import annotations

import mmap
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from vdms_rt.capture import v4l2_api as api
from vdms_rt.model import Damage, Luma

_BYTES_PER_PIXEL = {"YUYV": 2, "UYVY": 2, "GREY": 1}
_LUMA_BYTE = {"YUYV": 0, "UYVY": 1}
_EVERY_ROW = slice(None)
_TOP, _BOTTOM = slice(0, None, 2), slice(1, None, 2)

Part = tuple[NDArray[np.uint8], slice]
"""Pixels as they lie in a buffer, (rows, width[, bytes per pixel]), and the image rows they are."""


@dataclass(frozen=True, slots=True)
class PixelLayout:
    """How the pixels of an image lie in a buffer."""

    pixel_format: str
    """YUYV, UYVY, GREY or MJPG."""
    width_px: int
    height_px: int
    bytes_per_row: int
    """With padding; of no meaning for MJPG."""
    field: int
    """V4L2_FIELD_*: two fields may lie one after the other."""

    @property
    def needed_bytes(self) -> int:
        """Bytes from the first pixel to the last; 0 for MJPG, which has no fixed size."""
        pixel_bytes = _BYTES_PER_PIXEL.get(self.pixel_format, 0)
        if not pixel_bytes:
            return 0
        return (self.height_px - 1) * self.bytes_per_row + self.width_px * pixel_bytes

    def parts(self, buffer: mmap.mmap | NDArray[np.uint8]) -> tuple[Part, ...]:
        """Return views of an uncompressed buffer that together are the whole image."""
        pixel_bytes = _BYTES_PER_PIXEL[self.pixel_format]
        shape = (self.height_px, self.width_px, pixel_bytes)
        steps = (self.bytes_per_row, pixel_bytes, 1)
        pixels = np.ndarray(shape, np.uint8, buffer, strides=steps)
        return woven(pixels if pixel_bytes > 1 else pixels[..., 0], self.field)

    def copy(self, parts: tuple[Part, ...], out: Luma) -> None:
        """Copy the luma of `parts` into `out`, (height_px, width_px)."""
        channel = _LUMA_BYTE.get(self.pixel_format)
        for pixels, rows in parts:
            if channel is None:
                np.copyto(out[rows], pixels)
            else:
                cv2.extractChannel(pixels, channel, dst=out[rows])


def woven(pixels: NDArray[np.uint8], field: int) -> tuple[Part, ...]:
    """Return which rows of the frame the rows of a buffer are."""
    half = len(pixels) // 2
    if field == api.FIELD_SEQ_TB:
        return (pixels[:half], _TOP), (pixels[half:], _BOTTOM)
    if field == api.FIELD_SEQ_BT:
        return (pixels[:half], _BOTTOM), (pixels[half:], _TOP)
    return ((pixels, _EVERY_ROW),)


def decode_mjpg(data: NDArray[np.uint8], field: int, out: Luma) -> Damage:
    """Decode the luma of one JPEG picture into `out` and return what is wrong with it.

    A picture that is cut short, cannot be decoded or has another size leaves `out` black.
    """
    mode = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION
    picture = cv2.imdecode(data, mode) if data.size else None
    if picture is None or picture.shape != out.shape:
        out[:] = 0
        return Damage.FLAGGED
    for pixels, rows in woven(np.asarray(picture, np.uint8), field):
        np.copyto(out[rows], pixels)
    return Damage.NONE
