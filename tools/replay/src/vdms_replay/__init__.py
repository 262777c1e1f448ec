"""From a recording of vdms-rt to figures, files and comparisons."""

from vdms_replay.load import Recording, load, read
from vdms_replay.source import ReplayError

__version__ = "0.1.0"
__all__ = ["Recording", "ReplayError", "load", "read"]
