"""Between the values of `model` and the bytes of `vdms.proto`; one function each way."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from google.protobuf.timestamp_pb2 import Timestamp

from vdms_rt.model import (
    Aim,
    Circle,
    CircleFlag,
    Displacement,
    Event,
    Frame,
    Health,
    Luma,
    Region,
    Scan,
    Severity,
    State,
    Status,
    Truth,
)
from vdms_rt.wire import picture_pb2
from vdms_rt.wire import vdms_pb2 as pb

RAW8 = "raw8"
"""Patch.codec of one byte a pixel, row by row: the log's chunks compress it (decision 0001)."""

# To make a flag of a number costs more than to decode all the rest of a sample.
_scan = lru_cache(Scan)
_status = lru_cache(Status)
_circle_flag = lru_cache(CircleFlag)


def displacement_bytes(d: Displacement) -> bytes:
    """Return the sample as a serialised `vdms.Displacement`."""
    # Field by field: half the time of keyword arguments, in the path of every sample.
    m = pb.Displacement()
    m.session = d.session
    m.marker = d.marker
    m.seq = d.seq
    m.frame_seq = d.frame_seq
    m.scan = int(d.scan)  # type: ignore[assignment]
    m.segment = d.segment
    m.stamp_ns = d.stamp_ns
    m.t_ns = d.t_ns
    m.sigma_t_ns = d.sigma_t_ns
    m.utc_ns = d.utc_ns
    m.setup_revision = d.setup_revision
    m.x_mm = d.x_mm
    m.y_mm = d.y_mm
    m.rotation_mrad = d.rotation_mrad
    m.sigma_x_mm = d.sigma_x_mm
    m.sigma_y_mm = d.sigma_y_mm
    m.residual_mm = d.residual_mm
    m.valid = d.valid
    m.status = int(d.status)
    for c in d.circles:
        circle = m.circles.add()
        circle.x_px = c.x_px
        circle.y_px = c.y_px
        circle.area_px = c.area_px
        circle.contrast = c.contrast
        circle.flags = int(c.flags)
    return m.SerializeToString()


def displacement_from(data: bytes) -> Displacement:
    """Return the sample in a serialised `vdms.Displacement`.

    Raises google.protobuf.message.DecodeError, or ValueError, on bytes that are not one.
    """
    return displacement_of(displacement_message(data))


def displacement_message(data: bytes) -> pb.Displacement:
    """Return a serialised `vdms.Displacement` as a message that is fit for `displacement_of`.

    Raises google.protobuf.message.DecodeError, or ValueError, on bytes that are not one.
    """
    m = pb.Displacement.FromString(data)
    _scan(m.scan)
    return m


def displacement_of(m: pb.Displacement) -> Displacement:
    """Return the sample in a `vdms.Displacement` message."""
    return Displacement(
        session=m.session,
        marker=m.marker,
        seq=m.seq,
        frame_seq=m.frame_seq,
        scan=_scan(m.scan),
        segment=m.segment,
        stamp_ns=m.stamp_ns,
        t_ns=m.t_ns,
        sigma_t_ns=m.sigma_t_ns,
        utc_ns=m.utc_ns,
        setup_revision=m.setup_revision,
        x_mm=m.x_mm,
        y_mm=m.y_mm,
        rotation_mrad=m.rotation_mrad,
        sigma_x_mm=m.sigma_x_mm,
        sigma_y_mm=m.sigma_y_mm,
        residual_mm=m.residual_mm,
        status=_status(m.status),
        circles=tuple(
            [
                Circle(c.x_px, c.y_px, c.area_px, c.contrast, _circle_flag(c.flags))
                for c in m.circles
            ]
        ),
    )


def truth_bytes(t: Truth) -> bytes:
    """Return the truth as a serialised `vdms.Truth`."""
    return pb.Truth(
        marker=t.marker,
        frame=t.frame,
        scan=int(t.scan),  # type: ignore[arg-type]
        stamp_ns=t.stamp_ns,
        t_ns=t.t_ns,
        x_mm=t.x_mm,
        y_mm=t.y_mm,
        rotation_mrad=t.rotation_mrad,
        mean_x_mm=t.mean_x_mm,
        mean_y_mm=t.mean_y_mm,
    ).SerializeToString()


def truth_from(data: bytes) -> Truth:
    """Return the truth in a serialised `vdms.Truth`."""
    m = pb.Truth.FromString(data)
    return Truth(
        marker=m.marker,
        frame=m.frame,
        scan=Scan(m.scan),
        stamp_ns=m.stamp_ns,
        t_ns=m.t_ns,
        x_mm=m.x_mm,
        y_mm=m.y_mm,
        rotation_mrad=m.rotation_mrad,
        mean_x_mm=m.mean_x_mm,
        mean_y_mm=m.mean_y_mm,
    )


def event_bytes(e: Event, session: int) -> bytes:
    """Return the event as a serialised `vdms.Event`."""
    return pb.Event(
        session=session,
        utc_ns=e.utc_ns,
        t_ns=e.t_ns,
        severity=int(e.severity),  # type: ignore[arg-type]
        code=e.code,
        text=e.text,
        facts=[pb.Fact(name=name, value=value) for name, value in e.facts],
    ).SerializeToString()


def event_from(data: bytes) -> Event:
    """Return the event in a serialised `vdms.Event`."""
    m = pb.Event.FromString(data)
    return Event(
        severity=Severity(m.severity),
        code=m.code,
        text=m.text,
        t_ns=m.t_ns,
        utc_ns=m.utc_ns,
        facts=tuple((f.name, f.value) for f in m.facts),
    )


def aim_message(a: Aim) -> pb.Aim:
    """Return how the camera sees a marker as a `vdms.Aim` message."""
    return pb.Aim(**{name: getattr(a, name) for name in Aim.__dataclass_fields__})


def aim_from(m: pb.Aim) -> Aim:
    """Return how the camera sees a marker, from a `vdms.Aim` message."""
    values = {name: getattr(m, name) for name in Aim.__dataclass_fields__}
    values["advice"] = tuple(m.advice)
    return Aim(**values)


def health_message(h: Health) -> pb.Health:
    """Return the health as a `vdms.Health` message."""
    return pb.Health(
        session=h.session,
        utc_ns=h.utc_ns,
        uptime_s=h.uptime_s,
        state=h.state.value,
        device=h.device,
        captured=h.captured,
        missed=h.missed,
        damaged=h.damaged,
        overwritten=h.overwritten,
        measured=h.measured,
        invalid=h.invalid,
        not_recorded=h.not_recorded,
        unsent=h.unsent,
        frame_rate_hz=h.frame_rate_hz,
        sample_age_ms=h.sample_age_ms,
        ring_used=h.ring_used,
        record_queue=h.record_queue,
        recording=h.recording,
        record_trouble=h.record_trouble,
        fsync_ms=h.fsync_ms,
        disk_free_bytes=h.disk_free_bytes,
        clock_jitter_us=h.clock_jitter_us,
        clock_sigma_us=h.clock_sigma_us,
        clock_rate_ppm=h.clock_rate_ppm,
        utc_state=h.utc_state,
        repeated=h.repeated,
        no_signal=h.no_signal,
        pixels_left_out=h.pixels_left_out,
    )


def health_from(data: bytes) -> Health:
    """Return the health in a serialised `vdms.Health`."""
    m = pb.Health.FromString(data)
    values = {name: getattr(m, name) for name in Health.__dataclass_fields__}
    values["state"] = State(m.state)
    return Health(**values)


def picture_bytes(png: bytes, at_ns: int, station: str) -> bytes:
    """Return a PNG as a serialised `foxglove.CompressedImage`."""
    seconds, nanos = divmod(at_ns, 1_000_000_000)
    return picture_pb2.CompressedImage(
        timestamp=Timestamp(seconds=seconds, nanos=nanos),
        data=png,
        format="png",
        frame_id=station,
    ).SerializeToString()


def pixels_bytes(
    frame: Frame,
    markers: Sequence[str],
    regions: Sequence[Sequence[Region]],
    setup_revision: int,
    whole: bool,
) -> bytes:
    """Return a serialised `vdms.Pixels` with a copy of each marker's regions, in the order of its
    circles, or of the whole image; empty if there is nothing to copy.

    Regions are in rows of the whole frame, and are cut to the image. Of an image that is one
    field alone a patch holds every second row.
    """
    height_px, width_px = frame.image.shape
    row_step = 2 if frame.scan in (Scan.TOP, Scan.BOTTOM) else 1
    row_offset = 1 if frame.scan is Scan.BOTTOM else 0
    if whole:
        named = [("", 0, Region(0, row_offset, width_px, height_px * row_step))]
    else:
        named = [
            (marker, circle, region)
            for marker, circles in zip(markers, regions, strict=bool(regions))
            for circle, region in enumerate(circles)
        ]
    patches = []
    for marker, circle, region in named:
        left, right = max(region.x_px, 0), min(region.x_px + region.width_px, width_px)
        top = max(-((row_offset - region.y_px) // row_step), 0)
        end = -((row_offset - region.y_px - region.height_px) // row_step)
        bottom = min(end, height_px)
        if left < right and top < bottom:
            patches.append(
                pb.Patch(
                    marker=marker,
                    circle=circle,
                    x_px=left,
                    y_px=row_offset + top * row_step,
                    width_px=right - left,
                    height_px=bottom - top,
                    row_step=row_step,
                    codec=RAW8,
                    data=frame.image[top:bottom, left:right].tobytes(),
                )
            )
    if not patches:
        return b""
    return pb.Pixels(
        frame_seq=frame.seq,
        scan=int(frame.scan),  # type: ignore[arg-type]
        stamp_ns=frame.stamp_ns,
        t_ns=frame.t_ns,
        sigma_t_ns=frame.sigma_t_ns,
        utc_ns=frame.utc_ns,
        segment=frame.segment,
        period_ns=frame.period_ns,
        exposure_ns=frame.exposure_ns,
        order_known=frame.order_known,
        setup_revision=setup_revision,
        damage=int(frame.damage),
        width_px=width_px,
        height_px=height_px,
        patches=patches,
    ).SerializeToString()


def paste_pixels(pixels: pb.Pixels, out: Luma) -> None:
    """Fill `out`, (height_px, width_px) of the message, with its patches, and the rest with 0.

    The inverse of `pixels_bytes`. Raises ValueError with a phrase if a patch does not fit or is
    in a codec that is not known.
    """
    row_step = 2 if pixels.scan in (pb.TOP, pb.BOTTOM) else 1
    row_offset = 1 if pixels.scan == pb.BOTTOM else 0
    out[:] = 0
    for patch in pixels.patches:
        if patch.codec != RAW8:
            raise ValueError(f"pixels in the codec {patch.codec!r}, which is not known here")
        top, shift = divmod(patch.y_px - row_offset, row_step)
        bottom, right = top + patch.height_px, patch.x_px + patch.width_px
        size = patch.height_px * patch.width_px
        fits = bottom <= out.shape[0] and right <= out.shape[1] and len(patch.data) == size
        if shift or patch.row_step != row_step or top < 0 or not fits:
            raise ValueError("a patch that does not fit into its picture")
        out[top:bottom, patch.x_px : right] = np.frombuffer(patch.data, np.uint8).reshape(
            patch.height_px, patch.width_px
        )
