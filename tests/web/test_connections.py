"""People without the token cannot send much."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from rig_page import Server, new_store, serving
from rig_thorough import more

TOKEN = "a-token-of-the-rig"


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
