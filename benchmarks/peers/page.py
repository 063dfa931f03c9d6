"""``docs/benchmarks.md`` from the stored results. Nothing is run here."""

from __future__ import annotations

import statistics
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from ctxval._util.arrays import Array
from ctxval.paper.reproduce.jobs import AUTO, measured_with
from page_tables import table
from peers import overhead, run
from peers.functions import CASES, SEEDS
from peers.methods import METHODS
from peers.overhead import COUNTS, SUGGESTIONS
from peers.run import CUT, Result, applies, budget_of
from study_auto import ROOT, shown

PAGE = ROOT / "docs" / "benchmarks.md"
PICTURES = ROOT / "docs" / "benchmarks"
WITHIN = (5, 2, 1)
NEVER = float("inf")
ROUNDING = 1e-4


@dataclass(frozen=True)
class Cell:
    """The runs of one method on one function.

    Attributes:
        case, method: names.
        results: one for each seed.
    """

    case: str
    method: str
    results: list[Result]

    @property
    def budget(self) -> int:
        """Return the executions that were allowed."""
        return budget_of(self.case, self.method)

    def first_within(self, percent: float) -> list[float]:
        """Return after how many executions each run was within so much of d*; infinity where it never was."""
        return [first_within(result, percent) for result in self.results]

    def regrets(self) -> Array:
        """Return how far below d* the largest distance is after 1, 2, ... executions, in per cent, a row for a run.

        A run that has ended keeps its last regret.
        """
        return np.array([regret(result, self.budget) for result in self.results])


def first_within(result: Result, percent: float) -> float:
    """Return after how many executions a run was within so much of d*; infinity if it never was."""
    enough = (1 - percent / 100) * result["maximum"]
    return next((float(count) for count, value in result["improvements"] if value >= enough), NEVER)


def regret(result: Result, budget: int) -> Array:
    """Return what one run misses of d* after 1, 2, ... executions, in per cent, shape ``(budget,)``."""
    best = np.zeros(budget)
    for count, value in result["improvements"]:
        best[count - 1 :] = value
    return np.asarray(np.maximum(100 * (1 - best / result["maximum"]), 0.0))


def cells(case: str) -> list[Cell]:
    """Return the runs on a function, those of each method in the order of the seeds."""
    found: dict[str, list[Result]] = {}
    for result in sorted(run.STORED.select(case=case), key=lambda result: int(result["seed"])):
        found.setdefault(result["method"], []).append(result)
    return [Cell(case, name, found[name]) for name in METHODS if name in found]


def missing(case: str) -> list[str]:
    """Return the methods without a result on a function."""
    there = {cell.method for cell in cells(case)}
    return [METHODS[name].title for name in METHODS if applies(name, case) and name not in there]


# Tables


def spread(counts: list[float], budget: int) -> str:
    """Return median, quartiles, and how many of the runs got there."""
    low, high = np.quantile(counts, [0.25, 0.75], method="inverted_cdf")
    reached = int(np.isfinite(counts).sum())
    if not reached:
        return f"- (0/{len(counts)})"
    middle = shown(statistics.median(counts), budget)
    return f"{middle} [{shown(low, budget)}, {shown(high, budget)}] ({reached}/{len(counts)})"


def row(cell: Cell) -> list[str]:
    """Return a line of a function's table."""
    areas = cell.regrets().mean(axis=1)
    low, middle, high = np.quantile(areas, [0.25, 0.5, 0.75])
    executions = sum(result["executions"] for result in cell.results)
    seconds = sum(result["seconds"] for result in cell.results) / executions if executions else np.nan
    return [
        METHODS[cell.method].title,
        METHODS[cell.method].given,
        *(spread(cell.first_within(percent), cell.budget) for percent in WITHIN),
        "-" if (cell.case, cell.method) in CUT else f"{middle:.1f} [{low:.1f}, {high:.1f}]",
        f"{seconds:.2g}",
    ]


def function_section(case: str) -> str:
    """Return title, table and picture of a function."""
    found, described = cells(case), CASES[case]
    title = f"### {described.title}: {described.dimension}-D, {described.budget} executions"
    if not found:
        return f"{title}\n\nNot run yet."
    header = ["method", "input", *(f"to {percent} %" for percent in WITHIN), "mean regret [%]", "CPU s"]
    parts = [title, seeds_sentence(case, found), table(header, [row(cell) for cell in found])]
    parts += [f"![Regret against executions](benchmarks/{case}.png)"]
    return "\n\n".join(parts)


def seeds_sentence(case: str, found: list[Cell]) -> str:
    """Return which seeds there are, what is missing and what broke."""
    most = max(found, key=lambda cell: len(cell.results))
    maxima = sorted(result["maximum"] for result in most.results)
    text = f"{len(most.results)} of {len(SEEDS)} seeds. Their d* are {', '.join(f'{value:.3g}' for value in maxima)}."
    fewer = [cell for cell in found if len(cell.results) < len(most.results)]
    if fewer:
        names = (f"{METHODS[cell.method].title} ({len(cell.results)})" for cell in fewer)
        text += f" These have only the first seeds: {', '.join(names)}."
    excess = max(value / r["maximum"] - 1 for cell in found for r in cell.results for _, value in r["improvements"])
    if excess > ROUNDING:
        text += f" One of the methods found {100 * excess:.2g} % more than the value used for d*."
    if missing(case):
        text += f" Not run: {', '.join(missing(case))}."
    return text + "".join(limits_sentence(cell) for cell in found)


def limits_sentence(cell: Cell) -> str:
    """Return whether a method was cut short, and how often it broke."""
    text, title = "", METHODS[cell.method].title
    if (cell.case, cell.method) in CUT:
        text += f" {title} had a budget of only {cell.budget} executions because of its computing time."
    errors = [result["error"] for result in cell.results if result["error"]]
    if errors:
        text += f" {title} failed in {len(errors)} runs, first with `{errors[0]}`."
    return text


def against(name: str, other: str) -> str:
    """Return in how many runs a method was within 1 % earlier, as early and later than another one."""
    earlier = same = later = 0
    for mine, theirs in (pair for case in CASES for pair in paired(case, name, other)):
        earlier, same, later = earlier + (mine < theirs), same + (mine == theirs), later + (mine > theirs)
    return f"{earlier} / {same} / {later}"


def paired(case: str, name: str, other: str) -> list[tuple[float, float]]:
    """Return the executions to 1 % of two methods, for each seed that both have, within the smaller budget."""
    found = {cell.method: cell for cell in cells(case) if cell.method in (name, other)}
    if not {name, other} <= set(found):
        return []
    budget = min(cell.budget for cell in found.values())
    counts = {
        (method, result["seed"]): NEVER if (k := first_within(result, 1)) > budget else k
        for method, cell in found.items()
        for result in cell.results
    }
    return [(counts[name, s], counts[other, s]) for s in SEEDS if (name, s) in counts and (other, s) in counts]


def pairs_table() -> str:
    """Return every method against our scalar search and against ``auto``, run by run."""
    rows = [
        [method.title, method.given, against(name, "scalar"), against(name, "auto")]
        for name, method in METHODS.items()
        if any(cell.method == name for case in CASES for cell in cells(case))
    ]
    return table(["method", "input", "compared with ours: scalar", "compared with ours: auto"], rows)


# Overhead


def measured(case: str, name: str, n: int) -> Result | None:
    """Return a measurement of overhead."""
    return overhead.STORED.get((case, name, n))


def seconds(case: str, name: str, n: int) -> float | None:
    """Return the mean CPU seconds of a suggestion after n values; None where it was not measured."""
    found = measured(case, name, n)
    return statistics.mean(found["seconds"]) if found and found["seconds"] and not found["error"] else None


def overhead_cell(case: str, name: str, n: int) -> str:
    """Return CPU seconds, or why there are none."""
    found, mean = measured(case, name, n), seconds(case, name, n)
    if found is None:
        return "not run"
    return (found["error"] or "-") if mean is None else f"{mean:.2g}"


def overhead_table(case: str, names: Iterable[str], counts: tuple[int, ...]) -> str:
    """Return CPU seconds of a suggestion and the memory of the process, method by method."""
    rows = []
    for name in names:
        if any(measured(case, name, n) for n in counts):
            memory = [found["memory"] for n in counts if (found := measured(case, name, n)) and "memory" in found]
            cells_ = [overhead_cell(case, name, n) for n in counts]
            rows.append([METHODS[name].title, *cells_, f"{max(memory):.0f}" if memory else "-"])
    return table(["method", *(f"n = {n} [CPU s]" for n in counts), "peak memory [MB]"], rows)


def target(text: str, asked: float, value: float | None) -> list[str]:
    """Return a line of the targets' table."""
    if value is None:
        return [text, f"{asked:g}", "not run", "-"]
    return [text, f"{asked:g}", f"{value:.3g}", "met" if value <= asked else "**missed**"]


def targets_table() -> str:
    """Return what was asked of the overhead beside what was measured."""
    ours, theirs = seconds("linear-10", "scalar", 100), seconds("linear-10", "botorch-log-ei", 100)
    rows = [
        target("scalar, n = 100 in 20-D, fraction of BoTorch LogEI", 0.05, ours / theirs if ours and theirs else None),
        target("scalar, n = 100 in 20-D, CPU s", 0.1, ours),
        target("scalar, n = 1,000 in 20-D, CPU s", 2.0, seconds("linear-10", "scalar", 1000)),
        *(
            target(f"{METHODS[name].title}, Dubins car, n = {n}, CPU s", 2.0, seconds("dubins-basin", name, n))
            for name in ("auto", "auto-no-data")
            for n in (20, 100)
        ),
    ]
    return table(["quantity", "at most", "measured", ""], rows)


TEXT = """# Comparison with other tools

Generated by `make bench-peers` from the results in `benchmarks/results/peers.jsonl` and `peers_overhead.jsonl`;
nothing here is written by hand. {measured}

We know of no other tool that takes a system, a model and a controller designed on the model. The tools on this page
have one task in common with `ctxval`: they search for the largest value of a function in few evaluations. Each of them
is therefore given d(p), as a function of the unit cube, to maximise.

None of these tools learns from trajectories, but others do: FReaK, ARIsTEO and their successors learn a model of the
system from simulations, and search on it for a violation of a requirement. [searches.md](searches.md) states what their
authors report. They need a requirement in temporal logic and a system whose controller does not depend on the task, so
they are not run here.

## Method

The functions are the cases of `ctxval.cases`. The model and its data are drawn anew for each seed, and all methods have
the same seeds. d* is known in closed form for the linear systems. It is computed on a dense grid for pendulum and arm,
and by differential evolution and local search for the Dubins car. For arm and car it is the best known value. A run
ends within 1 % of d* or when its budget is spent. The first points are counted. If a method is deterministic, as DIRECT
is, seeds differ only in their functions. The training of the arm's network amplifies rounding, so its functions depend
on the processor. All methods on this page had the same functions, which `OPENBLAS_CORETYPE=SkylakeX` reproduces; those
of [searches.md](searches.md) are others.

The columns of the tables are:

- **To 5, 2, 1 %**: executions until the largest distance found is within this percentage of d*. The entry is the median
  over the seeds, the quartiles in brackets, and the number of seeds that reached it within the budget.
- **Mean regret**: the area under the regret curve over the budget. The regret is `1 - best / d*` in per cent, and a run
  that has ended keeps its last regret. The entry is the median over the seeds with quartiles.
- **CPU s**: processor seconds for one suggestion in these runs, over all threads, with BLAS and torch on one thread. It
  includes everything but the execution. Other programs ran on the machine, so compare only the orders of magnitude.
  Some runs of `auto` are the same campaigns as in `study_auto.py`, and their time includes the executions.
- **Input**: what a method receives from an execution. Most methods receive the distance, a number. `vector` receives
  the vector whose norm is the distance, if there is one. `auto` receives the whole trajectory and may run M. If M was
  learned from data, `auto` also receives these data, which are executions of S that were made before; it is also run
  without them. A comparison of `auto` with the other methods shows the value of the trajectories. A comparison of
  `scalar` with the other methods shows the performance without them.

{settings}

VerifAI and PSY-TaLiRo need different versions of `attrs` and cannot be installed together. There are therefore two
dependency groups, `peers` and `peers-verifai`.

## Run-by-run comparison

The table compares each method with two searches of `ctxval`, over all functions and seeds that both have. It gives the
number of runs in which the method was within 1 % of d* after fewer / equally many / more executions than the search of
`ctxval`. If neither was within 1 %, the run counts as equal. If the budgets differ, the smaller one applies to both.

{pairs}

![Executions until within 5 %](benchmarks/executions.png)

## Results for each function

{functions}

## Computing time of a suggestion

The table gives CPU seconds of a suggestion on the linear system with 10 states, 20-D. It is the mean of {suggestions}
successive suggestions after n values. Methods that build a model are given the same n uniformly random tasks, and they
first learn from these. All other methods use their own history. TuRBO makes its first 40 suggestions without a model.
The memory is the peak of a separate process that does nothing else, including Python and the case. Other programs ran
on the same cores, and this lengthens all times. The rows of `auto`, EGObox and bayesian-optimization are from a faster
computer, on which `scalar` and GP-UCB took 0.62 to 0.75 of the time in the table.

{overhead}

![CPU seconds of a suggestion](benchmarks/overhead.png)

On the Dubins car, the inner loop designs controllers and simulates them:

{dubins}

## Targets

{targets}
"""

SETTINGS = [
    [
        "ours",
        "default settings, as in `ctxval run`; CMA-ES and random are also searches of `ctxval` (CMA-ES uses `cmaes`, "
        "with restarts)",
    ],
    [
        "GPyOpt 1.2.6",
        "the paper's tool: Matern 3/2, lower confidence bound of the negative distance with GPyOpt's weight 2, exact "
        "evaluations, 5 random first points; stopping at convergence is off",
    ],
    [
        "BoTorch 0.18.1",
        "5 Sobol first points, 10 restarts from 512 raw samples; LogEI on the default model, UCB with Matern 3/2 and "
        "beta = 2; if a fit fails, the initial hyperparameters are used",
    ],
    [
        "TuRBO-1",
        "written on BoTorch according to its paper: 2 d Sobol points in each region, one Thompson sample of "
        "min(100 d, 5,000) candidates, batches of one",
    ],
    ["Optuna 5.0.0", "`GPSampler`, 10 random first points, exact evaluations"],
    [
        "EGObox 1.0.0",
        "default settings: log expected improvement; a Latin hypercube of d + 1 first points, and at least 5",
    ],
    [
        "bayesian-optimization 3.4.0",
        "default settings: upper confidence bound with kappa 2.576, Matern 5/2; 5 random first points",
    ],
    ["scipy 1.17.1", "`dual_annealing` and `direct` with their defaults"],
    [
        "VerifAI 2.2.0",
        "default settings; its Bayesian optimisation is GPyOpt's expected improvement, which is learned anew each "
        "time. Cross-entropy and bandit learn only from counterexamples. They are told that tasks above d* / 2 are "
        "counterexamples, which nobody knows in practice. Simulated annealing raises an error as released and is left "
        "out",
    ],
    ["PSY-TaLiRo 3.2.0", "both of its optimisers; its annealing makes no local searches"],
]


def text() -> str:
    """Return the page."""
    return TEXT.format(
        measured=measured_with(run.STORED.values(), AUTO),
        settings=table(["method", "settings"], SETTINGS),
        pairs=pairs_table(),
        functions="\n\n".join(function_section(case) for case in CASES),
        suggestions=SUGGESTIONS,
        overhead=overhead_table("linear-10", METHODS, (*COUNTS, 1000)),
        dubins=overhead_table("dubins-basin", ("auto", "auto-no-data", "scalar"), (20, 100)),
        targets=targets_table(),
    )


def main() -> None:
    """Write the page and its pictures."""
    from peers.pictures import draw  # here, as the text needs no pictures

    draw()
    PAGE.write_text(text())
    print(f"page: {PAGE.relative_to(ROOT)}")


if __name__ == "__main__":
    main()
