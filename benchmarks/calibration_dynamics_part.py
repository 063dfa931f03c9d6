"""The part of ``docs/calibration.md`` on campaigns that learned dynamics decide. Nothing is run here."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from calibrate_dynamics import BUDGETS, FALSE, FEW, GROUPS, RULE, STORED, TRUE, WITH_TESTS, wanted
from calibration_verdicts_part import false_of, table
from ctxval._util.json_lines import JsonLines
from ctxval.certificates.limits import LIMITS
from study_interval import BUDGET as INTERVAL_BUDGET
from study_interval import SEEDS as INTERVAL_SEEDS
from study_interval import rows as interval_rows
from study_posterior_ranks import FRESH
from study_posterior_ranks import KEY as RANK_KEY
from study_posterior_ranks import STORED as RANKS
from study_posterior_ranks import table as table_of_ranks
from study_time_varying import SEEDS as TIMED_SEEDS
from study_time_varying import SHARES as TIMED_SHARES
from study_time_varying import rows as time_varying_rows

TEXT = """## Verdicts by learned dynamics

These campaigns run as `ctxval run` does with the certificate `dynamics`, and at most {budget} executions. The
thresholds of the certificate were chosen on the development systems: a prediction holds within {accurate:.0%} of the
bound, the last {predictions} predictions must hold, the largest gap of the records is {gap:.0%}, and the largest excess
over the records is {beyond:.0%}. The reporting systems (`benchmarks/dynamics_reporting.py`) were written down before
any of them was run, and nothing was chosen with them. The parentheses contain the share of false verdicts, and the
upper limit of this share with confidence 97.5 %. The kind may say `validated` as long as at 0.95 d* at most 5 % are
false, with a limit of at most 7.5 %.

### Reporting systems

{present} of {planned} planned campaigns have been run by the present rule, with eight tests at drawn tasks before each
validation (seeds of each system: {present_seeds}). At 0.95 d*: {present_95}. At 0.99 d*: {present_99}. {compared}

{present_table}

{run} campaigns are of earlier rules, without tests at drawn tasks.

At 0.95 d*: {at_95}. At 0.99 d*: {at_99}. Of the misleading systems at 0.95 d*: {misleading_95}.

At 1.1 d*, {decided_11} of the {systems_11} systems that do not mislead are decided within 12 executions in the median
of their seeds, and {campaigns_11} of the campaigns on them; at 1.25 d*, {decided_125} of {systems_125}, and
{campaigns_125}.

{reporting}

`misleading`: the state is not complete, or the dynamics jump, or there is noise. At a threshold above d*, `validated`
is true of these systems as well; the column says how often it was given. Executions: median and quartiles.

These campaigns are from before `sharpness` and `jump` ([theory](theory.md#what-withdraws-it)), which can only withdraw
a bound.

### Without a threshold

These campaigns have no threshold. They end when the bound exceeds the largest executed distance by at most 5 %, or
after {interval_budget} executions. The systems are the same, with {interval_seeds} seeds. The ends of the interval are
shares of d*, each the smallest one of the campaigns that ended; a bound below 1 is false. A copy is an execution next
to an earlier one, within 2 % of the range of each task parameter.

{intervals}

### False verdicts

{false}

### Models that are rougher than the system

These systems have a network or a Gaussian process of few points in the place of another model
(`benchmarks/dynamics_rough.py`, at most {rough_seeds} seeds). If the records prefer it, the certificate learns the
system without M. The condition was chosen with the paper's arm. The controllers of such a model can jump from task to
task. Two of the first campaigns were falsely validated for this reason at 0.95 d*. The largest distance of
`sliding-tyres-network` (seed 0) is a needle, on which eight deep searches of the true system, of 80,000 evaluations
each, disagree by a factor of two. That of `hanging-pendulum-network` (seed 1) is one that a search of 2,048 tasks
misses in one of four cases, and a search of 8,192 tasks in none. `sharpness`, `jump`, `missed` and `disagreement` were
added then, with limits from the distances of all systems of these lists, seeds 0 and 1, and without certificates. The
table is of campaigns after this. If the deep searches disagree, the largest result counts as d*, and the true one may
be larger.

At 0.95 d*: {rough_95}. At 1.1 d*, {rough_11} of the campaigns on systems that do not mislead are validated.

{rough}

{rough_false}

### Dynamics that change with time

The certificate assumes that the dynamics do not change with time. Here they do: a mass with drag is moved to a goal in
30 steps (1-D and 2-D, two distances, {timed_seeds} seeds), and something pushes it that M does not know. Every
`validated` below d* is false. Nothing was chosen with these systems.

{timed}

### Ranks of the truth

Is the uncertainty of the draws right if the prior is? Each system is drawn from the prior that the posterior assumes
({fresh}; the method was chosen on other seeds). If the posterior is right, 5 % of the true values are
below all 19 draws and 5 % above them. The spread is the variance of the ranks as a share of the expected one, so it is
1. The p-values of a chi-squared test are uniform.

{ranks}

### The paper's cases

These campaigns have at most {budget_paper} executions. No threshold was chosen with these cases, but the method was
tried on them while it was written; that of models that are rougher than the system, on seeds 0 to 2 of `arm-gp` and
`arm-fnn`. By the present rule, with tests at drawn tasks (seeds of each case: {paper_seeds}): {paper_compared}

{paper_present}

Without tests, each has ten seeds:

{paper}

### Development systems

The thresholds of the certificate were chosen with seeds 0 to 2 of these systems, so results on them are not evidence.

{development}
"""

EXPLAINED = {
    "oblique-wall": """a slanting wall stands behind one corner of the positions and changes 0.2 % of the tasks. One
  execution of seed 7 grazed it by 2 mm, one of seed 9 by less than 1 mm, and all others passed it. The records cover
  each position coordinate alone, and the two together as far as the certificate asks (a gap of at most 50 % of their
  ranges), so the wall lies in a gap that is allowed. The last three predictions held because their tasks do not touch
  it.""",
    "icy-corner": """the grip is lost beyond two coordinates of the position and above a speed, in 0.3 % of the tasks.
  One of the seven executions passed there, too slowly. The records cover all pairs of coordinates as far as the
  certificate asks (a gap of at most 50 %), and it states that combinations of three are not covered.""",
}
"""Why verdicts on a system were false."""

TIMED_HEADER = [f"{share:g} d*: {answer}" for share in TIMED_SHARES for answer in ("validated", "falsified")]

Result = dict[str, Any]


def by_dynamics() -> str:
    """Return the part of the page."""
    present = STORED.select(group="reporting", rule=RULE)
    reported, present_paper = _of("reporting", before=WITH_TESTS), STORED.select(group="paper", rule=RULE)
    rough = _of("rough")
    mild = [one for one in reported if not _entry(one).misleading]
    return TEXT.format(
        budget=BUDGETS["reporting"],
        budget_paper=BUDGETS["paper"],
        present=len(present),
        present_seeds=len({one["seed"] for one in present}),
        present_95=false_of(_at(present, FALSE[0]))[1],
        present_99=false_of(_at(present, FALSE[1]))[1],
        compared=_compared(present, reported),
        present_table=_table(present),
        run=len(reported),
        planned=len(list(wanted("reporting"))),
        accurate=LIMITS.error,
        predictions=LIMITS.predictions,
        gap=LIMITS.gap,
        beyond=LIMITS.beyond,
        at_95=false_of(_at(reported, FALSE[0]))[1],
        at_99=false_of(_at(reported, FALSE[1]))[1],
        misleading_95=false_of([one for one in _at(reported, FALSE[0]) if _entry(one).misleading])[1],
        **_decided(mild, TRUE[0], "11"),
        **_decided(mild, TRUE[1], "125"),
        reporting=_table(reported),
        interval_budget=INTERVAL_BUDGET,
        interval_seeds=INTERVAL_SEEDS,
        intervals=table(["system", "ended", "executions", "largest", "bound", "copies"], interval_rows()),
        false=_false(reported),
        rough=_table(rough),
        rough_seeds=FEW,
        rough_95=false_of(_at(rough, FALSE[0]))[1],
        rough_11=_decided([one for one in rough if not _entry(one).misleading], TRUE[0], "11")["campaigns_11"],
        rough_false=_false(rough),
        fresh=f"with seeds from {FRESH} on",
        timed=table(["push", "when", *TIMED_HEADER], time_varying_rows()),
        timed_seeds=TIMED_SEEDS,
        ranks=table_of_ranks(JsonLines(RANKS, RANK_KEY), range(FRESH, FRESH + 1000)),
        paper=_table(_of("paper", before=WITH_TESTS)),
        paper_present=_table(present_paper),
        paper_seeds=len({one["seed"] for one in present_paper}),
        paper_compared=_compared(present_paper, _of("paper", before=WITH_TESTS)),
        development=_table(development) if (development := _of("development")) else "None was run by the present rule.",
    ).rstrip()


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
        f"{shares[1]} of the same campaigns without tests. Those that both rules validated took {np.median(more):g} "
        f"more executions in the median, and {min(more)} to {max(more)}."
    )


def _at(results: Iterable[Result], share: float) -> list[Result]:
    return [one for one in results if one["share"] == share]


def _entry(result: Result) -> Any:
    return GROUPS[result["group"]][result["entry"]]


def _decided(results: list[Result], share: float, name: str) -> dict[str, str | int]:
    """Return how many systems, and which share of their campaigns, are validated within 12 executions."""
    chosen = _at(results, share)
    early = [one["answer"] == "validated" and one["executions"] <= 12 for one in chosen]
    entries = dict.fromkeys(one["entry"] for one in chosen)
    of = {name: [done for one, done in zip(chosen, early, strict=True) if one["entry"] == name] for name in entries}
    return {
        f"decided_{name}": sum(np.mean(done) >= 0.5 for done in of.values()),
        f"systems_{name}": len(entries),
        f"campaigns_{name}": f"{sum(early)} of {len(early)}",
    }


def _table(results: list[Result]) -> str:
    """Return a table with a row for each system."""
    rows = []
    for name in dict.fromkeys(one["entry"] for one in results):
        own = [one for one in results if one["entry"] == name]
        entry = _entry(own[0])
        tasks, pairs, _ = entry.dimensions()
        rows.append([
            name, entry.family + (" (misleading)" if entry.misleading else ""), f"{tasks}-D", str(pairs),
            *(_count(_at(own, share), "validated") for share in FALSE),
            *(cell for share in TRUE for cell in (_count(_at(own, share), "validated"), _executions(_at(own, share)))),
            _median(own, lambda one: one["seconds"] / max(1, one["executions"])),
        ])  # fmt: skip
    header = ["system", "family", "tasks", "n + m", *(f"{share:g} d*: validated (false)" for share in FALSE)]
    header += [text for share in TRUE for text in (f"{share:g} d*: validated", "executions")]
    return table([*header, "CPU s for each execution"], rows)


def _count(results: list[Result], answer: str) -> str:
    return f"{sum(one['answer'] == answer for one in results)} of {len(results)}" if results else "-"


def _executions(results: list[Result]) -> str:
    """Return the quartiles of the executions until validated; more than the budget if it never was."""
    if not results:
        return "-"
    counts = [one["executions"] if one["answer"] == "validated" else np.inf for one in results]
    low, middle, high = np.quantile(counts, [0.25, 0.5, 0.75], method="higher")
    return f"{_number(middle)} ({_number(low)} to {_number(high)})"


def _number(count: float) -> str:
    return "undecided" if np.isinf(count) else f"{count:g}"


def _median(results: list[Result], value: Callable[[Result], float]) -> str:
    return f"{np.median([value(one) for one in results]):.2g}"


def _false(results: list[Result]) -> str:
    """Return a table of the false verdicts, with what the certificate said."""
    rows = [
        [
            one["entry"], str(one["seed"]), f"{one['share']:g}", str(one["executions"]), f"{one['bound']:.3f}",
            f"{one['largest']:.3f}", f"{one['gap']:.2f}",
        ]
        for one in results
        if one["answer"] == "validated" and one["share"] < 1
    ]  # fmt: skip
    if not rows:
        return "No verdict is false."
    why = [f"- `{name}`: {EXPLAINED.get(name, 'not explained yet.')}" for name in dict.fromkeys(row[0] for row in rows)]
    header = ["system", "seed", "tau / d*", "executions", "bound / d*", "best / d*", "gap"]
    return "\n".join([table(header, rows), "", *why])
