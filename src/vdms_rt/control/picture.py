"""The picture that a person aims the camera by."""

from __future__ import annotations

from collections.abc import Sequence

from vdms_rt import codec
from vdms_rt.command import Snapshot
from vdms_rt.measure.aim import aim
from vdms_rt.measure.centroid import otsu_circle, otsu_semi_axes
from vdms_rt.measure.gate import Workspace
from vdms_rt.measure.homography import GeometryError
from vdms_rt.model import UNUSABLE_CIRCLE, Luma, MarkerShape, Region, Scan
from vdms_rt.wire import control_pb2 as control
from vdms_rt.wire import vdms_pb2 as pb
from vdms_rt.wire.convert import aim_message, displacement_bytes


def preview(
    snapshot: Snapshot,
    shapes: Sequence[MarkerShape],
    pixel_aspect: float,
    quality: int,
    most_width_px: int,
) -> control.Preview:
    """Return a frame as a JPEG of 1 to 100 `quality`, with what was measured in it.

    The JPEG shows the whole frame, also of a source that gives single fields, and is not wider
    than `most_width_px` unless that is 0.
    """
    image = snapshot.image
    if snapshot.scan in (Scan.TOP, Scan.BOTTOM):
        image = image.repeat(2, axis=0)
    image = codec.narrowed(image, most_width_px)
    regions = snapshot.regions or ((),) * len(shapes)
    return control.Preview(
        jpeg=codec.jpeg(image, quality),
        width_px=snapshot.width_px,
        height_px=snapshot.height_px,
        seq=snapshot.seq,
        t_ns=snapshot.t_ns,
        utc_ns=snapshot.utc_ns,
        state=snapshot.state.value,
        markers=[
            control.MarkerSeen(
                marker=shape.name,
                regions=[rectangle(r) for r in own],
                newest=pb.Displacement.FromString(displacement_bytes(sample)),
                aim=_aim(snapshot, shape, own, pixel_aspect),
            )
            for shape, own, sample in zip(shapes, regions, snapshot.samples, strict=True)
        ],
    )


def _aim(
    snapshot: Snapshot, shape: MarkerShape, regions: Sequence[Region], pixel_aspect: float
) -> pb.Aim | None:
    """Return how the camera sees a marker, None where it is not seen in its regions."""
    image, first_row, row_step = _one_exposure(snapshot)
    light = shape.white_on_black
    circles = [otsu_circle(image, region, light, first_row, row_step) for region in regions]
    if not circles or any(c.flags & UNUSABLE_CIRCLE for c in circles):
        return None
    centres_px = tuple((c.x_px, c.y_px) for c in circles)
    semi_axes_px = tuple(
        otsu_semi_axes(image, region, light, first_row, row_step) for region in regions
    )
    try:
        seen = aim(
            image,
            first_row,
            row_step,
            snapshot.height_px,
            shape,
            centres_px,
            semi_axes_px,
            pixel_aspect,
            Workspace(),
        )
    except GeometryError:
        return None
    return aim_message(seen)


def _one_exposure(snapshot: Snapshot) -> tuple[Luma, int, int]:
    """Return the rows that were exposed at one time, the first of them, and their distance."""
    if snapshot.scan.interlaced:
        return snapshot.image[::2], 0, 2
    if snapshot.scan in (Scan.TOP, Scan.BOTTOM):
        return snapshot.image, int(snapshot.scan is Scan.BOTTOM), 2
    return snapshot.image, 0, 1


def marker_regions(marker: str, regions: Sequence[Region]) -> control.MarkerRegions:
    """Return a marker's regions as an answer carries them."""
    return control.MarkerRegions(marker=marker, regions=[rectangle(r) for r in regions])


def rectangle(region: Region) -> control.Rectangle:
    """Return a region as a message."""
    return control.Rectangle(
        x_px=region.x_px,
        y_px=region.y_px,
        width_px=region.width_px,
        height_px=region.height_px,
    )
