"""Real-time displacement in millimetres from a camera, a printed marker and a frame grabber."""

__version__ = "0.1.0"
