"""Where samples go: network and recording."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from vdms_rt.config.base import Section


class Publish(Section):
    enabled: bool = True
    mode: Literal["peer", "client"] = "peer"
    """peer listens itself; client needs a router at `connect`."""
    listen: tuple[str, ...] = ("tcp/0.0.0.0:7447",)
    connect: tuple[str, ...] = ()
    recover_s: float = Field(default=60.0, ge=1, le=600)
    """How long samples are kept for subscribers whose link was down."""


class Control(Section):
    enabled: bool = True
    """Take requests from this computer, and from elsewhere where that is set up below."""
    listen: tuple[str, ...] = ()
    """For whoever shows a certificate: tls addresses, with `keys`."""
    keys: str = ""
    """Folder that `vdms-rt keys server` made."""
    password_listen: tuple[str, ...] = ()
    """For whoever knows a name and password of `users`."""
    users: str = ""
    """File that `vdms-rt keys password` made: a line name:password for each."""
    through_router: bool = False
    """Whoever reaches a router of publish.connect may control."""

    @model_validator(mode="after")
    def _consistent(self) -> Control:
        for name, kept in (("listen", "keys"), ("password_listen", "users")):
            if getattr(self, name) and not getattr(self, kept):
                raise ValueError(f"{name} needs {kept}; `vdms-rt keys --help` tells how to make it")
        if others := [e for e in self.listen if not e.startswith(("tls/", "quic/"))]:
            raise ValueError(
                f'listen = "{others[0]}": only tls asks for a certificate; '
                'write for example "tls/0.0.0.0:7448"'
            )
        return self


class Record(Section):
    enabled: bool = True
    directory: str = "recordings"
    pixels: Literal["none", "regions", "frames"] = "regions"
    queue_messages: int = Field(default=4096, ge=64, le=1_000_000)
    rotate_s: float = Field(default=3600.0, ge=1, le=604800)
    rotate_mb: float = Field(default=2000.0, ge=1, le=1_000_000)
    sync_s: float = Field(default=0.5, gt=0, le=1)
    """Most that a pulled plug may cost."""
    free_mb: float = Field(default=500.0, ge=0, le=1_000_000)
    """With less room than this on the disk no pixels are recorded; 0: as long as there is any."""
    newest_pixels_gb: float = Field(default=10.0, ge=0, le=1_000_000)
    """Of the files with pixels that a grabber made outside of runs, the newest that keep them."""
    keep_gb: float = Field(default=0.0, ge=0, le=1_000_000)
    """With more recordings than this the oldest are removed; 0: never."""
