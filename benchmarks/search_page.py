"""``docs/searches.md`` and its pictures, from the stored campaigns of the studies. Nothing is run here."""

from __future__ import annotations

import functools
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import misleading
import search_plants_part
import search_speed_part
import search_versions_part
import study_global_search
from ctxval._util.arrays import Array
from ctxval._util.json_lines import JsonLines
from ctxval.paper.reproduce.jobs import AUTO, measured_with
from page_tables import table
from peers import run
from peers.page import first_within as within_of
from search_ablations_part import (
    ABLATION_SEEDS,
    ablation_table,
    left_out_table,
    new_ablation_table,
    plant_ablation_table,
    summary_table,
)
from search_cells import ENDS, SEEDS, Counts, cells, largest, reached, results, spread
from study_ablations import BUDGET as NEW_BUDGET
from study_ablations import CHOSEN_BY, OTHERS
from study_auto import NEAR, ROOT, WITHIN, Result, first_within, results_of, shown

PAGE = ROOT / "docs" / "searches.md"
PICTURES = ROOT / "docs" / "searches"

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


def target_table() -> str:
    """Return the targets beside what was measured."""
    header = ["case", "within", "target", "median", "25 to 75 %", "worst seed", "reached", "CPU s", "met"]
    return table(header, [row for target in targets() if (row := target.row())])


def unmeasured() -> str:
    """Return which cases of the table have no campaigns, or fewer seeds than the others; empty where none."""
    counts = {target.text: len(results(target.study, target.case, target.search)) for target in targets()}
    few = [f"{text} ({count} of {len(SEEDS)} seeds)" for text, count in counts.items() if count < len(SEEDS)]
    return f"Not measured in full: {', '.join(few)}." if few else ""


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
    """Return how the scalar search fares on all stored seeds, where they are more than the table has; else empty."""
    sentences = []
    for case, text, percent, limits in MORE_SEEDS:
        found = results("scalar", case, "scalar", range(1000))
        if len(found) <= len(SEEDS):
            continue
        counts, budget = [first_within(result, percent) for result in found.values()], found[0]["budget"]
        sentences.append(
            f"{text}, {len(counts)} seeds: within {percent:g} % after {shown(float(np.median(counts)), budget)} "
            f"(median; 25 to 75 %: {spread(counts, budget)}), "
            + " and ".join(f"{sum(count <= most for count in counts)} within {most}" for most in limits)
            + "."
        )
    if not sentences:
        return ""
    return "\n".join(["For `scalar` alone, more than ten seeds were run:", "", *(f"- {one}" for one in sentences)])


def scalar_alone() -> str:
    """Return how the search without trajectories compares with GPyOpt; empty without campaigns of both."""
    ours = results("scalar", "linear-10", "scalar", range(1000)).values()
    theirs = run.STORED.select(case="linear-10", method="gpyopt")
    if not ours or not theirs:
        return ""
    medians = [
        float(np.median([first_within(result, 1.0) for result in ours])),
        float(np.median([within_of(result, 1.0) for result in theirs])),
    ]
    return (
        "The search `scalar` alone, which sees no trajectory, is a Bayesian optimisation like others.\n"
        f"On the linear system in 20-D it needs {medians[0]:g} executions to 1 % of d* (median of {len(ours)} seeds).\n"
        f"This is level with GPyOpt's {medians[1]:g} ({len(theirs)} seeds): [benchmarks.md](benchmarks.md)."
    )


# Misleading cases


def misleading_table() -> str:
    """Return how the searches fare on the cases built to mislead."""
    rows = []
    for case, search in ((case, search) for case in misleading.CASES for search in ("auto", "scalar", "random")):
        found = results("misleading", case, search)
        if found:
            rows.append([case, search, *cells(found.values()), fallen(found.values()) if search == "auto" else "-"])
    return table(["case", "search", *ENDS, "switched"], rows)


def reasons(result: Result) -> list[str]:
    """Return why the search turned away from all predictions, suggestion by suggestion."""
    return [note["why"] for note in result["notes"] if note is not None and "why" in note]


def fallen(found: Iterable[Result]) -> str:
    """Return in how many campaigns, and in what share of their suggestions, the search fell back."""
    campaigns = list(found)
    shares = [len(reasons(result)) / len(result["notes"]) for result in campaigns]
    return f"{sum(share > 0 for share in shares)} of {len(shares)} seeds, {100 * np.mean(shares):.0f} % of suggestions"


def example() -> str:
    """Return what a note says where the search fell back; empty where it never did."""
    for case in misleading.CASES:
        for seed, result in results("misleading", case, "auto").items():
            if reasons(result):
                return f"`{case}`, seed {seed}: *{reasons(result)[-1]}*."
    return ""


# The global search of true systems


@functools.cache
def global_results() -> JsonLines:
    """Return the results of the global search; they are read once."""
    return JsonLines(study_global_search.RESULTS, study_global_search.KEY)


def global_search_table(chosen_by: bool) -> str:
    """Return what the global search finds, on the cases that its settings were chosen by or on the others."""
    return table(study_global_search.HEADER, study_global_search.rows(global_results(), chosen_by))


def global_search_notes() -> str:
    """Return which cases have no results, and where a search has surpassed a stored truth; empty if there are none."""
    missing = [f"`{case}`" for case in study_global_search.CASES if not global_results().select(case=case)]
    surpassed = study_global_search.surpassed(global_results())
    notes = [f"Not measured: {', '.join(missing)}."] if missing else []
    if surpassed:
        notes.append(f"Searches have found more than 1 % above the stored truth: {'; '.join(surpassed)}.")
    return "\n\n".join(notes)


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

Generated by `make search` from the stored campaigns in `benchmarks/results/`; no number here is written by hand.
{measured}

## Method

1. Before each execution, `auto` learns the residual r(x, u) = x' - M(x, u) as a Gaussian process. The data are all
   recorded trajectories and the training data that M carries:
   [dynamics_posterior.py](../src/ctxval/learning/dynamics_posterior.py).
2. M + r is a model again. The predicted distance at a task is therefore the
   [validation](../src/ctxval/core/validation.py) of M against M + r. It costs no execution, and it includes the jumps
   of the controller that is designed on M.
3. The uncertainty of r along the predicted closed loop gives the uncertainty of the prediction.
4. The next task maximises the prediction, increased in proportion to its uncertainty:
   [trust_region.py](../src/ctxval/searches/trust_region.py). The maximiser is
   [ascent.py](../src/ctxval/gp/ascent.py). If there are more than three task parameters, most points are screened with
   a rough prediction, which uses few of the recorded transitions.
5. The maximisation takes place in a trust region, a box around the best task of the current local search. The box
   grows if the prediction was right and shrinks if it was wrong.
6. A local search ends if it predicts no improvement, or after three executions without improvement. The next one
   starts at the task with the largest upper estimate. In this estimate the uncertainty has several times its usual
   weight, and the weight grows with each local search that finds nothing larger.
7. From six executions on, each execution is predicted from all others. If these predictions are no better than a
   surrogate of the distance, the prediction is not used. This test is the trust score.
8. In that case, the vector that the distance is composed of is modelled over the tasks:
   [prediction.py](../src/ctxval/learning/prediction.py). If that model is no better either, the distance alone is
   modelled: [bayesian_optimisation.py](../src/ctxval/searches/bayesian_optimisation.py). The note of the trial records
   the reason.
9. The search hedges: if the last two predictions erred by more than half and the next one is uncertain by more than
   its own size, or if six executions have found nothing larger, every second task is that of the model of the distance
   alone.
10. All choices follow from the seed and the stored trials. A campaign that was stopped therefore makes the same choices
    as an uninterrupted one: [architecture.md](architecture.md).

## Executions until the maximum is found

The table counts the executions of S until the best distance is within the stated percentage of the true maximum d*.
The first executions are included. Each seed has a new model and new data. d* is exact for the linear systems. It is
computed on a dense grid for pendulum and arm. For all other cases it is the best value known from a large search. A
campaign ends within 1 % of d* or when its budget is spent.

- `> 30`: the campaign was not within the percentage after 30 executions.
- `25 to 75 %`: quartiles over the seeds.
- CPU s: processor seconds for one suggestion, median over the seeds, measured while other programs ran on the machine.

{targets}

{unmeasured}

{heavy_tail}

Seed 8 of `basin` has no definite maximum. At its worst corner the executed closed loop is unstable, so that rounding
errors decide its distance. `auto` executes this corner, but the distance there need not be that of the large search.

{more_seeds}

{versions}

![Gap to the maximum against executions](searches/regret.png)

*The Dubins car's variant `basin`, 11-D: medians over the seeds with quartiles. Campaigns end within 1 %. `auto` uses
trajectories; `scalar`, `gp-ucb` and `random` use the distances alone.*

## Contribution of each part

The table repeats the campaigns, on the same seeds ({ablation_seeds}), each without one part of the search:

- no residual: Bayesian optimisation of the distance (`scalar`), which starts with one random point.
- no trust score: the prediction is always used, however wrong it is.
- no trust region: each suggestion is the best task of the whole task space, without a box and without restarts.
- no boldness: the weight of the uncertainty does not grow with each local search that finds nothing larger.

The trust score acts from the seventh execution on, and a local search ends after three executions without improvement.
A campaign that ends sooner shows no effect of either.

{ablations}

The plants below that are executed quickly, {new_budget} executions for each campaign:

{ablations_plants}

Further systems with a mechanism that misleads, {new_budget} executions for each campaign, all systems together. The
parts of the search were chosen by those in
[dynamics_development_misleading.py](../benchmarks/dynamics_development_misleading.py). The share of d* is the mean,
over all executions of the budget, of the largest distance so far. The last column counts executions that differ from
an earlier one by less than {near} in every coordinate of the unit cube and gained nothing.

{ablations_chosen}

Nothing was chosen by those in [dynamics_misleading.py](../benchmarks/dynamics_misleading.py):

{ablations_others}

All of these campaigns together. `Chosen by` are the systems by which parts of the search were chosen, and `others` are
the systems by which nothing was chosen. The columns count the campaigns, those whose distances are the same without the
part, and those in which `auto` needs fewer / more executions to 5 % and to 1 % of d* than the search without the part.

{ablations_summary}

The trust score and the boldness save executions on the systems by which they were chosen, and hardly any on the others.
They stay: without boldness or trust regions the search repeats itself (column `next to an earlier one` above), and
without the trust score the mean share of d* is smaller.

The code of commit 64a3b0d had two further mechanisms. A second Gaussian process, over the tasks, learned the ratio of
the executed to the predicted distances with its noise, and the prediction was multiplied by this discrepancy. And a
local search did not start next to an executed task unless a larger distance was predicted there. Both are gone: they
saved executions only on systems by which they were chosen, although fewer executions were next to an earlier one. The
table compares all campaigns; its last two rows are the plants and the further systems. Columns 5 % and 1 % count those
that needed fewer / more executions with these mechanisms than without them.

{left_out}

These mechanisms were tried, most of them on systems of the first table, and left out, because they found no more:

- the search for rare maxima that the certificates use ([global_search.py](../src/ctxval/gp/global_search.py)), with
  half of the predictions if a region is the whole task space. On seeds 0 to 9, the executions to 1 % of d* changed from
  5.5 to 4 on the Dubins car's variant `basin`, from 7 to 6 on the Dubins car and from 11 to 11.5 on the linear system
  in 20-D (medians); those to 5 % from 4 to 3, from 3 to 5 and from 5 to 5.5. A suggestion took 1.4 to 2.7 times as
  long;
- draws of the dynamics: the spread of the distance over draws instead of the uncertainty along the predicted closed
  loop, or the larger of the two; an upper quantile, the expected improvement or the mean over draws;
- an optimism that is estimated from the errors of predictions;
- a limit on predictions whose uncertainty exceeds one;
- a trust score from the second execution on.

Hyperparameters that are learned from executions alone, without the data of M, found more on these systems, but needed
more executions on the Dubins car.

## Misleading cases

Three cases in [misleading.py](../benchmarks/misleading.py) are built to mislead the search. Each campaign has {budget}
executions, and M carries data of short, gentle runs.

- `hidden-heat`: a drive whose torque falls with a temperature that is not recorded.
- `hidden-load`: a drive with a load on a spring. Only the drive is recorded, so r(x, u) does not exist as a function.
- `corner-stop`: a cart on a rail with a stop that fewer than 2 % of the tasks reach. These tasks are at the opposite
  end of the task space from the region that all other data indicate.

The column `switched` counts the campaigns, and the share of their suggestions, in which `auto` did not use any
prediction.

{misleading}

This is the reason that a note records when `auto` switches: {example}

![Gap to the maximum on the misleading cases](searches/misleading.png)

*Medians over the seeds with quartiles. Campaigns end within 1 %.*

{plants}

{speed}

## Falsification that learns from trajectories

`auto` is not the only search that learns a model of S from trajectories and searches on that model. Falsification tools
do this for a requirement in temporal logic, where `auto` does it for the distance between M and S:

- FReaK (Bak, Bogomolov, Hekal, Kochdumper, Lew, Mata and Rahmati, *Falsification using Reachability of Surrogate
  Koopman Models*, HSCC 2024, [doi:10.1145/3641513.3650141](https://doi.org/10.1145/3641513.3650141)) learns a linear
  Koopman model from the simulations so far. A mixed-integer linear program finds its least robust trajectory, which is
  simulated next. On the benchmarks of the ARCH falsification competition of 2022, its authors report fewer expected
  simulations than all participating tools on 16 of 19 benchmarks, and counterexamples on three benchmarks where no
  other tool found them consistently.
- *Fast Koopman Surrogate Falsification Using Linear Relaxations and Weights* (ATVA 2024) replaces the integer variables
  by a weighted encoding, and reports fewer simulations and less computation.
- ARIsTEO (Menghi, Nejati, Briand and Isasi Parache, *Approximation-Refinement Testing of Compute-Intensive
  Cyber-Physical Models*, ICSE 2020, [doi:10.1145/3377811.3380370](https://doi.org/10.1145/3377811.3380370)) refines a
  surrogate from system identification. On five models its authors report 24 % more violations than S-TaLiRo, found 31 %
  faster.
- Kötz, Sjöberg and Åkesson, *Optimal Control-Based Falsification of Learnt Dynamics via Neural ODEs and Symbolic
  Regression* ([arXiv:2602.00031](https://arxiv.org/abs/2602.00031)), search with optimal control on neural differential
  equations, and report orders of magnitude fewer experiments than optimisation without a model of the dynamics.

These figures are the authors' own, and none of these tools was run here. They search over input signals of one closed
system. Here, every task has a controller of its own that is designed on M, and what is searched for is a difference
between two closed loops. The plants above therefore have other tasks than the benchmarks of the competition.

{scalar_alone}

## Global search of the true systems

A bound on d* needs a search that finds the largest value of a function, even if large values fill less than a
thousandth of the task space: [global_search.py](../src/ctxval/gp/global_search.py). The search is tested on the true
systems, which are simulated, with {seeds} seeds. Each seed has a new model, new data and a new search without any
known point. The share is the largest distance found, divided by d*. d* is exact for the linear systems and the cliffs.
Otherwise it is the largest value of a stored truth, of all searches of this table and, except for the arm, of one more
search with {reference} evaluations.

In a `cliff`, values are at least 0.9 in a ball that fills {cliff} of the cube, and at most 0.6 elsewhere. A `ridge`
rises towards the ball, a `funnel` surrounds it at a few radii, and a `trace` is a slight rise close to it. The number
is the dimension.

Settings of the search were chosen by these cases:

{global_chosen}

These cases were not used to choose any setting:

{global_others}

{global_notes}
"""


def text() -> str:
    """Return the page."""
    page = TEXT.format(
        measured=measured_with(results_of("auto").values(), AUTO),
        targets=target_table(),
        unmeasured=unmeasured(),
        heavy_tail=heavy_tail(),
        more_seeds=more_seeds(),
        versions=search_versions_part.text(),
        ablation_seeds=f"{ABLATION_SEEDS[0]} to {ABLATION_SEEDS[-1]}",
        ablations=ablation_table(),
        new_budget=NEW_BUDGET,
        near=NEAR,
        ablations_plants=plant_ablation_table(),
        ablations_chosen=new_ablation_table(CHOSEN_BY),
        ablations_others=new_ablation_table(OTHERS),
        ablations_summary=summary_table(),
        left_out=left_out_table(),
        misleading=misleading_table(),
        plants=search_plants_part.text(),
        speed=search_speed_part.text(),
        scalar_alone=scalar_alone(),
        budget=misleading.BUDGET,
        example=example(),
        seeds=len(SEEDS),
        reference=f"{study_global_search.REFERENCE:,}",
        cliff=f"{study_global_search.CLIFF:.1e}",
        global_chosen=global_search_table(chosen_by=True),
        global_notes=global_search_notes(),
        global_others=global_search_table(chosen_by=False),
    )
    # What is empty leaves no gap.
    return re.sub(r"\n{3,}", "\n\n", page)


def main() -> None:
    """Write the page and its pictures."""
    matplotlib.use("Agg")
    PICTURES.mkdir(exist_ok=True)
    draw_regret()
    draw_misleading()
    PAGE.write_text(text())
    print(f"page: {PAGE.relative_to(ROOT)}")


if __name__ == "__main__":
    main()
