"""Measuring mathematics: pure functions of numpy arrays, no threads, no I/O.

Pictures are in whole-frame pixels (x right, y down), the marker plane in millimetres (x right,
y up); `homography` is the one place where the one becomes the other.
"""
