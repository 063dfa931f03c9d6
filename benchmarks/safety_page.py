"""The measured part of ``docs/how-to/safety.md`` and its picture, from what ``study_safety.py`` has stored."""

from __future__ import annotations

import textwrap
import tomllib
from pathlib import Path
from typing import Any

import numpy as np

from ctxval import Task, Trajectory
from ctxval.distances import UnsafeMargin
from safety_systems import SYSTEMS, TITLES
from study_safety import (
    ASKED,
    ASKED_SEEDS,
    BUDGET,
    LINEAR,
    STORED,
    TRUTH,
    files_of_page,
)

PAGE = Path(__file__).parents[1] / "docs" / "how-to" / "safety.md"
PICTURE = PAGE.parents[1] / "pictures" / "safety.png"
MARK = "<!-- written by benchmarks/safety_page.py -->\n"

TEXT = """
`make safety` computes this part and prints its tables. The truth is that of {truth:,} tasks and of more near the worst
ones; a campaign has at most {budget} executions.

![Places of an obstacle: safe, unsafe, and certified](../pictures/safety.png)

{outcome} {asked} The 1 % by which a bound is raised, because a search may end below a ridge, was chosen on seed 0 of
these systems. On random linear systems, all tasks with more robustness than $d_b$ are safe in {included} of {linear}.
"""


def _percent(value: float | None) -> str:
    return "-" if value is None else f"{100 * value:.1f}"


def _table(rows: list[list[str]]) -> str:
    head, *others = rows
    return "\n".join(f"| {' | '.join(line)} |" for line in [head, ["---"] * len(head), *others])


def found(name: str, asked: float | None) -> list[dict[str, Any]]:
    """Return the campaigns of a system that asked for a share of the true d_b, or for none."""
    return [one for one in STORED.select(part="campaign", case=name) if one["asked"] == asked]


def campaigns() -> tuple[str, str]:
    """Return the table of the campaigns that find the margin, and what became of them."""
    head = ["system", "d_a", "d_b", "certified bounds on d_b (executions)", "safe", "by d_a", "by d_b", "by the bound"]
    rows, certified, wrong, unsafe = [head], 0, 0, 0.0
    total = 0
    for name in SYSTEMS:
        true = STORED.get(("truth", name, 0, None))
        if true is None:
            continue
        of = found(name, None)
        # What campaigns have executed is a fact, and the search for the truth may end below it.
        largest = max([true["d_b"], *(one["d_b"] for one in STORED.select(part="campaign", case=name))])
        bounds = [f"{one['d_b_bound']:.4g} ({one['executions']})" if one["d_b_bound"] is not None else
                  f"none ({one['executions']})" for one in of]  # fmt: skip
        shares = [one["share_certified"] for one in of if one["share_certified"] is not None]
        rows.append(
            [
                f"{name}: {TITLES[name]}",
                f"{true['d_a']:.4g}",
                f"{largest:.4g}",
                ", ".join(bounds),
                *(_percent(true[key]) for key in ("safe", "by_d_a", "by_d_b")),
                _percent(float(np.median(shares)) if shares else None),
            ]
        )
        total += len(of)
        certified += len(shares)
        wrong += sum(one["d_b_bound"] is not None and one["d_b_bound"] < largest for one in of)
        unsafe = max([unsafe, *(one["wrong"] for one in of if one["wrong"] is not None)])
    text = (
        f"{certified} of {total} campaigns certified a bound; {wrong} of these bounds were below the true $d_b$, and "
        f"at most {100 * unsafe:.3g} % of the tasks that one of them called safe are not. "
    )
    drawn = [one["drawn"] for one in STORED.select(part="campaign") if one["drawn"] is not None]
    count, bad = sum(one["draws"] for one in drawn), sum(one["unsafe"] for one in drawn)
    return (
        _table(rows),
        text
        + f"Of {count} independent draws among the tasks above the bounds, or above the executed $d_b$ if there is no "
        f"bound, {bad} were unsafe.",
    )


def asked() -> str:
    """Return what became of margins that were asked for."""
    parts = []
    for share in ASKED:
        of = [one for name in SYSTEMS for one in found(name, share)]
        counts = {answer: sum(one["answer"] == answer for one in of) for answer in ("validated", "falsified")}
        truly = "too small" if share < 1 else "sufficient"
        executions = float(np.median([one["executions"] for one in of])) if of else 0.0
        parts.append(
            f"{share:g} of the true $d_b$, which is {truly}, was validated in {counts['validated']} and falsified in "
            f"{counts['falsified']} of {len(of)} campaigns (median {executions:g} executions)"
        )
    seeds = "one seed" if ASKED_SEEDS == 1 else f"{ASKED_SEEDS} seeds"
    return f"Asked for a margin ({seeds} for each system): {'; '.join(parts)}."


def section() -> str:
    """Return the measured part of the page."""
    linear = STORED.select(part="linear")
    text = TEXT.format(
        truth=TRUTH,
        budget=BUDGET,
        outcome=campaigns()[1],
        asked=asked(),
        linear=LINEAR,
        included=sum(one["included"] for one in linear),
    )
    return "\n\n".join(
        textwrap.fill(part, 120, break_long_words=False, break_on_hyphens=False) for part in text.split("\n\n")
    ).strip()


def draw() -> None:
    """Draw where an obstacle may be, from the stored campaign of the page's own robot."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    stored = STORED["picture", "robot", 0, None]
    table = tomllib.loads(files_of_page()["robot.toml"])["spec"]
    spec, size, low, high = UnsafeMargin({**table, "components": None}).spec, (390, 600), *stored["ends"][:2]
    grid = np.stack(
        np.meshgrid(np.linspace(low, high, size[0]), np.linspace(*stored["ends"][2:], size[1]), indexing="ij"), axis=-1
    ).reshape(-1, 2)
    steps = len(stored["model"]) - 1
    tasks = Task([0.0, 0.0], horizon=steps, dt=0.1, environment={"obstacle": grid})
    rho, of_system = (
        spec.robustness(Trajectory(tasks.times, np.array(stored[name])[None], np.zeros((1, steps, 1))), tasks)
        for name in ("model", "system")
    )
    figure, axes = plt.subplots(figsize=(5.2, 6.6), layout="constrained")
    kinds = np.select([rho > stored["bound"], (rho > 0) & (of_system > 0), rho > 0], [0, 1, 2], 3).reshape(size)
    colours = matplotlib.colors.ListedColormap(["#d5ead8", "#f3e3ae", "#d9534f", "#e6e6e6"])
    ends = tuple(stored["ends"])
    axes.imshow(kinds.T, origin="lower", extent=ends, cmap=colours, vmin=0, vmax=3, aspect="equal")
    for name, style in (("model", "--"), ("system", "-")):
        axes.plot(*np.array(stored[name]).T, style, color="#1f3b63", lw=1.6, label=f"path on the {name}")
    axes.plot(*np.array(stored["executed"]).T, "k.", ms=7, label="executed")
    for colour, label in zip(
        colours.colors,
        ("certified safe", "safe, not certified", "unsafe although the model satisfies", "the model violates"),
        strict=True,
    ):
        axes.plot([], [], "s", color=colour, ms=10, markeredgecolor="#888888", label=label)
    axes.set(xlim=ends[:2], ylim=ends[2:], xlabel="ox [m]", ylabel="oy [m]", title="Where the obstacle may be")
    figure.legend(loc="outside lower center", ncols=2, frameon=False, fontsize=8)
    figure.savefig(PICTURE, dpi=130, metadata={"Software": None})


def main() -> None:
    """Write the picture and the measured part of the page."""
    draw()
    before = PAGE.read_text().partition(MARK)[0]
    PAGE.write_text(f"{before}{MARK}\n{section()}\n")
    print(campaigns()[0], f"{PAGE} has been written", sep="\n\n")


if __name__ == "__main__":
    main()
