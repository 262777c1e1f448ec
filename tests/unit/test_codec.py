"""Pictures to bytes and back, and the pixels that go into the log without loss."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from vdms_rt import codec
from vdms_rt.model import Damage, Frame, Region, Scan
from vdms_rt.wire import vdms_pb2 as pb
from vdms_rt.wire.convert import paste_pixels, pixels_bytes

RANDOM = np.random.default_rng(3)


def frame_of(image, scan=Scan.PROGRESSIVE):
    return Frame(
        seq=7,
        stamp_ns=11,
        t_ns=12,
        sigma_t_ns=13,
        utc_ns=14,
        segment=2,
        period_ns=33_366_667,
        image=image,
        scan=scan,
        damage=Damage.SHORT,
    )


def noise(height, width):
    return RANDOM.integers(0, 256, (height, width), dtype=np.uint8)


def test_a_grey_picture_comes_back_as_it_was():
    image = noise(48, 61)
    assert np.array_equal(codec.picture_from(codec.png(image)), image)
    pgm = cv2.imencode(".pgm", image)[1].tobytes()
    decoded, exact = codec.decode_picture(pgm)
    assert exact
    assert np.array_equal(decoded, image)


def test_colour_becomes_luma_by_rec_601():
    colour = RANDOM.integers(0, 256, (40, 50, 3), dtype=np.uint8)
    luma, exact = codec.decode_picture(codec.png(colour))
    expected = colour @ np.array([0.114, 0.587, 0.299])
    assert not exact
    assert np.abs(luma - expected).max() <= 0.51
    opaque = np.dstack([colour, np.full((40, 50), 255, np.uint8)])
    assert np.array_equal(codec.picture_from(cv2.imencode(".png", opaque)[1].tobytes()), luma)


def test_sixteen_bits_become_eight():
    deep = RANDOM.integers(0, 65536, (40, 50), dtype=np.uint16)
    luma, exact = codec.decode_picture(cv2.imencode(".png", deep)[1].tobytes())
    assert not exact
    assert np.abs(luma - deep / 257).max() <= 0.5


def test_a_jpeg_is_smaller_and_close():
    image = cv2.GaussianBlur(noise(120, 160), (0, 0), 4)
    data = codec.jpeg(image, 80)
    assert data[:2] == b"\xff\xd8"
    assert len(data) < len(codec.png(image)) / 2
    assert np.abs(codec.picture_from(data).astype(int) - image).mean() < 2


@pytest.mark.parametrize("data", [b"", b"not a picture", codec.png(noise(90, 90))[:300]])
def test_bytes_that_are_no_picture(data):
    assert codec.picture_from(data) is None


def test_regions_come_back_without_loss_and_black_around_them():
    image = noise(100, 140)
    regions = ((Region(10, 20, 30, 25), Region(90, 60, 30, 30)), (Region(50, 5, 12, 11),))
    message = pb.Pixels.FromString(pixels_bytes(frame_of(image), ("a", "b"), regions, 5, False))
    assert [(p.marker, p.circle) for p in message.patches] == [("a", 0), ("a", 1), ("b", 0)]
    assert (message.frame_seq, message.stamp_ns, message.t_ns) == (7, 11, 12)
    assert (message.sigma_t_ns, message.utc_ns, message.segment) == (13, 14, 2)
    assert (message.setup_revision, message.damage, message.period_ns) == (5, 2, 33_366_667)
    out = noise(100, 140)
    paste_pixels(message, out)
    expected = np.zeros_like(image)
    for region in (*regions[0], *regions[1]):
        rows = slice(region.y_px, region.y_px + region.height_px)
        columns = slice(region.x_px, region.x_px + region.width_px)
        expected[rows, columns] = image[rows, columns]
    assert np.array_equal(out, expected)


def test_regions_are_cut_to_the_picture():
    image = noise(50, 60)
    regions = ((Region(-5, -7, 20, 20), Region(50, 40, 30, 30), Region(100, 10, 10, 10)),)
    message = pb.Pixels.FromString(pixels_bytes(frame_of(image), ("m",), regions, 1, False))
    assert [(p.circle, p.x_px, p.y_px, p.width_px, p.height_px) for p in message.patches] == [
        (0, 0, 0, 15, 13),
        (1, 50, 40, 10, 10),
    ]
    out = np.empty_like(image)
    paste_pixels(message, out)
    assert np.array_equal(out[:13, :15], image[:13, :15])
    assert np.array_equal(out[40:, 50:], image[40:, 50:])


def test_nothing_to_copy_is_empty():
    frame = frame_of(noise(50, 60))
    assert pixels_bytes(frame, ("m",), (), 1, False) == b""
    assert pixels_bytes(frame, ("m",), ((Region(70, 0, 5, 5),),), 1, False) == b""


@pytest.mark.parametrize("scan", list(Scan))
def test_a_whole_image_comes_back_as_it_was(scan):
    image = noise(31, 43)
    message = pb.Pixels.FromString(pixels_bytes(frame_of(image, scan), ("m",), (), 0, True))
    out = noise(31, 43)
    paste_pixels(message, out)
    assert np.array_equal(out, image)
    assert message.patches[0].marker == ""


@pytest.mark.parametrize(("scan", "offset"), [(Scan.TOP, 0), (Scan.BOTTOM, 1)])
def test_of_a_single_field_a_region_holds_every_second_row(scan, offset):
    whole = noise(60, 40)
    field = np.ascontiguousarray(whole[offset::2])
    regions = ((Region(5, 11, 20, 17),),)
    message = pb.Pixels.FromString(pixels_bytes(frame_of(field, scan), ("m",), regions, 1, False))
    (patch,) = message.patches
    assert patch.row_step == 2
    assert patch.y_px % 2 == offset
    rows = [row for row in range(11, 28) if row % 2 == offset]
    assert (patch.y_px, patch.height_px) == (rows[0], len(rows))
    assert patch.data == whole[rows, 5:25].tobytes()
    out = np.empty_like(field)
    paste_pixels(message, out)
    first = (rows[0] - offset) // 2
    assert np.array_equal(out[first : first + len(rows), 5:25], whole[rows, 5:25])
    assert not out[:first].any()


@pytest.mark.parametrize(
    ("patch", "phrase"),
    [
        ({"codec": "magic"}, "codec 'magic'"),
        ({"x_px": 35}, "does not fit"),
        ({"y_px": 28}, "does not fit"),
        ({"row_step": 2}, "does not fit"),
        ({"data": b"123"}, "does not fit"),
    ],
)
def test_patches_that_cannot_be_pasted_are_told(patch, phrase):
    good = {"width_px": 10, "height_px": 5, "row_step": 1, "codec": "raw8", "data": bytes(50)}
    message = pb.Pixels(width_px=40, height_px=30, patches=[pb.Patch(**{**good, **patch})])
    with pytest.raises(ValueError, match=phrase):
        paste_pixels(message, np.empty((30, 40), np.uint8))
