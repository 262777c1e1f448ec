"""Who may do what at a station: zenoh's access control, in the form of its configuration.

Denied is what no rule allows. Rules are by message and direction, seen from the station: ingress is
what a reader sends.
"""

from __future__ import annotations

from typing import Any

_OURS = "vdms/**"
_RECOVERY = "vdms/**/@adv/**"
"""Where zenoh's advanced publishers keep history and heartbeats: `**` never crosses an `@`."""
_CONTROL = "vdms/*/control/**"

_READING: list[dict[str, Any]] = [
    {
        "id": "ask for samples",
        "permission": "allow",
        "flows": ["ingress"],
        "messages": ["declare_subscriber", "declare_liveliness_subscriber", "liveliness_query"],
        "key_exprs": [_OURS, _RECOVERY],
    },
    {
        "id": "ask for history",
        "permission": "allow",
        "flows": ["ingress"],
        "messages": ["query"],
        "key_exprs": [_RECOVERY],
    },
    {
        "id": "offer history",
        "permission": "allow",
        "flows": ["egress"],
        "messages": ["declare_queryable"],
        "key_exprs": [_RECOVERY],
    },
    {
        "id": "tell",
        "permission": "allow",
        "flows": ["egress"],
        "messages": ["put", "delete", "reply", "liveliness_token"],
        "key_exprs": [_OURS, _RECOVERY],
    },
]

_CONTROLLING: list[dict[str, Any]] = [
    {
        "id": "command",
        "permission": "allow",
        "flows": ["ingress"],
        "messages": ["query"],
        "key_exprs": [_CONTROL],
    },
    {
        "id": "take commands",
        "permission": "allow",
        "flows": ["egress"],
        "messages": ["declare_queryable"],
        "key_exprs": [_CONTROL],
    },
]


def access(controllers: list[dict[str, Any]], *, reading: bool = True) -> dict[str, Any]:
    """Return zenoh's `access_control`: everyone may read, if `reading`, and `controllers` may
    command; nobody but the station puts on its keys or answers there.

    `controllers` are zenoh's subjects without their id; an empty one is everyone.
    """
    readers = [{"id": "everyone"}] if reading else []
    named = [{"id": f"controller {n}", **subject} for n, subject in enumerate(controllers)]
    policies = []
    if readers:
        policies.append({"rules": [r["id"] for r in _READING], "subjects": ["everyone"]})
    if named:
        subjects = [subject["id"] for subject in named]
        rules = _CONTROLLING if reading else [*_CONTROLLING, _READING[-1]]
        policies.append({"rules": [r["id"] for r in rules], "subjects": subjects})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": [*_READING, *_CONTROLLING],
        "subjects": [*readers, *named],
        "policies": policies,
    }


THIS_COMPUTER: dict[str, Any] = {"interfaces": ["lo"]}
"""Whoever comes through the loopback interface."""
BY_CERTIFICATE: dict[str, Any] = {"link_protocols": ["tls", "quic"]}
"""Whoever has shown a certificate."""
EVERYONE: dict[str, Any] = {}
