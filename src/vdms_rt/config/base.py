"""What all sections share: strictness, and the types of their values."""

from __future__ import annotations

from fractions import Fraction
from typing import Annotated

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field


def _rate(value: object) -> Fraction:
    try:
        rate = Fraction(value) if isinstance(value, (int, str)) else Fraction(str(value))
    except (ValueError, ZeroDivisionError):
        raise ValueError('a number or a fraction such as "30000/1001"') from None
    if not Fraction(1, 10) <= rate <= 1000:
        raise ValueError("between 0.1 and 1000")
    return rate


Rate = Annotated[Fraction, BeforeValidator(_rate)]
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,63}$")]
"""A chunk of a zenoh key and of a file name."""
Pair = tuple[float, float]


class Section(BaseModel):
    model_config = ConfigDict(
        frozen=True, extra="forbid", strict=True, allow_inf_nan=False, arbitrary_types_allowed=True
    )
