"""How much better a refined model is in truth, and how many executions it takes.

``python benchmarks/study_refine.py`` stores a line for each case, seed, data and method in
``benchmarks/results/refine.jsonl``, so a stopped study goes on, and then writes the tables of ``docs/refinement.md``.
The threshold is a tenth of the true d* of the first model. Distances before and after are those of a dense search on
the true system, which nothing else in the study may use.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from ctxval import Campaign, Trajectory, Validation, cases, grid_truth, models, refine, search_truth, searches, systems
from ctxval._util.arrays import Array
from ctxval.certificates import CertificateOptions, DistanceBound
from ctxval.paper.cases import pendulum
from ctxval.studies.refinement import Method, ParameterFit, Records
from json_lines import JsonLines
from page_tables import GeneratedPage, reflowed, table
from reproduce.jobs import AUTO, measured_with, provenance

ROOT = Path(__file__).parents[1]
STORED = JsonLines(ROOT / "benchmarks" / "results" / "refine.jsonl", ("case", "seed", "data", "method"))
BUDGETS = {"pendulum": 3, "dubins": 15}
SEEDS = {"pendulum": 10, "dubins": 3}
STUDIES = (
    ("pendulum", "own", "residual"),
    ("dubins", "own", "residual"),
    ("pendulum", "none", "residual"),
    ("dubins", "none", "residual"),
    ("dubins", "own", "gaussian-process"),
    ("dubins", "own", "linear"),
    ("pendulum", "own", "linear"),
)
"""Case, whether the first model carries the data that it was learned from, and method."""
SEARCH: dict[str, Any] = {"repeats": 2, "population": 8, "generations": 60, "climbs": 12}
"""The search for the true d* of the Dubins car after a refinement; before, it is that of the case."""
SHARE = 0.1
"""The threshold, as a share of the true d* of the first model."""
REPEATED = 200
"""Number of draws of the noise from which the mass is estimated."""


def truth_of(case: str, validation: Validation) -> float:
    """Return the true d* of a model by a dense search; infinity if its closed loop diverges somewhere."""
    try:
        if case == "pendulum":
            return grid_truth(validation, per_axis=401, refinements=2).distance
        return search_truth(validation, **SEARCH).distance
    except Exception:  # a refitted model whose controllers are useless
        return float("inf")


def run(case: str, seed: int, data: str, method: str | Method) -> dict[str, Any]:
    """Return one refinement, judged by the truth."""
    experiment = cases.by_name(case, seed=seed)
    validation = experiment.validation
    given: Any = validation.model
    if data == "none":
        validation = validation.with_parts(model=models.Linear(given.A, given.B, given.c))
    assert experiment.truth is not None
    before = experiment.truth().distance
    campaign = Campaign(validation, search=searches.by_name("auto", thinking="fast"), seed=seed)
    began = time.process_time()
    try:
        # The posterior bound chooses tasks at a tenth of the effort, and d* after is judged by the truth anyway.
        judged = CertificateOptions(DistanceBound())
        found = refine(campaign, SHARE * before, BUDGETS[case], method=method, certificate=judged)
    except Exception as error:  # a method that cannot learn from these executions is a result
        return {"before": before, "after": None, "ratio": None, "executions": campaign.executions, "why": str(error)}
    seconds = time.process_time() - began
    after = truth_of(case, found.last.campaign.validation)
    return {
        "before": before,
        "after": after,
        "ratio": before / after,
        "executions": found.executions,
        "rounds": [[one.executions, one.worst, one.verdict.answer] for one in found.rounds],
        "verdict": found.answer,
        "tracking": [tracking(validation), tracking(found.last.campaign.validation)],
        "cpu_seconds": round(seconds, 1),
    }


def tracking(validation: Validation) -> float:
    """Return how far S is from the reference: the median over random tasks of the mean gap in the first two states."""
    space = validation.space
    points = space.iid(200, np.random.default_rng(7))
    task = validation.task(space.parameters(points))
    executed = validation.system.execute(validation.synthesizer.design(task, validation.model), task)
    gaps = np.linalg.norm((executed.states - task.reference)[..., :2], axis=-1).mean(axis=-1)
    return float(np.median(gaps))


def swing(x: Array, u: Array, theta: Array) -> Array:
    """Return the step of a pendulum whose mass is a parameter."""
    return systems.rk4(pendulum.Pendulum(mass=float(theta[0])).derivative, 0.02)(x, u)


def mass_is_found(seed: int) -> bool:
    """Return whether the interval of the mass holds the truth, from three noisy executions of a model 20 % off."""
    rng = np.random.default_rng(seed)
    records = []
    for _ in range(3):
        states, inputs = [np.array([np.pi, 0.0])], rng.uniform(-5, 5, (50, 1))
        for u in inputs:
            states.append(swing(states[-1], u, np.array([1.0])) + [0.0, 1e-2] * rng.normal(size=2))
        records.append(Trajectory(0.02 * np.arange(51), np.array(states), inputs))
    off = models.Parametric(swing, {"mass": 1.2}, vectorized=True)
    learned = ParameterFit({"mass": (0.5, 2.0)}).learn(off, Records.of(off, records))
    found = learned.parameters[0]
    return bool(found.low < 1.0 < found.high)


def study(chosen: Callable[[str], bool]) -> None:
    """Run what is not stored."""
    for case, data, method in STUDIES:
        for seed in range(SEEDS[case]) if chosen(case) else ():
            if (case, seed, data, method) not in STORED:
                STORED.append(
                    {
                        **{"case": case, "seed": seed, "data": data, "method": method},
                        **run(case, seed, data, method),
                        **provenance(AUTO),
                    }
                )
                one = STORED[case, seed, data, method]
                print(case, seed, data, method, one["executions"], one["ratio"], one.get("verdict"), flush=True)
    if ("mass", 0, "none", "parameters") not in STORED and chosen("mass"):
        held = sum(mass_is_found(seed) for seed in range(REPEATED))
        mass = {"case": "mass", "seed": 0, "data": "none", "method": "parameters", "held": held, "of": REPEATED}
        STORED.append({**mass, **provenance(AUTO)})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("cases", nargs="*", default=["pendulum", "dubins", "mass"])
    options = parser.parse_args()
    study(lambda case: case in options.cases)
    page().write()


def page() -> GeneratedPage:
    """Return the page of the results."""
    text = TEXT.format(
        table=table(HEADER, rows()),
        pendulum=BUDGETS["pendulum"],
        dubins=BUDGETS["dubins"],
        measured=measured_with(STORED.values(), AUTO),
        **STORED["mass", 0, "none", "parameters"],
    )
    return GeneratedPage("refinement.md", reflowed(text))


HEADER = ["case", "data of M", "method", "seeds", "d* before", "d* after", "ratio: median (least)", "a tenth reached"]
HEADER += ["executions", "rounds", "last verdict", "tracking of S before, after"]


def rows() -> list[list[str]]:
    """Return the rows of the table, one for each study."""
    found = []
    for case, data, method in STUDIES:
        cells = STORED.select(case=case, data=data, method=method)
        if not cells:
            continue
        known = [one for one in cells if one["ratio"] is not None]
        ratios = [one["ratio"] for one in known] or [0.0]
        reached = sum(one["ratio"] >= 1 / SHARE for one in known)
        before = statistics.median(one["before"] for one in cells)
        after = statistics.median(one["after"] for one in known) if known else float("nan")
        executed, rounds = ([count(one) for one in cells] for count in (_executions, _rounds))
        gaps = [statistics.median(one["tracking"][k] for one in known) if known else float("nan") for k in (0, 1)]
        found.append(
            [
                *(case, data, method, str(len(cells)), f"{before:.3g}", f"{after:.2g}"),
                *(f"{statistics.median(ratios):.3g} ({min(ratios):.3g})", f"{reached} of {len(cells)}"),
                *(_range(executed), _range(rounds), _verdicts(known), f"{gaps[0]:.3g}, {gaps[1]:.3g}"),
            ]
        )
    return found


def _executions(one: dict[str, Any]) -> int:
    return int(one["executions"])


def _rounds(one: dict[str, Any]) -> int:
    return len(one.get("rounds", [])) - 1 if one.get("rounds") else 0


def _verdicts(cells: list[dict[str, Any]]) -> str:
    counts = Counter(one["verdict"] for one in cells)
    return ", ".join(f"{answer}: {count}" for answer, count in counts.most_common())


def _range(values: list[int]) -> str:
    return str(min(values)) if min(values) == max(values) else f"{min(values)} to {max(values)}"


TEXT = """# Refinement, measured

Generated by `make study-refine` from `benchmarks/results/refine.jsonl`. {measured}

[`ctxval refine`](how-to/retrain.md) learns a better model from the executions that falsified one. The threshold is a
tenth of the true d* of the first model. The budget counts all executions, with those of the first model: {pendulum}
for the pendulum and {dubins} for the Dubins car. Distances come from a dense search on the true system. "Data of M:
none" means that the first model does not carry the steps that it was learned from, so the executions alone teach.
"Tracking" is the median distance of the system from the reference: a model that is close to the system would be
worth little if tasks were completed worse.

{table}

The study asks whether the model becomes better, and not how many executions validate it: budgets are small, and the
verdict comes from the posterior bound. The linear method makes the Dubins car worse.

- **Controllers.** For the Dubins car, LQR linearises at zero input, where the heading of the true car does not act
  on its position. A controller that is designed with the Jacobian of a nonlinear model hardly steers there, and its
  distance is small for a bad reason. So the residual correction keeps the Jacobian of the linear model, unless the
  other one makes the cost of the tasks clearly smaller.
- **Errors.** The correction is kept for states whose error on held-out executions falls, and the reported errors
  include these executions. So they are slightly too small, except on the executions of the last round.
- **Known truth.** A pendulum model has a mass 20 % too large. The mass is estimated from three noisy executions; its
  interval of confidence 0.95 held the true mass in {held} of {of} repetitions.
"""


if __name__ == "__main__":
    main()
