"""Where samples go: network and recording."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from vdms_rt.config.base import Section


class Publish(Section):
    enabled: bool = True
    mode: Literal["peer", "client"] = "peer"
    """peer listens itself; client needs a router at `connect`."""
    listen: tuple[str, ...] = ("tcp/0.0.0.0:7447",)
    connect: tuple[str, ...] = ()
    recover_s: float = Field(default=60.0, ge=1, le=600)
    """How long samples are kept for subscribers whose link was down."""


class Record(Section):
    enabled: bool = True
    directory: str = "recordings"
    pixels: Literal["none", "regions", "frames"] = "regions"
    queue_messages: int = Field(default=4096, ge=64, le=1_000_000)
    rotate_s: float = Field(default=3600.0, ge=1, le=604800)
    rotate_mb: float = Field(default=2000.0, ge=1, le=1_000_000)
    sync_s: float = Field(default=0.5, gt=0, le=1)
    """Most that a pulled plug may cost."""
