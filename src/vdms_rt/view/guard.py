"""Who may do what at the page, and what a browser may load for it."""

from __future__ import annotations

import hmac
import ipaddress
import socket
from dataclasses import dataclass
from urllib.parse import urlsplit

from aiohttp import web
from aiohttp.typedefs import Handler

HEADERS = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; "
        "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-cache",
}


@dataclass(frozen=True, slots=True)
class Guard:
    """The rule: everybody who reaches the page may look. To control takes the token, where there is
    one; without one, only this computer controls."""

    token: str

    @web.middleware
    async def middleware(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        """Refuse requests that another site's page made a browser send."""
        host = request.headers.get("Host", "")
        if not _ours(host):
            # A foreign name that was pointed at this address would read as the same origin.
            raise web.HTTPForbidden(
                text="this page is only served under an address or this computer's own name"
            )
        origin = request.headers.get("Origin")
        if origin is not None and urlsplit(origin).netloc != host:
            raise web.HTTPForbidden(text="this request comes from another site's page")
        return await handler(request)

    def refusal(self, request: web.Request) -> str | None:
        """Return why this request may not control, None if it may."""
        if self.token:
            kind, _, given = request.headers.get("Authorization", "").partition(" ")
            if kind != "Bearer" or not given:
                return "Controlling needs the token that vdms-rt view printed when it started."
            if not hmac.compare_digest(_bytes(given), _bytes(self.token)):
                return "This is not the token that vdms-rt view printed when it started."
            return None
        if not self.local(request):
            return (
                "From another computer this page is for looking only; start it with "
                "vdms-rt view --token to control from here."
            )
        return None

    def access(self, request: web.Request) -> str:
        """Return `control`, `token` (it takes one) or `look` for the browser of this request."""
        if self.token:
            return "token"
        return "control" if self.local(request) else "look"

    def local(self, request: web.Request) -> bool:
        """Return whether a request comes from this computer."""
        if request.remote is None:
            return False
        return ipaddress.ip_address(request.remote.split("%")[0]).is_loopback


async def add_headers(_: web.Request, response: web.StreamResponse) -> None:
    """Add what keeps the browser from loading anything else (an `on_response_prepare`)."""
    for name, value in HEADERS.items():
        response.headers.setdefault(name, value)


def _ours(host: str) -> bool:
    try:
        name = urlsplit(f"//{host}").hostname or ""
    except ValueError:
        return False
    try:
        ipaddress.ip_address(name)
    except ValueError:
        own = socket.gethostname().lower()
        return name in ("localhost", own, own.split(".")[0], f"{own.split('.')[0]}.local")
    return True


def _bytes(text: str) -> bytes:
    # A header's bytes that are no UTF-8 have come as surrogates.
    return text.encode("utf-8", "surrogateescape")
