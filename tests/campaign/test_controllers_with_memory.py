"""Campaigns whose controllers have memory: a PID controller on a cart with friction that the model lacks."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_by_hand import MODULE
from typer.testing import CliRunner

from ctxval import Campaign, Task, TaskSpace, Trajectory, Validation, controllers, distances, models, systems
from ctxval._util.arrays import Array
from ctxval.certificates import Automatic, CertificateOptions
from ctxval.cli import app
from ctxval.errors import ExecutionError
from facts import refuses

DT = 0.05
UNTESTED = CertificateOptions(Automatic(tests=0))


def rub(x: Array, u: Array) -> Array:
    """A cart with Coulomb and quadratic friction."""
    speed = x[..., 1]
    force = u[..., 0] - 0.3 * np.tanh(speed / 0.05) - 0.2 * speed * np.abs(speed)
    return np.stack([x[..., 0] + DT * speed, speed + DT * force], axis=-1)


def validation(**parts: Any) -> Validation:
    chosen: dict[str, Any] = {"system": systems.Simulated(rub, vectorized=True), **parts}
    return Validation(
        space=TaskSpace(goal=(0.5, 2.0, "m")),
        task=lambda p: Task([0.0, 0.0], goal=[p.goal, 0.0], horizon=60, dt=DT),
        model=models.Linear([[1.0, DT], [0.0, 1.0]], [[0.0], [DT]]),
        synthesizer=controllers.PID(6.0, 1.5, 4.0, derivative_filter=0.05, limits=5.0),
        distance=distances.MaximumDeviation(components=[0]),
        **chosen,
    )


def alone(controller: Any, task: Task) -> Trajectory:
    """Execute one task; a function of a module, so that workers can have it."""
    return systems.Simulated(rub, vectorized=True).execute(controller, task)


def truth() -> float:
    return float(validation().distances(np.linspace(0.5, 2.0, 31)[:, None]).max())


@pytest.mark.thorough
def test_a_campaign_ends_with_a_verdict_and_the_prediction_runs_many_memories_at_once() -> None:
    largest = truth()
    campaign = Campaign(validation(), seed=3)
    verdict = campaign.run(25, threshold=1.5 * largest, certificate=UNTESTED).verdict(
        1.5 * largest, certificate=UNTESTED
    )
    assert verdict.answer == "validated", verdict.reason
    refused = Campaign(validation(), seed=3)
    assert refused.run(25, threshold=0.7 * largest).verdict(0.7 * largest).answer == "falsified"


@pytest.mark.slow
@pytest.mark.thorough
def test_workers_and_a_resumed_campaign_have_the_same_distances(tmp_path: Path) -> None:
    largest = truth()
    made = validation(system=systems.Function(alone))
    first = Campaign(made, seed=3, store=tmp_path / "cart.sqlite").run(4, workers=2)
    assert first.executions == 4
    resumed = Campaign(made, seed=3, store=tmp_path / "cart.sqlite")
    assert resumed.executions == 4
    verdict = resumed.run(25, 1.5 * largest, workers=2, certificate=UNTESTED).verdict(
        1.5 * largest, certificate=UNTESTED
    )
    assert verdict.answer == "validated", verdict.reason
    points = np.array([trial.parameters["goal"] for trial in resumed.completed])[:, None]
    distances_ = [trial.distance for trial in resumed.completed]
    np.testing.assert_allclose(distances_, validation().distances(points), rtol=1e-9)


def test_a_person_runs_the_loop_step_by_step() -> None:
    rig = systems.Manual(states={"position": "m", "speed": "m/s"}, inputs={"force": "N"}, dt=DT)
    campaign = Campaign(validation(system=rig), seed=3)
    opened = campaign.ask()
    plan = campaign.reopen(opened.number).plan
    pi, x, states, inputs = controllers.started(plan.controller, plan.task), plan.task.initial_state, [], []
    for t in range(plan.task.horizon):
        states.append(x)
        inputs.append(pi(t, x))
        x = rub(x, inputs[-1])
    trial = campaign.tell(opened, Trajectory(plan.task.times, np.stack([*states, x]), np.stack(inputs)))
    assert trial.distance == pytest.approx(validation().distances([[trial.parameters["goal"]]])[0])
    with refuses(ExecutionError, "campaign.ask", "campaign.tell"):
        rig.execute(plan.controller, plan.task)


PID_RIG = MODULE.replace("LQR([10, 1], [0.1], limits=3.0)", "PID(3.0, 1.0, 2.0, limits=3.0)").replace(
    "weights=(1, 1)", "components=[0]"
)


def test_the_files_of_a_trial_lack_the_controller_and_ask_tells_how_to_run_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "pid_rig.py").write_text(PID_RIG)
    monkeypatch.delitem(sys.modules, "pid_rig", raising=False)
    spoken = CliRunner().invoke(app, ["ask", "pid_rig:experiment", "--store", "rig.sqlite"])
    assert spoken.exit_code == 0, spoken.stderr
    assert "controllers.started(plan.controller, plan.task)" in spoken.stdout
    again = CliRunner().invoke(app, ["ask", "rig.sqlite", "--trial", "0", "--json", "--out", "files"])
    assert json.loads(again.stdout)["files"] == ["task.json", "model.csv"]
    sys.modules.pop("pid_rig", None)
