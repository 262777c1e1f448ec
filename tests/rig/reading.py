"""Reading from a source as the capture thread does, for tests."""

import numpy as np

from vdms_rt.capture.v4l2 import V4l2Source
from vdms_rt.model import Grab, Luma, SourceError

TIMEOUT_S = 5.0


def new_image(source: V4l2Source) -> Luma:
    return np.empty((source.info.height_px, source.info.width_px), np.uint8)


def take(source: V4l2Source, count: int) -> tuple[list[Luma], list[Grab]]:
    """Return the next images, one array each, and what the driver says of them."""
    images, grabs = [], []
    for _ in range(count):
        image = new_image(source)
        grab = source.read(image, TIMEOUT_S)
        assert grab is not None
        images.append(image)
        grabs.append(grab)
    return images, grabs


def take_known(
    source: V4l2Source, pictures: np.ndarray, count: int
) -> tuple[list[int], list[Grab]]:
    """Return which of the pictures, (n, height, width, 2) in YUYV, each image is byte for byte,
    and what the driver says of it; fails on an image that is none of them."""
    numbers = {luma.tobytes(): number for number, luma in enumerate(pictures[..., 0])}
    image = new_image(source)
    seen, grabs = [], []
    for _ in range(count):
        grab = source.read(image, TIMEOUT_S)
        assert grab is not None
        seen.append(numbers[image.tobytes()])
        grabs.append(grab)
    return seen, grabs


def skip_to_known(source: V4l2Source, pictures: np.ndarray) -> None:
    """Read until an image is one of the pictures: a device may begin with something else."""
    lumas = {luma.tobytes() for luma in pictures[..., 0]}
    image = new_image(source)
    for _ in range(100):
        assert source.read(image, TIMEOUT_S) is not None
        if image.tobytes() in lumas:
            return
    raise AssertionError("100 images, and none of them was sent")


def last_words(source: V4l2Source) -> str:
    """Return the sentence with which a source that is gone stops, after what it still holds."""
    image = new_image(source)
    try:
        for _ in range(100):
            assert source.read(image, TIMEOUT_S) is not None
    except SourceError as error:
        return str(error)
    raise AssertionError("the source goes on")
