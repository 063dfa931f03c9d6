"""Tokens, sessions and tokens of forms."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctxval.errors import InputError
from ctxval.web.security import Access

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
    with pytest.raises(InputError, match="at least 16 characters") as error:
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
    assert repr(Access(TOKEN, 1)) == "Access(needs_token=True)"
