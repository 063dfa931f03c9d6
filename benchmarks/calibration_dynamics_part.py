"""The part of ``docs/calibration.md`` on campaigns that learned dynamics decide. Nothing is run here."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

import study_interval
import study_posterior_ranks
import study_time_varying
from calibrate_dynamics import BUDGETS, FALSE, GROUPS, RULE, STORED, TRUE, WITH_TESTS
from calibration_verdicts_part import false_of
from json_lines import JsonLines
from page_tables import Table, included, table

TEXT = """## Verdicts by learned dynamics

The limits of the diagnostics were chosen on development systems. The {systems} reporting systems
(`benchmarks/dynamics_reporting.py`) were written down before any of them was run. Campaigns have at most {budget}
executions, and eight tests at drawn tasks before each validation.

{compared} Few campaigns with this rule have thresholds below d* (see the summary). By earlier rules, without tests
at drawn tasks, {earlier_95} were validated falsely at 0.95 d*, {misleading_95} on systems that mislead, and
{earlier_99} at 0.99 d*. All of these are `oblique-wall` and `icy-corner`: a wall, or a loss of grip, that concerns
0.2 % and 0.3 % of the tasks and lies in a gap that the diagnostics permit.

{present}

Executions are medians with quartiles; "undecided" means that the budget did not suffice. On {mislead} further
systems with an incomplete state, jumps or noise, {mislead_above} were validated at 1.1 d*, which is true as well.

- **Without a threshold** ({interval_seeds} seeds, at most {interval_budget} executions): campaigns end once the
  bound exceeds the largest executed distance by at most 5 %. {ended} of {intervals} ended; {low} of these had a
  bound below d*, the lowest at {lowest:.4f} d*.
- **Models that are rougher than the system** (networks, Gaussian processes of few points): {rough_95} were validated
  falsely at 0.95 d*, and {rough_11} on systems that do not mislead were validated at 1.1 d*. Two of the first
  campaigns were validated falsely; `peak_ratio`, `jump`, `search_shortfall` and `disagreement` were added for this
  reason.
- **The paper's cases** ({paper_seeds} seeds, at most {budget_paper} executions; the method was tried on them while
  it was written). {paper_compared}

Tables: [by earlier
rules](tables/calibration-dynamics-earlier.csv), [false verdicts](tables/calibration-dynamics-false.csv), [without a
threshold](tables/calibration-intervals.csv), [rough models](tables/calibration-rough.csv), [the paper's
cases](tables/calibration-paper.csv).

### Dynamics that change with time

The certificate assumes that the dynamics do not change with time. Here a push that M does not know acts on a mass at
certain times. Of {timed} campaigns with thresholds of 0.5 and 0.95 d*, {timed_false} were validated. At 0.95 d*, the
push that was found least often is `{push}`, in {found} campaigns ([table](tables/calibration-time.csv)).

### Ranks of the truth

Systems are drawn from the prior that the posterior assumes, with seeds from {fresh} on; the method was chosen on
other seeds. If the draws of the dynamics are right, 5 % of the true values lie below all 19 draws and 5 % above
them, the spread (the variance of the ranks divided by the expected one) is 1, and the p-values of a chi-squared test
are uniform.

{ranks}

[By number of states](tables/calibration-ranks.csv). `pairs` are random transitions, `loops` come from closed loops."""

Result = dict[str, Any]


def by_dynamics() -> tuple[str, dict[str, Table]]:
    """Return the part of the page and its tables."""
    present = STORED.select(group="reporting", rule=RULE)
    earlier, present_paper = _of("reporting", before=WITH_TESTS), STORED.select(group="paper", rule=RULE)
    rough, timed = _of("rough"), study_time_varying.rows()
    intervals = list(study_interval.STORED.values())
    ended = [line for line in intervals if line["ended"]]
    fresh = study_posterior_ranks.FRESH
    results = JsonLines(study_posterior_ranks.STORED, study_posterior_ranks.KEY)
    ranks = study_posterior_ranks.rows(results, range(fresh, fresh + 1000))
    misleading = [one for one in present if _entry(one).misleading]
    hardest = min(timed, key=lambda row: int(row[-1].split()[0]))
    text = TEXT.format(
        systems=len({one["entry"] for one in present}),
        budget=BUDGETS["reporting"],
        compared=_compared(present, earlier),
        earlier_95=false_of(_at(earlier, FALSE[0])),
        earlier_99=false_of(_at(earlier, FALSE[1])),
        misleading_95=false_of([one for one in _at(earlier, FALSE[0]) if _entry(one).misleading]),
        present=included("calibration-dynamics"),
        mislead=len({one["entry"] for one in misleading}),
        mislead_above=_count(_at(misleading, TRUE[0]), "validated"),
        interval_seeds=study_interval.SEEDS,
        interval_budget=study_interval.BUDGET,
        intervals=len(intervals),
        ended=len(ended),
        low=sum(line["bound"] < 1 for line in ended),
        lowest=min(line["bound"] for line in ended),
        rough_95=false_of(_at(rough, FALSE[0])),
        rough_11=_count([one for one in _at(rough, TRUE[0]) if not _entry(one).misleading], "validated"),
        paper_seeds=len({one["seed"] for one in present_paper}),
        budget_paper=BUDGETS["paper"],
        paper_compared=_compared(present_paper, _of("paper", before=WITH_TESTS)),
        timed=len(study_time_varying.STORED),
        timed_false=sum(line["answer"] == "validated" for line in study_time_varying.STORED.values()),
        push=hardest[0],
        found=hardest[-1],
        fresh=fresh,
        ranks=table(study_posterior_ranks.HEADER, [row for row in ranks if row[0].endswith("all")]),
    )
    return text, {
        "calibration-dynamics": (HEADER, _rows(present)),
        "calibration-dynamics-earlier": (HEADER, _rows(earlier)),
        "calibration-dynamics-false": (FALSE_HEADER, _false([*earlier, *present, *rough])),
        "calibration-intervals": (
            ["system", "ended", "executions", "largest / d*", "bound / d*", "copies"],
            study_interval.rows(),
        ),
        "calibration-rough": (HEADER, _rows(rough)),
        "calibration-paper": (HEADER, _rows(present_paper)),
        "calibration-time": (
            [
                *("push", "when"),
                *(f"{s:g} d*: {answer}" for s in study_time_varying.SHARES for answer in ("validated", "falsified")),
            ],
            timed,
        ),
        "calibration-ranks": (study_posterior_ranks.HEADER, ranks),
    }


def summary(group: str) -> tuple[str, str]:
    """Return how many campaigns of the present rule were validated at 0.95 d*, and how many at 1.1 d* that could be."""
    present = STORED.select(group=group, rule=RULE) if group != "rough" else _of(group)
    above = [one for one in _at(present, TRUE[0]) if not _entry(one).misleading]
    return false_of(_at(present, FALSE[0])), f"{_count(above, 'validated')} at {TRUE[0]:g} d*"


def _of(group: str, before: int = RULE + 1) -> list[Result]:
    """Return the campaigns of a group by the latest rule by which each was run."""
    by_rule = sorted(STORED.select(group=group), key=lambda one: one["rule"])
    return list({_key(one): one for one in by_rule if one["rule"] < before}.values())


def _key(result: Result) -> tuple[Any, ...]:
    return result["entry"], result["seed"], result["share"]


def _compared(present: list[Result], earlier: list[Result]) -> str:
    """Return what tests cost: the same campaigns above d*, on systems that do not mislead, with and without them."""
    before = {_key(one): one for one in earlier}
    pairs = [(one, before[_key(one)]) for one in present if one["share"] > 1 and not _entry(one).misleading]
    both = [pair for pair in pairs if all(one["answer"] == "validated" for one in pair)]
    more = [now["executions"] - once["executions"] for now, once in both]
    shares = [sum(pair[i]["answer"] == "validated" for pair in pairs) for i in (0, 1)]
    return (
        f"Above d*, {shares[0]} of {len(pairs)} campaigns on systems that do not mislead were validated, and "
        f"{shares[1]} without tests. Tests cost {np.median(more):g} more executions in the median ({min(more)} to "
        f"{max(more)})."
    )


def _at(results: Iterable[Result], share: float) -> list[Result]:
    return [one for one in results if one["share"] == share]


def _entry(result: Result) -> Any:
    return GROUPS[result["group"]][result["entry"]]


def _by_entry(results: list[Result]) -> list[tuple[str, list[Result]]]:
    names = dict.fromkeys(one["entry"] for one in results)
    return [(name, [one for one in results if one["entry"] == name]) for name in names]


HEADER = [
    *("system", "family", "tasks", "n + m", *(f"{share:g} d*: validated (false)" for share in FALSE)),
    *(text for share in TRUE for text in (f"{share:g} d*: validated", "executions")),
    "CPU s for each execution",
]


def _rows(results: list[Result]) -> list[list[str]]:
    """Return a row for each system."""
    rows = []
    for name, own in _by_entry(results):
        entry = _entry(own[0])
        tasks, pairs, _ = entry.dimensions()
        rows.append([
            name, entry.family + (" (misleading)" if entry.misleading else ""), f"{tasks}-D", str(pairs),
            *(_count(_at(own, share), "validated") for share in FALSE),
            *(cell for share in TRUE for cell in (_count(_at(own, share), "validated"), _executions(_at(own, share)))),
            f"{np.median([one['seconds'] / max(1, one['executions']) for one in own]):.2g}",
        ])  # fmt: skip
    return rows


def _count(results: list[Result], answer: str) -> str:
    return f"{sum(one['answer'] == answer for one in results)} of {len(results)}" if results else "-"


def _executions(results: list[Result]) -> str:
    """Return the quartiles of the executions until validated; more than the budget if it never was."""
    if not results:
        return "-"
    counts = [one["executions"] if one["answer"] == "validated" else np.inf for one in results]
    low, middle, high = np.quantile(counts, [0.25, 0.5, 0.75], method="higher")
    return "undecided" if np.isinf(low) else f"{_number(middle)} ({_number(low)} to {_number(high)})"


def _number(count: float) -> str:
    return "undecided" if np.isinf(count) else f"{count:g}"


FALSE_HEADER = ["system", "seed", "tau / d*", "executions", "bound / d*", "best / d*", "gap"]


def _false(results: list[Result]) -> list[list[str]]:
    """Return the false verdicts, with what the certificate said."""
    return [
        [
            one["entry"], str(one["seed"]), f"{one['share']:g}", str(one["executions"]), f"{one['bound']:.3f}",
            f"{one['largest']:.3f}", f"{one['gap']:.2f}",
        ]
        for one in results
        if one["answer"] == "validated" and one["share"] < 1
    ]  # fmt: skip
