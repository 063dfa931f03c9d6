from __future__ import annotations

from ctxval._util.latest import Latest


def test_the_first_entries_go_when_others_come() -> None:
    kept = Latest[str, int](2)
    for number, key in enumerate(["a", "b", "a", "c"]):
        kept[key] = number
    assert kept == {"b": 1, "c": 3}
