"""The table of checks in ``docs/theory.md``, from the table of the gate. Nothing is run here."""

from __future__ import annotations

from pathlib import Path

from ctxval.certificates.checks import CHECKS, Check
from ctxval.certificates.limits import LIMITS

PAGE = Path(__file__).parents[1] / "docs" / "theory.md"
BEGIN, END = "<!-- checks: begin -->\n", "<!-- checks: end -->"


def limit_of(check: Check) -> str:
    """Return the limit in words: a share in percent, a number, or the threshold."""
    if check.stage == "bound":
        return "the threshold"
    value = getattr(LIMITS, check.limit) if isinstance(check.limit, str) else check.limit
    return "0" if not value else f"{100 * value:g} %" if value < 0.6 else f"{value:g}"


def table() -> str:
    """Return the rows, in the order in which checks withdraw the bound and choose tasks."""
    rows = ["| check | about | limit | an execution closes it | reason |", "|---|---|---|---|---|"]
    for check in CHECKS:
        remedy = "yes" if check.remedy else ""
        rows.append(f"| `{check.code}` | {check.stage} | {limit_of(check)} | {remedy} | {check.reason} |")
    return "\n".join(rows) + "\n"


def page() -> str:
    """Return the page with the present table."""
    text = PAGE.read_text(encoding="utf-8")
    first, last = text.index(BEGIN) + len(BEGIN), text.index(END)
    return text[:first] + table() + text[last:]


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
