"""People without the token do not keep operators out, and cannot make the server work."""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Iterator
from typing import BinaryIO

import pytest

from rig_page import Server, new_store, serving
from rig_thorough import more

TOKEN = "a-token-of-the-rig"

HALVES = {
    "nothing": b"",
    "half a head": b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nX-",
    "half a form": b"POST /enter HTTP/1.1\r\nHost: 127.0.0.1\r\nOrigin: http://127.0.0.1\r\n"
    b"Content-Type: application/x-www-form-urlencoded\r\nContent-Length: 900\r\n\r\ntoken=",
    "half a recording": b"POST /trials/0/recording HTTP/1.1\r\nHost: 127.0.0.1\r\nOrigin: http://127.0.0.1\r\n"
    b"Content-Type: multipart/form-data; boundary=e\r\nContent-Length: 60000000\r\n\r\n--e\r\n",
}


@pytest.fixture(scope="module", params=[("--token", TOKEN), *more(((),))], ids=["token", "no token"])
def server(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """A server that asks for a token, and one that does not."""
    folder = tmp_path_factory.mktemp("rig")
    new_store(folder)
    with serving(folder, *request.param) as found:
        yield found


def session(server: Server) -> str:
    return (
        server.request("GET", f"/?token={TOKEN}").cookie
        if "token" in server.address
        else server.request("GET", "/").cookie
    )


@contextlib.contextmanager
def half_sent(server: Server, count: int, content: bytes) -> Iterator[list[socket.socket]]:
    """Open connections that send half a request, and keep them open."""
    with contextlib.ExitStack() as stack:
        found = []
        for _ in range(count):
            one = stack.enter_context(socket.create_connection(("127.0.0.1", server.port), timeout=30))
            with contextlib.suppress(OSError):
                one.sendall(content.replace(b"127.0.0.1", f"127.0.0.1:{server.port}".encode()))
            found.append(one)
        yield found


@pytest.mark.slow
@pytest.mark.parametrize("half", HALVES)
def test_three_hundred_half_sent_requests_keep_nobody_out(server: Server, half: str) -> None:
    with half_sent(server, 300, HALVES[half]):
        for _ in range(3):
            connection = socket.create_connection(("127.0.0.1", server.port), timeout=8)
            with connection, connection.makefile("rb") as answer:
                connection.sendall(f"GET / HTTP/1.1\r\nHost: 127.0.0.1:{server.port}\r\n\r\n".encode())
                assert answer.readline().split()[1] in (b"200", b"401")
        cookie = session(server)
        assert server.request("GET", "/", Cookie=cookie).status == 200


@contextlib.contextmanager
def opened_page(server: Server) -> Iterator[BinaryIO]:
    """Open the page of an operator; yield what keeps it up to date."""
    cookie = session(server)
    with socket.create_connection(("127.0.0.1", server.port), timeout=30) as page, page.makefile("rb") as events:
        page.sendall(f"GET /events HTTP/1.1\r\nHost: 127.0.0.1:{server.port}\r\nCookie: {cookie}\r\n\r\n".encode())
        assert events.readline().split()[1] == b"200"
        yield events


@pytest.mark.slow
@pytest.mark.thorough
def test_requests_that_do_not_come_end_and_pages_stay_up_to_date_meanwhile(server: Server) -> None:
    with contextlib.ExitStack() as stack:
        events = stack.enter_context(opened_page(server))
        last = []
        stack.enter_context(half_sent(server, 180, HALVES["half a head"]))
        for half in list(HALVES)[:3]:  # so few that none of them must make room for another one
            last += stack.enter_context(half_sent(server, 40, HALVES[half]))
        for one in last:
            with contextlib.suppress(ConnectionResetError):
                while one.recv(2**16):
                    pass
        assert any(line.startswith(b": the server") for line in events)


def test_nobody_without_the_token_can_send_much(server: Server) -> None:
    sent = {"Origin": f"http://127.0.0.1:{server.port}", "Content_Type": "application/x-www-form-urlencoded"}
    large = server.request("POST", "/enter", b"token=" + b"&a=" * 4096, **sent)
    assert (large.status, "at most 4 KiB" in large.text) == (413, True)
    slow = server.request("POST", "/enter", (b"a" * 400 for _ in range(40)), **sent)
    assert slow.status == 413
    if "token" in server.address:
        assert server.request("POST", "/choose", b"a" * 5000, **sent).status == 413
    cookie = session(server)
    assert server.request("POST", "/choose", b"how=" + b"a" * 2**18, Cookie=cookie, **sent).status == 413
