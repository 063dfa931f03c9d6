"""``docs/searches.md``, its tables and pictures, from the stored campaigns of the studies. Nothing is run here."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import misleading
import search_ablations_part
import search_plants_part
import search_speed_part
import search_versions_part
import study_global_search
from ctxval._util.arrays import Array
from json_lines import JsonLines
from landed import LANDED
from page_tables import DOCS, GeneratedPage, Table, included, reflowed, table
from peers import run
from peers.page import first_within as within_of
from reproduce.jobs import AUTO, measured_with
from search_ablations_part import ABLATION_SEEDS
from search_cells import ENDS, SEEDS, Counts, cells, largest, reached, results, spread
from study_auto import WITHIN, Result, first_within, results_of, shown

PICTURES = DOCS / "searches"

# The targets


@dataclass(frozen=True)
class Target:
    """What is asked of a search on a case.

    Attributes:
        case: its name among the stored campaigns.
        text: what the reader calls it.
        percent: of the maximum that it must come near.
        asked: in words.
        holds: whether executions, seed by seed, are as asked.
        study, search: whose campaigns.
    """

    case: str
    text: str
    percent: float
    asked: str
    holds: Callable[[Counts], bool]
    study: str = "auto"
    search: str = "auto"

    def row(self) -> list[str]:
        """Return what was measured beside it; empty where nothing was."""
        found = results(self.study, self.case, self.search)
        if not found:
            return []
        counts = [first_within(result, self.percent) for result in found.values()]
        budget = next(iter(found.values()))["budget"]
        worst = max(found, key=lambda seed: first_within(found[seed], self.percent))
        seconds = float(np.median([result["seconds"] for result in found.values()]))
        return [
            self.text,
            f"{self.percent:g} %",
            self.asked,
            shown(float(np.median(counts)), budget),
            spread(counts, budget),
            f"{shown(max(counts), budget)} (seed {worst})",
            reached(counts),
            f"{seconds:.2g}",
            "yes" if self.holds(counts) else "**no**",
        ]


def within(count: float) -> Callable[[Counts], bool]:
    """Return whether the median is at most so much."""
    return lambda counts: float(np.median(counts)) <= count


def all_within(count: float) -> Callable[[Counts], bool]:
    """Return whether every seed is at most so much."""
    return lambda counts: max(counts) <= count


def _median(case: str, text: str, percent: float, count: int) -> Target:
    return Target(case, text, percent, f"<= {count}", within(count))


def targets() -> list[Target]:
    """Return everything asked, in the order of the page."""
    found = [
        _median("pendulum", "pendulum, 1-D", 1.0, 3),
        _median("pendulum-no-data", "pendulum without M's data", 1.0, 5),
    ]
    for case, text in (("dubins", "Dubins, 11-D"), ("dubins-no-data", "Dubins without M's data")):
        found += [_median(case, text, 5.0, 10), _median(case, text, 1.0, 15)]
    for case, text in (("dubins-basin", "its variant `basin`"), ("dubins-basin-no-data", "`basin` without M's data")):
        found += [_median(case, text, 5.0, 13), _median(case, text, 1.0, 16)]
        found += [Target(case, text, 1.0, "all seeds <= 30", all_within(30))]
    found += [_median("dubins-heavy-tail", "its variant `heavy-tail`", 5.0, 20)]
    for model, text in (("fnn", "network"), ("gp", "Gaussian process"), ("linear", "linear model")):
        found += [_median(f"arm-{model}", f"arm, 2-D, {text}", 2.0, 10)]
        found += [_median(f"arm-{model}-no-data", f"arm, {text} without its data", 2.0, 10)]
    found += [_median(f"linear-{n}", f"linear, {2 * n}-D", 1.0, n + 2) for n in range(1, 11)]
    found += [
        Target("linear-10", "`scalar` alone: linear, 20-D", 1.0, "all seeds <= 35", all_within(35), "scalar", "scalar"),
        Target(
            *("dubins-basin", "`scalar` alone: `basin`", 5.0, "8 of 10 seeds <= 100"),
            *(lambda counts: sum(count <= 100 for count in counts) >= 8, "scalar", "scalar"),
        ),
    ]
    return found


TARGETS = ["case", "within", "target", "median", "25 to 75 %", "worst seed", "reached", "CPU s", "met"]


def target_rows() -> list[list[str]]:
    """Return the targets and the measured executions."""
    return [row for target in targets() if (row := target.row())]


def heavy_tail() -> str:
    """Return how `auto` compares with many random tasks on the heavy tail; empty without campaigns."""
    found = results("auto", "dubins-heavy-tail", "auto")
    if not found:
        return ""
    shares = [largest(result) / result["random"] for result in found.values()]
    worse = sum(share < 1 for share in shares)
    return (
        f"On `heavy-tail`, {worse} of {len(shares)} seeds end below the best of 2,000 random executions "
        f"(target: none). The largest distance found is {min(shares):.2f} to {max(shares):.3g} times that best, "
        f"with a median of {float(np.median(shares)):.3g}."
    )


MORE_SEEDS = (("linear-10", "linear, 20-D", 1.0, (35, 50)), ("dubins-basin", "`basin`", 5.0, (100,)))
"""Case, what the reader calls it, per cent of the maximum, and numbers of executions to count the seeds within."""


def more_seeds() -> str:
    """Return how the scalar search fares on all stored seeds of these cases."""
    sentences = []
    for case, text, percent, limits in MORE_SEEDS:
        found = results("scalar", case, "scalar", range(1000))
        counts, budget = [first_within(result, percent) for result in found.values()], found[0]["budget"]
        near = " and ".join(f"{sum(count <= most for count in counts)} within {most}" for most in limits)
        sentences.append(
            f"{text}, {len(counts)} seeds: within {percent:g} % after {shown(float(np.median(counts)), budget)} "
            f"(median; 25 to 75 %: {spread(counts, budget)}), {near}"
        )
    return "; ".join(sentences)


def scalar_alone() -> str:
    """Return how the search without trajectories compares with GPyOpt."""
    ours = results("scalar", "linear-10", "scalar", range(1000)).values()
    theirs = run.STORED.select(case="linear-10", method="gpyopt")
    medians = [
        float(np.median([first_within(result, 1.0) for result in ours])),
        float(np.median([within_of(result, 1.0) for result in theirs])),
    ]
    return f"{medians[0]:g} executions (median of {len(ours)} seeds), and GPyOpt {medians[1]:g} ({len(theirs)} seeds)"


# Misleading cases


MISLEADING = ["case", "search", *ENDS, "switched"]


def misleading_rows() -> list[list[str]]:
    """Return how the searches fare on the cases built to mislead."""
    rows = []
    for case, search in ((case, search) for case in misleading.CASES for search in ("auto", "scalar", "random")):
        found = results("misleading", case, search)
        rows.append([case, search, *cells(found.values()), fallen(found.values()) if search == "auto" else "-"])
    return rows


def reasons(result: Result) -> list[str]:
    """Return why the search turned away from all predictions, suggestion by suggestion."""
    return [note["why"] for note in result["notes"] if note is not None and "why" in note]


def fallen(found: Iterable[Result]) -> str:
    """Return in how many campaigns, and in what share of their suggestions, the search fell back."""
    campaigns = list(found)
    shares = [len(reasons(result)) / len(result["notes"]) for result in campaigns]
    return f"{sum(share > 0 for share in shares)} of {len(shares)} seeds, {100 * np.mean(shares):.0f} % of suggestions"


# The global search of true systems


@functools.cache
def global_results() -> JsonLines:
    """Return the results of the global search; they are read once."""
    return JsonLines(study_global_search.RESULTS, study_global_search.KEY)


def global_search_rows() -> list[list[str]]:
    """Return what the global search finds: first on the cases that its settings were chosen by, then on the others."""
    rows = {chosen_by: study_global_search.rows(global_results(), chosen_by) for chosen_by in (True, False)}
    return [[*row, "yes" if chosen_by else "no"] for chosen_by, of in rows.items() for row in of]


def global_search_short() -> list[list[str]]:
    """Return, by kind of case and number of evaluations, how many searches found at least 0.99 d*."""
    cases = study_global_search.CASES
    kinds = {
        **{f"cliffs with a {lead}": [case for case in cases if f"-{lead}-" in case] for lead in CLIFFS},
        "closed loops that settings were chosen by": [c for c in cases if cases[c].chosen_by and "cliff" not in c],
        "other closed loops": [case for case in cases if not cases[case].chosen_by],
    }
    rows = []
    for kind, names in kinds.items():
        row = [kind]
        for evaluations in sorted(study_global_search.EVALUATIONS):
            found = [study_global_search.shares(case, evaluations, global_results()) for case in names]
            of = [share for shares in found for share in shares]
            row.append(f"{sum(share >= 0.99 for share in of)} of {len(of)}")
        rows.append(row)
    return rows


CLIFFS = ("ridge", "funnel", "trace")


# Pictures

STYLES = {
    "auto": ("#0072b2", "-", "o"),
    "auto without M's data": ("#56b4e9", (0, (5, 1)), "s"),
    "scalar": ("#d55e00", "--", "^"),
    "gp-ucb": ("#009e73", "-.", "D"),
    "random": ("#000000", ":", "x"),
}
"""Colours that the colour-blind tell apart, and lines and marks for grey print."""


def missing(found: Iterable[Result]) -> Array:
    """Return what is missing to d* after 1, 2, ... executions in per cent, 1 where it is less, ``(seeds, budget)``.

    A campaign that ended within 1 % stays where it is.
    """
    rows = []
    for result in found:
        best = np.maximum.accumulate([distance or 0.0 for distance in result["distances"]])
        best = np.append(best, np.full(result["budget"] - len(best), best[-1]))
        rows.append(np.maximum(100 * (1 - best / result["truth"]), WITHIN[-1]))
    return np.array(rows)


def draw_missing(axes: Axes, name: str, found: Iterable[Result]) -> None:
    """Draw the median of what is missing, with its quartiles."""
    rows = missing(found)
    if not len(rows):
        return
    colour, line, marker = STYLES[name]
    executions = np.arange(1, rows.shape[1] + 1)
    low, middle, high = np.quantile(rows, [0.25, 0.5, 0.75], axis=0)
    axes.fill_between(executions, low, high, color=colour, alpha=0.15, linewidth=0)
    every = max(1, len(executions) // 8)
    axes.plot(executions, middle, color=colour, linestyle=line, marker=marker, markevery=every, ms=4, label=name)


def finish(axes: Axes) -> None:
    """Give the axes their scales and names."""
    axes.set_yscale("log")
    axes.set_ylim(0.9, 110)
    axes.set_yticks([1, 2, 5, 10, 20, 50, 100], ["1", "2", "5", "10", "20", "50", "100"])
    axes.minorticks_off()
    axes.set_xlabel("executions of S")
    axes.grid(alpha=0.25)


def draw_regret() -> None:
    """Draw what is missing to the maximum on the Dubins car's variant `basin`."""
    figure = Figure(figsize=(7, 4.2), layout="constrained")
    axes = figure.add_subplot()
    sources = {
        "auto": ("auto", "dubins-basin", "auto"),
        "auto without M's data": ("auto", "dubins-basin-no-data", "auto"),
        **{search: ("scalar", "dubins-basin", search) for search in ("scalar", "gp-ucb", "random")},
    }
    for name, source in sources.items():
        draw_missing(axes, name, results(*source).values())
    finish(axes)
    # What auto does in ten executions, and the others in a hundred.
    axes.set_xscale("log")
    axes.set_xticks([1, 2, 5, 10, 20, 50, 100], ["1", "2", "5", "10", "20", "50", "100"])
    axes.minorticks_off()
    axes.set_ylabel("missing to d*: 100 (1 - best / d*) [%]")
    figure.legend(loc="outside upper center", ncols=5, fontsize=8)
    figure.savefig(PICTURES / "regret.png", dpi=150)


def draw_misleading() -> None:
    """Draw the same for the cases built to mislead."""
    figure = Figure(figsize=(7, 3.2), layout="constrained")
    panels = figure.subplots(1, len(misleading.CASES), sharey=True)
    for axes, case in zip(panels, misleading.CASES, strict=True):
        for search in ("auto", "scalar", "random"):
            draw_missing(axes, search, results("misleading", case, search).values())
        finish(axes)
        axes.set_title(case, fontsize=9)
    panels[0].set_ylabel("missing to d* [%]")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper center", ncols=3, fontsize=8)
    figure.savefig(PICTURES / "misleading.png", dpi=150)


TEXT = """# The search `auto`: method and number of executions

Generated by `make search` from the stored campaigns in `benchmarks/results/`. {measured}

## Method

[How `auto` works](explanation/auto.md) has the steps. The predicted distance of a task includes the jumps of the
controller that is designed on M; the uncertainty of the residual along the predicted closed loop gives that of the
prediction. The region of a local search grows if the prediction was right and shrinks if it was wrong
([trust_region.py](../src/ctxval/searches/trust_region.py)). A local search ends if it predicts no improvement, or after
three executions without improvement. The next one starts at the task with the largest upper estimate, in which the
uncertainty weighs more with each local search that finds nothing larger (boldness).

From six executions on, each execution is predicted from all others (trust score). If these predictions are no better
than a surrogate of the distance, the vector that the distance is composed of is modelled over the tasks, and if that is
no better, the distance alone ([prediction.py](../src/ctxval/learning/prediction.py)). If the last two predictions erred
by more than half and the next one is uncertain by more than its own size, or if six executions have found nothing
larger, every second task comes from the model of the distance alone.

All choices follow from the seed and the stored trials, so a stopped campaign continues with the same choices.

## Executions until the maximum is found

The executions of S until the best distance is within a percentage of the true maximum d*; each of ten seeds has a
new model and new data. d* is exact for linear systems, computed on a dense grid for pendulum and arm, and otherwise
the best value of a large search. `> 30` means that the campaign was not that near after 30 executions. {met} of
{asked} targets are met.

{targets}

- {heavy_tail}
- `scalar`, which sees no trajectory, with more seeds: {more_seeds}. To 1 % on linear, 20-D, it needs {scalar_alone}:
  it is a Bayesian optimisation like [others](benchmarks.md).
- Seed 8 of `basin` has no definite maximum: its worst closed loop is unstable, so rounding decides its distance.
- Since commit {landed}, {fewer} of {pairs} campaigns need fewer executions to 1 % and {more} need more
  ([table](tables/searches-versions.csv)).

![Gap to the maximum against executions](searches/regret.png)

*The Dubins car's variant `basin`, 11-D: medians over the seeds with quartiles. `auto` uses trajectories; `scalar`,
`gp-ucb` and `random` use the distances alone.*

## Contribution of each part

Campaigns were repeated on the same seeds ({ablation_seeds}) without one part: without the residual (`scalar`),
without the trust score, without trust regions, and without boldness. The columns count the campaigns, those with the
same distances without the part, and those in which `auto` needs fewer / more executions to 5 % and 1 % of d*.
"Chosen by" are systems by which parts were chosen.

{ablations}

Most executions are saved by the residual. The trust score and the boldness save them on the systems by which they
were chosen, and hardly any on the others. They stay: without boldness or trust regions the search repeats itself, in
up to a quarter of the executions on misleading systems, and without the trust score the mean share of d* is smaller.
Tables: [by case](tables/searches-ablations.csv), [misleading systems](tables/searches-ablations-misleading.csv).

Left out, because they saved executions at most on the systems by which they were chosen: a Gaussian process of the
ratio of executed to predicted distances, and a least distance between new starts and executed tasks
([table](tables/searches-left-out.csv)); the search for rare maxima that certificates use, which took 1.4 to 2.7
times as long for similar numbers of executions; spreads, quantiles and expected improvements over draws of the
dynamics; an optimism that is learned from errors; a limit on uncertain predictions; a trust score from the second
execution on; hyperparameters learned without the data of M, which found more on misleading systems and needed more
executions on the Dubins car.

## Misleading cases

Three cases ([misleading.py](../benchmarks/misleading.py)) are built to mislead the search; campaigns have {budget}
executions. In `hidden-heat`, the torque of a drive falls with a temperature that is not recorded. In `hidden-load`,
a drive moves a load on a spring, and only the drive is recorded. In `corner-stop`, fewer than 2 % of the tasks reach
a stop, opposite to the region that all other data indicate. `switched`: campaigns, and suggestions, without any
prediction.

{misleading}

![Gap to the maximum on the misleading cases](searches/misleading.png)

*Medians over the seeds with quartiles. Campaigns end within 1 %.* [With random
tasks](tables/searches-misleading.csv).

{plants}

{speed}

## Falsification that learns from trajectories

Other tools learn a model of S from trajectories and search on it, for a requirement in temporal logic: FReaK ([HSCC
2024](https://doi.org/10.1145/3641513.3650141)) with linear Koopman models, whose authors report fewer expected
simulations than all participants on 16 of 19 benchmarks of the ARCH competition of 2022, and a faster version of it
(ATVA 2024); ARIsTEO ([ICSE 2020](https://doi.org/10.1145/3377811.3380370)) with surrogates from system
identification; Kötz, Sjöberg and Åkesson ([arXiv:2602.00031](https://arxiv.org/abs/2602.00031)) with neural
differential equations. None of them was run here. They search over input signals of one closed system; here every
task has a controller of its own, designed on M, and the difference between two closed loops is searched for.

## Global search of the true systems

A bound on d* needs a search that finds maxima in less than a thousandth of the task space
([global_search.py](../src/ctxval/gp/global_search.py)). It is tested on the true systems, which are simulated, with
{seeds} seeds. A cliff has values of at least 0.9 in a ball that fills {cliff} of the cube, and at most 0.6
elsewhere; a ridge rises towards the ball, a funnel surrounds it, and a trace is a slight rise close to it. The table
counts searches that found at least 0.99 d*.

{global_short}

Cliffs that only a trace announces are often missed, above all in six dimensions. [All
cases](tables/searches-global.csv). {surpassed}
"""


def page() -> GeneratedPage:
    """Return the page and its tables."""
    rows = target_rows()
    versions = search_versions_part.rows()
    fewer, more = search_versions_part.total()
    plants, plants_tables = search_plants_part.part()
    speed, speed_tables = search_speed_part.part()
    surpassed = study_global_search.surpassed(global_results())
    text = TEXT.format(
        measured=measured_with(results_of("auto").values(), AUTO),
        met=sum(row[-1] == "yes" for row in rows),
        asked=len(rows),
        targets=included("searches-targets"),
        heavy_tail=heavy_tail(),
        more_seeds=more_seeds(),
        scalar_alone=scalar_alone(),
        landed=LANDED,
        fewer=fewer,
        more=more,
        pairs=sum(int(row[1]) for row in versions) // 2,
        ablation_seeds=f"{ABLATION_SEEDS[0]} to {ABLATION_SEEDS[-1]}",
        ablations=table(search_ablations_part.SUMMARY, search_ablations_part.summary_rows()),
        budget=misleading.BUDGET,
        misleading=table(MISLEADING, [row for row in misleading_rows() if row[1] != "random"]),
        plants=plants,
        speed=speed,
        seeds=len(SEEDS),
        cliff=f"{study_global_search.CLIFF:.1e}",
        global_short=table(
            ["", *(f"{evaluations:,} evaluations" for evaluations in sorted(study_global_search.EVALUATIONS))],
            global_search_short(),
        ),
        surpassed=f"Searches have found more than 1 % above the stored truth: {'; '.join(surpassed)}.",
    )
    tables: dict[str, Table] = {
        "searches-targets": (TARGETS, rows),
        "searches-versions": (search_versions_part.HEADER, versions),
        "searches-ablations": (search_ablations_part.HEADER, search_ablations_part.rows()),
        "searches-ablations-misleading": (search_ablations_part.TOGETHER, search_ablations_part.new_rows()),
        "searches-left-out": (search_ablations_part.LEFT_OUT, search_ablations_part.left_out_rows()),
        "searches-misleading": (MISLEADING, misleading_rows()),
        "searches-global": ([*study_global_search.HEADER, "settings chosen by it"], global_search_rows()),
    }
    return GeneratedPage("searches.md", reflowed(text), {**tables, **plants_tables, **speed_tables})


def main() -> None:
    """Write the page, its tables and pictures."""
    matplotlib.use("Agg")
    PICTURES.mkdir(exist_ok=True)
    draw_regret()
    draw_misleading()
    page().write()


if __name__ == "__main__":
    main()
