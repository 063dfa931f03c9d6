"""Who may use the page, and what is refused before: other hosts, other sites, and bodies that are too large."""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import hmac
import ipaddress
import secrets
import socket
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from html import escape
from urllib.parse import urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import ClientDisconnect, HTTPConnection
from starlette.responses import HTMLResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from ctxval.errors import InputError

MOST_UPLOAD = 64 * 2**20  #: largest size of a recording in bytes

HEADERS = {
    # Nothing from elsewhere, and no script or style inside the page; maps are images inside of charts.
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; "
    "connect-src 'self'; form-action 'self'; base-uri 'none'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    # With no-referrer, a browser sends forms with the origin "null".
    "Referrer-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Permissions-Policy": "camera=(), geolocation=(), microphone=()",
    "Cache-Control": "no-store",
}


class Access:
    """Who may use the page: the token of the server, if it has one, sessions in cookies, and tokens of forms."""

    def __init__(self, token: str | None, port: int) -> None:
        if token is not None and (len(token) < 16 or not (token.isascii() and token.isprintable())):
            raise InputError("the token must have at least 16 characters, all of them visible ASCII.")
        self._token = token
        self._key = secrets.token_bytes(32)  # of the signatures, as long as the server lives
        self.needs_token = token is not None
        self.cookie = f"ctxval-session-{port}"  # browsers share cookies among the ports of one computer

    def admits(self, token: str) -> bool:
        """Return whether this is the token of the server. The comparison takes the same time for every text."""
        return self._token is not None and _same(self._token, token)

    def new_session(self) -> tuple[str, str]:
        name = secrets.token_urlsafe(18)
        return name, f"{name}.{self._signed('session', name)}"

    def session(self, cookies: Mapping[str, str]) -> str | None:
        """Return the name of the session of a request; None if it has no valid cookie."""
        name, _, signature = cookies.get(self.cookie, "").partition(".")
        return name if name and _same(self._signed("session", name), signature) else None

    def form_token(self, session: str) -> str:
        return self._signed("form", session)

    def allows_form(self, session: str, token: str) -> bool:
        return _same(self.form_token(session), token)

    def _signed(self, purpose: str, text: str) -> str:
        return hmac.new(self._key, f"{purpose}:{text}".encode("utf-8", "replace"), hashlib.sha256).hexdigest()


def _same(known: str, given: str) -> bool:
    return hmac.compare_digest(known.encode(), given.encode("utf-8", "backslashreplace"))


@dataclass(frozen=True)
class Hosts:
    """The names in lower case under which a browser may address the server, and whether every IP address is one too.

    A page of another site can direct its own name to this computer (DNS rebinding), and its requests would then be
    requests of the same site. They still carry that name. A site cannot direct an address elsewhere.
    """

    names: frozenset[str]
    any_address: bool

    @staticmethod
    def of(host: str, more: Iterable[str] = ()) -> Hosts:
        names = {"localhost", "127.0.0.1", "::1", host.lower(), *(name.lower() for name in more)}
        local = is_loopback(host)
        if not local:
            computer = socket.gethostname().lower()
            names |= {computer, f"{computer.partition('.')[0]}.local"}
        return Hosts(frozenset(names), not local)

    def permit(self, header: str | None) -> bool:
        with contextlib.suppress(ValueError):
            place = urlsplit(f"//{header or ''}")
            name = None if "@" in place.netloc else place.hostname
            return bool(name) and (name in self.names or (self.any_address and is_address(str(name))))
        return False


def is_address(host: str) -> bool:
    with contextlib.suppress(ValueError):
        return bool(ipaddress.ip_address(host.partition("%")[0]))
    return False


def is_loopback(host: str) -> bool:
    return host == "localhost" or (is_address(host) and ipaddress.ip_address(host.partition("%")[0]).is_loopback)


def refusal(method: str, headers: Headers, hosts: Hosts) -> str | None:
    """Return why a request is refused, in one sentence; None if it is not."""
    host = headers.get("host")
    if not hosts.permit(host):
        return (
            f"This server is not called {(host or 'by no name')[:80]!r}. If the name is right, start the server with "
            "--allow-host NAME."
        )
    site = headers.get("sec-fetch-site", "same-origin" if headers.get("origin") else "")
    if method in ("GET", "HEAD"):
        followed_link = headers.get("sec-fetch-mode") == "navigate" and headers.get("sec-fetch-dest") == "document"
        elsewhere = site in ("cross-site", "same-site") and not followed_link
        return "Other sites cannot use this page." if elsewhere else None
    origin = headers.get("origin")
    if origin is None and site not in ("same-origin", "none"):
        return "The browser does not say which site sent this form."
    if site not in ("same-origin", "none") or (origin is not None and urlsplit(origin).netloc != host):
        return "This form was sent by another site."
    return None


class _Body:
    """Receives a body of a limited size, of which parts arrive in limited time."""

    def __init__(self, receive: Receive, most: int) -> None:
        self.receive, self.most = receive, most
        self.size, self.whole = 0, False
        self.refused: tuple[int, str] | None = None

    def require(self, size: int) -> None:
        if size > self.most:
            limit = f"{self.most / 2**20:g} MiB" if self.most >= 2**20 else f"{self.most / 2**10:g} KiB"
            self.refused = 413, f"This is too large: at most {limit} are accepted here. Nothing is stored."
            raise ClientDisconnect

    async def __call__(self) -> Message:
        try:
            async with asyncio.timeout(None if self.whole else 30.0):
                message = await self.receive()
        except TimeoutError:
            self.refused = 408, "The request arrives too slowly. Nothing is stored."
            raise ClientDisconnect from None
        self.size += len(message.get("body", b""))
        self.whole = self.whole or not message.get("more_body", False)
        self.require(self.size)
        return message


class Guard:
    """Refuses requests before the application reads them, and adds the security headers to every response."""

    def __init__(self, app: ASGIApp, hosts: Hosts, access: Access) -> None:
        self.app, self.hosts, self.access = app, hosts, access

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            # There are no WebSockets here; only the start and the end of the server are left.
            await (self.app(scope, receive, send) if scope["type"] == "lifespan" else send({"type": "websocket.close"}))
            return

        async def guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                stated = MutableHeaders(scope=message)
                for name, value in HEADERS.items():
                    stated.setdefault(name, value)
            await send(message)

        headers = Headers(scope=scope)
        refused, reason = None, refusal(scope["method"], headers, self.hosts)
        if reason is not None:
            refused = 403, reason
        elif len(scope["path"]) > 500:
            refused = 414, "The address is too long."
        else:
            body = _Body(receive, self._most(scope))

            async def sending(message: Message) -> None:
                if body.refused is None:  # otherwise starlette sends that it has failed
                    await guarded(message)

            with contextlib.suppress(ClientDisconnect):
                declared = headers.get("content-length", "0")
                body.require(int(declared) if declared.isdecimal() else 0)
                await self.app(scope, body, sending)
            refused = body.refused
        if refused is not None:
            page = _REFUSED.format(escape(refused[1]))
            await HTMLResponse(page, refused[0], {"Connection": "close"})(scope, receive, guarded)

    def _most(self, scope: Scope) -> int:
        """Return the largest size of a request."""
        known = self.access.session(HTTPConnection(scope).cookies) is not None
        if scope["path"] == "/enter" or not (known or not self.access.needs_token):
            return 2**12
        return MOST_UPLOAD if scope["path"].endswith("/recording") else 2**18


_REFUSED = (
    '<!doctype html><html lang="en"><head><meta charset="utf-8"><title>Refused</title>'
    '<meta name="viewport" content="width=device-width"></head>'
    '<body><main><h1>Refused</h1><p>{}</p><p><a href="/">To the page</a></p></main></body></html>'
)
