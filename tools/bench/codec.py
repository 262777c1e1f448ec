"""How region pixels are best kept in the log: size, and time to encode and to decode.

Four regions of 120 x 120 pixels around the circles of a marker that moves by 10 mm at 1 Hz, two
seconds of interlaced frames, white noise of some standard deviations. Every way is what it would be
in the log: its output for half a second of frames, in one zstd chunk of the level that the log has.
Each is decoded and compared; one that loses anything stops the program.

    python -m tools.bench.codec
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable, Sequence
from math import pi, sin
from pathlib import Path

import cv2
import numpy as np
import zstandard
from numpy.typing import NDArray

from tools.bench.picture import Bench, grabbed, woven

Image = NDArray[np.uint8]
Frame = list[Image]
"""The four regions of one frame."""

SIDE_PX = 120
FRAMES = 60
CHUNK_FRAMES = 15
RATE_HZ = 30000 / 1001
NOISES_GREY = (0.5, 1.0, 2.0, 4.0)
ZSTD_LEVEL = 3
"""Of the MCAP writer."""


def clean_frames(bench: Bench) -> list[list[NDArray[np.float64]]]:
    """Return the regions of frames without noise."""
    corners = [
        (round(x_px) - SIDE_PX // 2, round(y_px) - SIDE_PX // 2)
        for x_px, y_px in bench.centres_px()
    ]
    frames = []
    for index in range(FRAMES):
        fields = [bench.still(10 * sin(2 * pi * (index + half / 2) / RATE_HZ)) for half in range(2)]
        frame = woven(*fields)
        frames.append([frame[y : y + SIDE_PX, x : x + SIDE_PX] for x, y in corners])
    return frames


def raw8(image: Image) -> bytes:
    return image.tobytes()


def raw8_back(data: bytes) -> Image:
    return np.frombuffer(data, np.uint8).reshape(SIDE_PX, SIDE_PX)


def from_left(image: Image) -> bytes:
    out = image.copy()
    out[:, 1:] -= image[:, :-1]
    return out.tobytes()


def from_left_back(data: bytes) -> Image:
    return np.cumsum(raw8_back(data), axis=1, dtype=np.uint8)


def from_same_field(image: Image) -> bytes:
    out = image.copy()
    out[2:] -= image[:-2]
    return out.tobytes()


def from_same_field_back(data: bytes) -> Image:
    out = np.empty((SIDE_PX, SIDE_PX), np.uint8)
    for field in range(2):
        np.cumsum(raw8_back(data)[field::2], axis=0, dtype=np.uint8, out=out[field::2])
    return out


def picture(suffix: str, settings: Sequence[int]) -> Callable[[Image], bytes]:
    return lambda image: cv2.imencode(suffix, image, settings)[1].tobytes()


def picture_back(data: bytes) -> Image:
    return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)


WAYS: dict[str, tuple[Callable[[Image], bytes], Callable[[bytes], Image]]] = {
    "raw8": (raw8, raw8_back),
    "less left pixel": (from_left, from_left_back),
    "less pixel above": (from_same_field, from_same_field_back),
    "PNG level 1": (picture(".png", [cv2.IMWRITE_PNG_COMPRESSION, 1]), picture_back),
    "PNG level 6": (picture(".png", [cv2.IMWRITE_PNG_COMPRESSION, 6]), picture_back),
    "JPEG 2000": (picture(".jp2", [cv2.IMWRITE_JPEG2000_COMPRESSION_X1000, 1000]), picture_back),
}


def measure(way: str, frames: list[Frame]) -> tuple[float, float, float]:
    """Return bytes, microseconds to encode and microseconds to decode, each of one frame."""
    encode, decode = WAYS[way]
    compressor = zstandard.ZstdCompressor(level=ZSTD_LEVEL)
    decompressor = zstandard.ZstdDecompressor()
    size, encoding_s, decoding_s = 0, 0.0, 0.0
    for start in range(0, len(frames), CHUNK_FRAMES):
        regions = [region for frame in frames[start : start + CHUNK_FRAMES] for region in frame]
        begun_s = time.perf_counter()
        parts = [encode(region) for region in regions]
        chunk = compressor.compress(b"".join(parts))
        encoding_s += time.perf_counter() - begun_s
        size += len(chunk)
        begun_s = time.perf_counter()
        data = decompressor.decompress(chunk)
        back, at = [], 0
        for part in parts:
            back.append(decode(data[at : at + len(part)]))
            at += len(part)
        decoding_s += time.perf_counter() - begun_s
        if not all(map(np.array_equal, back, regions)):
            raise SystemExit(f"{way} loses something")
    return size / len(frames), encoding_s / len(frames) * 1e6, decoding_s / len(frames) * 1e6


def measure_ffv1(frames: list[Frame]) -> tuple[float, float, float]:
    """The same of FFV1, the four regions side by side as one video."""
    with tempfile.TemporaryDirectory() as directory:
        path = Path(directory) / "regions.mkv"
        begun_s = time.perf_counter()
        writer = cv2.VideoWriter(
            str(path), cv2.CAP_FFMPEG, cv2.VideoWriter_fourcc(*"FFV1"), RATE_HZ,
            (4 * SIDE_PX, SIDE_PX), False,
        )  # fmt: skip
        for frame in frames:
            writer.write(np.hstack(frame))
        writer.release()
        encoding_s = time.perf_counter() - begun_s
        begun_s = time.perf_counter()
        reader = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG, [cv2.CAP_PROP_CONVERT_RGB, 0])
        back = [reader.read()[1] for _ in frames]
        decoding_s = time.perf_counter() - begun_s
        if not all(np.array_equal(b, np.hstack(f)) for b, f in zip(back, frames, strict=True)):
            raise SystemExit("FFV1 loses something")
        size = path.stat().st_size
    return size / len(frames), encoding_s / len(frames) * 1e6, decoding_s / len(frames) * 1e6


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--angle-deg", type=float, default=30.0)
    bench = Bench(angle_deg=parser.parse_args().angle_deg)
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_ERROR)
    clean = clean_frames(bench)
    random = np.random.default_rng(1)
    print(f"a frame is {4 * SIDE_PX**2 / 1000:.1f} kB of pixels; times relative to raw8 = 1")
    for noise_grey in NOISES_GREY:
        frames = [[grabbed(region, noise_grey, random) for region in frame] for frame in clean]
        found = {way: measure(way, frames) for way in WAYS}
        found["FFV1"] = measure_ffv1(frames)
        _, raw_encoding_us, raw_decoding_us = found["raw8"]
        print(f"\nnoise {noise_grey:g} grey levels")
        for way, (size, encoding_us, decoding_us) in found.items():
            print(
                f"  {way:18}{size / 1000:7.1f} kB"
                f"   encode {encoding_us:7.0f} us {encoding_us / raw_encoding_us:6.1f}"
                f"   decode {decoding_us:7.0f} us {decoding_us / raw_decoding_us:6.1f}"
            )


if __name__ == "__main__":
    main()
