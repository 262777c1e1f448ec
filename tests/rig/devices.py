"""The rig's devices, as a test handles them: vivid, and grabbers that are plugged in and out."""

import contextlib
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import numpy as np
from rig import frames, usbip

from vdms_rt.capture.grabber import DeviceInfo, list_devices

REPOSITORY = Path(__file__).parents[2]
FRAMES_FILE = REPOSITORY / ".rig" / "frames.yuyv"

_Answer = TypeVar("_Answer")


def wait_for(ask: Callable[[], _Answer], what: str, timeout_s: float = 20.0) -> _Answer:
    """Return the first answer that is true; fails when none comes in time."""
    deadline_s = time.monotonic() + timeout_s
    while time.monotonic() < deadline_s:
        if answer := ask():
            return answer
        time.sleep(0.02)
    raise AssertionError(f"waited {timeout_s:g} s in vain for {what}")


def run(*command: str) -> str:
    """Run a program to its end and return what it printed; fails with that if the program does."""
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, f"{' '.join(command)}: {done.stdout}{done.stderr}"
    return done.stdout


class Vivid:
    """The kernel's virtual video device with two inputs, and an output that the first kind of
    input can show."""

    OPTIONS = ("n_devs=1", "node_types=0x101", "num_outputs=1", "output_types=0", "num_inputs=2")
    """A capture and an output node; the output is S-Video."""

    def __init__(self, input_types: str = "0xa") -> None:
        """`input_types`: two bits each: 0 webcam, 2 S-Video, 3 HDMI; 0xa is S-Video twice."""
        # No cropping or scaling: a picture is as large as its standard says.
        sizes = ("ccs_cap_mode=0", "ccs_out_mode=0")
        run("modprobe", "vivid", *self.OPTIONS, *sizes, f"input_types={input_types}")
        self.node = self._node("vid-cap")
        self.output_node = self._node("vid-out")
        # Nothing is written into the pictures.
        self.control("osd_text_mode", 2)

    def _node(self, kind: str) -> str:
        classes = Path("/sys/class/video4linux")

        def find() -> list[str]:
            names = [(d / "name").read_text() for d in classes.iterdir()]
            nodes = [
                d.name for d, name in zip(classes.iterdir(), names, strict=True) if kind in name
            ]
            return [f"/dev/{node}" for node in nodes if Path(f"/dev/{node}").exists()]

        return wait_for(find, f"vivid's {kind} node")[0]

    def control(self, name: str, value: int = 1) -> None:
        """Set one of the driver's controls, or push the button that it is."""
        run("v4l2-ctl", "-d", self.node, "-c", f"{name}={value}")

    def unload(self) -> None:
        """Take the driver away; fails if anybody still holds it."""
        run("modprobe", "-r", "vivid")


def show(vivid: Vivid, control: str, choice: str) -> None:
    """Choose an entry of one of vivid's menus by its name, or by the first that begins so."""
    menu = run("v4l2-ctl", "-d", vivid.node, "--list-ctrls-menus").split(f"{control} 0x")[1]
    lines = (line.strip() for line in menu.splitlines())
    number = next(line.split(":")[0] for line in lines if f": {choice}" in line)
    vivid.control(control, int(number))


class Projector:
    """Shows the frames on vivid's S-Video output, which its S-Video inputs then see: the marker
    at rest until `move` is set. A context manager.

    Output and input have clocks of their own, so a frame may be seen twice, or not at all.
    """

    def __init__(self, vivid: Vivid, pictures: np.ndarray) -> None:
        self.move = threading.Event()
        self._pictures = [picture.tobytes() for picture in pictures]
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._feed, name="projector")
        vivid.control("loop_video")
        output = ("v4l2-ctl", "-d", vivid.output_node)
        # The standard decides on the size, so it comes first, in a call of its own.
        run(*output, "--set-standard", "ntsc-m")
        size = f"width={frames.WIDTH_PX},height={frames.HEIGHT_PX}"
        run(*output, f"--set-fmt-video-out={size},pixelformat=YUYV,field=interlaced")
        # vivid's output refuses plain write() of interlaced frames; this streams what it is given.
        self._output = subprocess.Popen(
            [*output, "--stream-out-mmap=4", "--stream-from=-"],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )

    def __enter__(self) -> "Projector":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._output.terminate()
        self._output.wait(timeout=20)
        self._thread.join(timeout=20)
        assert not self._thread.is_alive()

    def _feed(self) -> None:
        film = frames.Film()
        # The output takes a frame each 1001/30000 s, and the pipe makes us wait for it.
        with self._output.stdin as pipe, contextlib.suppress(BrokenPipeError):
            while not self._stop.is_set():
                pipe.write(self._pictures[film.next(held=not self.move.is_set())])


class Grabber:
    """An emulated USB grabber and its cable. `kind` is `usbtv` or `uvc`; two at once need two
    `tcp_port`."""

    def __init__(self, kind: str, serial: str, control: Path, tcp_port: int = 3240) -> None:
        run("modprobe", "vhci-hcd")
        run("modprobe", {"usbtv": "usbtv", "uvc": "uvcvideo"}[kind])
        self.serial = serial
        self._tcp_port = str(tcp_port)
        self._control = control
        self._log = control / "grabber.log"
        command = [sys.executable, "-m", "rig.virtual_grabber", kind, str(FRAMES_FILE)]
        environment = {**os.environ, "PYTHONPATH": str(REPOSITORY / "tests")}
        with self._log.open("w") as log:
            command += ["--serial", serial, "--control", str(control)]
            self._server = subprocess.Popen(
                [*command, "--tcp-port", self._tcp_port],
                stdout=log,
                stderr=subprocess.STDOUT,
                env=environment,
            )
        wait_for(self._listens, "the emulated grabber", 60)

    def _listens(self) -> bool:
        said = self._log.read_text()
        assert self._server.poll() is None, said
        return "listening" in said

    def plug(self) -> DeviceInfo:
        """Plug it in and return the capture device that it becomes."""
        port = ("--tcp-port", self._tcp_port)
        run("usbip", *port, "attach", "-r", "127.0.0.1", "-b", usbip.BUS_ID)
        return wait_for(self.device, "the grabber's node")

    def device(self) -> DeviceInfo | None:
        """Return its capture device if it is plugged in."""
        found = [d for d in list_devices() if d.serial == self.serial and d.usable]
        return found[0] if found else None

    def unplug(self) -> None:
        run("usbip", "detach", "-p", str(self._vhci_port()))
        wait_for(lambda: not self.device(), "the grabber's node to go")

    def _vhci_port(self) -> int:
        """Return the emulated host's port that it is plugged into."""
        (status,) = Path("/sys/devices/platform").glob("vhci_hcd.0/status")
        rows = [line.split() for line in status.read_text().splitlines()[1:]]
        serials = {row[1]: Path("/sys/bus/usb/devices") / row[-1] / "serial" for row in rows}
        return next(
            int(port)
            for port, file in serials.items()
            if file.exists() and file.read_text().strip() == self.serial
        )

    def set(self, what: str, on: bool) -> None:
        """`hold`: show the marker at rest. `blank`: show nothing. `stall`: send nothing. `wedge`:
        send nothing until it is reset."""
        flag = self._control / what
        if on:
            flag.touch()
        else:
            flag.unlink(missing_ok=True)

    def reset(self) -> None:
        """Leave it unplugged, and as it was at first."""
        for what in ("hold", "blank", "stall", "wedge"):
            self.set(what, False)
        if self.device():
            self.unplug()

    def close(self) -> None:
        self._server.terminate()
        self._server.wait(timeout=20)
