"""The axis of the table in the marker's plane, and the scale, from a stroke of known length."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from vdms_rt.model import Points, VdmsError

Floats = NDArray[np.float64]

Number = TypeVar("Number", float, NDArray[np.float64])

LEAST_SAMPLES = 20
BLOCKS = 20
"""Stretches of a recording whose errors count as independent of each other."""
LEAST_REST_S = 0.5
REST_SIGMAS = 4.0
REST_PART = 0.0005
"""Within a rest the marker stays as near to its middle as so many standard deviations of its noise,
or as this part of the stroke."""
LEAST_SIGMAS = 100.0
"""A stroke is so many times as long as its noise."""


class StrokeError(VdmsError):
    """The recorded motion is not a stroke that can be measured."""


@dataclass(frozen=True, slots=True)
class StrokeResult:
    """A recorded stroke from one rest to another."""

    angle_deg: float
    """Of the axis, -90 up to 90, from x towards y."""
    sigma_angle_deg: float
    length_mm: float
    sigma_length_mm: float
    """From the scatter within the rests. An error of the reference, which both share, is part of
    the scale that the stroke checks."""
    scale: float
    """True length over measured length."""
    sigma_scale: float
    straightness_mm: float
    """Root mean square distance of the motion from its axis."""
    rests: int
    """How often the motion rested at one of its ends."""


def principal_axis(xy_mm: Points) -> tuple[float, float]:
    """Return the angle of the line that the samples (n, 2) lie along, in degrees, and its standard
    error.

    Total least squares: the line through the mean with the least sum of squared distances. The
    angle is in [-90, 90), positive from x towards y. The standard error holds for errors that are
    alike within a twentieth of the samples, which are in the order of time.

    Raises StrokeError when there are too few samples, or none of them moved.
    """
    if len(xy_mm) < LEAST_SAMPLES:
        raise StrokeError(
            f"{len(xy_mm)} samples are no stroke; at least {LEAST_SAMPLES} are needed"
        )
    centred = xy_mm - xy_mm.mean(axis=0)
    values, vectors = np.linalg.eigh(centred.T @ centred)
    if not values[1] > 0:
        raise StrokeError("the marker did not move")
    angle_deg = math.degrees(math.atan2(vectors[1, 1], vectors[0, 1]))
    angle_deg = (angle_deg + 90) % 180 - 90
    along, across = rotate_mm(centred[:, 0], centred[:, 1], angle_deg)
    moments = along * across
    blocks = np.array([block.sum() for block in np.array_split(moments, BLOCKS)])
    variance = max(float((moments**2).sum()), float((blocks**2).sum())) / float(values[1]) ** 2
    return angle_deg, math.degrees(math.sqrt(variance))


def rotate_mm(x_mm: Number, y_mm: Number, axis_deg: float) -> tuple[Number, Number]:
    """Return the coordinates along and across an axis that lies at `axis_deg` from x towards y."""
    (c, s), _ = axis_rotation(axis_deg).tolist()
    return c * x_mm + s * y_mm, c * y_mm - s * x_mm


def axis_rotation(axis_deg: float) -> Floats:
    """Return the matrix R, (2, 2), of `rotate_mm`: R C R^T is the covariance along the axis."""
    angle = math.radians(axis_deg)
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, s], [-s, c]])


def measure_stroke(t_ns: NDArray[np.int64], xy_mm: Points, stroke_mm: float) -> StrokeResult:
    """Return the axis, length and scale of a slow stroke of known length.

    Samples (n, 2) at the times `t_ns` (n,), in the order of time. The marker rests at one end for
    half a second or more, goes to the other end and rests there, and may go to and fro. The length
    is the distance between the means of the rests at both ends.

    Raises StrokeError when the marker did not move, or did not rest at both ends.
    """
    angle_deg, sigma_angle_deg = principal_axis(xy_mm)
    along, across = rotate_mm(xy_mm[:, 0], xy_mm[:, 1], angle_deg)
    bend = along[2:] - 2 * along[1:-1] + along[:-2]
    noise_mm = float(np.median(np.abs(bend))) / 0.6745 / math.sqrt(6)
    span_mm = float(np.ptp(along))
    if span_mm < LEAST_SIGMAS * noise_mm:
        raise StrokeError(
            f"the marker moved {span_mm:.3g} mm in all, which its noise of {noise_mm:.2g} mm could "
            "hide; record a longer stroke"
        )
    room_mm = max(REST_SIGMAS * noise_mm, REST_PART * span_mm)
    period_s = float(np.median(np.diff(t_ns))) / 1e9
    resting = _resting(along, max(math.ceil(LEAST_REST_S / period_s), 2), room_mm)
    if not resting.any():
        raise StrokeError(
            f"the marker never rested for {LEAST_REST_S:g} s; let it rest so long at both ends of "
            "the stroke"
        )
    low, high = (
        _core(along, np.flatnonzero(resting & (np.abs(along - level) <= 2 * room_mm)))
        for level in (along[resting].min() + room_mm, along[resting].max() - room_mm)
    )
    length_mm = math.hypot(
        *(values[high].mean() - values[low].mean() for values in (along, across))
    )
    if length_mm < span_mm / 2:
        raise StrokeError(
            f"the marker moved {span_mm:.3g} mm but rested at one end alone; let it rest "
            f"{LEAST_REST_S:g} s at both ends of the stroke"
        )
    sigma_length_mm = math.hypot(_sigma_of_mean(along[low]), _sigma_of_mean(along[high]))
    at_high = np.isin(np.sort(np.concatenate([low, high])), high)
    return StrokeResult(
        angle_deg=angle_deg,
        sigma_angle_deg=sigma_angle_deg,
        length_mm=length_mm,
        sigma_length_mm=sigma_length_mm,
        scale=stroke_mm / length_mm,
        sigma_scale=stroke_mm / length_mm**2 * sigma_length_mm,
        straightness_mm=float(across.std()),
        rests=1 + int(np.count_nonzero(np.diff(at_high))),
    )


def _resting(along: Floats, samples: int, room_mm: float) -> NDArray[np.bool_]:
    """Return which samples belong to so many in a row that stay within `room_mm` of a middle."""
    resting = np.zeros(len(along), dtype=np.bool_)
    if len(along) < samples:
        return resting
    windows = np.lib.stride_tricks.sliding_window_view(along, samples)
    for start in np.flatnonzero(np.ptp(windows, axis=1) <= 2 * room_mm):
        resting[start : start + samples] = True
    return resting


def _core(along: Floats, rest: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return the samples of a rest without those of the first and last creep of the motion."""
    away = np.abs(along[rest] - np.median(along[rest]))
    near: NDArray[np.bool_] = away <= REST_SIGMAS * np.median(away) / 0.6745
    return rest[near]


def _sigma_of_mean(values: Floats) -> float:
    """Return the standard error of a mean, also where errors are alike within a part of it."""
    blocks = np.array([block.mean() for block in np.array_split(values, min(BLOCKS, len(values)))])
    return float(max(values.std() / math.sqrt(len(values)), blocks.std() / math.sqrt(len(blocks))))
