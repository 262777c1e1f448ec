"""Whether a camera is at the grabber's input: the driver's word, and what the pictures show.

Drivers differ. Without a signal stk1160 and em28xx detect no standard (QUERYSTD), cx231xx says so
of its input (ENUMINPUT), usbtv says nothing; they give noise, a blank, or no frames at all.
Converters of the UVC class show a blank or a test card.
"""

from __future__ import annotations

from ctypes import c_uint64
from dataclasses import dataclass
from enum import Enum

import cv2
import numpy as np

from vdms_rt.capture import v4l2_api as api
from vdms_rt.capture.v4l2_settings import detected_standard
from vdms_rt.model import Luma, Scan

_ABSENT = (
    api.IN_ST_NO_POWER
    | api.IN_ST_NO_SIGNAL
    | api.IN_ST_NO_H_LOCK
    | api.IN_ST_NO_V_LOCK
    | api.IN_ST_NO_SYNC
)
_SMALL = (24, 16)
"""Columns and rows to which a picture's middle is reduced: its noise is averaged away."""
ALIKE_GREY = 4
"""Rows, or all of the picture, that differ by no more are alike: rounding and hum."""
SNOW_GREY = 10.0
SNOW_CORRELATION = 0.3
"""Of a row with the next of its field. Of what a camera sees it is 0.9 and more, of noise 0."""
SNOW_EVEN = 2.0
"""Range of the reduced picture over the standard deviation of its pixels: of white noise 0.3, of
noise that is smooth along a row 0.6, of a picture with anything in it 2 and more."""


class Word(Enum):
    """What a driver says of the signal."""

    PRESENT = "present"
    ABSENT = "absent"
    UNKNOWN = "unknown"
    """It cannot tell, as most cannot."""


@dataclass(frozen=True, slots=True)
class DriverSignal:
    word: Word
    standard: str = ""
    """By its name in the configuration, where the driver detects it."""


def driver_signal(fd: int, input_index: int) -> DriverSignal:
    """Return what the driver of an open node says of the signal at the input in use."""
    word = Word.UNKNOWN
    one = api.Input(index=input_index)
    if _answered(fd, api.VIDIOC_ENUMINPUT, one) and one.status & _ABSENT:
        return DriverSignal(Word.ABSENT)
    detected = c_uint64()
    if not _answered(fd, api.VIDIOC_QUERYSTD, detected):
        return DriverSignal(word)
    if not detected.value:
        return DriverSignal(Word.ABSENT)
    standard = detected_standard(detected.value)
    return DriverSignal(Word.PRESENT if standard else word, standard)


def _answered(fd: int, request: int, argument: api.Argument) -> bool:
    try:
        api.ioctl(fd, request, argument)
    except OSError:
        return False
    return True


def blank(image: Luma) -> str:
    """Return why a picture, (height, width), is no camera's; empty if it may be one."""
    height, width = image.shape
    # The outermost columns and rows of a converter are black whatever the picture is.
    middle = image[height // 10 : height - height // 10, width // 10 : width - width // 10]
    small = cv2.resize(middle, _SMALL, interpolation=cv2.INTER_AREA)
    if int(np.ptp(small)) <= ALIKE_GREY:
        return "the picture is blank"
    if int(np.ptp(small, axis=0).max()) <= ALIKE_GREY:
        return "the picture is a test card"
    rows = middle[0:-2:16, ::8].astype(np.float32)
    deviation = float(rows.std())
    if deviation > SNOW_GREY and np.ptp(small) < SNOW_EVEN * deviation:
        below = middle[2::16, ::8][: len(rows)].astype(np.float32)
        if np.corrcoef(rows.ravel(), below.ravel())[0, 1] < SNOW_CORRELATION:
            return "the picture is noise"
    return ""


class Repeats:
    """Tells a picture that is the one before, delivered once more: a camera's noise makes every
    picture differ from every other. Used by the capture thread alone."""

    def __init__(self) -> None:
        self._before: dict[Scan, bytes] = {}

    def seen(self, image: Luma, scan: Scan) -> bool:
        """Return whether a picture is the same as the last one of its scan."""
        sample = image[::4, ::8].tobytes()
        same = self._before.get(scan) == sample
        self._before[scan] = sample
        return same
