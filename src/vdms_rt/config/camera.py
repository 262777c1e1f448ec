"""Camera and lens."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path

from pydantic import Field, ValidationError, model_validator

from vdms_rt.config.base import Pair, Section
from vdms_rt.config.wording import key_of, rule


class Camera(Section):
    exposure_ms: float = Field(default=16.683, ge=0, le=1000)
    """Time for which each field collects light."""
    chain_delay_ms: float = Field(default=0.0, ge=-1000, le=1000)
    """Constant extra delay of camera and grabber, from a test against a reference."""


class Lens(Section):
    """What the lens bends: a point seen at the radius r belongs at r (1 - k1 rho^2 - k2 rho^4),
    where rho is r over half the picture's diagonal."""

    k1: float = Field(default=0.0, ge=-0.2, le=0.2)
    k2: float = Field(default=0.0, ge=-0.2, le=0.2)
    centre_px: Pair | None = None
    """None: the middle of the picture."""
    pixel_aspect: float = Field(default=1.1, ge=0.5, le=2.0)
    """Pixels per unit length along a row over pixels along a column."""
    file: str = ""
    """A TOML with a section [lens], read in place of the other keys; empty in the values in
    force."""

    @model_validator(mode="after")
    def _consistent(self) -> Lens:
        # The ideal radius must rise up to the corner; its slope is a parabola in rho^2.
        steepest = [1.0]
        if self.k2 and 0 < (turn := -3 * self.k1 / (10 * self.k2)) < 1:
            steepest.append(turn)
        if any(1 - 3 * self.k1 * s - 5 * self.k2 * s * s <= 0 for s in steepest):
            raise ValueError(
                f"k1 = {self.k1:g} with k2 = {self.k2:g} folds the picture over before its corner, "
                "which no lens does; take both from one `vdms-rt lens`"
            )
        return self


def lens_of_file(lens: Lens) -> Lens:
    if not lens.file:
        return lens
    if others := sorted(lens.model_fields_set - {"file"}):
        raise ValueError(
            f"file = {lens.file!r} is read in place of {', '.join(others)}; leave out one or other"
        )
    try:
        text = Path(lens.file).expanduser().read_text(encoding="utf-8")
        found = Lens.model_validate_json(json.dumps(tomllib.loads(text)["lens"], default=str))
    except OSError as error:
        raise ValueError(
            f"{lens.file}: cannot be read: {error.strerror}; `vdms-rt lens` prints such a file"
        ) from None
    except ValidationError as error:
        fault = error.errors()[0]
        key = key_of(["lens", *fault["loc"]])
        raise ValueError(f"{lens.file}: {key}: {rule(fault['msg'])}") from None
    except (UnicodeDecodeError, tomllib.TOMLDecodeError, KeyError):
        raise ValueError(
            f"{lens.file}: not a TOML with a section [lens]; `vdms-rt lens` prints such a file"
        ) from None
    if found.file:
        raise ValueError(f"{lens.file}: lens.file = {found.file!r}: names yet another file")
    return found
