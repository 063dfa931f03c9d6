"""The part of ``docs/calibration.md`` on systems that nobody tuned to. Nothing is run here."""

from __future__ import annotations

from collections import Counter
from typing import Any

from calibrate_strangers import BUDGET, ENTRIES, FALSE, HALVES, RULE, STORED
from calibration_verdicts_part import interval, table
from strangers_diagnostics import caught
from study_drawn_tests import STORED as DRAWN_TESTS

TEXT = """## Systems of strangers

{systems} systems were written to embarrass the verdict, {reporting} of which are reported here and were never tuned on.
Their dynamics depend on the task, have contacts and small places that matter, hidden modes, heat, hysteresis, backlash,
stall, slip, rate limits, delays, loads or wind, or M is far from its data. Campaigns run as a user runs them, with the
default certificate, eight tests and at most {budget} executions, until they are decided against a threshold of a known
share of d*. {count} campaigns are stored.

**At 0.95 d*, {false} of {below} campaigns were validated, which is false ({share:.1f} %; the 95 % interval is
{low:.1f} to {high:.1f} %).**

{families}

{listed}

{diagnostics}"""

DIAGNOSTICS = """### What each diagnostic caught

At {steps} steps of {campaigns} campaigns with a threshold below d*, the bound from learned dynamics was below the
threshold, and diagnostics alone stopped a validation. A diagnostic caught a step alone if no other one spoke. (The
campaigns are those of both halves and of `make drawn-tests` of which it is stored what spoke. Whether other systems
need a diagnostic that caught nothing here is not known.)

{table}"""


def of_strangers() -> str:
    """Return the part; without campaigns it is empty."""
    results = [line for line in STORED.select(rule=RULE) if line["entry"] in HALVES["reporting"]]
    if not results:
        return ""
    below, false = at(results, 0.95), [line for line in at(results, 0.95) if line["answer"] == "validated"]
    low, high = interval(len(below) - len(false), len(below))
    return TEXT.format(
        systems=len(ENTRIES),
        reporting=len(HALVES["reporting"]),
        budget=BUDGET,
        count=len(results),
        false=len(false),
        below=len(below),
        share=100 * len(false) / max(1, len(below)),
        low=low,
        high=high,
        families=by_family(results),
        listed=false_verdicts([line for line in results if line["share"] in FALSE and line["answer"] == "validated"]),
        diagnostics=of_diagnostics(),
    ).rstrip()


def of_diagnostics() -> str:
    """Return what each diagnostic caught in the stored campaigns of all strangers; empty if none know it."""
    results = [line for line in STORED.select(rule=RULE) if line["share"] < 1]
    results = [line for line in [*results, *DRAWN_TESTS.select(what="campaign")] if "stopped" in line]
    if not results:
        return ""
    steps = sum(len(by) > 0 for line in results for _, by in line["stopped"])
    header = ["diagnostic", "steps at which it spoke", "steps at which it alone spoke", "campaigns with such a step"]
    return DIAGNOSTICS.format(steps=steps, campaigns=len(results), table=table(header, caught(results)))


def at(results: list[dict[str, Any]], share: float) -> list[dict[str, Any]]:
    """Return the campaigns with a threshold of this share of d*."""
    return [line for line in results if line["share"] == share]


def by_family(results: list[dict[str, Any]]) -> str:
    """Return a table of the answers by family."""
    rows = []
    for family in sorted({ENTRIES[line["entry"]].family for line in results}):
        of_family = [line for line in results if ENTRIES[line["entry"]].family == family]
        row = [family]
        for share in (0.95, 1.25):
            answers = Counter(line["answer"] for line in at(of_family, share))
            row.append(", ".join(str(answers[answer]) for answer in ("validated", "falsified", "undecided")))
        rows.append(row)
    answers = "validated, falsified, undecided"
    return table(["family", f"at 0.95 d*: {answers}", f"at 1.25 d*: {answers}"], rows)


def false_verdicts(false: list[dict[str, Any]]) -> str:
    """Return a table of the validations that are false, with what they said that they survive."""
    if not false:
        return "No threshold below d* was validated."
    rows = []
    for line in false:
        everywhere, away = line["tolerances"] or (float("nan"), float("nan"))
        rows.append(
            [
                *(line["entry"], ENTRIES[line["entry"]].family, str(line["seed"]), f"{line['share']:g}"),
                *(str(line["executions"]), f"{line['bound']:.3f}", f"{line['largest']:.3f}"),
                f"{everywhere:.2g}, {away:.2g}",
            ]
        )
    survives = "survived push / largest residual: everywhere, away"
    header = ["system", "family", "seed", "tau / d*", "executions", "bound / d*", "best / d*", survives]
    return "The validations that are false:\n\n" + table(header, rows)
