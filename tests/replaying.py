"""Recordings with known content, for the tests of vdms-replay."""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

import numpy as np

from vdms_rt import codec
from vdms_rt.logfile.writer import PART_SUFFIX, LogAttachment, LogMessage, LogWriter
from vdms_rt.wire import convert, picture_pb2, topics
from vdms_rt.wire import vdms_pb2 as pb

PERIOD_NS = 16_683_350
RATE_HZ = 1e9 / PERIOD_NS
START_T_NS = 1_000_000_000_123
START_UTC_NS = 1_790_000_000_123_456_789
SESSION = 0x00C0FFEE12345678
AMPLITUDE_MM = 10.0
FREQUENCY_HZ = 1.0
PNG = codec.png(np.arange(48, dtype=np.uint8).reshape(6, 8))


def t_ns_of(seq: int) -> int:
    return START_T_NS + seq * PERIOD_NS


def x_mm_of(seq: int) -> float:
    return AMPLITUDE_MM * math.sin(2e-9 * math.pi * FREQUENCY_HZ * seq * PERIOD_NS)


def sample(
    seq: int,
    marker: str = "m1",
    *,
    status: int = 0,
    session: int = SESSION,
    utc_offset_ns: int = START_UTC_NS - START_T_NS,
) -> pb.Displacement:
    """Return a sample of the known motion; one without a position for status NOT_FOUND."""
    lost = bool(status & pb.NOT_FOUND)
    return pb.Displacement(
        session=session,
        marker=marker,
        seq=seq,
        frame_seq=seq // 2,
        scan=pb.BOTTOM if seq % 2 == 0 else pb.TOP,
        stamp_ns=t_ns_of(seq // 2 * 2) + 25_000_000,
        t_ns=t_ns_of(seq),
        sigma_t_ns=50_000,
        utc_ns=t_ns_of(seq) + utc_offset_ns if utc_offset_ns else 0,
        setup_revision=1,
        x_mm=math.nan if lost else x_mm_of(seq),
        y_mm=math.nan if lost else -x_mm_of(seq) / 7,
        rotation_mrad=math.nan if lost else 0.5,
        sigma_x_mm=0.001,
        sigma_y_mm=0.002,
        residual_mm=0.003,
        valid=not lost,
        status=status,
        circles=[pb.Circle(x_px=100 + n, y_px=200 + n, area_px=300, flags=0) for n in range(4)],
    )


def write_recording(
    path: Path,
    seqs: Sequence[int] = range(300),
    *,
    station: str = "lab",
    markers: Sequence[str] = ("m1",),
    lost: Collection[int] = (),
    status: Mapping[int, int] | None = None,
    session: int = SESSION,
    utc_offset_ns: int = START_UTC_NS - START_T_NS,
    truth: bool = False,
    pixels: bool = False,
    finish: bool = True,
    sync_every: int = 30,
    health: Mapping[str, int] | None = None,
) -> Path:
    """Write samples `seqs` of each marker, those in `lost` left out; return the file's path, which
    ends in .part where it is not finished."""
    log = LogWriter(path)
    number = 0

    def add(topic: topics.Topic, at_ns: int, message: object, marker: str = "") -> None:
        nonlocal number
        number += 1
        log.add(
            LogMessage(
                topic.key.format(station=station, marker=marker),
                topic.message,
                number,
                at_ns,
                at_ns,
                message.SerializeToString(),  # type: ignore[attr-defined]
            )
        )

    begin_ns = t_ns_of(seqs[0]) + utc_offset_ns
    log.add_metadata("vdms", {"station": station, "version": "9.9"})
    log.attach(LogAttachment("reference.png", "image/png", begin_ns, PNG), begin_ns)
    add(
        topics.RUN,
        begin_ns,
        pb.Run(
            session=session,
            utc_ns=begin_ns,
            version="9.9",
            station=station,
            config_text="[station]",
            effective_config=json.dumps({"marker": [{"name": name} for name in markers]}),
            facts=[pb.Fact(name="source", value="written by a test")],
        ),
    )
    add(
        topics.PICTURE,
        begin_ns,
        picture_pb2.CompressedImage.FromString(convert.picture_bytes(PNG, begin_ns, station)),
    )
    for seq in seqs:
        at_ns = t_ns_of(seq) + utc_offset_ns
        if seq in lost:
            continue
        for marker in markers:
            value = sample(
                seq,
                marker,
                status=(status or {}).get(seq, 0),
                session=session,
                utc_offset_ns=utc_offset_ns,
            )
            add(topics.DISPLACEMENT, at_ns, value, marker)
            if truth:
                add(
                    topics.TRUTH,
                    at_ns,
                    pb.Truth(
                        marker=marker,
                        frame=seq // 2,
                        scan=value.scan,
                        stamp_ns=value.stamp_ns,
                        t_ns=value.t_ns,
                        x_mm=x_mm_of(seq),
                        mean_x_mm=x_mm_of(seq),
                    ),
                    marker,
                )
        if pixels and seq % 2 == 0:
            patch = pb.Patch(marker="m1", width_px=40, height_px=40, data=bytes(range(40)) * 40)
            add(topics.PIXELS, at_ns, pb.Pixels(frame_seq=seq // 2, patches=[patch]))
        if seq % sync_every == 0:
            log.sync()
        if seq % 60 == 0:
            counters = {"missed": len(lost), **(health or {})}
            standing = pb.Health(session=session, utc_ns=at_ns, state="measuring", **counters)
            add(topics.HEALTH, at_ns, standing)
    end_ns = t_ns_of(seqs[-1]) + utc_offset_ns
    add(
        topics.EVENT,
        end_ns,
        pb.Event(
            session=session,
            utc_ns=end_ns,
            severity=pb.Event.WARNING,
            code="frames-missed",
            text="a frame was missed",
        ),
    )
    if not finish:
        log.sync()
        log.abandon()
        return path.with_name(path.name + PART_SUFFIX)
    add(topics.END, end_ns, pb.End(session=session, reason="stopped by the test"))
    log.close()
    return path
