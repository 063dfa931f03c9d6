from __future__ import annotations

import contextlib
import shutil
import sqlite3
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from conftest import make_validation
from ctxval import Campaign, Store, TaskSpace, Validation, distances, searches
from ctxval._util.arrays import Array
from ctxval._util.describe import describe
from ctxval.certificates import CertificateOptions, DistanceBound
from ctxval.cli import app
from ctxval.cli.config.settings import read_settings
from ctxval.errors import DistanceError, InputError, StoreError, StoreMismatchError
from ctxval.gp.kernels import Matern
from facts import assert_names, refuses
from faulty_rig import FaultyRig
from rig_thorough import more

SEARCH = searches.GPUCB


@pytest.mark.parametrize("validation", ["[]", "{}", "null"])
@pytest.mark.parametrize("options", [{}, {"remeasure": True, "accept_change": "another scale"}])
def test_a_store_that_describes_no_validation_is_damaged(
    validation: str, options: dict[str, Any], tmp_path: Path
) -> None:
    path = tmp_path / "a.sqlite"
    Campaign(make_validation(), search=searches.Random(), store=path).run(1)
    with contextlib.closing(sqlite3.connect(path)) as database, database:
        database.execute("UPDATE experiment SET value = ? WHERE key = 'validation'", (validation,))
    with pytest.raises(StoreError):
        Campaign(make_validation(), search=searches.Random(), store=path, **options)


class Scaled:
    """A distance whose scale can be seen or is private."""

    def __init__(self, scale: float = 1.0, private: float = 1.0) -> None:
        self.scale, self._private = scale, private
        self.distance = distances.FinalState(norm=1)

    def __call__(self, model: Any, system: Any, task: Any) -> Any:
        return self.scale * self._private * self.distance(model, system, task)


class Private:
    """A model whose weights nobody sees, as those of many network libraries."""

    def __init__(self, model: Any, gain: float = 1.0) -> None:
        self._model, self._gain = model, gain

    def step(self, x: Array, u: Array) -> Array:
        return np.asarray(self._model.step(x, self._gain * u))

    def jacobian(self, x: Array, u: Array) -> tuple[Array, Array]:
        A, B = self._model.jacobian(x, u)
        return A, self._gain * B


def campaign(store: Path, validation: Validation | None = None, **options: Any) -> Campaign:
    return Campaign(validation or make_validation(), search=SEARCH(), store=store, seed=2, **options)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("made") / "a.sqlite"
    campaign(path).run(7)
    return path


@pytest.fixture
def store(made: Path, tmp_path: Path) -> Path:
    return Path(shutil.copy(made, tmp_path / "a.sqlite"))


# The model


def test_a_model_learned_again_is_noticed_even_if_its_weights_are_private(tmp_path: Path) -> None:
    learned = make_validation().model
    campaign(tmp_path / "a.sqlite", make_validation(model=Private(learned))).run(4)
    assert campaign(tmp_path / "a.sqlite", make_validation(model=Private(learned))).executions == 4
    other = make_validation(model=Private(learned, gain=1.01))
    for reason in (None, "learned from more data"):
        with refuses(StoreMismatchError, "a.sqlite", 0):
            campaign(tmp_path / "a.sqlite", other, accept_change=reason)


def test_a_model_that_fails_now_is_noticed(tmp_path: Path) -> None:
    class Failing(Private):
        def step(self, x: Array, u: Array) -> Array:
            raise ValueError("no weights")

    learned = make_validation().model
    campaign(tmp_path / "a.sqlite", make_validation(model=Private(learned))).run(3)
    failing = make_validation(model=Failing(learned))
    failing.model.__class__.__name__ = failing.model.__class__.__qualname__ = "Private"
    with pytest.raises(StoreMismatchError):
        campaign(tmp_path / "a.sqlite", failing)


def test_a_controller_design_that_differs_each_time_is_not_taken_for_another_one(tmp_path: Path) -> None:
    class Drawing:
        rng = np.random.default_rng(0)

        def design(self, task: Any, model: Any) -> Any:
            gain = self.rng.normal(-1, 0.3)
            return lambda t, x: gain * x[..., :1]

        def describe(self) -> dict[str, object]:
            return {}

    validation = make_validation()
    validation.synthesizer = Drawing()
    campaign(tmp_path / "a.sqlite", validation).run(3)
    assert campaign(tmp_path / "a.sqlite", validation).run(5).executions == 5


# The distance


@pytest.mark.parametrize("other", [Scaled(scale=2.0), Scaled(private=2.0)])
def test_another_distance_is_refused_until_everything_is_measured_anew(tmp_path: Path, other: Scaled) -> None:
    path = tmp_path / "a.sqlite"
    before = campaign(path, make_validation(distance=Scaled())).run(6)
    for reason in (None, "it is the same"):
        with refuses(StoreMismatchError, "STORE", "remeasure"):
            campaign(path, make_validation(distance=other), accept_change=reason)
    after = campaign(path, make_validation(distance=other), remeasure=True)
    np.testing.assert_allclose([t.distance for t in after.trials], [2 * (t.distance or 0) for t in before.trials])
    assert after.executions == 6
    (change,) = after.store.history()
    assert change.what == "remeasured"
    assert change.content["before"]["3"] == {
        "state": "completed",
        "distance": before.trials[3].distance,
        "failure": None,
    }
    assert campaign(path, make_validation(distance=other)).run(7).executions == 7


def test_a_distance_that_is_only_written_otherwise_can_be_accepted(store: Path) -> None:
    same = make_validation(distance=lambda model, system, task: distances.FinalState(norm=1)(model, system, task))
    with refuses(StoreMismatchError, "remeasure", "a.sqlite"):
        campaign(store, same)
    accepted = campaign(store, same, accept_change="rewritten")
    assert [(c.what, c.why) for c in accepted.store.history()] == [("accepted", "rewritten")]
    assert campaign(store, same).run(8).executions == 8


def test_a_live_campaign_takes_another_distance(store: Path) -> None:
    running = campaign(store)
    before = [trial.distance for trial in running.trials]
    changed = running.remeasure(Scaled(scale=3.0))
    assert len(changed) == 7
    np.testing.assert_allclose([t.distance for t in running.trials], 3 * np.array(before))
    assert running.remeasure() == []
    assert running.run(8).executions == 8
    resumed = campaign(store, make_validation(distance=Scaled(scale=3.0)))
    assert [t.distance for t in resumed.trials] == [t.distance for t in running.trials]


def test_a_distance_that_raises_now_changes_nothing(store: Path) -> None:
    def broken(model: Any, system: Any, task: Any) -> float:
        raise ZeroDivisionError("no")

    before = Store(store).trials()
    with refuses(DistanceError, "distance", 0):
        campaign(store, make_validation(distance=broken), remeasure=True)
    with refuses(DistanceError, 0):
        campaign(store).remeasure(broken)
    assert [t.distance for t in Store(store).trials()] == [t.distance for t in before]
    assert campaign(store).executions == 7


def test_a_distance_that_was_told_alone_is_none_of_another_definition(store: Path) -> None:
    told = campaign(store)
    told.tell(told.ask(), distance=0.25)
    after = campaign(store, make_validation(distance=Scaled(scale=2.0)), remeasure=True)
    assert (after.trials[7].state, after.trials[7].distance, after.executions) == ("unmeasured", None, 8)
    assert_names(str(after.trials[7].failure), "told")
    assert after.store.history()[0].content["before"]["7"]["distance"] == 0.25


# The rest


def test_a_repaired_system_goes_on_with_a_note(store: Path) -> None:
    repaired = make_validation(system=FaultyRig(make_validation().system))
    with refuses(StoreMismatchError, "--accept-change", "a.sqlite"):
        campaign(store, repaired)
    with refuses(InputError, "change"):
        campaign(store, repaired, accept_change=" ")
    accepted = campaign(store, repaired, accept_change="gripper replaced")
    (change,) = accepted.store.history()
    assert (change.why, change.content["trials"]) == ("gripper replaced", 7)
    assert campaign(store, repaired).run(8).executions == 8


def test_another_question_cannot_be_accepted(store: Path) -> None:
    for change in (
        {"seed": 3},
        {"search": searches.Random()},
        {"name": "other"},
    ):
        with refuses(StoreMismatchError, "store", "a.sqlite"):
            Campaign(make_validation(), **{"search": SEARCH(), "seed": 2, **change}, store=store, accept_change="x")


def test_the_unit_of_a_parameter_is_part_of_the_question(store: Path) -> None:
    other = make_validation()
    other.space = TaskSpace(goal=(-3.0, 3.0, "deg"))
    with refuses(StoreMismatchError, "rad", "deg"):
        campaign(store, other, accept_change="x")


@pytest.mark.parametrize(
    "space",
    [TaskSpace(goal=(-1.0, 1.0)), TaskSpace(goal=(-3.0, 3.0), load=(0.0, 1.0)), TaskSpace(goal=(-3.0, 4.0))],
    ids=["a subset of the tasks", "another parameter", "more tasks"],
)
def test_other_tasks_need_another_store_whatever_the_reason(store: Path, space: TaskSpace) -> None:
    other = make_validation()
    other.space = space
    with refuses(StoreMismatchError, "a.sqlite", "validation.space.goal"):
        campaign(store, other, accept_change="only these tasks matter")


def test_a_failure_cannot_be_dropped(store: Path) -> None:
    made = campaign(store)
    failed = made.tell(made.ask(), failed="it slipped")
    with refuses(InputError, "failed", 7, failed.number):
        made.tell(failed.number, distance=0.1)
    by = CertificateOptions(DistanceBound(resolution=1.0))
    assert made.verdict(1e3, certificate=by).answer == "undecided"
    made.tell(made.ask(failed.parameters), distance=0.1)  # it succeeds for no stated reason
    verdict = made.verdict(1e3, certificate=by)
    assert verdict.answer == "undecided"
    assert_names(verdict.reason, "failed", failed.number, failed.number + 1)


# Without a search


@pytest.mark.slow
@pytest.mark.parametrize(
    "search",
    [
        SEARCH(beta=3.0, noise=(1e-6, 0.5)),
        *more(
            searches.Auto("fast"),
            searches.Auto(40),
            searches.Random(),
            searches.SamplingDiscarding(2),
        ),
    ],
    ids=repr,
)
def test_a_campaign_goes_on_with_the_search_that_its_store_was_made_with(tmp_path: Path, search: Any) -> None:
    whole = Campaign(make_validation(), search=search, seed=2).run(5)
    Campaign(make_validation(), search=search, seed=2, store=tmp_path / "a.sqlite").run(4)
    resumed = Campaign(make_validation(), seed=2, store=tmp_path / "a.sqlite")
    assert type(resumed.search) is type(search)
    assert describe(resumed.search) == describe(search)
    points = [[trial.unit_point.tolist() for trial in one.trials] for one in (resumed.run(5), whole)]
    assert points[0] == points[1]


class Random(searches.Random):
    """A user's own search, under the name of a ready-made one."""


@pytest.mark.parametrize(
    ("search", "called"),
    [(SEARCH(kernel=Matern(2.5)), "GPUCB"), (SEARCH(prior_mean=np.sum), "GPUCB"), (Random(), "Random")],
)
def test_a_search_that_cannot_be_made_again_must_be_given(tmp_path: Path, search: Any, called: str) -> None:
    Campaign(make_validation(), search=search, seed=2, store=tmp_path / "a.sqlite")
    with refuses(StoreMismatchError, "a.sqlite", "search", called):
        Campaign(make_validation(), seed=2, store=tmp_path / "a.sqlite")
    assert Campaign(make_validation(), search=search, seed=2, store=tmp_path / "a.sqlite").search is search


def test_a_new_campaign_has_the_search_of_the_command_line() -> None:
    default = read_settings("pendulum", {}).search.build()
    assert describe(Campaign(make_validation()).search) == describe(default) == describe(searches.Auto())


# Values that may be secrets


SECRETIVE = """
import os, sys
import numpy as np
from ctxval import Experiment, Task, TaskSpace, Trajectory, Validation, controllers, distances, models

KEY, ARGUMENTS = os.environ["AWS_SECRET_ACCESS_KEY"], sys.argv

def closing(secret):
    return lambda x: x + 0.0 * len(secret)

class Rig:
    def __init__(self, password=os.environ["ROBOT_PASSWORD"]):
        self.password, self.keys, self.same = password, {"robot": [password]}, closing(password)

    def execute(self, controller, task):
        assert KEY and ARGUMENTS and os.environ["ROBOT_PASSWORD"] == self.password
        states, inputs = [task.initial_state], []
        for t in range(task.horizon):
            inputs.append(np.asarray(controller(t, states[-1])))
            states.append(self.same(0.9 * states[-1] + 0.1 * inputs[-1]))
        return Trajectory(task.dt * np.arange(task.horizon + 1), np.array(states), np.array(inputs))

def experiment(seed=0):
    validation = Validation(
        space=TaskSpace(goal=(0.5, 2.0)),
        task=lambda p: Task([0.0], goal=[p.goal], horizon=5 if KEY else 0, dt=0.1),
        system=Rig(),
        model=models.Linear([[1.0]], [[0.1]]),
        synthesizer=controllers.LQR([1.0], [0.1]),
        distance=distances.FinalState(),
    )
    return Experiment("secretive", validation, budget=3, threshold=1.0)
"""


@pytest.mark.thorough
def test_no_output_has_a_value_that_the_system_uses_and_such_values_may_change(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "secretive.py").write_text(SECRETIVE)
    canaries = []
    for budget, name in enumerate(("first", "second"), start=2):
        canary = [f"{name}-key", f"{name}-password", f"{name}-argument"]
        monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", canary[0])
        monkeypatch.setenv("ROBOT_PASSWORD", canary[1])
        monkeypatch.setattr(sys, "argv", ["run", canary[2]])
        monkeypatch.delitem(sys.modules, "secretive", raising=False)
        done = CliRunner().invoke(app, ["run", "secretive:experiment", "--store", "a.sqlite", "--budget", str(budget)])
        assert done.exit_code in (0, 1), done.output
        canaries += canary
    assert len(Store("a.sqlite").trials()) == 3
    CliRunner().invoke(app, ["export", "a.sqlite"])
    CliRunner().invoke(app, ["report", "a.sqlite", "--trust", "--out", "report.html"])
    files = [path for path in tmp_path.rglob("*") if path.is_file() and path.suffix != ".pyc"]
    assert {"a.sqlite", "trials.json", "report.html"} <= {path.name for path in files}
    assert not [(path.name, one) for path in files for one in canaries if one.encode() in path.read_bytes()]


# Changed while it is open


def test_a_campaign_that_has_not_seen_another_distance_writes_nothing(tmp_path: Path) -> None:
    path = tmp_path / "a.sqlite"
    stale = campaign(path)
    stale.run(2)
    opened = stale.ask()
    whole = stale.validation.execute(opened.plan)
    fresh = campaign(path, make_validation(distance=Scaled(scale=100.0)), remeasure=True)
    for act in (
        lambda: stale.run(5),
        lambda: stale.tell(opened, whole),
        lambda: stale.add({"goal": 1.0}, stale.validation.execute(stale.validation.plan([1.0]))),
        lambda: stale.ask(),
    ):
        with refuses(StoreMismatchError, "a.sqlite", "validation.distance.type"):
            act()
    assert [t.state for t in Store(path).trials()] == ["completed", "completed", "open"]
    assert fresh.run(5).executions == 5


def test_what_is_measured_by_the_old_distance_at_the_same_time_is_kept_beside(tmp_path: Path) -> None:
    path = tmp_path / "a.sqlite"
    stale = campaign(path)
    opened = stale.ask()
    whole = stale.validation.execute(opened.plan)
    before = stale.store.signature()
    campaign(path, make_validation(distance=Scaled(scale=100.0)), remeasure=True)
    stale.store.signature = lambda: before  # type: ignore[method-assign]  # it has looked just before
    stale.store._require_unchanged = Store(path)._require_unchanged  # type: ignore[method-assign]
    with refuses(StoreMismatchError, "a.trial", "0.npz"):
        stale.tell(opened, whole)


def test_what_is_told_while_distances_are_measured_anew_is_measured_anew_too(tmp_path: Path) -> None:
    path = tmp_path / "a.sqlite"
    first = campaign(path).run(2)
    opened = first.ask()
    whole = first.validation.execute(opened.plan)
    told: list[int] = []

    class Telling(Scaled):
        def __call__(self, model: Any, system: Any, task: Any) -> Any:
            if not told:
                told.append(1)
                first.tell(opened, whole)
            return super().__call__(model, system, task)

    second = campaign(path)
    second.remeasure(Telling(scale=100.0))
    plan = first.validation.plan
    measure, space = first.validation.measure, first.validation.space
    plain = [
        measure(plan(space.from_unit(t.unit_point)), m) for t in second.trials for m in [second.trajectories(t)[1]] if m
    ]
    np.testing.assert_allclose([t.distance for t in second.trials], 100 * np.array(plain))
    assert len(plain) == 3


def test_an_interrupted_remeasure_changes_neither_store_nor_campaign(store: Path) -> None:
    def interrupted(model: Any, system: Any, task: Any) -> float:
        raise KeyboardInterrupt

    running = campaign(store)
    before = [trial.distance for trial in running.trials]
    with pytest.raises((KeyboardInterrupt, DistanceError)):
        running.remeasure(interrupted)
    assert running.run(8).executions == 8
    assert [trial.distance for trial in campaign(store).trials][:7] == before


def test_a_reason_is_kept_although_no_code_differs(store: Path) -> None:
    repaired = campaign(store, accept_change="gripper replaced")
    assert [(c.what, c.why) for c in repaired.store.history()] == [("accepted", "gripper replaced")]


def test_counters_of_a_system_do_not_go_into_the_store_with_another_distance(tmp_path: Path) -> None:
    rig = FaultyRig(make_validation().system)
    rig.executed = 0  # type: ignore[attr-defined]
    running = campaign(tmp_path / "a.sqlite", make_validation(system=rig)).run(2)
    rig.executed = 2  # type: ignore[attr-defined]
    running.remeasure(Scaled(scale=2.0))
    rig.executed = 0  # type: ignore[attr-defined]
    assert campaign(tmp_path / "a.sqlite", make_validation(system=rig, distance=Scaled(scale=2.0))).executions == 2


@pytest.mark.slow
def test_a_task_that_was_told_in_another_distance_counts_again_once_it_is_executed(store: Path) -> None:
    told, by = campaign(store), CertificateOptions(DistanceBound(resolution=1.0))
    told.tell(told.ask({"goal": 1.0}), distance=0.25)
    told.remeasure(Scaled(scale=2.0))
    assert_names(told.verdict(1e6, certificate=by).reason, 7, "distance")
    again = told.ask({"goal": 1.0})
    told.tell(again, told.validation.execute(again.plan))
    assert "could not be measured" not in told.verdict(1e6, certificate=by).reason
