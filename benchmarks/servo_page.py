"""``docs/servo.md``: what campaigns on the recordings of a real servo find.

``python benchmarks/study_servo.py`` computes what this page shows; only the pictures are drawn here.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import matplotlib as mpl

mpl.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from page_tables import DOCS, GeneratedPage, Table, reflowed, table
from study_servo import (
    DISTANCES,
    FITTED,
    MODELS,
    PAIRS,
    REFINED_STORED,
    SHARES,
    SHOWN,
    STORED,
    require_recordings,
    servo,
    validation,
)

NAMES = [f"{path}-{gain}" for gain in servo.GAINS for path in servo.PATHS]

TEXT = """# On a real servo

`make servo` computes this page. A Dynamixel XL330 servo turns a pendulum of 0.49 kg. The Rhoban team recorded it in
16 closed loops, four references at four gains of the servo's firmware, and published the recordings with friction
models ([source and licence](https://github.com/Rhoban/bam), Apache-2.0; Duclusaud, Passault and others, *Extended
Friction Models for the Physics Simulation of Servo Actuators*, arXiv 2410.08650). The recordings are no part of
ctxval: FOLDER is a folder with the 16 files of 0.49 kg at 0.1 m in `bam/data.bak/processed` of that repository at
commit af22604. They have the limits of real recordings: an encoder with 4096 counts per turn records the angle
alone, the torque is switched off in some runs, and there are 16 runs and no more.

```console
$ cd examples/servo
$ ctxval run servo:experiment --option folder=FOLDER --threshold 0.38
$ ctxval run servo:experiment --option folder=FOLDER --threshold 0.6 --option friction=m4
```

The tasks are a [suite](how-to/suites.md), and `systems.Recorded` gives the recording of a task when it is chosen.
The controller is the firmware: a duty in proportion to the error of the encoder's angle, with its limit; it runs on
the model in the same way. The validation has `outputs=[0]`. The distance is the largest deviation of the angle over
6 s.

## The models

m1 has viscous and Coulomb friction. In m3, friction also depends on the torque that the gears carry; in m4 this part
has a Stribeck term. Parameters are as published, or fitted to the angles of two recordings, in three pairs that were
chosen before the first fit.

{models}

**The published m4 is better than m1 at gains up to 200, and not at the largest distances**: its d* is {m4:.2f} rad
and that of m1 is {m1:.2f} rad. Fitted to two recordings, m4 has a d* of {fitted}, and m1 of {fitted_m1}: with a
friction that does not depend on the load, no fit helps in all runs. [All runs](tables/servo-runs.csv).

![The angle of the servo and of the models m1 and m4 in four runs, with the reference](pictures/servo.png)

*The servo sticks where the reference turns round, against the weight of the pendulum, and the models follow the
reference (sin_sin, up_and_down). The models damp swings without torque too little (lift_and_drop), and the servo is
later than the models at the end of the fast sweep (sin_time_square).*

## Campaigns, one run at a time

A campaign sees a recording when it executes its task. {campaigns} campaigns ran until they were decided, at
thresholds of 1.1 and 0.9 times the largest distance of all 16 runs.

{searches}

Numbers are medians with the smallest and the largest. A random order meets the worst of 16 runs after 8.5.

**Each verdict is true.** {validated} The cause is dry friction: where the servo sticks, its rate jumps to 0, which
is no smooth function of angle, rate and duty. So the learned dynamics predict other runs roughly: of {predictions}
predictions that were stored before their run, {near} came within 20 % of the threshold, and the median error is
{error:.0f} % of it.

## Refined with eight runs

`ctxval.refine` learns a correction of the model from eight runs, in which each reference has two gains; the other
eight judge it, and then the halves change places. The threshold is 0.9 times the largest distance of the eight runs
that it learns from.

{refined}

## Limits of this study

- No task was recorded twice, so it is not known how much of a distance is chance. The verdicts are about recorded
  runs.
- The recordings were interpolated to steps of 5 ms when they were published; here a step takes 10 ms, and the duty
  is held for that time. The firmware is faster.
"""


def page() -> GeneratedPage:
    """Return the page and its table."""
    largest = {model: max(pair[0] for pair in DISTANCES[model,]["distances"].values()) for model in (*MODELS, *FITTED)}
    errors = [error for line in STORED.values() for error in _errors(line)]
    _require_claims(largest)
    text = TEXT.format(
        models=_models(largest),
        m1=largest["m1"],
        m4=largest["m4"],
        fitted=_listed([largest[f"m4 {pair}"] for pair in PAIRS]),
        fitted_m1=_listed([largest[f"m1 {pair}"] for pair in PAIRS]),
        campaigns=len(STORED),
        searches=_searches(),
        validated=_validated(),
        predictions=len(errors),
        near=sum(error <= 0.2 for error in errors),
        error=100 * float(np.median(errors)),
        refined=_refined(),
    )
    return GeneratedPage("servo.md", reflowed(text), {"servo-runs": _runs()})


def _require_claims(largest: dict[str, float]) -> None:
    """Refuse results with which sentences of the page would lie."""
    known = {model: DISTANCES[model,]["distances"] for model in MODELS}
    low = [name for name in NAMES if int(name.rpartition("-")[2]) <= 200]
    assert all(known["m4"][name][0] < known["m1"][name][0] for name in low)
    assert largest["m4"] > largest["m1"]
    assert all(largest[f"m4 {pair}"] < largest["m4"] for pair in PAIRS)
    assert max(largest[f"m1 {pair}"] for pair in PAIRS) > largest["m1"]


def _listed(values: Sequence[float]) -> str:
    *first, last = (f"{value:.2f}" for value in values)
    return f"{', '.join(first)} and {last} rad"


def _models(largest: dict[str, float]) -> str:
    head = ["d* [rad]", "as published", *(f"fitted to {pair.replace(',', ' and ')}" for pair in PAIRS)]
    rows = [
        [model, f"{largest[model]:.3f}", *(f"{largest.get(f'{model} {pair}', np.nan):.3f}" for pair in PAIRS)]
        for model in MODELS
    ]
    return table(head, rows).replace("nan", "")


def _runs() -> Table:
    """Return the largest and the RMS deviations of all runs."""
    known = {model: DISTANCES[model,]["distances"] for model in SHOWN}
    head = ["run", *(f"{_short(model)}: {kind} [rad]" for model in SHOWN for kind in ("largest", "RMS"))]
    return head, [[name, *(f"{value:.3f}" for model in SHOWN for value in known[model][name])] for name in NAMES]


def _short(model: str) -> str:
    friction, _, pair = model.partition(" ")
    return f"{friction}, fitted" if pair else friction


def _searches() -> str:
    head = ["model", "threshold", "campaigns", "verdicts", "executions", "the worst run was executed after"]
    rows = []
    for model in MODELS:
        largest = max(pair[0] for pair in DISTANCES[model,]["distances"].values())
        for share in SHARES:
            lines = STORED.select(model=model, share=share)
            if not lines:
                continue
            answers = [line["answer"] for line in lines]
            counts = ", ".join(f"{answers.count(answer)} {answer}" for answer in dict.fromkeys(answers))
            executed = [len(line["tasks"]) for line in lines]
            worst = "-"  # a campaign that is falsified need not have met it
            if share > 1:
                found = [1 + line["distances"].index(max(line["distances"])) for line in lines]
                met = sum(max(line["distances"]) >= largest - 1e-9 for line in lines)
                worst = f"{_spread(found)} runs" if met == len(lines) else f"in {met} of {len(lines)}"
            rows.append([model, f"{share} d*", str(len(lines)), counts, _spread(executed), worst])
    return table(head, rows)


def _validated() -> str:
    """Return when models were validated; refuse results with which the page would lie."""
    if any(line["answer"] != {1.1: "validated", 0.9: "falsified"}[line["share"]] for line in STORED.values()):
        raise SystemExit("a stored verdict is not the true one: the page must say so")
    whole = [line["kind"] == "suite" for line in STORED.values() if line["share"] == 1.1]
    if all(whole):
        return "At 1.1 d*, each campaign executed all 16 runs: no bound on those that were left was validated before."
    return f"At 1.1 d*, {sum(whole)} of {len(whole)} campaigns executed all 16 runs."


def _spread(values: Sequence[float]) -> str:
    if not values:
        return "-"
    return f"{np.median(values):g} ({min(values):g} to {max(values):g})"


def _errors(line: dict[str, Any]) -> list[float]:
    """Return the errors of stored predictions, as shares of the threshold."""
    threshold = line["share"] * max(pair[0] for pair in DISTANCES[line["model"],]["distances"].values())
    pairs = zip(line["predicted"], line["distances"], strict=True)
    return [abs(predicted - distance) / threshold for predicted, distance in pairs if predicted is not None]


def _refined() -> str:
    head = ["model", "half", "largest of the others [rad]", "mean of the others [rad]", "nearer runs", "result"]
    rows, refused = [], 0
    for line in REFINED_STORED.values():
        before, after = (np.array(list((line[key] or {}).values())) for key in ("before", "after"))
        row = [line["model"], str(line["half"] + 1)]
        if after.size:
            assert after.max() < before.max()
            values = [f"{of(before):.3f} to {of(after):.3f}" for of in (np.max, np.mean)]
            rows.append([*row, *values, f"{(after < before).sum()} of {len(after)}", "a model"])
        else:
            assert "on a task that it has learned from" in line["ended"]
            rows.append([*row, f"{before.max():.3f}", f"{before.mean():.3f}", "-", "none"])
            refused += 1
    text = (
        f"In {len(rows) - refused} of {len(rows)} cases the refined model is nearer to runs that it has not seen. In "
        f"{refused} there is no model, because a run that it was learned from stays above the threshold. Each "
        "estimated rate has the errors of the encoder, so one step says little of friction."
    )
    return f"{table(head, rows)}\n\n{text}"


def draw() -> None:
    """Draw the angles in four runs."""
    figure, grid = plt.subplots(2, 2, figsize=(10, 5.6), sharex=True, layout="constrained")
    tasks = ("sin_sin-400", "up_and_down-800", "lift_and_drop-800", "sin_time_square-800")
    for name, axes in zip(tasks, grid.flat, strict=True):
        for model, style in (("m1", ":"), ("m4", "--")):
            chosen = validation(model)
            outcome = chosen.outcome(chosen.space.point({"task": name}))
            times = outcome.system_trajectory.times
            colour = {"m1": "#cc6600", "m4": "#0066aa"}[model]
            axes.plot(times, outcome.plan.model_trajectory.states[:, 0], style, color=colour, lw=1.8, label=model)
        axes.plot(times, outcome.system_trajectory.states[:, 0], color="black", lw=1.6, label="servo")
        axes.plot(times, outcome.plan.task.reference[:, 0], color="0.65", lw=1.0, label="reference")
        axes.set_title(name, fontsize=10)
        axes.set_ylabel("angle [rad]")
    for axes in grid[-1]:
        axes.set_xlabel("time [s]")
    grid[0, 0].legend(fontsize=8, ncols=4, loc="lower left")
    figure.savefig(DOCS / "pictures" / "servo.png", dpi=110)
    plt.close(figure)


if __name__ == "__main__":
    require_recordings()
    draw()
    page().write()
