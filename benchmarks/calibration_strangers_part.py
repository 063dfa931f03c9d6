"""The part of ``docs/calibration.md`` on systems that nobody tuned to. Nothing is run here."""

from __future__ import annotations

import statistics
from collections import Counter
from typing import Any

from calibrate_strangers import BUDGET, ENTRIES, FALSE, HALVES, RULE, STORED
from calibration_drawn_tests_part import of_rules
from calibration_verdicts_part import interval, table

TEXT = """## Systems of strangers

{systems} systems were written to embarrass the verdict, {reporting} of which are reported here and were never tuned on.
Their dynamics depend on the task, have contacts and small places that matter, hidden modes, heat, hysteresis, backlash,
stall, slip, rate limits, delays, loads or wind, or M is far from its data. Campaigns run as a user runs them, with the
default certificate and its tests, with at most {budget} executions, until they are decided against a threshold of a
known share of d*. {count} campaigns are stored.

**At 0.95 d*, {false} of {below} campaigns were validated, which is false ({share:.1f} %; the 95 % interval is
{low:.1f} to {high:.1f} %).**{regular}

{families}

{listed}

{rules}"""


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
        regular=of_regular(),
        families=by_family(results),
        listed=false_verdicts([line for line in results if line["share"] in FALSE and line["answer"] == "validated"]),
        rules=of_rules([line for line in STORED.select(rule=RULE) if line["share"] < 1]),
    ).rstrip()


def of_regular() -> str:
    """Return how many campaigns above d* on regular systems were validated, by the latest rule that ran some."""
    lines = [
        line
        for line in STORED.select(share=1.25)
        if line["entry"] in HALVES["reporting"] and not ENTRIES[line["entry"]].misleading
    ]
    if not lines:
        return ""
    rule = max(line["rule"] for line in lines)
    of_rule = [line for line in lines if line["rule"] == rule]
    executions = sorted(line["executions"] for line in of_rule if line["answer"] == "validated")
    earlier = "" if rule == RULE else f" (by the earlier rule {rule} of campaigns; the present one is {RULE})"
    after = ""
    if executions:
        soon = sum(count <= 15 for count in executions)
        middle, spread = statistics.median(executions), f"{executions[0]} to {executions[-1]}"
        after = f", after a median of {middle:g} executions ({spread}), and {soon} of them within 15"
    return (
        f" At 1.25 d*, {len(executions)} of {len(of_rule)} campaigns on systems for which the assumptions hold were "
        f"validated{after}{earlier}."
    )


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
            counts = ", ".join(str(answers[answer]) for answer in ("validated", "falsified", "undecided"))
            row.append(counts if answers else "-")
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
