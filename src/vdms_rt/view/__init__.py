"""A page in a browser: looks at stations, sets them up and starts runs. A client like any other."""

from vdms_rt.view.server import ViewError, run_view

__all__ = ["ViewError", "run_view"]
