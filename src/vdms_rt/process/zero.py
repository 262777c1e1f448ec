"""Counting displacement from elsewhere than the reference pose."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

from vdms_rt.model import Displacement
from vdms_rt.process.progress import Progress
from vdms_rt.setup import Zero

NO_ZERO = Zero()


def zeroed(progress: Progress, samples: tuple[Displacement, ...]) -> tuple[Displacement, ...]:
    """Return the samples, one for each marker, counted from the zeros of the set-up in force."""
    set_up = progress.set_up
    if set_up is None or all(m.zero == NO_ZERO for m in set_up.markers):
        return samples
    return tuple(
        _counted_from(sample, marker.zero, axis_deg)
        for sample, marker, axis_deg in zip(
            samples, set_up.markers, progress.plan.axes_deg, strict=True
        )
    )


def _counted_from(sample: Displacement, zero: Zero, axis_deg: float) -> Displacement:
    cos, sin = math.cos(math.radians(axis_deg)), math.sin(math.radians(axis_deg))
    return dataclasses.replace(
        sample,
        x_mm=sample.x_mm - (cos * zero.x_mm + sin * zero.y_mm),
        y_mm=sample.y_mm - (cos * zero.y_mm - sin * zero.x_mm),
        rotation_mrad=sample.rotation_mrad - zero.rotation_mrad,
    )


def moved_zero(zero: Zero, resting: Sequence[Displacement], axis_deg: float) -> Zero:
    """Return the zero that makes the mean of samples of a resting marker zero.

    `resting` are counted from `zero` with x along `axis_deg`. The mean of n samples has 1/n of
    their variance; a sample's sigma does not include it.
    """
    n = len(resting)
    x_mm, y_mm = sum(d.x_mm for d in resting) / n, sum(d.y_mm for d in resting) / n
    cos, sin = math.cos(math.radians(axis_deg)), math.sin(math.radians(axis_deg))
    return Zero(
        x_mm=zero.x_mm + cos * x_mm - sin * y_mm,
        y_mm=zero.y_mm + sin * x_mm + cos * y_mm,
        rotation_mrad=zero.rotation_mrad + sum(d.rotation_mrad for d in resting) / n,
    )
