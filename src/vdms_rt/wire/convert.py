"""Between the values of `model` and the bytes of `vdms.proto`; one function each way."""

from __future__ import annotations

from vdms_rt.model import (
    Circle,
    CircleFlag,
    Displacement,
    Event,
    Health,
    Scan,
    Severity,
    State,
    Status,
    Truth,
)
from vdms_rt.wire import vdms_pb2 as pb


def displacement_bytes(d: Displacement) -> bytes:
    """Return the sample as a serialised `vdms.Displacement`."""
    return pb.Displacement(
        session=d.session,
        marker=d.marker,
        seq=d.seq,
        frame_seq=d.frame_seq,
        scan=int(d.scan),  # type: ignore[arg-type]
        segment=d.segment,
        stamp_ns=d.stamp_ns,
        t_ns=d.t_ns,
        sigma_t_ns=d.sigma_t_ns,
        utc_ns=d.utc_ns,
        setup_revision=d.setup_revision,
        x_mm=d.x_mm,
        y_mm=d.y_mm,
        rotation_mrad=d.rotation_mrad,
        sigma_x_mm=d.sigma_x_mm,
        sigma_y_mm=d.sigma_y_mm,
        residual_mm=d.residual_mm,
        valid=d.valid,
        status=int(d.status),
        circles=[
            pb.Circle(
                x_px=c.x_px,
                y_px=c.y_px,
                area_px=c.area_px,
                contrast=c.contrast,
                flags=int(c.flags),
            )
            for c in d.circles
        ],
    ).SerializeToString()


def displacement_from(data: bytes) -> Displacement:
    """Return the sample in a serialised `vdms.Displacement`.

    Raises google.protobuf.message.DecodeError on bytes that are not one.
    """
    m = pb.Displacement.FromString(data)
    return Displacement(
        session=m.session,
        marker=m.marker,
        seq=m.seq,
        frame_seq=m.frame_seq,
        scan=Scan(m.scan),
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
        status=Status(m.status),
        circles=tuple(
            Circle(c.x_px, c.y_px, c.area_px, c.contrast, CircleFlag(c.flags)) for c in m.circles
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
    )


def health_from(data: bytes) -> Health:
    """Return the health in a serialised `vdms.Health`."""
    m = pb.Health.FromString(data)
    values = {name: getattr(m, name) for name in Health.__dataclass_fields__}
    values["state"] = State(m.state)
    return Health(**values)
