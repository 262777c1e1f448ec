"""What every zenoh session of ours has in common, and how an address of one is written."""

from __future__ import annotations

import re
from typing import Any

SESSION: dict[str, Any] = {
    # Nobody finds us, and no third session links up behind the back of access control.
    "scouting/multicast/enabled": False,
    "scouting/gossip/enabled": False,
    "scouting/delay": 0,
    "open/return_conditions": {"connect_scouted": False, "declares": False},
    "timestamping/enabled": True,
    # A cut is noticed within 2 s instead of 10 s, and mended as soon.
    "transport/link/tx/lease": 2000,
    "connect/retry": {
        "period_init_ms": 200,
        "period_max_ms": 500,
        "period_increase_factor": 1.5,
    },
    # Samples are far too small to gain from it.
    "transport/shared_memory/enabled": False,
}
"""zenoh's configuration keys and their values."""

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"

_ENDPOINT = re.compile(
    r"(?:tcp|tls|quic|udp|ws)/(?:\[[0-9A-Fa-f:.]+(?:%[\w.-]+)?\]|[\w.*-]+):(?P<port>\d{1,5})"
    r"(?:\?[^#\s]*)?(?:#\S*)?"
)
_SOCKET_FILE = re.compile(r"unixsock-stream/\S+")
_PLACE_IN_SOURCE = re.compile(r"\s*\bat \S+\.rs:\d+\.?")


def endpoint_fault(endpoint: str) -> str | None:
    """Return what is wrong with the text of an address and how to mend it, or None."""
    found = _ENDPOINT.fullmatch(endpoint)
    if (found and int(found["port"]) <= 65535) or _SOCKET_FILE.fullmatch(endpoint):
        return None
    return (
        f'"{endpoint}" is not an address; write protocol/host:port, '
        f'for example "{DEFAULT_ENDPOINT}"'
    )


def reason(error: Exception) -> str:
    """Return zenoh's message without the places in its source code."""
    return _PLACE_IN_SOURCE.sub("", str(error)).strip().rstrip(".")
