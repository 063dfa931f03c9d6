"""``docs/benchmarks.md`` from the stored results. Nothing is run here."""

from __future__ import annotations

import statistics
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from calibration_page import table
from ctxval._util.arrays import Array
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
    header = ["method", "is given", *(f"to {percent} %" for percent in WITHIN), "mean regret [%]", "CPU s"]
    parts = [title, seeds_sentence(case, found), table(header, [row(cell) for cell in found])]
    parts += [f"![Regret against executions](benchmarks/{case}.png)"]
    return "\n\n".join(parts)


def seeds_sentence(case: str, found: list[Cell]) -> str:
    """Return which seeds there are, what is missing and what broke."""
    most = max(found, key=lambda cell: len(cell.results))
    maxima = sorted(result["maximum"] for result in most.results)
    text = f"{len(most.results)} of {len(SEEDS)} seeds; their d* are {', '.join(f'{value:.3g}' for value in maxima)}."
    fewer = [cell for cell in found if len(cell.results) < len(most.results)]
    if fewer:
        names = (f"{METHODS[cell.method].title} ({len(cell.results)})" for cell in fewer)
        text += f" Fewer seeds, the first ones: {', '.join(names)}."
    excess = max(value / r["maximum"] - 1 for cell in found for r in cell.results for _, value in r["improvements"])
    if excess > ROUNDING:
        text += f" One of the methods found {100 * excess:.2g} % more than what was taken for d*."
    if missing(case):
        text += f" Not run: {', '.join(missing(case))}."
    return text + "".join(limits_sentence(cell) for cell in found)


def limits_sentence(cell: Cell) -> str:
    """Return whether a method was cut short, and how often it broke."""
    text, title = "", METHODS[cell.method].title
    if (cell.case, cell.method) in CUT:
        text += f" {title} was allowed {cell.budget} executions only, for the time it takes."
    errors = [result["error"] for result in cell.results if result["error"]]
    if errors:
        text += f" {title} broke in {len(errors)} runs, first with `{errors[0]}`."
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
    return table(["method", "is given", "against ours: scalar", "against ours: auto"], rows)


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
        target("scalar, n = 100 in 20-D, share of BoTorch LogEI", 0.05, ours / theirs if ours and theirs else None),
        target("scalar, n = 100 in 20-D, CPU s", 0.1, ours),
        target("scalar, n = 1,000 in 20-D, CPU s", 2.0, seconds("linear-10", "scalar", 1000)),
        *(
            target(f"{METHODS[name].title}, Dubins car, n = {n}, CPU s", 2.0, seconds("dubins-basin", name, n))
            for name in ("auto", "auto-no-data")
            for n in (20, 100)
        ),
    ]
    return table(["what", "at most", "measured", ""], rows)


TEXT = """# Beside other tools

Generated by `make bench-peers` from `benchmarks/results/peers.jsonl` and `peers_overhead.jsonl`; nothing here is
written by hand. We know of no other tool that takes a system, a model and a controller designed on the model. What
these have in common with ours is that they look for the largest value of a function in few evaluations, so each of them
is given d(p), as a function of the unit cube, to maximise.

## What was done

The functions are the cases of `ctxval.cases`, the model and its data drawn anew for each seed, and all methods have the
same seeds. d* is known: in closed form for the linear systems, by a dense grid
for pendulum and arm, by differential evolution and climbs for the Dubins car; for arm and car it is the best known
value. A run ends within 1 % of d*, or when its budget is used up; first points are counted. Where a method is
deterministic, as DIRECT is, seeds differ by their functions alone.

**To 5, 2, 1 %**: executions until the largest distance found is so close to d*: the median over the seeds, in brackets
the quartiles, and how many seeds got there within the budget. **Mean regret**: the area under the regret curve over the
budget, `1 - best / d*` in per cent, a run that has ended keeping its last; the median over the seeds with quartiles.
**CPU s**: of a suggestion in these runs, everything but the execution, all threads, on one thread of BLAS and torch; on
a machine with other work, so to be compared by its order of magnitude. Some runs of `auto` are the same campaigns of
`study_auto.py`, whose time has the executions in it.

**Is given**: what a method sees of an execution. Most see the distance, a number. Ours see more where it is there:
`vector` sees the vector whose norm the distance is, and `auto` sees the whole trajectory and may run M. Where M was
learned from data it has these too, which are executions of S already paid for; once it is run without them. So `auto`
beside the others shows what it is worth to look at trajectories, and `scalar` what is left if nobody does.

{settings}

VerifAI and PSY-TaLiRo need different versions of `attrs` and cannot be installed together, so there are two dependency
groups, `peers` and `peers-verifai`.

## Who is first

In how many runs, all functions and seeds that both have together, a method was within 1 % of d* after fewer / as many /
more executions than ours. Where neither got there, it is as many; budgets that differ are cut to the smaller one.

{pairs}

![Executions until within 5 %](benchmarks/executions.png)

## Function by function

{functions}

## What a suggestion costs

CPU seconds of a suggestion on the linear system with 10 states, 20-D: the mean of {suggestions} suggestions, one after
the other, after n values. Methods that build a model are given the same n uniformly random tasks and learn from them
first; for the others it is their own history. TuRBO makes its first 40 suggestions without a model. The memory is the
largest of a process of its own that does nothing else, Python and the case included. Other programs ran on the same
cores, which lengthens all of these times.

{overhead}

![CPU seconds of a suggestion](benchmarks/overhead.png)

On the Dubins car, where the inner loop designs controllers and simulates them:

{dubins}

## What was asked for

{targets}
"""

SETTINGS = [
    ["ours", "default settings, as `ctxval run` has them; CMA-ES and random are ours too (`cmaes`, with restarts)"],
    [
        "GPyOpt 1.2.6",
        "the paper's tool: Matern 3/2, lower confidence bound of the negative distance with GPyOpt's weight 2, exact "
        "evaluations, 5 random points first; its stop at convergence is off",
    ],
    [
        "BoTorch 0.18.1",
        "5 Sobol points first, 10 restarts from 512 raw samples; LogEI on the default model, UCB with Matern 3/2 and "
        "beta = 2; where a fit fails, the hyperparameters that it began with",
    ],
    [
        "TuRBO-1",
        "written on BoTorch as its paper has it: 2 d Sobol points in each region, one Thompson sample of "
        "min(100 d, 5,000) candidates, batches of one",
    ],
    ["Optuna 5.0.0", "`GPSampler`, 10 random points first, exact evaluations"],
    ["scipy 1.17.1", "`dual_annealing` and `direct` with their defaults"],
    [
        "VerifAI 2.2.0",
        "its defaults; its Bayesian optimisation is GPyOpt's expected improvement, learned anew each time. "
        "Cross-entropy and bandit learn from counterexamples alone: they are told that tasks above d* / 2 are such, "
        "which nobody knows. Simulated annealing raises an error as released, and is left out",
    ],
    ["PSY-TaLiRo 3.2.0", "both its optimisers; its annealing makes no local searches"],
]


def text() -> str:
    """Return the page."""
    return TEXT.format(
        settings=table(["method", "how it is used"], SETTINGS),
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
