"""The immutable set-up: what was found and measured before the first displacement.

It is state, not configuration: kept as one JSON file in the state directory, written atomically,
copied into every recording.
"""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

from pydantic import BaseModel, ConfigDict, ValidationError

from vdms_rt.config import Config, SetUpSection
from vdms_rt.measure.expect import Appearance
from vdms_rt.measure.validity import Limits
from vdms_rt.model import Aim, MarkerShape, Region, Scan, VdmsError


class SetUpError(VdmsError):
    """A stored set-up cannot be used."""


class _Value(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class FieldSetUp(_Value):
    """How one marker looks at rest in one kind of picture; tuples run over its circles."""

    kind: Scan
    """TOP or BOTTOM for a single field, PROGRESSIVE for whole frames."""
    reference_px: tuple[tuple[float, float], ...]
    """Centres in the reference pose, mean of the stills, whole-frame pixels."""
    area_px: tuple[float, ...]
    contrast: tuple[float, ...]
    appearance: Appearance | None = None
    """Of method smooth, and its limits."""
    limits: Limits | None = None


class Zero(_Value):
    """Where displacement counts from: a pose in the marker plane, relative to the reference."""

    x_mm: float = 0.0
    y_mm: float = 0.0
    rotation_mrad: float = 0.0


class MarkerSetUp(_Value):
    """One marker's reference; tuples run over its circles."""

    shape: MarkerShape
    regions: tuple[Region, ...]
    noise_px: float
    """Standard deviation of one centre's coordinate in one still."""
    homography: tuple[tuple[float, float, float], ...]
    """3 x 3, marker plane in millimetres to image in pixels, of the mean over the kinds."""
    fields: tuple[FieldSetUp, ...]
    zero: Zero = Zero()
    axis_deg: float = 0.0
    """Direction of x in the marker plane, from the marker's own x towards its y."""
    aim: Aim | None = None
    """How the camera saw it when the reference was taken."""

    @property
    def reference_px(self) -> tuple[tuple[float, float], ...]:
        """Mean of the kinds' reference centres."""
        kinds = [f.reference_px for f in self.fields]
        return tuple(
            (sum(x for x, _ in c) / len(c), sum(y for _, y in c) / len(c))
            for c in zip(*kinds, strict=True)
        )


class SetUp(_Value):
    revision: int
    utc_ns: int
    width_px: int
    height_px: int
    """Of the whole frame."""
    scan: Scan
    order_proved: bool = False
    """Motion has shown that the fields come in the order of `scan`."""
    method: str
    stills: int
    """Pictures that the reference is the mean of."""
    markers: tuple[MarkerSetUp, ...]


def set_up_path(section: SetUpSection) -> Path:
    """Return where the set-up is kept."""
    directory = section.directory or os.environ.get("STATE_DIRECTORY", "").split(":")[0]
    base = Path(directory) if directory else Path.home() / ".local" / "state" / "vdms-rt"
    return base.expanduser() / section.file


def load_set_up(path: Path) -> SetUp | None:
    """Return the stored set-up, or None where there is none.

    Raises SetUpError if the file cannot be read or is not a set-up.
    """
    try:
        text = path.read_bytes()
    except FileNotFoundError:
        return None
    except OSError as error:
        raise SetUpError(
            f"{path}: cannot read the stored set-up: {error.strerror}; mend its permissions or "
            "set setup.load = false"
        ) from None
    try:
        return SetUp.model_validate_json(text)
    except ValidationError:
        raise SetUpError(
            f"{path}: not a set-up of this version; it is ignored, and a new one replaces it"
        ) from None


def save_set_up(path: Path, set_up: SetUp) -> None:
    """Write the set-up so that after a power cut either the old or the new file is whole.

    Raises SetUpError if the disk does not take it.
    """
    beside = path.with_name(path.name + ".new")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with beside.open("wb") as file:
            file.write(set_up_json(set_up).encode())
            file.flush()
            os.fsync(file.fileno())
        beside.replace(path)
        directory = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(directory)
        finally:
            os.close(directory)
    except OSError as error:
        with contextlib.suppress(OSError):
            beside.unlink()
        raise SetUpError(
            f"{path}: cannot store the set-up: {error.strerror}; make the folder writable or set "
            "setup.directory"
        ) from None


def set_up_json(set_up: SetUp) -> str:
    """Return the set-up as the text of its file."""
    return set_up.model_dump_json(indent=1)


def set_up_from_json(text: str) -> SetUp:
    """Return the set-up in the text of its file. Raises SetUpError if it is not one."""
    try:
        return SetUp.model_validate_json(text)
    except ValidationError:
        raise SetUpError("the recorded set-up is not one of this version") from None


def mismatch(set_up: SetUp, config: Config) -> str | None:
    """Return why a stored set-up does not belong to this configuration, or None if it does."""
    shapes = [m.shape for m in config.marker]
    stored = [m.shape for m in set_up.markers]
    if shapes != stored:
        return "the markers of the configuration are others than those of the stored set-up"
    if set_up.method != config.process.method:
        return (
            f"the stored set-up was taken with method {set_up.method}, "
            f"the configuration says {config.process.method}"
        )
    for marker, kept in zip(config.marker, set_up.markers, strict=True):
        if marker.find == "regions" and marker.regions != kept.regions:
            return f"the regions of marker {marker.name} are others than those of the set-up"
    return None
