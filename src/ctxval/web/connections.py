"""Connections that wait: whoever has shown no token, or sends half a request, cannot keep others out."""

from __future__ import annotations

import asyncio
from collections import Counter
from typing import Any

from uvicorn.protocols.http.h11_impl import H11Protocol

SECONDS = 10.0
"""Largest time in seconds that a connection may wait."""

MOST = 128
"""Largest number of connections that wait at a time."""


class Waiting:
    """The connections without a request of a session, in the order in which they began to wait.

    If there are too many, the oldest one of the address with the most ends. A browser sends its request as a whole and
    at once, so it does not wait long enough, even if it shares its address with those who do.
    """

    def __init__(self) -> None:
        self._ends: dict[Connection, asyncio.TimerHandle] = {}

    def add(self, connection: Connection) -> None:
        """Let a connection wait, from now on."""
        self.remove(connection)
        self._ends[connection] = connection.loop.call_later(SECONDS, connection.transport.abort)
        if len(self._ends) > MOST:
            ((busiest, _),) = Counter(waiting.address for waiting in self._ends).most_common(1)
            oldest = next(waiting for waiting in self._ends if waiting.address == busiest)
            self.remove(oldest)
            oldest.transport.abort()

    def remove(self, connection: Connection) -> None:
        """Let a connection go on: it has a request of a session, or has ended."""
        ends = self._ends.pop(connection, None)
        if ends is not None:
            ends.cancel()


class Connection(H11Protocol):
    """A connection of the server; h11 limits the size of headers, which httptools does not.

    The application finds it as ``scope["state"]["connection"]``.
    """

    def __init__(self, waiting: Waiting, **options: Any) -> None:
        super().__init__(**options)
        self.waiting = waiting
        self.app_state = {**self.app_state, "connection": self}

    @property
    def address(self) -> str | None:
        """The address of the other side."""
        return self.client[0] if self.client else None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Begin to wait for a request."""
        super().connection_made(transport)
        self.waiting.add(self)

    def connection_lost(self, exc: Exception | None) -> None:
        """Wait no longer."""
        self.waiting.remove(self)
        super().connection_lost(exc)

    def on_response_complete(self) -> None:
        """Wait for the next request."""
        if not self.transport.is_closing():
            self.waiting.add(self)
        super().on_response_complete()
