"""What is agreed with a driver before it streams: input, standard, format, fields and rate."""

from __future__ import annotations

from ctypes import c_int, c_uint64
from dataclasses import dataclass
from fractions import Fraction

from vdms_rt.capture import v4l2_api as api
from vdms_rt.capture.controls import set_controls
from vdms_rt.capture.grabber import PIXEL_FORMATS
from vdms_rt.capture.v4l2_luma import PixelLayout
from vdms_rt.capture.v4l2_node import Node
from vdms_rt.config import V4l2
from vdms_rt.model import NTSC_FRAME_PERIOD_S, PAL_FRAME_PERIOD_S, Scan, SourceError

FIRST_FIELD_HABIT = {
    "stk1160": Scan.TOP_FIRST,
    "em28xx": Scan.TOP_FIRST,
    "cx231xx": Scan.TOP_FIRST,
    "usbtv": Scan.BOTTOM_FIRST,
}
"""The field that these drivers pair first into a frame, whatever the standard says."""

_SINGLE_STANDARDS = ("ntsc-m", "ntsc-m-jp", "ntsc-m-kr", "ntsc-443", "pal-m", "pal-60")


@dataclass(frozen=True, slots=True)
class Settings:
    """What the driver agreed to."""

    layout: PixelLayout
    scan: Scan
    scan_known: bool
    frame_period_s: Fraction
    standard: str
    """By its name in the configuration; empty where there is none."""
    facts: tuple[tuple[str, str], ...]
    warnings: tuple[str, ...]


def agree(node: Node, config: V4l2, field: int) -> Settings:
    """Set input, standard, format and controls, in this order; return what the driver made of it.

    `field` is the V4L2_FIELD_* to ask for. Raises SourceError. Nothing is changed on a device that
    another program has in use. Standards are refused once there are buffers, so this comes first.
    """
    # Only the holder of a node's buffers may free them, so this asks whether there is another.
    nothing = api.RequestBuffers(type=api.BUF_TYPE_VIDEO_CAPTURE, memory=api.MEMORY_MMAP)
    node.call(api.VIDIOC_REQBUFS, nothing, "being asked whether it is free")
    offered, input_name = _set_input(node, config.input)
    standard, standard_fact = _set_standard(node, config.standard, offered)
    layout = _set_format(node, config, standard, field)
    scan, known = _scan(node, layout, standard, config.field_order)
    period_s, period_fact = _frame_period(node, layout, standard)
    adjusted, warnings = set_controls(node, config)
    size = f"{layout.width_px}x{layout.height_px}"
    order = scan.name.lower().replace("_", " ") if scan != Scan.TOP else "one field an image"
    facts = (
        ("input", input_name),
        ("standard", standard_fact),
        ("format", f"{layout.pixel_format} {size}"),
        ("fields", order if known else f"{order} by habit of the driver"),
        ("frame period", period_fact),
        *adjusted,
    )
    name = standard_fact.split(",")[0] if standard else ""
    return Settings(layout, scan, known, period_s, name, facts, warnings)


def _set_input(node: Node, index: int) -> tuple[int, str]:
    """Return the standards that the input has, as bits, and its number and name."""
    inputs = api.inputs(node.fd)
    if index >= max(len(inputs), 1):
        names = ", ".join(f"{i} {api.text(one.name)}" for i, one in enumerate(inputs))
        raise SourceError(
            f"{node.name} has no input {index}; set v4l2.input to one of: {names or '0'}"
        )
    if not inputs:
        return 0, "the only one"
    node.call(api.VIDIOC_S_INPUT, c_int(index), f"setting input {index}")
    return inputs[index].std, f"{index} {api.text(inputs[index].name)}"


def _set_standard(node: Node, wanted: str, offered: int) -> tuple[int, str]:
    """Return the bits of the standard that was set, 0 where there are none, and words on it.

    `offered` is what the input has.
    """
    names = [name for name, bits in api.STANDARDS.items() if bits & offered]
    name, how = wanted, "as configured"
    if wanted == "auto":
        detected = c_uint64()
        asked = node.offers(api.VIDIOC_QUERYSTD, detected, "detecting the standard")
        name, how = detected_standard(detected.value) if asked else "", "detected"
        if not name:
            name, how = next(iter(names), "ntsc-m"), "assumed, none was detected"
    bits = api.STANDARDS[name]
    if node.offers(api.VIDIOC_S_STD, c_uint64(bits), f"setting the standard {name}"):
        return bits, f"{name}, {how}"
    if wanted == "auto" and not names:
        return 0, "none"
    mend = f"set v4l2.standard to one that it has: {', '.join(names)}"
    if not names:
        mend = 'it has none; set v4l2.standard = "auto"'
    raise SourceError(f"{node.name} does not accept the standard {name}; {mend}")


def detected_standard(bits: int) -> str:
    """Return the configuration's name of a standard that a driver detects, or "" if its answer
    leaves open whether there are 525 or 625 lines."""
    if bits & api.STD_525_60 and not bits & api.STD_625_50:
        return next(name for name in _SINGLE_STANDARDS if api.STANDARDS[name] & bits)
    if bits & api.STD_625_50 and not bits & api.STD_525_60:
        return "pal"
    return ""


def _set_format(node: Node, config: V4l2, standard: int, field: int) -> PixelLayout:
    """Set the first wanted format that the driver has in the wanted size, else the first that it
    has at all, in the size nearest to it."""
    try:
        offered = api.pixel_formats(node.fd)
    except OSError as error:
        raise node.error(error, "listing its formats") from None
    wanted = PIXEL_FORMATS if config.pixel_format == "auto" else (config.pixel_format,)
    size = (config.width_px, config.height_px or (576 if standard & api.STD_625_50 else 480))
    others: list[PixelLayout] = []
    for name in wanted:
        if name not in offered:
            continue
        layout = _request_format(node, name, size, field)
        if layout.pixel_format != name:
            continue
        if (layout.width_px, layout.height_px) == size:
            return layout
        others.append(layout)
    if others:
        best = others[0]
        return _request_format(node, best.pixel_format, (best.width_px, best.height_px), best.field)
    mend = "choose another device"
    if config.pixel_format != "auto":
        mend = 'set v4l2.pixel_format = "auto"'
    raise SourceError(
        f"{node.name} has no picture format {' or '.join(wanted)}, only "
        f"{', '.join(offered) or 'none'}; {mend}"
    )


def _request_format(node: Node, name: str, size: tuple[int, int], field: int) -> PixelLayout:
    answer = api.Format(type=api.BUF_TYPE_VIDEO_CAPTURE)
    pix = answer.pix
    pix.pixelformat = api.fourcc(name)
    pix.width, pix.height = size
    pix.field = field
    node.call(api.VIDIOC_S_FMT, answer, f"setting the format {name}")
    return PixelLayout(
        api.fourcc_name(pix.pixelformat), pix.width, pix.height, pix.bytesperline, pix.field
    )


def _scan(node: Node, layout: PixelLayout, standard: int, override: str) -> tuple[Scan, bool]:
    bottom_first = bool(standard & api.STD_525_60) or (not standard and layout.height_px == 480)
    rule = Scan.BOTTOM_FIRST if bottom_first else Scan.TOP_FIRST
    try:
        return image_scan(layout.field, FIRST_FIELD_HABIT.get(node.driver, rule), override)
    except ValueError as error:
        raise SourceError(
            f"{node.name} gives {error}; set v4l2.height_px to the rows of a whole frame"
        ) from None


def image_scan(field: int, habit: Scan, override: str) -> tuple[Scan, bool]:
    """Return how the rows of an image come about, and whether that is a fact or a habit.

    `field` is the V4L2_FIELD_* of the format; `habit` is what to believe where it does not tell
    which field is the older; `override` is the configuration's field_order. Where no driver has a
    habit of its own, the V4L2 specification holds (Field Order): of the 525-line standards the
    bottom field is the older, of all others the top field.
    Raises ValueError for a format that has the same one field of every frame.
    """
    if field == api.FIELD_ALTERNATE:
        return Scan.TOP, True
    if field in (api.FIELD_TOP, api.FIELD_BOTTOM):
        raise ValueError("only one field of each frame")
    if override != "auto":
        orders = {"top-first": Scan.TOP_FIRST, "bottom-first": Scan.BOTTOM_FIRST}
        return orders.get(override, Scan.PROGRESSIVE), True
    if field in (api.FIELD_INTERLACED_TB, api.FIELD_SEQ_TB):
        return Scan.TOP_FIRST, True
    if field in (api.FIELD_INTERLACED_BT, api.FIELD_SEQ_BT):
        return Scan.BOTTOM_FIRST, True
    if field == api.FIELD_INTERLACED:
        return habit, False
    return Scan.PROGRESSIVE, True


def _frame_period(node: Node, layout: PixelLayout, standard: int) -> tuple[Fraction, str]:
    """Return seconds from one frame to the next, and words on where that comes from."""
    if standard & api.STD_525_60:
        return NTSC_FRAME_PERIOD_S, "1001/30000 s by the standard"
    if standard & api.STD_625_50:
        return PAL_FRAME_PERIOD_S, "1/25 s by the standard"
    now = api.StreamParameters(type=api.BUF_TYPE_VIDEO_CAPTURE)
    first = api.FrameInterval(
        pixel_format=api.fourcc(layout.pixel_format), width=layout.width_px, height=layout.height_px
    )
    period = api.Fraction()
    if node.offers(api.VIDIOC_G_PARM, now, "asking for its rate"):
        period = now.timeperframe
    if not period.numerator and node.offers(
        api.VIDIOC_ENUM_FRAMEINTERVALS, first, "asking for its rates"
    ):
        period = first.discrete if first.type == api.FRMIVAL_TYPE_DISCRETE else api.Fraction()
    if not period.numerator or not period.denominator:
        return NTSC_FRAME_PERIOD_S, "1001/30000 s assumed, for the driver names none"
    seconds = Fraction(period.numerator, period.denominator)
    return seconds, f"{seconds} s by the driver"
