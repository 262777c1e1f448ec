"""What the tests on kernel drivers share. They run in the virtual machine that `make rig` boots."""

from pathlib import Path

import numpy as np
import pytest
from rig import frames
from rig.devices import FRAMES_FILE, Grabber, Vivid
from rig.hands import Hands, Person


def pytest_addoption(parser):
    parser.addoption(
        "--device",
        metavar="DEVICE",
        help="run the tests marked `hardware` on this real grabber: a node, USB id, serial or port",
    )


@pytest.fixture(scope="session")
def pictures() -> np.ndarray:
    """The frames that the devices show, (frames, height, width, 2) in YUYV."""
    return frames.load(FRAMES_FILE)


@pytest.fixture
def vivid():
    driver = Vivid()
    yield driver
    driver.unload()


@pytest.fixture(scope="module")
def usbtv_emulator(tmp_path_factory):
    grabber = Grabber("usbtv", "EASY01", tmp_path_factory.mktemp("usbtv"))
    yield grabber
    grabber.close()


@pytest.fixture
def usbtv(usbtv_emulator):
    """An emulated EasyCAP that is not plugged in yet."""
    yield usbtv_emulator
    usbtv_emulator.reset()


@pytest.fixture
def hands(request):
    """Who handles a grabber that is not plugged in yet, or in a real test, may be."""
    if device := request.config.getoption("--device", None):
        return Person(device)
    return Hands(request.getfixturevalue("usbtv"))


@pytest.fixture(autouse=True)
def _nothing_is_left_open():
    """A source gives back its node and its mapped buffers, whatever happened to it."""
    yield
    assert "/dev/video" not in Path("/proc/self/maps").read_text()
    links = list(Path("/proc/self/fd").iterdir())
    open_files = [str(link.readlink()) for link in links if link.is_symlink()]
    assert not [file for file in open_files if file.startswith("/dev/video")]
