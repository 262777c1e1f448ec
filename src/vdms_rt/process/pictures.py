"""What gets measured of a frame: itself, or its two fields as strided views."""

from __future__ import annotations

from vdms_rt.model import Frame, Picture, Scan


def pictures(frame: Frame, sampling: str, order: Scan | None = None) -> tuple[Picture, ...]:
    """Return what gets measured of a frame, in the order of exposure: itself, or its two fields.

    With sampling "field" or "auto" an interlaced frame gives two; `seq` is then 2 x frame + k.
    `order`, TOP_FIRST or BOTTOM_FIRST, takes the place of the frame's own.
    """
    if frame.scan in (Scan.TOP, Scan.BOTTOM):
        # The fields of one frame follow each other and share its number.
        second = frame.scan is (Scan.BOTTOM if order is Scan.TOP_FIRST else Scan.TOP)
        return (_picture(frame, 2 * frame.seq + second, frame.scan, frame.t_ns, alone=True),)
    if sampling == "frame" or not frame.scan.interlaced:
        return (_picture(frame, frame.seq, frame.scan, frame.t_ns, alone=True),)
    top_first = (order or frame.scan) is Scan.TOP_FIRST
    kinds = (Scan.TOP, Scan.BOTTOM) if top_first else (Scan.BOTTOM, Scan.TOP)
    quarter_ns = (frame.period_ns + 2) // 4
    return tuple(
        _picture(frame, 2 * frame.seq + k, scan, frame.t_ns + (2 * k - 1) * quarter_ns, alone=False)
        for k, scan in enumerate(kinds)
    )


def _picture(frame: Frame, seq: int, scan: Scan, t_ns: int, *, alone: bool) -> Picture:
    field = scan in (Scan.TOP, Scan.BOTTOM)
    offset = int(scan is Scan.BOTTOM)
    return Picture(
        seq=seq,
        frame_seq=frame.seq,
        stamp_ns=frame.stamp_ns,
        t_ns=t_ns,
        sigma_t_ns=frame.sigma_t_ns,
        utc_ns=frame.utc_ns + t_ns - frame.t_ns if frame.utc_ns else 0,
        segment=frame.segment,
        period_ns=frame.period_ns // 2 if field else frame.period_ns,
        image=frame.image if alone else frame.image[offset::2],
        scan=scan,
        row_offset=offset,
        row_step=2 if field else 1,
        damage=frame.damage,
        exposure_ns=frame.exposure_ns,
        order_known=frame.order_known,
    )
