"""`python -m vdms_rt` and the command `vdms-rt`."""

from __future__ import annotations

import sys


def main() -> None:
    """Run the command line and exit with its status."""
    from vdms_rt.cli import run

    sys.exit(run(sys.argv[1:]))


if __name__ == "__main__":
    main()
