"""Who may use the page: the token of the server, sessions, and tokens of forms."""

from __future__ import annotations

import hashlib
import hmac
import secrets
from collections.abc import Mapping

from ctxval._util.representation import call
from ctxval.errors import InputError

LEAST_TOKEN = 16
"""Least number of characters of a token that the user chooses."""


class Access:
    """Sessions in signed cookies, with a key that lives as long as the server.

    Without a token, every browser on this computer may use the page. Browsers share cookies among the ports of one
    computer.
    """

    def __init__(self, token: str | None, port: int) -> None:
        if token is not None and (len(token) < LEAST_TOKEN or not (token.isascii() and token.isprintable())):
            raise InputError(f"the token must have at least {LEAST_TOKEN} characters, all of them visible ASCII.")
        self._token = token
        self._key = secrets.token_bytes(32)
        self.cookie = f"ctxval-session-{port}"

    @property
    def needs_token(self) -> bool:
        """Whether a browser must show a token."""
        return self._token is not None

    def admits(self, token: str) -> bool:
        """Return whether this is the token of the server. The comparison takes the same time for every text."""
        known, given = (self._token or "").encode(), token.encode("utf-8", "backslashreplace")
        return self._token is not None and hmac.compare_digest(known, given)

    def new_session(self) -> str:
        """Return the cookie of a new session."""
        name = secrets.token_urlsafe(18)
        return f"{name}.{self._signed('session', name)}"

    def session(self, cookies: Mapping[str, str]) -> str | None:
        """Return the name of the session of a request; None if it has no valid cookie."""
        name, _, signature = cookies.get(self.cookie, "").partition(".")
        valid = hmac.compare_digest(self._signed("session", name).encode(), signature.encode("utf-8", "replace"))
        return name if name and valid else None

    def form_token(self, session: str) -> str:
        """Return the token that each form of a session must contain."""
        return self._signed("form", session)

    def allows_form(self, session: str, token: str) -> bool:
        """Return whether a form is one of this session."""
        return hmac.compare_digest(self.form_token(session).encode(), token.encode("utf-8", "replace"))

    def _signed(self, purpose: str, text: str) -> str:
        content = f"{purpose}:{text}".encode("utf-8", "replace")
        return hmac.new(self._key, content, hashlib.sha256).hexdigest()

    def __repr__(self) -> str:
        return call(self, needs_token=self.needs_token)  # neither the key nor the token


def new_token() -> str:
    """Return a random token of 192 bits."""
    return secrets.token_urlsafe(24)
