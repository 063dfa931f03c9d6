from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from conftest import make_validation
from ctxval import Experiment, Parameters, Task, TaskSpace, cases, controllers, models
from ctxval.cli.config.check import check_experiment
from rig_thorough import more

A, B = np.array([[1.0, 0.02], [0.2, 0.99]]), np.array([[0.0], [0.02]])


def of_sklearn() -> Any:
    linear_model = pytest.importorskip("sklearn.linear_model")
    z = np.random.default_rng(0).normal(size=(30, 3))
    return models.ScikitLearn(linear_model.LinearRegression().fit(z, z[:, :2] @ (A - np.eye(2)).T))


def of_torch() -> Any:
    torch = pytest.importorskip("torch", reason="torch is not installed: pip install 'ctxval[torch]'")
    torch.manual_seed(0)
    return models.Torch(torch.nn.Sequential(torch.nn.Linear(3, 4), torch.nn.Tanh(), torch.nn.Linear(4, 2)))


def of_mujoco() -> Any:
    pytest.importorskip("mujoco")
    return models.MuJoCo(
        """<mujoco><option timestep="0.02" iterations="1"/><worldbody><body>
        <joint name="a" axis="0 1 0" frictionloss="0.1"/>
        <geom size="0.1" fromto="0 0 0 0 0 -0.5" type="capsule"/></body></worldbody>
        <actuator><general joint="a" dyntype="filter" dynprm="0.1"/></actuator></mujoco>"""
    )


class Drifting:
    """A model that remembers runs."""

    count = 0

    def step(self, x: Any, u: Any) -> Any:
        self.count += 1
        return x @ A.T + u @ B.T + 1e-6 * self.count


NOISE = np.random.default_rng(0)
MODELS: dict[str, Any] = {
    "function": lambda: lambda x, u: A @ x + B @ u,
    "linear": lambda: models.Linear(A, B),
    "scikit-learn": of_sklearn,
    "torch": of_torch,
    "mujoco": of_mujoco,
}


@pytest.mark.usefixtures("without_costs")
@pytest.mark.parametrize("name", [name if name != "scikit-learn" else more(name)[0] for name in MODELS])
def test_every_kind_of_model_has_the_distance_0_to_itself(name: str) -> None:
    finding = against_itself(MODELS[name]())
    assert (finding.state, finding.text.split(" is ")[1].split()[0]) == ("ok", "0")


@pytest.mark.usefixtures("without_costs")
@pytest.mark.parametrize("model", [Drifting(), lambda x, u: A @ x + B @ u + 1e-4 * NOISE.normal(size=2)])
def test_a_random_model_and_one_that_remembers_runs_are_named_with_the_number(model: Any) -> None:
    finding = against_itself(model)
    assert finding.state == "noted"
    assert 1e-6 < float(finding.text.split(" is ")[1].split()[0]) < 1e-1


def against_itself(model: Any) -> Any:
    policy = controllers.Policy(lambda t, x, task: -x[..., :1])
    validation = make_validation(horizon=20).with_parts(model=model, synthesizer=policy)
    (finding,) = [
        each for each in check_experiment(Experiment("x", validation)) if each.check == "model against itself"
    ]
    return finding


CASES: list[tuple[str, dict[str, Any]]] = [
    ("pendulum", {}),
    *more(("dubins", {}), ("arm", {"model": "linear"})),
    *more(("pendulum", {"variant": "biased"}), ("dubins", {"variant": "basin"}), ("dubins", {"variant": "heavy-tail"})),
    *more(("arm", {"model": "gp"}), ("arm", {"model": "fnn"})),
    ("linear", {"dim": 1}),
    *more(("linear", {"dim": 10})),
]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "options"),
    CASES,
    ids=str,
)
def test_no_case_of_the_paper_fails_a_check(name: str, options: dict[str, Any]) -> None:
    found = check_experiment(cases.by_name(name, **options), execute=True)
    assert [finding for finding in found if finding.state == "failed"] == []


def test_every_case_is_checked() -> None:
    names = {getattr(case, "values", case)[0] for case in CASES}
    assert names == set(cases.NAMES) - {"pendulum-noisy"}  # its executions differ, as they should


@pytest.mark.usefixtures("without_costs")
@pytest.mark.parametrize(("error", "state"), [(1e-15, "ok"), (1e-9, "failed")])
def test_a_task_of_a_batch_may_differ_by_rounding_alone(error: float, state: str) -> None:
    validation = make_validation()

    def task(p: Parameters) -> Task:
        goal = np.asarray(p.goal) * (1 + error * np.ndim(p.goal))
        return Task([np.pi, 0.0], goal=np.stack([goal, 0 * goal], axis=-1), horizon=5, dt=0.02)

    validation.task = task
    found = check_experiment(Experiment("x", validation))
    assert [finding.state for finding in found if finding.check == "batches"] == [state]


@pytest.mark.usefixtures("without_costs")
@pytest.mark.parametrize(("unit", "expected"), [((), True), (("m",), False)])
def test_it_says_what_a_unit_of_length_is_good_for(unit: tuple[str, ...], expected: bool) -> None:
    validation = make_validation(horizon=5)
    validation.space = TaskSpace(goal=(-3.0, 3.0, *unit), side=(0.0, 1.0, *unit))
    (finding,) = [each for each in check_experiment(Experiment("x", validation)) if each.check == "space"]
    assert (finding.state == "noted") == ("places of positions are tested" in finding.text) == expected
