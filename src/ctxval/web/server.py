"""Serving the page: the socket, the server, and its end."""

from __future__ import annotations

import contextlib
import secrets
import socket
import threading
from collections.abc import Callable, Iterator, Sequence
from types import FrameType

import uvicorn

from ctxval._util.refusals import reworded
from ctxval.errors import InputError
from ctxval.web.app import application
from ctxval.web.jobs import OpenCampaign
from ctxval.web.security import Access, Hosts, is_loopback
from ctxval.web.service import CampaignService
from ctxval.web.state import LiveCampaign, PageState


def serve(
    open_campaign: OpenCampaign,
    reopen: OpenCampaign,
    on_start: Callable[[str, str | None], None],
    *,
    host: str = "127.0.0.1",
    port: int = 8765,
    token: str | None = None,
    names: Sequence[str] = (),
) -> None:
    """Serve a campaign until the process gets SIGINT or SIGTERM.

    ``reopen`` opens it in a child process, and must be picklable. ``on_start`` is called with the address of the page
    and its token before the first request. Without a token there is a random one, or none at a loopback address.
    """
    with contextlib.closing(listening(host, port)) as listener:
        if token is None and not is_loopback(host):
            token = secrets.token_urlsafe(24)
        port = listener.getsockname()[1]
        access = Access(token, port)
        service = CampaignService(open_campaign, reopen)
        server = Server(service, access, Hosts.of(host, names))
        on_start(page_address(host, port), token)
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
        server = Server(live, Access(None, port), Hosts.of(host))
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]}, daemon=True)
        thread.start()
        try:
            live.started.wait(10)
            yield page_address(host, port)
            live.wait_until_seen()
        finally:
            server.end()
            thread.join()


class Server(uvicorn.Server):
    """A server whose listeners end before it waits for its connections."""

    def __init__(self, state: PageState, access: Access, hosts: Hosts) -> None:
        config = uvicorn.Config(
            application(state, access, hosts),
            log_level="error",  # whoever sends nonsense must not fill the terminal
            access_log=False,  # an address may contain the token
            server_header=False,
            proxy_headers=False,
            timeout_graceful_shutdown=5,
            lifespan="on",
            http="h11",  # which limits the size of headers
            ws="none",
        )
        super().__init__(config)
        self._state = state

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        super().handle_exit(sig, frame)  # which asks whether the end has begun already
        self.end()

    def end(self) -> None:
        """End the server; any thread may call this."""
        self._state.post(self._state.end_events)
        self.should_exit = True


def listening(host: str, port: int) -> socket.socket:
    if not 0 <= port <= 65535:
        raise InputError(f"the port must be from 0 to 65535, got {port}.")
    with reworded(f"the page cannot be served at {host}, port {port}", OSError, UnicodeError):
        family, *_, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0]
        return socket.create_server(address[:2], family=family, backlog=128)


def page_address(host: str, port: int) -> str:
    """Return the address of the page for a browser; a wildcard becomes the name of this computer."""
    name = socket.gethostname() if host in ("0.0.0.0", "::", "") else host
    return f"http://[{name}]:{port}/" if ":" in name else f"http://{name}:{port}/"
