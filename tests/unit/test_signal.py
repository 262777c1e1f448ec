"""Pictures with and without a camera behind them."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from lab_picture import Lab, View, picture

from vdms_rt.capture.signal import Repeats, blank
from vdms_rt.model import Scan

RNG = np.random.default_rng(7)
PLAIN = Lab(clutter=None, noise=0.0, gradient=0.0)


def with_noise(grey: np.ndarray, sigma: float) -> np.ndarray:
    noisy = grey + RNG.normal(0, sigma, grey.shape)
    return np.clip(np.round(noisy), 0, 255).astype(np.uint8)


def snow() -> np.ndarray:
    """Noise as an analogue channel of limited bandwidth shows it: smooth along a row."""
    white = RNG.normal(0, 1, (480, 720)).astype(np.float32)
    along = cv2.blur(white, (5, 1))
    return np.clip(128 + 60 * along / along.std(), 0, 255).astype(np.uint8)


def bars() -> np.ndarray:
    return np.repeat(np.linspace(16, 235, 8), 90)[None, :].repeat(480, axis=0)


def in_black_borders(image: np.ndarray) -> np.ndarray:
    """A converter's frame is wider and higher than what the camera sends."""
    image = image.copy()
    image[:8] = image[-8:] = 16
    image[:, :12] = image[:, -12:] = 16
    return image


@pytest.mark.parametrize(
    ("image", "why"),
    [
        (np.full((480, 720), 16, np.uint8), "the picture is blank"),
        (in_black_borders(np.full((480, 720), 41, np.uint8)), "the picture is blank"),
        (with_noise(np.full((480, 720), 30.0), 3.0), "the picture is blank"),
        (in_black_borders(with_noise(bars(), 1.0)), "the picture is a test card"),
        (snow(), "the picture is noise"),
        (with_noise(np.full((240, 720), 128.0), 40.0), "the picture is noise"),
    ],
    ids=["black", "blue screen", "lens cap", "bars", "snow", "white noise in one field"],
)
def test_a_picture_without_a_camera(image, why):
    assert blank(image) == why


@pytest.mark.parametrize("fill", [1.0, 0.25, 0.1])
@pytest.mark.parametrize("noise", [0.5, 4.0, 12.0])
def test_a_marker_before_a_plain_wall_is_a_picture(fill, noise):
    # From one that fills the picture to one of a tenth of its height, before nothing else.
    grey = picture((replace(View(), px_per_mm=1.418 * fill),), PLAIN).astype(float)
    assert blank(with_noise(grey, noise)) == ""
    # Also one of its fields alone.
    assert blank(with_noise(grey[1::2], noise)) == ""


def test_a_dim_picture_in_strong_noise_is_a_picture():
    grey = picture((View(),), PLAIN).astype(float)
    assert blank(with_noise(30 + (grey - 30) * 0.3, 8.0)) == ""


def test_the_same_picture_twice_is_a_repeat():
    repeats = Repeats()
    first = with_noise(np.full((480, 720), 90.0), 1.0)
    second = with_noise(np.full((480, 720), 90.0), 1.0)
    seen = [repeats.seen(image, Scan.TOP_FIRST) for image in (first, second, second, first)]
    assert seen == [False, False, True, False]


def test_the_two_fields_of_alternating_ones_are_compared_each_with_its_own():
    repeats = Repeats()
    image = with_noise(np.full((240, 720), 90.0), 1.0)
    assert not repeats.seen(image, Scan.BOTTOM)
    assert not repeats.seen(image, Scan.TOP)
    assert repeats.seen(image, Scan.BOTTOM)
