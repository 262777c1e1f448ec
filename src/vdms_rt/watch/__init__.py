"""A running station's displacement in a terminal, and in a CSV."""

from vdms_rt.watch.csv_file import CsvError
from vdms_rt.watch.loop import run_watch

__all__ = ["CsvError", "run_watch"]
