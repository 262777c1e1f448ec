"""Where keys and certificates lie, and how a session uses them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from vdms_rt.model import VdmsError

AUTHORITY = "ca.pem"
SERVER = "server.pem"
SERVER_KEY = "server-key.pem"
CLIENT = "client.pem"
CLIENT_KEY = "client-key.pem"
USERS = "users.txt"


class KeysError(VdmsError):
    """Keys, certificates or passwords that cannot be used."""


def server_tls(folder: str) -> dict[str, Any]:
    """Return zenoh's `transport/link/tls` of a station that asks everyone for a certificate.

    Raises KeysError if something is missing in the folder.
    """
    authority, certificate, key = _files(
        folder, (AUTHORITY, SERVER, SERVER_KEY), "vdms-rt keys server"
    )
    return {
        "root_ca_certificate": authority,
        "listen_certificate": certificate,
        "listen_private_key": key,
        "enable_mtls": True,
    }


def client_tls(folder: str) -> dict[str, Any]:
    """Return zenoh's `transport/link/tls` of whoever dials such a station. Raises KeysError."""
    authority, certificate, key = _files(
        folder, (AUTHORITY, CLIENT, CLIENT_KEY), "vdms-rt keys client"
    )
    return {
        "root_ca_certificate": authority,
        "connect_certificate": certificate,
        "connect_private_key": key,
        "enable_mtls": True,
    }


def users_file(path: str) -> str:
    """Return the path of a file of users as zenoh reads it. Raises KeysError if nobody is in it."""
    file = Path(path).expanduser()
    try:
        lines = [line for line in file.read_text(encoding="utf-8").splitlines() if line.strip()]
    except OSError as error:
        raise KeysError(
            f"{file}: cannot be read: {error.strerror}; `vdms-rt keys password NAME` makes it"
        ) from None
    except UnicodeDecodeError:
        lines = []
    if not lines or any(":" not in line for line in lines):
        raise KeysError(
            f"{file}: not a file of users; `vdms-rt keys password NAME` makes one, "
            "with a line name:password for each"
        )
    return str(file)


def _files(folder: str, names: tuple[str, ...], maker: str) -> list[str]:
    paths = []
    for name in names:
        path = Path(folder).expanduser() / name
        try:
            path.read_bytes()
        except OSError as error:
            raise KeysError(
                f"{path}: cannot be read: {error.strerror}; `{maker}` makes it"
            ) from None
        paths.append(str(path))
    return paths
