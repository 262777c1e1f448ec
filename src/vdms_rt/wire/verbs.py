"""The one table of what may be asked of a daemon."""

from __future__ import annotations

from typing import TypeAlias

from vdms_rt.wire import control_pb2 as control

CONTROL_KEY = "vdms/{station}/control/{verb}"

Request: TypeAlias = (
    control.StatusRequest
    | control.PreviewRequest
    | control.FindRequest
    | control.RegionsRequest
    | control.ReferenceRequest
    | control.ZeroRequest
    | control.RecordRequest
    | control.RecordingsRequest
    | control.AxisRequest
    | control.StrokeRequest
    | control.FieldOrderRequest
    | control.MarkerRequest
)

VERBS: dict[str, type[Request]] = {
    "status": control.StatusRequest,
    "preview": control.PreviewRequest,
    "find": control.FindRequest,
    "regions": control.RegionsRequest,
    "reference": control.ReferenceRequest,
    "zero": control.ZeroRequest,
    "record": control.RecordRequest,
    "recordings": control.RecordingsRequest,
    "axis": control.AxisRequest,
    "stroke": control.StrokeRequest,
    "field-order": control.FieldOrderRequest,
    "marker": control.MarkerRequest,
}
"""The last chunk of the key, and the request that is its payload."""
