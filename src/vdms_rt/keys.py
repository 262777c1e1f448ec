"""Keys, certificates and passwords for those who control a station from another computer.

A small authority of the station's own signs one certificate for the station and one for each who
may control it; whoever has none of it gets no connection. Keys are on the curve P-256.
"""

from __future__ import annotations

import contextlib
import datetime
import ipaddress
import os
import re
import secrets
from collections.abc import Sequence
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from vdms_rt.wire.keys import (
    AUTHORITY,
    CLIENT,
    CLIENT_KEY,
    SERVER,
    SERVER_KEY,
    USERS,
    KeysError,
)

AUTHORITY_KEY = "ca-key.pem"
YEARS = 10
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.@-]{0,63}")

Issuer = tuple[x509.Certificate, ec.EllipticCurvePrivateKey]


def make_server(folder: Path, hosts: Sequence[str]) -> str:
    """Make the station's certificate in `folder`, and the authority if there is none yet.

    `hosts` are the names and addresses under which the station is reached. Returns what to do with
    it. Raises KeysError.
    """
    names: list[x509.GeneralName] = []
    for host in hosts:
        with contextlib.suppress(ValueError):
            names.append(x509.IPAddress(ipaddress.ip_address(host)))
            continue
        if not re.fullmatch(r"[A-Za-z0-9]([A-Za-z0-9.-]{0,252}[A-Za-z0-9])?", host):
            raise KeysError(f'"{host}" is neither the name nor the address of a computer')
        names.append(x509.DNSName(host))
    issuer = _authority(folder, make=True)
    _issue(
        issuer,
        hosts[0],
        (folder / SERVER, folder / SERVER_KEY),
        ExtendedKeyUsageOID.SERVER_AUTH,
        names,
    )
    return (
        f"{folder / SERVER}: for {', '.join(hosts)}, {YEARS} years\n"
        "Write into the station's configuration:\n"
        f'[control]\nlisten = ["tls/0.0.0.0:7448"]\nkeys = "{folder.absolute()}"'
    )


def make_client(folder: Path, name: str) -> str:
    """Make a certificate for somebody who may control, signed by the authority in `folder`.

    Returns what to do with it. Raises KeysError.
    """
    _check_name(name)
    own = folder / "clients" / name
    issuer = _authority(folder, make=False)
    _make_folder(own)
    _issue(issuer, name, (own / CLIENT, own / CLIENT_KEY), ExtendedKeyUsageOID.CLIENT_AUTH, [])
    _write(own / AUTHORITY, _pem(issuer[0]), 0o644)
    return (
        f"{own}: for {name}, {YEARS} years\n"
        f"Take that folder to the other computer, by a safe way, and there:\n"
        f"vdms-rt ctl --connect tls/HOST:7448 --keys {name} status"
    )


def make_password(folder: Path, name: str, password: str) -> str:
    """Let somebody in by name and password; an empty password is made up and returned in the text.

    Raises KeysError.
    """
    _check_name(name)
    made = not password
    password = password or secrets.token_urlsafe(12)
    if not password.isprintable() or ":" in password or password != password.strip():
        raise KeysError('a password is of printable characters without ":"; choose another')
    _make_folder(folder)
    file = folder / USERS
    try:
        lines = file.read_text(encoding="utf-8").splitlines() if file.exists() else []
    except OSError as error:
        raise KeysError(f"{file}: cannot be read: {error.strerror}") from None
    lines = [line for line in lines if not line.startswith(f"{name}:")]
    _write(file, "\n".join([*lines, f"{name}:{password}", ""]).encode(), 0o600)
    told = f"{file}: {name} may control" + (f" with the password {password}" if made else "")
    return (
        f"{told}\nWrite into the station's configuration:\n"
        f'[control]\npassword_listen = ["tcp/0.0.0.0:7449"]\nusers = "{file.absolute()}"'
    )


def _authority(folder: Path, *, make: bool) -> Issuer:
    certificate, key = folder / AUTHORITY, folder / AUTHORITY_KEY
    if make and not certificate.exists():
        _make_folder(folder)
        return _issue(None, "vdms-rt station authority", (certificate, key), None, [])
    try:
        private = serialization.load_pem_private_key(key.read_bytes(), None)
        issuer = x509.load_pem_x509_certificate(certificate.read_bytes())
    except OSError as error:
        raise KeysError(
            f"{error.filename}: cannot be read: {error.strerror}; `vdms-rt keys server` makes the "
            "authority in this folder first"
        ) from None
    except ValueError:
        raise KeysError(f"{folder}: holds no authority that can be used; name another") from None
    assert isinstance(private, ec.EllipticCurvePrivateKey)
    return issuer, private


def _issue(
    issuer: Issuer | None,
    name: str,
    paths: tuple[Path, Path],
    usage: x509.ObjectIdentifier | None,
    hosts: Sequence[x509.GeneralName],
) -> Issuer:
    """Write a certificate and its key; without an issuer, of an authority that signs itself."""
    key = ec.generate_private_key(ec.SECP256R1())
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
    now = datetime.datetime.now(datetime.UTC)
    builder = (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer[0].subject if issuer else subject)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        # A day back: the clocks of two laptops seldom agree.
        .not_valid_before(now - datetime.timedelta(days=1))
        .not_valid_after(now + datetime.timedelta(days=YEARS * 365))
        .add_extension(
            x509.BasicConstraints(ca=issuer is None, path_length=None if issuer else 0), True
        )
    )
    if usage is not None:
        builder = builder.add_extension(x509.ExtendedKeyUsage([usage]), False)
    if hosts:
        builder = builder.add_extension(x509.SubjectAlternativeName(hosts), False)
    certificate = builder.sign(issuer[1] if issuer else key, hashes.SHA256())
    secret = key.private_bytes(
        serialization.Encoding.PEM,
        serialization.PrivateFormat.PKCS8,
        serialization.NoEncryption(),
    )
    _write(paths[1], secret, 0o600)
    _write(paths[0], _pem(certificate), 0o644)
    return certificate, key


def _pem(certificate: x509.Certificate) -> bytes:
    return certificate.public_bytes(serialization.Encoding.PEM)


def _check_name(name: str) -> None:
    if not NAME.fullmatch(name):
        raise KeysError(
            f'"{name}" is not a name here; use letters, digits, "_", ".", "@" and "-", at most 64'
        )


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError as error:
        raise KeysError(f"{folder}: cannot be made: {error.strerror}; name another") from None


def _write(path: Path, data: bytes, mode: int) -> None:
    """Write a file that nobody else may read before it has its mode."""
    beside = path.with_name(path.name + ".new")
    try:
        beside.unlink(missing_ok=True)
        with open(os.open(beside, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "wb") as file:
            file.write(data)
        beside.replace(path)
    except OSError as error:
        raise KeysError(
            f"{path}: cannot be written: {error.strerror}; name another folder"
        ) from None
