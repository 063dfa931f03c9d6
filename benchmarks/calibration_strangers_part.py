"""The part of ``docs/calibration.md`` on systems that nothing was tuned on, and on the rules. Nothing is run here."""

from __future__ import annotations

import statistics
from collections import Counter
from typing import Any

import study_drawn_tests
import study_ranked_coverage
import study_tolerances
from calibrate_strangers import BUDGET, ENTRIES, FALSE, HALVES, RULE, STORED
from page_tables import Table, included, share_of, table
from strangers_diagnostics import caught

TEXT = """## Systems of strangers

{systems} systems were written to embarrass the verdict; {reporting} of them are reported here, and nothing was tuned
on these. Their dynamics depend on the task, have contacts and small places that matter, hidden modes, heat,
hysteresis, backlash, stall, slip, rate limits, delays, loads or wind, or M is far from its data. Campaigns run with
the default certificate and its tests, with at most {budget} executions; {count} are stored. **At 0.95 d*, {false}
were validated, which is false.** All of these are campaigns on `{false_systems}`, whose castings of one thickness
and one end temperature absorb less heat. At 1.25 d*, {regular}.

{families}

[False validations](tables/calibration-strangers-false.csv).

### Tests at drawn tasks

These systems have different dynamics in some tasks or places. `met` is the percentage of sets of eight tests, drawn
without a campaign, that have a test in such a task; in parentheses, of independent draws in place of a hypercube.
The campaigns (`make drawn-tests`) have thresholds of 0.95 d*, so each validation is false: {drawn} were. The systems
belong to the development half.

{power}

[All designs of tests](tables/calibration-drawn-tests.csv).

### Validations that each diagnostic prevented

At {steps} steps of {campaigns} campaigns with a threshold below d*, the bound from learned dynamics was below the
threshold, and only diagnostics prevented a validation. Each of these was the only obstacle at some step:

{diagnostics}

These spoke, and never alone: {silent}. Other checks did not speak; some are newer than the campaigns. Whether other
systems need them is not known ([all diagnostics](tables/calibration-diagnostics.csv)).

### Rules that were tried and not adopted

- **A warning for validations that survive little.** A validation states the smallest push that would bring a task
  above the threshold. This push is below the largest residual in most true validations on regular systems, and above
  it in the false one. A warning would be given to the wrong ones, so the verdict states the numbers alone
  ([table](tables/calibration-tolerances.csv)).
- **Coverage tasks ranked by pushes** in place of the distance to the records: nothing was gained in few campaigns
  ([table](tables/calibration-ranked-coverage.csv))."""


def of_strangers() -> tuple[str, dict[str, Table]]:
    """Return the part of the page and its tables."""
    results = reported()
    false = [line for line in results if line["share"] in FALSE and line["answer"] == "validated"]
    below = [line for line in STORED.select(rule=RULE) if line["share"] < 1]
    known = [line for line in [*below, *study_drawn_tests.STORED.select(what="campaign")] if "stopped" in line]
    diagnostics = [row for row in caught(known) if row[1] != "0"]
    answers = by_family(results)
    power = study_drawn_tests.power_table()
    campaigns = study_drawn_tests.campaigns_table()
    text = TEXT.format(
        systems=len(ENTRIES),
        reporting=len(HALVES["reporting"]),
        budget=BUDGET,
        count=f"{len(results):,}",
        false=false_of(results),
        false_systems="`, `".join(dict.fromkeys(line["entry"] for line in false)),
        regular=of_regular(results),
        families=included("calibration-strangers"),
        drawn=false_of_drawn(),
        power=table(
            ["system", "met", "validated", "falsified", "undecided", "median executions"],
            [[row[0], _met(row), *counts[2:]] for row, counts in zip(power, campaigns, strict=True)],
        ),
        steps=f"{sum(len(by) > 0 for line in known for _, by in line['stopped']):,}",
        campaigns=f"{len(known):,}",
        diagnostics=table(DIAGNOSTICS, [row for row in diagnostics if row[2] != "0"]),
        silent=", ".join(row[0] for row in diagnostics if row[2] == "0"),
    )
    return text, {
        "calibration-strangers": (ANSWERS, [*answers, total(answers)]),
        "calibration-strangers-false": (FALSE_HEADER, false_verdicts(false)),
        "calibration-drawn-tests": (
            ["system", *(f"{name}: met / failed" for name in study_drawn_tests.DESIGNS)],
            power,
        ),
        "calibration-diagnostics": (DIAGNOSTICS, diagnostics),
        "calibration-tolerances": (
            ["tau / d*", "push", "less than the largest residual", "median tolerance / largest residual"],
            study_tolerances.rows(),
        ),
        "calibration-ranked-coverage": (
            ["tau / d*", "ranked by", "campaigns", "validated", "falsified", "undecided", "executions"],
            study_ranked_coverage.rows(),
        ),
    }


def reported() -> list[dict[str, Any]]:
    """Return the campaigns on the reporting half."""
    return [line for line in STORED.select(rule=RULE) if line["entry"] in HALVES["reporting"]]


def false_of(results: list[dict[str, Any]]) -> str:
    """Return how many campaigns at 0.95 d* were validated."""
    below = at(results, 0.95)
    return share_of(sum(line["answer"] == "validated" for line in below), len(below))


def false_of_drawn() -> str:
    """Return how many campaigns of the study of drawn tests were validated."""
    lines = study_drawn_tests.STORED.select(what="campaign")
    return share_of(sum(line["answer"] == "validated" for line in lines), len(lines))


def regular_above(results: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the campaigns at 1.25 d* on systems for which the assumptions hold."""
    return [line for line in at(results, 1.25) if not ENTRIES[line["entry"]].misleading]


def of_regular(results: list[dict[str, Any]]) -> str:
    """Return how many campaigns above d* on regular systems were validated, and after how many executions."""
    lines = regular_above(results)
    executions = sorted(line["executions"] for line in lines if line["answer"] == "validated")
    return (
        f"{len(executions)} of {len(lines)} campaigns on systems for which the assumptions hold were validated, after "
        f"{statistics.median(executions):g} executions in the median ({executions[0]} to {executions[-1]})"
    )


def at(results: list[dict[str, Any]], share: float) -> list[dict[str, Any]]:
    """Return the campaigns with a threshold of this share of d*."""
    return [line for line in results if line["share"] == share]


KINDS = ("validated", "falsified", "undecided")
ANSWERS = ["family", *(f"{share:g} d*: {answer}" for share in (0.95, 1.25) for answer in KINDS)]
DIAGNOSTICS = ["diagnostic", "steps at which it spoke", "steps at which it alone spoke", "campaigns with such a step"]
FALSE_HEADER = [
    *("system", "family", "seed", "tau / d*", "executions", "bound / d*", "best / d*"),
    *("survived push everywhere / largest residual", "survived push away from records / largest residual"),
]


def by_family(results: list[dict[str, Any]]) -> list[list[str]]:
    """Return the answers by family."""
    rows = []
    for family in sorted({ENTRIES[line["entry"]].family for line in results}):
        of_family = [line for line in results if ENTRIES[line["entry"]].family == family]
        answers = [Counter(line["answer"] for line in at(of_family, share)) for share in (0.95, 1.25)]
        rows.append([family, *(str(counted[answer]) for counted in answers for answer in KINDS)])
    return rows


def total(rows: list[list[str]]) -> list[str]:
    """Return the sum of all families."""
    return [f"all {len(rows)}", *(str(sum(int(row[k]) for row in rows)) for k in range(1, len(ANSWERS)))]


def _met(row: list[str]) -> str:
    met = dict(zip(study_drawn_tests.DESIGNS, (cell.split(" / ")[0] for cell in row[1:]), strict=True))
    return f"{met['hypercube']} ({met['independent draws']})"


def false_verdicts(false: list[dict[str, Any]]) -> list[list[str]]:
    """Return the validations that are false, with the pushes that they said they survive."""
    rows = []
    for line in false:
        pushes = line["tolerances"] or (float("nan"), float("nan"))
        rows.append(
            [
                *(line["entry"], ENTRIES[line["entry"]].family, str(line["seed"]), f"{line['share']:g}"),
                *(str(line["executions"]), f"{line['bound']:.3f}", f"{line['largest']:.3f}"),
                *(f"{push:.2g}" for push in pushes),
            ]
        )
    return rows
