"""Serving the page: the socket, the server, and its end."""

from __future__ import annotations

import asyncio
import contextlib
import socket
import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from types import FrameType

import uvicorn

from ctxval._util.representation import call
from ctxval.errors import InputError
from ctxval.web.access import Access, new_token
from ctxval.web.app import application
from ctxval.web.connections import Connection, Waiting
from ctxval.web.desk import Desk
from ctxval.web.live import LiveCampaign
from ctxval.web.security import Hosts, is_loopback
from ctxval.web.served import OpenCampaign
from ctxval.web.service import CampaignService
from ctxval.web.state import PageState


@dataclass(frozen=True, repr=False)
class Address:
    """Where the page is served, and who may use it.

    Attributes:
        host: the address to listen at; other computers reach the page only if it is not a loopback address.
        port: the port; 0 for any free one.
        token: the token that a browser must show once; None for a random one, or for none at a loopback address.
        names: further names under which browsers may address the server.
    """

    host: str = "127.0.0.1"
    port: int = 8765
    token: str | None = None
    names: Sequence[str] = ()

    def __repr__(self) -> str:
        return call(self, self.host, self.port)  # the token is secret


def serve(
    open_campaign: OpenCampaign,
    reopen: OpenCampaign,
    address: Address,
    on_start: Callable[[str, str | None], None],
) -> None:
    """Serve a campaign until the process gets SIGINT or SIGTERM.

    Args:
        open_campaign: opens the campaign of the server.
        reopen: opens the campaign in a child process; it must be picklable.
        address: where the page is served.
        on_start: called with the address of the page and its token, if it has one, before the first request.
    """
    with contextlib.closing(listening(address.host, address.port)) as listener:
        token = address.token if address.token is not None or is_loopback(address.host) else new_token()
        access = Access(token, listener.getsockname()[1])
        service = CampaignService(Desk(open_campaign), reopen)
        server = _server(service, access, Hosts.of(address.host, address.names))
        on_start(page_address(address.host, listener.getsockname()[1]), token)
        try:
            server.run(sockets=[listener])
        finally:
            service.close()  # a second Ctrl-C skips the end of the application


@contextlib.contextmanager
def showing(live: LiveCampaign) -> Iterator[str]:
    """Serve the page of a campaign at this computer while this process executes it; yield the address of the page."""
    host = "127.0.0.1"
    with contextlib.closing(listening(host, 0)) as listener:
        port = listener.getsockname()[1]
        server = _server(live, Access(None, port), Hosts.of(host))
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]}, daemon=True)
        thread.start()
        try:
            live.started.wait(10)
            yield page_address(host, port)
            live.wait_until_seen()
        finally:
            server.end()
            thread.join()


def _server(state: PageState, access: Access, hosts: Hosts) -> _Server:
    config = uvicorn.Config(
        application(state, access, hosts),
        log_level="error",  # whoever sends nonsense must not fill the terminal
        access_log=False,  # an address may contain the token
        server_header=False,
        proxy_headers=False,
        limit_concurrency=256,  # requests and open pages
        timeout_graceful_shutdown=5,
        lifespan="on",
        http=partial(Connection, Waiting()),  # type: ignore[arg-type]
        ws="none",
    )
    return _Server(config, state.end_events)


class _Server(uvicorn.Server):
    """A server whose listeners end before it waits for its connections."""

    def __init__(self, config: uvicorn.Config, end_events: Callable[[], None]) -> None:
        super().__init__(config)
        self._end_events = end_events

    async def serve(self, sockets: list[socket.socket] | None = None) -> None:
        self._loop = asyncio.get_running_loop()
        await super().serve(sockets)

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        super().handle_exit(sig, frame)  # which asks whether the end has begun already
        self.end()

    def end(self) -> None:
        """End the server; any thread may call this."""
        self._loop.call_soon_threadsafe(self._end_events)
        self.should_exit = True


def listening(host: str, port: int) -> socket.socket:
    """Return a socket that listens at an address."""
    if not 0 <= port <= 65535:
        raise InputError(f"the port must be from 0 to 65535, got {port}.")
    try:
        family, *_, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0]
        return socket.create_server(address[:2], family=family, backlog=128)
    except (OSError, UnicodeError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise InputError(f"the page cannot be served at {host}, port {port}: {reason}.") from error


def page_address(host: str, port: int) -> str:
    """Return the address of the page for a browser; a wildcard becomes the name of this computer."""
    name = socket.gethostname() if host in ("0.0.0.0", "::", "") else host
    return f"http://[{name}]:{port}/" if ":" in name else f"http://{name}:{port}/"
