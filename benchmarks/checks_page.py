"""``docs/tables/checks.csv``: the checks of ``docs/theory.md``, from the table of the gate. Nothing is run here."""

from __future__ import annotations

from ctxval.certificates.checks import CHECKS, Check
from ctxval.certificates.limits import LIMITS
from page_tables import DOCS, csv_text

TABLE = DOCS / "tables" / "checks.csv"


def limit_of(check: Check) -> str:
    """Return the limit in words: a share in percent, a number, or the threshold."""
    if check.stage == "bound":
        return "the threshold"
    value = getattr(LIMITS, check.limit) if isinstance(check.limit, str) else check.limit
    return "0" if not value else f"{100 * value:g} %" if value < 0.6 else f"{value:g}"


def table() -> str:
    """Return the rows, in the order in which checks withdraw the bound and choose tasks."""
    rows = [
        [f"`{each.code}`", each.stage, limit_of(each), "yes" if each.remedy else "", each.reason] for each in CHECKS
    ]
    return csv_text((["check", "about", "limit", "an execution closes it", "reason"], rows))


if __name__ == "__main__":
    TABLE.write_text(table(), encoding="utf-8")
