from __future__ import annotations

from ctxval.certificates import Certificate


def test_a_threshold_is_kept_only_beyond_two_errors() -> None:
    certificate = Certificate("posterior", "", 1.0, 0.95, 0.0, 9, (), error=0.1)
    assert certificate.covers(1.2)
    assert not certificate.covers(1.19)


HOSTILE = Certificate(
    "audit",
    "At most 5 % are above 0.5.",
    0.5,
    0.95,
    0.0496,
    59,
    ("the tasks are independent", "you state: fuse\r\n- replaced <b>"),
    {"largest_found": 0.123456, "not_counted": 0, "failures": {"failed": [1]}},
    doubt="trial 3 is too large",
)


def test_a_certificate_as_text_is_what_the_command_line_prints() -> None:
    assert str(HOSTILE).splitlines() == [
        "audit: At most 5 % are above 0.5.",
        "withdrawn: trial 3 is too large.",
        "It assumes that",
        "- the tasks are independent;",
        "- you state: fuse",
        "  - replaced <b>;",
        "largest found  0.1235",
        "not counted    0",
        "trials         59",
        f"version        {HOSTILE.version}",
    ]
