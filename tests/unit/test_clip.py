"""Clips: the luma that stands in the file, the order and time of pictures, and bad input."""

from __future__ import annotations

import contextlib
import time
from fractions import Fraction

import cv2
import numpy as np
import pytest
from clips import noise, smooth, uyvy, write_avi, write_h264, write_video, write_y4m, yuy2

from vdms_rt.capture.clip import ClipSource
from vdms_rt.config import Clip
from vdms_rt.model import Damage, Scan, SourceEnded, SourceError, StampEvent


def opened(path, **settings):
    return contextlib.closing(ClipSource(Clip(path=str(path), **{"pace": "fast", **settings})))


def read_all(source):
    """Return [(grab, image)] and what the source said at its end."""
    found = []
    while True:
        image = np.full((source.info.height_px, source.info.width_px), 77, np.uint8)
        try:
            grab = source.read(image, 5.0)
        except SourceEnded as end:
            return found, str(end)
        assert grab is not None
        found.append((grab, image))


def images_in(path, **settings):
    with opened(path, **settings) as source:
        return [image for _, image in read_all(source)[0]]


def same(found, given):
    return len(found) == len(given) and all(map(np.array_equal, found, given))


def fact(source, name):
    return dict(source.info.facts)[name]


def write_folder(directory, images, names):
    directory.mkdir()
    for image, name in zip(images, names, strict=True):
        assert cv2.imwrite(str(directory / name), image)
    return directory


@pytest.mark.parametrize(
    ("name", "fourcc", "colour"),
    [
        ("grey.mkv", "FFV1", False),
        ("grey.avi", "FFV1", False),
        ("colour.mkv", "FFV1", True),
        ("huffyuv-rgb.avi", "HFYU", True),
        ("png.avi", "MPNG", False),
        ("raw.avi", "Y800", False),
    ],
)
def test_lossless_video_gives_the_luma_that_was_written(tmp_path, name, fourcc, colour):
    given = noise(5)
    path = write_video(tmp_path / name, given, fourcc, colour=colour)
    with opened(path) as source:
        found, end = read_all(source)
        facts = dict(source.info.facts)
    assert same([image for _, image in found], given)
    assert end == f"clip {name} ended after 5 frames"
    assert "warning" not in facts
    assert (facts["luma"] == "exact") is not colour


@pytest.mark.parametrize("chroma", ["420", "422", "444", "mono"])
@pytest.mark.parametrize("extra", ["", " XCOLORRANGE=FULL", " XCOLORRANGE=LIMITED"])
def test_uncompressed_planar_video_gives_its_luma_at_any_range(tmp_path, chroma, extra):
    given = noise(3)
    path = write_y4m(tmp_path / "clip.y4m", given, chroma, extra)
    assert same(images_in(path), given)


@pytest.mark.parametrize(("fourcc", "pack"), [(b"YUY2", yuy2), (b"UYVY", uyvy)])
def test_uncompressed_packed_video_gives_its_luma(tmp_path, fourcc, pack):
    given = noise(3)
    frames = [pack(image) for image in given]
    path = write_avi(tmp_path / "clip.avi", frames, (64, 48), fourcc, 16)
    with opened(path) as source:
        found, _ = read_all(source)
        assert fact(source, "codec") == "uncompressed"
        assert fact(source, "luma") == "exact"
    assert same([image for _, image in found], given)


@pytest.mark.parametrize(("fourcc", "pixels"), [("FFVH", "I420"), ("HFYU", "Y42B")])
def test_lossless_yuv_video_gives_its_y_plane(tmp_path, fourcc, pixels):
    # The writer makes limited-range YUV of grey: level g becomes 16 + g * 219 / 255.
    given = smooth(3)
    path = write_video(tmp_path / "clip.avi", given, fourcc)
    with opened(path) as source:
        found, _ = read_all(source)
        assert fact(source, "pixel format") == pixels
        assert fact(source, "luma").startswith("Y plane")
    for (_, image), expected in zip(found, given, strict=True):
        assert np.abs(image - (16 + expected * (219 / 255))).max() <= 1


@pytest.mark.parametrize("full_range", [False, True])
def test_lossless_h264_gives_its_y_plane(tmp_path, full_range):
    given = noise(3)
    path = write_h264(tmp_path / "clip.h264", given, full_range=full_range)
    with opened(path) as source:
        found, _ = read_all(source)
        assert (fact(source, "luma") == "exact") is full_range
        assert fact(source, "warning") == "h264 is lossy unless it was made without loss"
    assert same([image for _, image in found], given)


def test_sixteen_bits_become_eight(tmp_path):
    given = [image.astype(np.uint16) * 257 for image in noise(3)]
    path = write_video(tmp_path / "deep.mkv", given)
    with opened(path) as source:
        found, _ = read_all(source)
        assert fact(source, "luma") == "16 bits made 8"
    assert same([image for _, image in found], noise(3))


def test_a_lossy_video_is_read_with_a_warning(tmp_path):
    given = smooth(3)
    path = write_video(tmp_path / "clip.avi", given, "MJPG")
    with opened(path) as source:
        found, _ = read_all(source)
        assert fact(source, "warning").startswith("mjpg is lossy")
    assert len(found) == 3
    assert np.corrcoef(found[0][1].ravel(), given[0].ravel())[0, 1] > 0.99


def test_uncompressed_rgb_is_refused_with_the_remedy(tmp_path):
    path = write_avi(tmp_path / "clip.avi", [bytes(64 * 48 * 3)] * 2, (64, 48), bytes(4), 24)
    with pytest.raises(SourceError) as caught:
        ClipSource(Clip(path=str(path)))
    assert "ffmpeg -i clip.avi -c:v ffv1 -pix_fmt gray new.mkv" in str(caught.value)


def test_stamps_are_the_index_by_the_rate(tmp_path):
    path = write_video(tmp_path / "clip.mkv", noise(4))
    with opened(path, field_order="top-first") as source:
        info = source.info
        found, _ = read_all(source)
    assert info.frame_period_s == Fraction(1001, 30000)
    assert info.scan is Scan.TOP_FIRST
    assert info.scan_known
    assert not info.live
    assert info.sequence_counts_lost
    assert info.stamp_event is StampEvent.MID_EXPOSURE
    grabs = [grab for grab, _ in found]
    assert [grab.stamp_ns for grab in grabs] == [8_341_667, 41_708_333, 75_075_000, 108_441_667]
    assert [grab.sequence for grab in grabs] == [0, 1, 2, 3]
    assert {(grab.scan, grab.damage, grab.tick) for grab in grabs} == {
        (Scan.TOP_FIRST, Damage.NONE, None)
    }


def test_a_loop_goes_on_counting(tmp_path):
    given = noise(3)
    for path in (
        write_video(tmp_path / "clip.mkv", given),
        write_folder(tmp_path / "folder", given, ["a.png", "b.png", "c.png"]),
    ):
        image = np.empty((48, 64), np.uint8)
        with opened(path, loop=True, rate_hz=25) as source:
            for index in range(8):
                grab = source.read(image, 1.0)
                assert grab.sequence == index
                assert grab.stamp_ns == index * 40_000_000
                assert np.array_equal(image, given[index % 3])


def test_at_realtime_pictures_come_at_their_own_pace(tmp_path):
    path = write_video(tmp_path / "clip.mkv", noise(3))
    image = np.empty((48, 64), np.uint8)
    with opened(path, pace="realtime", rate_hz=5) as source:
        assert source.info.live
        before_ns = time.monotonic_ns()
        first = source.read(image, 0.5)
        assert before_ns <= first.stamp_ns <= time.monotonic_ns()
        assert source.read(image, 0.01) is None
        found, _ = read_all(source)
    assert [grab.stamp_ns - first.stamp_ns for grab, _ in found] == [200_000_000, 400_000_000]
    assert time.monotonic_ns() >= found[-1][0].stamp_ns
    assert same([image for _, image in found], noise(3)[1:])


def test_a_folder_is_read_in_the_order_of_its_numbers(tmp_path):
    given = noise(4)
    folder = write_folder(
        tmp_path / "folder", given, ["img10.png", "img2.png", "img1.pgm", "x2img3.PNG"]
    )
    (folder / "notes.txt").write_text("not a picture")
    with opened(folder) as source:
        found, end = read_all(source)
        assert fact(source, "pictures") == "4"
        assert fact(source, "luma") == "exact"
    assert same([image for _, image in found], [given[2], given[1], given[0], given[3]])
    assert end == "clip folder ended after 4 frames"


def test_one_picture_is_a_clip_too(tmp_path):
    folder = write_folder(tmp_path / "folder", noise(2), ["a.png", "b.png"])
    assert same(images_in(folder / "b.png"), noise(2)[1:])


def test_colour_pictures_become_luma_and_it_is_said(tmp_path):
    colour = np.random.default_rng(5).integers(0, 256, (48, 64, 3), dtype=np.uint8)
    folder = write_folder(tmp_path / "folder", [colour], ["a.png"])
    with opened(folder) as source:
        ((_, image),), _ = read_all(source)
        assert "Rec. 601" in fact(source, "luma")
    assert np.abs(image - colour @ np.array([0.114, 0.587, 0.299])).max() <= 0.51


def test_bad_clips_are_told_in_one_sentence(tmp_path):
    (tmp_path / "empty").mkdir()
    (tmp_path / "text.mkv").write_text("this is no video")
    (tmp_path / "nothing.avi").write_bytes(b"")
    broken = write_folder(tmp_path / "broken", noise(1), ["a.png"])
    (broken / "a.png").write_bytes((broken / "a.png").read_bytes()[:100])
    for path, phrase in (
        (tmp_path / "none.mkv", "no such file or directory"),
        (tmp_path / "empty", "a folder without PNG or PGM pictures"),
        (tmp_path / "text.mkv", "not a video that can be read"),
        (tmp_path / "nothing.avi", "not a video that can be read"),
        (broken, "a.png: not a picture that can be read"),
        (tmp_path / "text.mkv" / "below", "not a directory"),
    ):
        with pytest.raises(SourceError) as caught:
            ClipSource(Clip(path=str(path)))
        assert phrase in str(caught.value)
        assert str(path) in str(caught.value)
        assert "\n" not in str(caught.value)


def test_a_picture_of_another_size_or_broken_ends_the_clip_with_its_name(tmp_path):
    folder = write_folder(
        tmp_path / "folder", [*noise(2), *noise(1, 40)], ["1.png", "2.png", "3.png"]
    )
    image = np.empty((48, 64), np.uint8)
    with opened(folder) as source:
        source.read(image, 1.0)
        (folder / "2.png").write_bytes(b"broken")
        with pytest.raises(SourceError, match=r"2\.png: not a picture that can be read"):
            source.read(image, 1.0)
        with pytest.raises(SourceError, match=r"3\.png: the picture is 64 x 40 px, but 1\.png is"):
            source.read(image, 1.0)
