"""The luma of a video file, exact: the Y plane as the codec gives it, never by way of RGB and back.

What OpenCV can deliver that way was tried format by format; tests hold it. Two things it cannot: a
compressed YUV file whose container, not its codec, says full range comes scaled to 16..235; and
uncompressed RGB is refused, because OpenCV 5.0 writes past its buffers on its bottom-up pictures.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from vdms_rt import codec
from vdms_rt.model import Luma, SourceError

# FFmpeg's own lines on stderr; what is wrong with a file is told in our words.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")

LOSSLESS = frozenset({"ffv1", "ffvh", "hfyu", "lags", "magy", "mpng", "png", "zlib", "mszh"})
MAYBE_LOSSLESS = frozenset({"h264", "avc1", "x264", "hevc", "hev1", "hvc1", "h265", "vp90", "av01"})
PLANAR = frozenset({"Y800", "I420", "NV12", "Y42B", "444P"})
"""Pixel formats whose first plane is 8-bit luma."""
GREY_16 = "Y1\0\x10"
PACKED_LUMA = {"YUY2": 0, "UYVY": 1}
"""Where the first luma byte stands in uncompressed packed formats."""
AGREES_GREY = 4.0
"""Most mean difference of the Y plane from the luma of the same frame's RGB."""


class Video:
    """One video file, from its first frame to its last, and again after `rewind`."""

    def __init__(self, path: Path) -> None:
        """Raises SourceError for a file that is not a video or cannot be read exactly."""
        self.path = path
        capture = _open(path, [])
        self.width_px = int(capture.get(cv2.CAP_PROP_FRAME_WIDTH))
        self.height_px = int(capture.get(cv2.CAP_PROP_FRAME_HEIGHT))
        self._codec = _tag(capture.get(cv2.CAP_PROP_FOURCC)).lower()
        self._pixels = _tag(capture.get(cv2.CAP_PROP_CODEC_PIXEL_FORMAT))
        capture.release()
        self._read, self._settings, self._luma = self._way()
        self._capture = _open(path, self._settings)

    @property
    def facts(self) -> tuple[tuple[str, str], ...]:
        """Codec, and how its frames become luma; a warning where something is lost."""
        name = self._codec or "uncompressed"
        facts = [("codec", name), ("pixel format", self._pixels or "unknown"), ("luma", self._luma)]
        if self._codec in MAYBE_LOSSLESS:
            facts.append(("warning", f"{name} is lossy unless it was made without loss"))
        elif self._codec and self._codec not in LOSSLESS:
            facts.append(("warning", f"{name} is lossy: circles lie where its artefacts put them"))
        return tuple(facts)

    def next(self) -> Luma | None:
        """Return the next frame, (height_px, width_px) uint8, or None after the last."""
        there, image = self._capture.read()
        return self._read(image) if there else None

    def rewind(self) -> None:
        """Begin again with the first frame."""
        self._capture.release()
        self._capture = _open(self.path, self._settings)

    def close(self) -> None:
        self._capture.release()

    def _way(self) -> tuple[Callable[[np.ndarray], Luma], list[int], str]:
        """Return what makes luma of what OpenCV reads, OpenCV's settings for it, and its name."""
        if not self._codec:
            size = self._packet_bytes()
            if size is None:
                raise SourceError(
                    f"{self.path}: uncompressed video in a pixel format that cannot be read; "
                    + self._remedy()
                )
            return self._from_packet, [cv2.CAP_PROP_FORMAT, -1], "exact"
        if self._pixels == GREY_16:
            return self._from_any, [cv2.CAP_PROP_CONVERT_RGB, 0], "16 bits made 8"
        if self._pixels in PLANAR and (luma := self._first_plane()):
            return self._checked, [cv2.CAP_PROP_CONVERT_RGB, 0], luma
        return self._from_any, [], "Rec. 601 from the colours, rounded"

    def _first_plane(self) -> str:
        """Return what OpenCV's untouched first plane is, or nothing if it is not luma."""
        seen = []
        for settings in ([cv2.CAP_PROP_CONVERT_RGB, 0], []):
            capture = _open(self.path, settings)
            there, image = capture.read()
            capture.release()
            if not there:
                return "exact"
            seen.append(image)
        plane, colours = seen
        if plane.shape != (self.height_px, self.width_px) or plane.dtype != np.uint8:
            return ""
        luma = self._from_any(colours).astype(np.float64)
        from_full = np.abs(plane - luma).mean()
        from_limited = np.abs(np.clip(plane, 16, 235) - (16 + luma * (219 / 255))).mean()
        if min(from_full, from_limited) > AGREES_GREY:
            return ""
        if from_full < from_limited:
            return "exact"
        return "Y plane; scaled to 16..235 if the container says full range"

    def _packet_bytes(self) -> int | None:
        """Return the size of an uncompressed frame, or None in a format that is not known."""
        width, height = self.width_px, self.height_px
        half_width, half_height = (width + 1) // 2, (height + 1) // 2
        return {
            "Y800": width * height,
            "I420": width * height + 2 * half_width * half_height,
            "NV12": width * height + 2 * half_width * half_height,
            "Y42B": width * height + 2 * half_width * height,
            "444P": 3 * width * height,
            "YUY2": 2 * width * height,
            "UYVY": 2 * width * height,
        }.get(self._pixels)

    def _from_packet(self, packet: np.ndarray) -> Luma:
        data = packet.ravel()
        if data.size != self._packet_bytes():
            raise SourceError(
                f"{self.path}: a frame has {data.size} bytes instead of {self._packet_bytes()}; "
                + self._remedy()
            )
        first = PACKED_LUMA.get(self._pixels)
        luma = data[first::2] if first is not None else data[: self.width_px * self.height_px]
        return self._checked(luma.reshape(self.height_px, self.width_px))

    def _from_any(self, image: np.ndarray) -> Luma:
        return self._checked(codec.luma(image))

    def _checked(self, image: np.ndarray) -> Luma:
        if image.shape != (self.height_px, self.width_px) or image.dtype != np.uint8:
            raise SourceError(
                f"{self.path}: its frames change their size or format; {self._remedy()}"
            )
        return image

    def _remedy(self) -> str:
        return f"convert it: ffmpeg -i {self.path.name} -c:v ffv1 -pix_fmt gray new.mkv"


def _open(path: Path, settings: list[int]) -> cv2.VideoCapture:
    capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG, settings)
    capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
    if not capture.isOpened():
        raise SourceError(
            f"{path}: not a video that can be read; clip.path must name a lossless video (FFV1) "
            "or a folder of PNG or PGM pictures"
        )
    return capture


def _tag(value: float) -> str:
    """Return a four-character code as text; empty for none."""
    return int(value).to_bytes(4, "little").decode("latin-1").strip("\0 ") if value > 0 else ""
