"""Luma out of every arrangement of bytes that a driver may deliver."""

import cv2
import numpy as np
import pytest

from vdms_rt.capture import v4l2_api as api
from vdms_rt.capture.v4l2_luma import PixelLayout, decode_mjpg
from vdms_rt.model import Damage

WIDTH_PX, HEIGHT_PX = 24, 10


@pytest.fixture
def luma():
    rng = np.random.default_rng(7)
    return rng.integers(0, 256, (HEIGHT_PX, WIDTH_PX), np.uint8)


def buffer_of(rows: np.ndarray, pixel_format: str, padding: int) -> np.ndarray:
    """Bytes of a driver's buffer whose chroma and padding are not like its luma."""
    height, width = rows.shape
    pixel_bytes = 1 if pixel_format == "GREY" else 2
    buffer = np.full((height, width * pixel_bytes + padding), 201, np.uint8)
    at = 1 if pixel_format == "UYVY" else 0
    buffer[:, at : width * pixel_bytes : pixel_bytes] = rows
    return buffer.ravel()


@pytest.mark.parametrize("padding", [0, 40])
@pytest.mark.parametrize("pixel_format", ["YUYV", "UYVY", "GREY"])
def test_luma_of_uncompressed_formats(luma, pixel_format, padding):
    row = WIDTH_PX * (1 if pixel_format == "GREY" else 2)
    layout = PixelLayout(pixel_format, WIDTH_PX, HEIGHT_PX, row + padding, api.FIELD_INTERLACED)
    out = np.zeros_like(luma)
    layout.copy(layout.parts(buffer_of(luma, pixel_format, padding)), out)
    np.testing.assert_array_equal(out, luma)
    assert layout.needed_bytes == (HEIGHT_PX - 1) * (row + padding) + row


@pytest.mark.parametrize("pixel_format", ["YUYV", "GREY"])
@pytest.mark.parametrize(
    ("field", "first"), [(api.FIELD_SEQ_TB, 0), (api.FIELD_SEQ_BT, 1)], ids=["TB", "BT"]
)
def test_fields_one_after_the_other_are_woven(luma, pixel_format, field, first):
    sequential = np.concatenate([luma[first::2], luma[1 - first :: 2]])
    row = WIDTH_PX * (1 if pixel_format == "GREY" else 2)
    layout = PixelLayout(pixel_format, WIDTH_PX, HEIGHT_PX, row + 8, field)
    out = np.zeros_like(luma)
    layout.copy(layout.parts(buffer_of(sequential, pixel_format, 8)), out)
    np.testing.assert_array_equal(out, luma)


def test_copy_follows_the_buffer_and_fills_a_slot_of_a_larger_array(luma):
    layout = PixelLayout("YUYV", WIDTH_PX, HEIGHT_PX, 2 * WIDTH_PX, api.FIELD_NONE)
    buffer = buffer_of(luma, "YUYV", 0)
    parts = layout.parts(buffer)
    slots = np.zeros((3, HEIGHT_PX, WIDTH_PX), np.uint8)
    layout.copy(parts, slots[1])
    buffer[0] ^= 0xFF
    layout.copy(parts, slots[2])
    np.testing.assert_array_equal(slots[1], luma)
    assert not slots[0].any()
    assert slots[2, 0, 0] == luma[0, 0] ^ 0xFF
    np.testing.assert_array_equal(slots[2].ravel()[1:], luma.ravel()[1:])


@pytest.fixture
def picture():
    """A smooth picture in colour, and its luma, 8-bit BT.601 as JPEG has it."""
    rng = np.random.default_rng(3)
    colours = cv2.GaussianBlur(rng.integers(0, 256, (48, 64, 3), np.uint8), (0, 0), 3)
    return colours, cv2.cvtColor(colours, cv2.COLOR_BGR2YCrCb)[..., 0]


def jpeg(colours: np.ndarray) -> np.ndarray:
    return cv2.imencode(".jpg", colours, [cv2.IMWRITE_JPEG_QUALITY, 100])[1].ravel()


def without_huffman_tables(data: np.ndarray) -> np.ndarray:
    """The same picture as USB cameras send it: they leave the standard tables out."""
    raw = data.tobytes()
    kept, at = raw[:2], 2
    while raw[at + 1] != 0xDA:
        end = at + 2 + int.from_bytes(raw[at + 2 : at + 4], "big")
        kept += raw[at:end] if raw[at + 1] != 0xC4 else b""
        at = end
    return np.frombuffer(kept + raw[at:], np.uint8)


@pytest.mark.parametrize("strip", [False, True], ids=["with tables", "without tables"])
def test_luma_of_mjpg(picture, strip):
    colours, luma = picture
    data = jpeg(colours)
    if strip:
        bare = without_huffman_tables(data)
        assert len(bare) < len(data)
        data = bare
    out = np.zeros_like(luma)
    assert decode_mjpg(data, api.FIELD_NONE, out) == Damage.NONE
    assert np.abs(out.astype(int) - luma).max() <= 1


def test_mjpg_with_padding_behind_it(picture):
    colours, luma = picture
    out = np.zeros_like(luma)
    data = np.concatenate([jpeg(colours), np.zeros(100, np.uint8)])
    assert decode_mjpg(data, api.FIELD_NONE, out) == Damage.NONE
    assert np.abs(out.astype(int) - luma).max() <= 1


@pytest.mark.parametrize("kind", ["empty", "cut short", "not a picture", "another size"])
def test_broken_mjpg_is_flagged_and_black(picture, kind):
    colours, luma = picture
    whole = jpeg(colours)
    data = {
        "empty": whole[:0],
        "cut short": whole[:-20],
        "not a picture": np.full(500, 17, np.uint8),
        "another size": jpeg(colours[:32]),
    }[kind]
    out = np.full_like(luma, 99)
    assert decode_mjpg(data, api.FIELD_NONE, out) == Damage.FLAGGED
    assert not out.any()
