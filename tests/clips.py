"""Small clips of known luma, written without the code that reads them."""

from __future__ import annotations

import struct
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

Images = list[NDArray[np.uint8]]
RATE = "F30000:1001"


def noise(count: int, height: int = 48, width: int = 64, seed: int = 1) -> Images:
    random = np.random.default_rng(seed)
    return [random.integers(0, 256, (height, width), dtype=np.uint8) for _ in range(count)]


def smooth(count: int, height: int = 48, width: int = 64) -> Images:
    """Return images as a camera would give them, within 16..235."""
    return [
        np.clip(cv2.GaussianBlur(image, (0, 0), 3).astype(int) * 3 - 250, 16, 235).astype(np.uint8)
        for image in noise(count, height, width)
    ]


def write_video(path: Path, images: Images, fourcc: str = "FFV1", *, colour: bool = False) -> Path:
    height, width = images[0].shape
    writer = cv2.VideoWriter(
        str(path),
        cv2.CAP_FFMPEG,
        cv2.VideoWriter_fourcc(*fourcc),
        30.0,
        (width, height),
        [
            cv2.VIDEOWRITER_PROP_IS_COLOR,
            int(colour),
            cv2.VIDEOWRITER_PROP_DEPTH,
            cv2.CV_16U if images[0].dtype == np.uint16 else cv2.CV_8U,
        ],
    )
    assert writer.isOpened()
    for image in images:
        writer.write(np.repeat(image[:, :, None], 3, axis=2) if colour else image)
    writer.release()
    return path


def write_y4m(path: Path, images: Images, chroma: str, extra: str = "") -> Path:
    """Write uncompressed planar video; the colour planes are neutral."""
    height, width = images[0].shape
    shapes = {"420": (2 * (height // 2), width // 2), "422": (2 * height, width // 2)}
    planes = {"444": (2 * height, width), "mono": (0, 0), **shapes}[chroma]
    frames = b"".join(
        b"FRAME\n" + image.tobytes() + np.full(planes, 128, np.uint8).tobytes() for image in images
    )
    header = f"YUV4MPEG2 W{width} H{height} {RATE} Ip A1:1 C{chroma}{extra}\n"
    path.write_bytes(header.encode() + frames)
    return path


def write_avi(path: Path, frames: list[bytes], size: tuple[int, int], fourcc: bytes, bits: int):
    """Write uncompressed video as a RIFF AVI; `size` is (width, height)."""
    width, height = size
    bytes_each = len(frames[0])

    def chunk(name: bytes, data: bytes) -> bytes:
        return name + struct.pack("<I", len(data)) + data + bytes(len(data) % 2)

    def group(name: bytes, data: bytes) -> bytes:
        return chunk(b"LIST", name + data)

    main = struct.pack(
        "<14I", 33367, 0, 0, 16, len(frames), 0, 1, bytes_each, width, height, 0, 0, 0, 0
    )
    stream = b"vids" + fourcc
    stream += struct.pack(
        "<IHHIIIIIIII4h", 0, 0, 0, 0, 1001, 30000, 0, len(frames), bytes_each, 0xFFFFFFFF, 0,
        0, 0, width, height,
    )  # fmt: skip
    form = struct.pack("<IiiHH4sIiiII", 40, width, height, 1, bits, fourcc, bytes_each, 0, 0, 0, 0)
    header = chunk(b"avih", main) + group(b"strl", chunk(b"strh", stream) + chunk(b"strf", form))
    data = group(b"hdrl", header) + group(b"movi", b"".join(chunk(b"00dc", f) for f in frames))
    path.write_bytes(chunk(b"RIFF", b"AVI " + data))
    return path


def yuy2(image: NDArray[np.uint8]) -> bytes:
    return np.dstack([image, np.full_like(image, 90)]).tobytes()


def uyvy(image: NDArray[np.uint8]) -> bytes:
    return np.dstack([np.full_like(image, 90), image]).tobytes()


class _Bits:
    def __init__(self) -> None:
        self.text: list[str] = []

    def u(self, width: int, value: int) -> None:
        self.text.append(f"{value:0{width}b}")

    def ue(self, value: int) -> None:
        code = f"{value + 1:b}"
        self.text.append("0" * (len(code) - 1) + code)

    def raw(self, data: bytes) -> None:
        """Append bytes after the zeros that align them."""
        bits = "".join(self.text)
        bits += "0" * (-len(bits) % 8)
        self.text = [bits, "".join(f"{byte:08b}" for byte in data)]

    def nal(self, head: int) -> bytes:
        bits = "".join(self.text) + "1"
        bits += "0" * (-len(bits) % 8)
        payload, zeros = bytearray([head]), 0
        for byte in int(bits, 2).to_bytes(len(bits) // 8, "big"):
            if zeros == 2 and byte <= 3:
                payload.append(3)
                zeros = 0
            payload.append(byte)
            zeros = zeros + 1 if byte == 0 else 0
        return b"\x00\x00\x00\x01" + bytes(payload)


def write_h264(path: Path, images: Images, *, full_range: bool = False) -> Path:
    """Write lossless H.264 (Rec. ITU-T H.264, macroblocks of type I_PCM), sides in multiples of
    16, colour neutral."""
    height, width = images[0].shape
    sequence = _Bits()
    for value in (66, 0xC0, 30):
        sequence.u(8, value)
    for value in (0, 0, 2, 1):  # id, frame number bits - 4, order type, reference frames
        sequence.ue(value)
    sequence.u(1, 0)
    sequence.ue(width // 16 - 1)
    sequence.ue(height // 16 - 1)
    sequence.u(4, 0b1101)  # frames only, direct 8x8, no cropping, usability information
    sequence.u(3, 0b001)  # no aspect, no overscan, signal type
    sequence.u(3, 5)
    sequence.u(1, int(full_range))
    sequence.u(7, 0)
    picture = _Bits()
    picture.text = ["1", "1", "00", "1", "1", "1", "0", "00", "1", "1", "1", "100"]
    data = sequence.nal(0x67) + picture.nal(0x68)
    chroma = bytes([128]) * 128
    for number, image in enumerate(images):
        part = _Bits()
        for value in (0, 7, 0):  # first macroblock, I slice, parameter set
            part.ue(value)
        part.u(4, 0)
        part.ue(number % 2)
        part.u(2, 0)
        part.ue(0)
        part.ue(1)  # no deblocking
        for top in range(0, height, 16):
            for left in range(0, width, 16):
                part.ue(25)
                part.raw(image[top : top + 16, left : left + 16].tobytes() + chroma)
        data += part.nal(0x65)
    path.write_bytes(data)
    return path
