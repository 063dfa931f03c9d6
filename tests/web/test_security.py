"""Which requests reach the page, without a server."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from facts import refuses

pytest.importorskip("starlette", reason="starlette is not installed")

import pytest
from starlette.datastructures import Headers

from ctxval.errors import InputError
from ctxval.web.security import HEADERS, Access, Guard, Hosts, is_address, is_loopback, refusal

LOCAL = Hosts.of("127.0.0.1")
NETWORK = Hosts.of("0.0.0.0", ["Rig.Example"])


@pytest.mark.parametrize(
    ("host", "local", "network"),
    [
        ("localhost", True, True),
        ("127.0.0.1:8765", True, True),
        ("[::1]:8765", True, True),
        ("192.168.0.7:8765", False, True),
        ("[fe80::1]:1", False, True),
        ("rig.example", False, True),
        ("RIG.EXAMPLE:80", False, True),
        ("evil.example", False, False),
        ("evil.example@localhost", False, False),
        ("localhost.evil.example", False, False),
        ("127.0.0.1.nip.io", False, False),
        ("[::1", False, False),
        ("localhost:port", True, True),
        ("", False, False),
        (None, False, False),
    ],
)
def test_only_the_names_of_the_server_are_permitted(host: str | None, local: bool, network: bool) -> None:
    assert (LOCAL.permit(host), NETWORK.permit(host)) == (local, network)


@given(st.text())
def test_no_host_is_too_odd(host: str) -> None:
    assert LOCAL.permit(host) in (True, False)
    assert is_address(host) in (True, False)


def test_addresses_of_this_computer_alone_are_loopback() -> None:
    assert [is_loopback(host) for host in ("127.0.0.1", "127.9.9.9", "::1", "localhost")] == [True] * 4
    assert [is_loopback(host) for host in ("0.0.0.0", "::", "", "192.168.0.7", "localhost.example")] == [False] * 5


def headers(**given: str) -> Headers:
    return Headers({"host": "localhost:1", **{name.replace("_", "-"): value for name, value in given.items()}})


SITES = st.sampled_from(["same-origin", "same-site", "cross-site", "none", "odd"])
ORIGINS = st.sampled_from(
    ["http://localhost:1", "https://localhost:1", "http://localhost:2", "http://evil", "null", ""]
)


@given(st.none() | SITES, st.none() | ORIGINS)
def test_a_form_is_accepted_from_the_page_alone(site: str | None, origin: str | None) -> None:
    sent = {name: value for name, value in (("sec_fetch_site", site), ("origin", origin)) if value is not None}
    right_site = site in (None, "same-origin", "none")
    right_origin = origin in (None, "http://localhost:1", "https://localhost:1")
    accepted = right_site and right_origin and (site is not None or origin is not None)
    assert (refusal("POST", headers(**sent), LOCAL) is None) == accepted


def test_a_program_without_a_browser_may_read_but_not_write() -> None:
    assert refusal("GET", headers(), LOCAL) is None
    assert refusal("HEAD", headers(), LOCAL) is None
    for method in ("POST", "PUT", "DELETE", "ODD"):
        assert refusal(method, headers(), LOCAL) is not None


def test_the_policy_permits_no_inline_code() -> None:
    policy = HEADERS["Content-Security-Policy"]
    assert "unsafe" not in policy
    assert "default-src 'none'" in policy
    assert "frame-ancestors 'none'" in policy
    assert "LOCAL" not in repr(Guard(lambda *_: None, LOCAL, Access(None, 1)))  # type: ignore[arg-type, return-value]


# Tokens, sessions and tokens of forms


TOKEN = "a token of many letters"


def test_a_token_admits_and_no_other_text_does() -> None:
    access = Access(TOKEN, 1)
    assert access.needs_token
    assert access.admits(TOKEN)
    assert not any(access.admits(text) for text in ("", TOKEN[:-1], TOKEN + " ", TOKEN.upper(), "\udcff", "ü" * 23))


def test_without_a_token_nothing_is_admitted_by_one() -> None:
    access = Access(None, 1)
    assert not access.needs_token
    assert not access.admits("")


@pytest.mark.parametrize("token", ["", "short", "x" * 15, "ü" * 20, "x" * 20 + "\n"])
def test_a_weak_token_is_refused_without_being_shown(token: str) -> None:
    with refuses(InputError, 16, "token") as error:
        Access(token, 1)
    assert not token or token not in str(error.value)


def test_a_session_belongs_to_its_server() -> None:
    one, other = Access(None, 1), Access(None, 1)
    name, cookie = one.new_session()
    assert one.session({one.cookie: cookie}) == name
    assert other.session({other.cookie: cookie}) is None
    assert one.session({one.cookie: f"x{cookie}"}) is None
    assert one.session({}) is None
    assert one.cookie != Access(None, 2).cookie
    assert one.allows_form(name, one.form_token(name))
    assert not one.allows_form("another", one.form_token(name))
    assert not one.allows_form(name, cookie.partition(".")[2])


@given(st.text(), st.text())
def test_no_cookie_and_no_token_is_too_odd(cookie: str, token: str) -> None:
    access = Access(TOKEN, 1)
    assert access.session({access.cookie: cookie}) is None
    assert not access.allows_form(cookie, token)
    assert not access.admits(token)


def test_secrets_are_random_and_not_shown() -> None:
    one, other = Access(None, 1), Access(None, 1)
    assert len({one.new_session(), one.new_session(), other.new_session()}) == 3
    assert TOKEN not in repr(Access(TOKEN, 1))
