"""An emulated USB frame grabber, to which the kernel's own driver binds; runs in the guest.

    PYTHONPATH=tests python -m rig.virtual_grabber usbtv|uvc FRAMES.yuyv --serial S --control DIR

`usbip attach -r 127.0.0.1 -b 1-1` plugs it in, `usbip detach -p 0` pulls it out. It shows the
marker at rest while DIR/hold exists, else moving; while DIR/blank exists, what a grabber shows
without a camera; while DIR/stall exists it sends nothing, and while DIR/wedge does neither, but a
reset of the device takes that away.
"""

import argparse
import logging
import struct
from pathlib import Path

import numpy as np
from rig import frames
from rig.usbip import Device, Pace, Setup, Stall, isochronous_packets, serve

FRAME_PERIOD_S = 1001 / 30000
BLANK = -1
"""Number of the frame without a picture: the one after the last."""


class Camera:
    """What is at the grabber's input."""

    def __init__(self, control: Path):
        self._film = frames.Film()
        self._hold, self._blank = control / "hold", control / "blank"
        self._stall, self._wedge = control / "stall", control / "wedge"

    def next(self) -> int | None:
        """Return the number of the next frame, None when nothing is sent."""
        number = self._film.next(self._hold.exists())
        if self._stall.exists() or self._wedge.exists():
            return None
        return BLANK if self._blank.exists() else number

    def configured(self) -> None:
        """The device was plugged in or reset."""
        self._wedge.unlink(missing_ok=True)


class Usbtv(Device):
    """Fushicai UTV007, the EasyCAP of the driver usbtv.

    A field is 360 chunks of 1024 bytes: a big-endian word (0x88 << 24 | frame id << 16 | odd << 15
    | number of the chunk), 960 bytes of YUYV, 60 of padding. Three chunks are a packet, and 8
    packets an URB, so that 15 URBs are a field: it is answered in one burst, which an emulated
    processor can do. The bottom field, "even" (rows 1, 3, ...), goes first, as the driver pairs
    them.
    """

    vendor_id, product_id = 0x1B71, 0x3002
    interface_count = 1
    maker, product = "fushicai", "usbtv007"

    _CHUNKS, _URBS = 360, 15
    _PACKETS = isochronous_packets(8, 3072)

    def __init__(self, serial: str, pictures: np.ndarray, control: Path):
        super().__init__(serial)
        blank = np.full_like(pictures[:1], 128)
        blank[..., 0] = 16
        shown = np.concatenate([pictures, blank])
        self._fields = [self._chunks(p, odd) for p in shown for odd in (0, 1)]
        self._camera = Camera(control)
        self._pace = Pace(FRAME_PERIOD_S / 2)
        self._unsent: list[bytes] = []
        self._picture: int | None = None

    def _chunks(self, picture: np.ndarray, odd: int) -> np.ndarray:
        chunks = np.zeros((self._CHUNKS, 1024), np.uint8)
        chunks[:, 4:964] = picture[1 - odd :: 2].reshape(self._CHUNKS, 960)
        head = 0x88000000 | odd << 15 | np.arange(self._CHUNKS)
        chunks[:, :4] = head.astype(">u4").view(np.uint8).reshape(-1, 4)
        return chunks

    def interfaces(self) -> bytes:
        silent = bytes.fromhex("09 04 00 00 00 ff 00 00 00")
        streaming = bytes.fromhex("09 04 00 01 04 ff 00 00 00")
        video = bytes.fromhex("07 05 81 05 00 14 01")
        others = bytes.fromhex("07 05 02 02 00 02 00  07 05 83 02 00 02 00  07 05 84 02 00 02 00")
        return silent + streaming + video + others

    def own_request(self, setup: Setup) -> bytes:
        return bytes(setup.length)  # A register: takes every value, reads as 0.

    def configured(self) -> None:
        self._camera.configured()

    def alternate_set(self, interface: int, alternate: int) -> None:
        self._unsent.clear()
        if alternate == 1:
            self._pace.start()
        else:
            self._pace.stop()

    def due_s(self) -> float | None:
        return self._pace.due_s()

    def idle(self) -> bool:
        return not self._unsent

    def stream(self, now_s: float) -> None:
        while (due_s := self._pace.due_s()) is not None and due_s <= now_s:
            self._begin_field(self._pace.take())
        count = min(len(self._unsent), len(self.urbs))
        for urb, payload in zip(self.urbs[:count], self._unsent[:count], strict=True):
            self.answer(urb.number, 0, payload, self._PACKETS)
        del self.urbs[:count], self._unsent[:count]

    def _begin_field(self, number: int) -> None:
        if number % 2 == 0:
            # When the one before is still unsent the machine is too slow: this frame is lost whole.
            lost = len(self._unsent) > self._URBS
            picture = self._camera.next()
            self._picture = None if lost else picture
        if self._picture is None:
            return
        chunks = self._fields[2 * self._picture + number % 2]
        chunks[:, 1] = number // 2 & 0xFF
        data = chunks.tobytes()
        size = len(data) // self._URBS
        self._unsent += [data[n * size : (n + 1) * size] for n in range(self._URBS)]


class Uvc(Device):
    """A USB camera of the UVC class, version 1.0, YUYV, with a bulk endpoint.

    A frame is one payload: a header of 12 bytes and the picture, over as many URBs as it takes; a
    short one ends it.
    """

    vendor_id, product_id = 0x1209, 0x0002
    device_class = (239, 2, 1)
    interface_count = 2
    maker, product = "vdms test", "virtual UVC grabber"

    _INTERVAL = round(FRAME_PERIOD_S * 10_000_000)

    def __init__(self, serial: str, pictures: np.ndarray, control: Path):
        super().__init__(serial)
        self._pictures = [picture.tobytes() for picture in pictures]
        self._pictures.append(b"\x10\x80" * (frames.FRAME_BYTES // 2))
        self._camera = Camera(control)
        self._pace = Pace(FRAME_PERIOD_S)
        self._frame_id = 0
        self._unsent = memoryview(b"")
        size = frames.FRAME_BYTES
        self._probe = struct.pack(
            "<HBBIHHHHHII", 0, 1, 1, self._INTERVAL, 0, 0, 0, 0, 0, size, size + 12
        )

    def interfaces(self) -> bytes:
        camera = bytes.fromhex("11 24 02 01 01 02 00 00 00 00 00 00 00 00 02 00 00")
        stream = bytes.fromhex("09 24 03 03 01 01 00 01 00")
        units = camera + stream
        header = struct.pack("<BBBHHIBB", 13, 0x24, 1, 0x0100, 13 + len(units), 48000000, 1, 1)
        association = bytes.fromhex("08 0b 00 02 0e 03 00 00")
        control = bytes.fromhex("09 04 00 00 00 0e 01 00 00") + header + units
        endpoint = bytes.fromhex("07 05 81 02 00 02 00")
        streaming = bytes.fromhex("09 04 01 00 01 0e 02 00 00") + self._formats() + endpoint
        return association + control + streaming

    def _formats(self) -> bytes:
        guid = b"YUY2" + bytes.fromhex("0000 1000 8000 00aa 0038 9b71")
        form = struct.pack("<BBBBB16sBBBBBB", 27, 0x24, 4, 1, 1, guid, 16, 1, 0, 0, 0, 0)
        size, rate = frames.FRAME_BYTES, frames.FRAME_BYTES * 8 * 30
        shape = (frames.WIDTH_PX, frames.HEIGHT_PX)
        interval = self._INTERVAL
        frame = struct.pack(
            "<BBBBBHHIIIIBI", 30, 0x24, 5, 1, 0, *shape, rate, rate, size, interval, 1, interval
        )
        colour = bytes.fromhex("06 24 0d 01 01 04")
        total = 14 + len(form) + len(frame) + len(colour)
        head = struct.pack("<BBBBHBBBBBBBB", 14, 0x24, 1, 1, total, 0x81, 0, 3, 0, 0, 0, 1, 0)
        return head + form + frame + colour

    def own_request(self, setup: Setup) -> bytes:
        probe_or_commit = setup.value >> 8
        if setup.index & 0xFF != 1 or probe_or_commit not in (1, 2):
            raise Stall
        match setup.request:
            case 0x01:  # SET_CUR
                if probe_or_commit == 2:
                    self._unsent = memoryview(b"")
                    self._pace.start()
                return b""
            case 0x81 | 0x82 | 0x83 | 0x87:  # GET_CUR, MIN, MAX, DEF
                return self._probe
            case 0x85:  # GET_LEN
                return struct.pack("<H", len(self._probe))
            case 0x86:  # GET_INFO
                return b"\x03"
        raise Stall

    def control(self, setup: Setup) -> bytes:
        if (setup.kind, setup.request) == (0x02, 1):
            # CLEAR_FEATURE(ENDPOINT_HALT) is how a bulk stream is ended.
            self._pace.stop()
            self._unsent = memoryview(b"")
        return super().control(setup)

    def due_s(self) -> float | None:
        if not self._unsent:
            return self._pace.due_s()
        return 0 if self.urbs else None

    def idle(self) -> bool:
        return False

    def stream(self, now_s: float) -> None:
        due_s = self._pace.due_s()
        if not self._unsent and due_s is not None and due_s <= now_s and self.urbs:
            self._begin_frame(now_s)
        while self._unsent and self.urbs:
            urb = self.urbs.pop(0)
            part, self._unsent = self._unsent[: urb.length], self._unsent[urb.length :]
            self.answer(urb.number, 0, part)

    def _begin_frame(self, now_s: float) -> None:
        # What the machine was too slow for is lost.
        while (due_s := self._pace.due_s()) is not None and due_s <= now_s:
            self._pace.take()
            picture = self._camera.next()
        if picture is None:
            return
        self._frame_id ^= 1
        header = bytes((12, 0x82 | self._frame_id)) + bytes(10)
        self._unsent = memoryview(header + self._pictures[picture])


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("kind", choices=("usbtv", "uvc"))
    parser.add_argument("frames", type=Path)
    parser.add_argument("--serial", required=True)
    parser.add_argument("--control", type=Path, required=True)
    parser.add_argument("--tcp-port", type=int, default=3240)
    options = parser.parse_args()
    logging.basicConfig(level=logging.INFO)
    kind = {"usbtv": Usbtv, "uvc": Uvc}[options.kind]
    device = kind(options.serial, frames.load(options.frames), options.control)
    serve(device, options.tcp_port)


if __name__ == "__main__":
    main()
