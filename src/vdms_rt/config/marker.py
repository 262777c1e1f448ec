"""The printed markers, and how they are measured."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from vdms_rt.config.base import Name, Pair, Section
from vdms_rt.model import MarkerShape, Region


class Marker(Section):
    """One printed marker. The four-circle sheet is the default."""

    name: Name = "m1"
    spacing_mm: float = Field(default=120.0, gt=0, le=10000)
    """Between neighbouring circles' centres of the four-circle sheet."""
    diameter_mm: float = Field(default=50.0, gt=0, le=5000)
    circles_mm: tuple[Pair, ...] = ()
    """Instead of spacing_mm: any four or more centres, x right, y up."""
    colour: Literal["white-on-black", "black-on-white"] = "white-on-black"
    find: Literal["auto", "regions"] = "auto"
    regions_px: tuple[tuple[int, int, int, int], ...] = ()
    """With find = "regions": left, top, width, height around each circle, in order."""
    fixed: bool = False
    axis_deg: float = Field(default=0.0, ge=-180, le=180)
    """Direction of the table's motion in the marker plane, from x towards y: x_mm is along it."""

    @model_validator(mode="after")
    def _consistent(self) -> Marker:
        circles = self.shape.circles_mm
        if len(circles) < 4:
            raise ValueError(f"circles_mm has {len(circles)} circles, at least 4 are needed")
        if self.find == "regions" and len(self.regions_px) != len(circles):
            raise ValueError(
                f'find = "regions" needs one region for each of the {len(circles)} circles, '
                f"regions_px has {len(self.regions_px)}"
            )
        for i, (ax, ay) in enumerate(circles):
            for j, (bx, by) in enumerate(circles[:i]):
                if (ax - bx) ** 2 + (ay - by) ** 2 <= self.diameter_mm**2:
                    raise ValueError(
                        f"circles {j + 1} and {i + 1} touch: their centres must lie more than "
                        f"diameter_mm = {self.diameter_mm:g} apart"
                    )
        return self

    @property
    def shape(self) -> MarkerShape:
        """The marker in millimetres; of the four-circle sheet the order is top left, top right,
        bottom left, bottom right."""
        half = self.spacing_mm / 2
        square = ((-half, half), (half, half), (-half, -half), (half, -half))
        return MarkerShape(
            name=self.name,
            circles_mm=self.circles_mm or square,
            diameter_mm=self.diameter_mm,
            white_on_black=self.colour == "white-on-black",
            fixed=self.fixed,
        )

    @property
    def regions(self) -> tuple[Region, ...]:
        return tuple(Region(*r) for r in self.regions_px)


class SetUpSection(Section):
    file: str = "set-up.json"
    """In `directory`; loaded at start, written after each reference."""
    directory: str = ""
    """Empty: $STATE_DIRECTORY of the service, else ~/.local/state/vdms-rt."""
    load: bool = True
    store: bool = True
    reference_pictures: int = Field(default=60, ge=1, le=1000)
    still_px: float = Field(default=0.3, gt=0, le=10)
    """The most that any circle may move, peak to peak, while the reference is taken."""
    stale_px: float = Field(default=0.5, gt=0, le=50)
    """The most that a stored reference may differ from fresh stills."""
    turned_px: float = Field(default=0.1, gt=0, le=50)
    """The most that a marker's circles may have moved against each other since."""


class Process(Section):
    method: Literal["otsu", "smooth"] = "smooth"
    sampling: Literal["auto", "frame", "field"] = "auto"
    ring_slots: int = Field(default=64, ge=64, le=4096)
