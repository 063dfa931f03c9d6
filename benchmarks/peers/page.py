"""``docs/benchmarks.md`` from the stored results. Nothing is run here."""

from __future__ import annotations

import statistics
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from ctxval._util.arrays import Array
from page_tables import DOCS, GeneratedPage, Table, included, reflowed
from peers import overhead, run
from peers.functions import CASES, SEEDS
from peers.methods import METHODS
from peers.overhead import COUNTS
from peers.run import CUT, Result, applies, budget_of
from reproduce.jobs import AUTO, measured_with
from study_auto import shown

PICTURES = DOCS / "benchmarks"
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


def spread(counts: list[float], budget: int, *, short: bool = False) -> str:
    """Return the median, the quartiles unless ``short``, and how many of the runs got there."""
    low, high = np.quantile(counts, [0.25, 0.75], method="inverted_cdf")
    reached = int(np.isfinite(counts).sum())
    if not reached and not short:
        return f"- (0/{len(counts)})"
    middle = shown(statistics.median(counts), budget)
    if short:
        return f"{middle} ({reached}/{len(counts)})"
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


HEADER = ["function", "method", "input", *(f"to {percent} %" for percent in WITHIN), "mean regret [%]", "CPU s"]


def function_rows() -> list[list[str]]:
    """Return what each method needs on each function."""
    return [[CASES[case].title, *row(cell)] for case in CASES for cell in cells(case)]


def functions() -> list[list[str]]:
    """Return each function with its maxima, and what is special about its runs."""
    found = []
    for case, described in CASES.items():
        of = cells(case)
        most = max(of, key=lambda cell: len(cell.results))
        maxima = ", ".join(f"{value:.3g}" for value in sorted(result["maximum"] for result in most.results))
        notes = special(case, of, len(most.results))
        found.append([described.title, f"{described.dimension}-D", str(described.budget), maxima, notes])
    return found


def short_rows() -> list[list[str]]:
    """Return medians of the executions to 5 % on each function, and CPU seconds of a suggestion."""
    rows = []
    for name, method in METHODS.items():
        own = {case: cell for case in CASES for cell in cells(case) if cell.method == name}
        if own:
            counts = [spread(own[c].first_within(5), own[c].budget, short=True) if c in own else "-" for c in CASES]
            rows.append([method.title, *counts, overhead_cell("linear-10", name, 100)])
    return rows


def special(case: str, found: list[Cell], seeds: int) -> str:
    """Return which runs are missing, which had less budget, and which failed."""
    text = ""
    fewer = [cell for cell in found if len(cell.results) < seeds]
    if fewer:
        names = (f"{METHODS[cell.method].title} ({len(cell.results)})" for cell in fewer)
        text += f" These have only the first seeds: {', '.join(names)}."
    excess = max(value / r["maximum"] - 1 for cell in found for r in cell.results for _, value in r["improvements"])
    if excess > ROUNDING:
        text += f" One of the methods found {100 * excess:.2g} % more than the value used for d*."
    if missing(case):
        text += f" Not run: {', '.join(missing(case))}."
    return (text + "".join(limits_sentence(cell) for cell in found)).strip()


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


def pairs() -> list[list[str]]:
    """Return every method in comparison with our scalar search and with ``auto``, run by run."""
    return [
        [method.title, method.given, against(name, "scalar"), against(name, "auto")]
        for name, method in METHODS.items()
        if any(cell.method == name for case in CASES for cell in cells(case))
    ]


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


def overhead_rows(case: str, names: Iterable[str], counts: tuple[int, ...]) -> list[list[str]]:
    """Return CPU seconds of a suggestion and the memory of the process, method by method."""
    rows = []
    for name in names:
        if any(measured(case, name, n) for n in counts):
            memory = [found["memory"] for n in counts if (found := measured(case, name, n)) and "memory" in found]
            cells_ = [overhead_cell(case, name, n) for n in counts]
            rows.append([METHODS[name].title, *cells_, f"{max(memory):.0f}" if memory else "-"])
    return rows


def target(text: str, asked: float, value: float | None) -> list[str]:
    """Return a line of the targets' table."""
    if value is None:
        return [text, f"{asked:g}", "not run", "-"]
    return [text, f"{asked:g}", f"{value:.3g}", "met" if value <= asked else "**missed**"]


def targets() -> list[list[str]]:
    """Return the requested CPU seconds and the measured ones."""
    ours, theirs = seconds("linear-10", "scalar", 100), seconds("linear-10", "botorch-log-ei", 100)
    return [
        target("scalar, n = 100 in 20-D, fraction of BoTorch LogEI", 0.05, ours / theirs if ours and theirs else None),
        target("scalar, n = 100 in 20-D, CPU s", 0.1, ours),
        target("scalar, n = 1,000 in 20-D, CPU s", 2.0, seconds("linear-10", "scalar", 1000)),
        *(
            target(f"{METHODS[name].title}, Dubins car, n = {n}, CPU s", 2.0, seconds("dubins-basin", name, n))
            for name in ("auto", "auto-no-data")
            for n in (20, 100)
        ),
    ]


TEXT = """# Comparison with other tools

Generated by `make bench-peers` from the stored results in `benchmarks/results/`. {measured}

We know of no other tool that takes a system, a model and a controller designed on the model. The tools on this page
share one task with `ctxval`: they search for the largest value of a function in few evaluations. So each of them
maximises d(p) on the unit cube. Tools that learn from trajectories need a requirement in temporal logic and a
controller that does not depend on the task; they were not run
([searches](searches.md#falsification-that-learns-from-trajectories)).

## Method

The functions are the cases of `ctxval.cases`, with a new model and new data for each of {seeds} seeds, the same for
all methods. d* is exact for linear systems, computed on a dense grid for pendulum and arm, and the best known value
for the Dubins car. A run ends within 1 % of d* or when its budget is spent; the first points are counted. The
training of the arm's network amplifies rounding, so its functions depend on the processor
(`OPENBLAS_CORETYPE=SkylakeX` reproduces them).

Most methods receive a distance from each execution. `vector` receives the vector whose norm is the distance, and
`auto` the trajectory; it may run M, and has the data that M was learned from, unless it says "without data". So
`auto` shows the value of trajectories, and `scalar` the performance without them. VerifAI's cross-entropy and bandit
learn only from counterexamples: they are told that tasks above d* / 2 are some, which is unknown in practice. TuRBO
was written on BoTorch according to its paper. [Settings of each method](tables/benchmarks-settings.csv).

## Executions and computing time

Executions to 5 % of d*: medians over the seeds, with the number of seeds that reached it within the budget
({budgets}). The last column has CPU seconds of a suggestion in 20-D after 100 values.

{short}

![Executions until within 5 %](benchmarks/executions.png)

- `auto` and `scalar` came within 1 % of d* at different times in most of the runs that both have: `auto` was earlier
  / equal / later in {auto_scalar} runs. GPyOpt, the paper's tool, in comparison with `auto`: {gpyopt_auto}.
- `scalar` is a Bayesian optimisation like others. In comparison with it, GPyOpt was earlier / equal / later in
  {gpyopt_scalar} runs, BoTorch LogEI in {log_ei_scalar} and EGObox in {egobox_scalar}. On the arm, methods that see
  only distances often end in a local maximum.
- {met} of {asked} targets of computing time are met ([targets](tables/benchmarks-targets.csv)).

Other programs ran on the machine, so compare only orders of magnitude of times. `auto`, EGObox and
bayesian-optimization ran on a faster computer (0.62 to 0.75 of the time of `scalar` and GP-UCB).

![CPU seconds of a suggestion](benchmarks/overhead.png)

Tables: [each function with quartiles, regret and CPU time](tables/benchmarks-functions.csv), [the functions, their
d* and exceptions](tables/benchmarks-cases.csv), [run by run](tables/benchmarks-pairs.csv), [CPU time and
memory](tables/benchmarks-overhead.csv), [on the Dubins car](tables/benchmarks-overhead-dubins.csv).

## Regret of each function

The regret is `1 - best / d*`, as medians over the seeds.

{pictures}
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
        "counterexamples, which is unknown in practice. Simulated annealing raises an error as released and is left "
        "out",
    ],
    ["PSY-TaLiRo 3.2.0", "both of its optimisers; its annealing makes no local searches"],
]


def page() -> GeneratedPage:
    """Return the page and its tables."""
    asked = targets()
    text = TEXT.format(
        measured=measured_with(run.STORED.values(), AUTO),
        seeds=len(SEEDS),
        budgets=", ".join(f"{described.budget}" for described in CASES.values()),
        short=included("benchmarks-executions"),
        auto_scalar=against("auto", "scalar"),
        gpyopt_auto=against("gpyopt", "auto"),
        gpyopt_scalar=against("gpyopt", "scalar"),
        log_ei_scalar=against("botorch-log-ei", "scalar"),
        egobox_scalar=against("egobox", "scalar"),
        met=sum(row[-1] == "met" for row in asked),
        asked=len(asked),
        pictures="\n\n".join(f"![{CASES[case].title}](benchmarks/{case}.png)" for case in CASES),
    )
    counts, memory = (*COUNTS, 1000), "peak memory [MB]"
    tables: dict[str, Table] = {
        "benchmarks-settings": (["method", "settings"], SETTINGS),
        "benchmarks-functions": (HEADER, function_rows()),
        "benchmarks-executions": (
            ["method", *(f"{case.title}, {case.dimension}-D" for case in CASES.values()), "CPU s"],
            short_rows(),
        ),
        "benchmarks-cases": (["function", "tasks", "budget", "d* of the seeds", "exceptions"], functions()),
        "benchmarks-pairs": (["method", "input", "compared with scalar", "compared with auto"], pairs()),
        "benchmarks-overhead": (
            ["method", *(f"n = {n} [CPU s]" for n in counts), memory],
            overhead_rows("linear-10", METHODS, counts),
        ),
        "benchmarks-overhead-dubins": (
            ["method", "n = 20 [CPU s]", "n = 100 [CPU s]", memory],
            overhead_rows("dubins-basin", ("auto", "auto-no-data", "scalar"), (20, 100)),
        ),
        "benchmarks-targets": (["quantity", "at most", "measured", ""], asked),
    }
    return GeneratedPage("benchmarks.md", reflowed(text), tables)


def main() -> None:
    """Write the page, its tables and pictures."""
    from peers.pictures import draw  # here, as the text needs no pictures

    draw()
    page().write()


if __name__ == "__main__":
    main()
