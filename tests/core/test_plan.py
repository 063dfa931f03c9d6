from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import pytest

from conftest import make_validation
from ctxval import Campaign, Task, Validation, controllers, distances, searches
from ctxval.core.labels import Labels
from ctxval.core.plan import DistanceWarning, start_offset
from ctxval.core.validation import CostWarning
from ctxval.distances import AtCrossing, AtTimes, CrossingTime, FinalState, GoalError, RelativeDeviation, TrackingError
from ctxval.errors import DesignError, DistanceError, InputError, UnknownNameError
from facts import refuses, warns


@pytest.mark.parametrize(
    "distance",
    [
        FinalState(components=[5]),
        FinalState(angles=[7]),
        FinalState(weights=[1.0] * 7),
        FinalState(components=["position"]),
        AtTimes(times=[99.0]),
        AtCrossing(state=9),
        CrossingTime(state="speed"),
        RelativeDeviation(least=[1.0] * 7),
        lambda model, system, task: np.nan,
        lambda model, system, task: -1.0,
        lambda model, system, task: np.zeros(3),
        lambda model, system, task: 1 / 0,
        lambda model, system, task: 1j,
    ],
    ids=lambda distance: getattr(distance, "__name__", None) or repr(distance),
)
@pytest.mark.parametrize("how", ["run", "ask", "audit"])
def test_a_distance_that_cannot_be_used_costs_nothing(distance: Any, how: str) -> None:
    campaign = Campaign(make_validation().with_parts(distance=distance), search=searches.Random())
    calls = {"run": lambda: campaign.run(2), "ask": campaign.ask, "audit": lambda: campaign.audit(2)}
    for _ in range(2):
        with pytest.raises(DistanceError):
            calls[how]()
    assert campaign.trials == ()


@pytest.mark.parametrize("how", ["run", "ask"])
def test_a_controller_that_remembers_its_run_in_itself_costs_nothing(how: str) -> None:
    class Integrating:
        """Adds up its errors, and never forgets them."""

        def __init__(self, forgets: bool) -> None:
            self.forgets, self.sum = forgets, 0.0

        def __call__(self, t: int, x: Any, task: Task) -> Any:
            self.sum = 0.0 if self.forgets and t == 0 else self.sum + float(x[0] - task.goal[0])
            return np.array([-3.0 * (x[0] - task.goal[0]) - 0.1 * self.sum])

    def campaign(forgets: bool) -> Campaign:
        policy = controllers.Policy(Integrating(forgets), vectorized=False)
        return Campaign(make_validation().with_parts(synthesizer=policy), search=searches.Random())

    remembering, forgetting = campaign(False), campaign(True)
    with refuses(DesignError, 0, "run"):
        {"run": lambda: remembering.run(1), "ask": remembering.ask}[how]()
    assert remembering.trials == ()
    forgetting.run(1)
    assert len(forgetting.completed) == 1


def test_a_model_that_is_random_costs_nothing() -> None:
    rng, linear = np.random.default_rng(0), make_validation().model
    campaign = Campaign(make_validation(model=lambda x, u: linear.step(x, u) + 0.1 * rng.normal(size=np.shape(x))))
    with refuses(DesignError, "models.Expected", 0):
        campaign.run(1)
    assert campaign.trials == ()


def test_a_task_function_that_is_random_costs_nothing() -> None:
    rng, plain = np.random.default_rng(0), make_validation().task
    campaign = Campaign(make_validation().with_parts(task=lambda p: plain(p).starting_at(rng.normal(size=2))))
    with refuses(InputError, "task", "function"):
        campaign.run(1)
    assert campaign.trials == ()


def test_a_distance_that_works_in_place_does_not_change_what_is_stored() -> None:
    def in_place(model: Any, system: Any, task: Task) -> Any:
        system.states[...] -= model.states
        model.states[...] = 0.0
        return np.abs(system.states[..., -1, :]).sum(axis=-1)

    plain = Campaign(make_validation(distance=distances.FinalState(norm=1)), search=searches.Random()).run(1)
    changing = Campaign(make_validation(distance=in_place), search=searches.Random()).run(1)
    assert changing.trials[0].distance == plain.trials[0].distance
    for stored, expected in zip(
        changing.trajectories(changing.trials[0]), plain.trajectories(plain.trials[0]), strict=True
    ):
        np.testing.assert_array_equal(stored.states, expected.states)


def test_a_distance_of_a_trajectory_with_itself_that_is_not_0_is_a_warning() -> None:
    def shifted(model: Any, system: Any, task: Task) -> Any:
        return np.abs(system.final_state - model.final_state).sum(axis=-1) + 0.1

    campaign = Campaign(make_validation().with_parts(distance=shifted), search=searches.Random())
    with warns(DistanceWarning, 0.1, 0):
        campaign.run(1)
    assert len(campaign.trials) == 1
    for to_task in (GoalError(), TrackingError()):
        Campaign(make_validation().with_parts(distance=to_task), search=searches.Random()).run(1)  # no warning


OF_STATES = ("components", "angles", "state")
"""Options of distances that name states; a distance need not have any."""


def options_of_states(name: str) -> list[str]:
    """Return the options of a distance that name states; those of ``UnsafeMargin`` are in its sets."""
    known = getattr(distances.REGISTRY[name], "__dataclass_fields__", ())
    return [option for option in OF_STATES if option in known and name != "UnsafeMargin"]


def test_most_distances_name_states() -> None:
    assert len([name for name in distances.REGISTRY.built_in if options_of_states(name)]) >= 10


@pytest.mark.parametrize("name", [name for name in distances.REGISTRY.built_in if options_of_states(name)])
def test_every_distance_takes_states_by_name(name: str) -> None:
    n = len(make_validation().plan([0.5]).task.initial_state)
    labels = Labels(tuple(f"state {i} [rad]" for i in range(n)))
    required: dict[str, Any] = {
        "AtTimes": {"times": [0.1]},
        "RelativeDeviation": {"least": [0.1]},
        "ContactTime": {"height": 0.1},
    }.get(name, {})
    cls: Any = distances.REGISTRY[name]
    for option in options_of_states(name):
        by_name, by_index = (0 if option == "state" else (0,)), ("state 0" if option == "state" else ["state 0"])
        validation = make_validation().with_parts(labels=labels)
        named = validation.with_parts(distance=cls(**required, **{option: by_index})).distance
        indexed = cls(**required, **{option: by_name})
        assert named == indexed
        assert named.describe() == indexed.describe() if hasattr(named, "describe") else True
        with refuses(UnknownNameError, "state 0", 0):
            validation.with_parts(distance=cls(**required, **{option: "stat 0" if option == "state" else ["stat 0"]}))


def test_names_given_before_the_labels_are_resolved_with_them() -> None:
    unnamed = make_validation().with_parts(distance=FinalState(components=["angle"]))
    n = len(unnamed.plan([0.5]).task.initial_state)
    labelled = unnamed.with_parts(labels=Labels(("angle", *(f"x{i}" for i in range(1, n)))))
    assert labelled.distance == FinalState(components=(0,))


def long(horizon: int, **options: Any) -> Validation:
    short = make_validation()
    state = short.plan([0.5]).task.initial_state

    def task(p: Any) -> Task:
        return Task(state, goal=np.zeros(len(state)), horizon=horizon, dt=0.1)

    return Validation(**{**vars(short), "task": task, **options})


def test_a_horizon_that_is_too_long_is_refused_with_its_cost() -> None:
    with refuses(InputError, 10000000, "CPU"):
        Campaign(long(10**7)).ask()
    with refuses(InputError, 20, "longest"):
        long(21, longest=20).plan([0.5])
    assert long(20, longest=20).plan([0.5]).task.horizon == 20


def test_the_cost_of_a_long_horizon_is_stated_once() -> None:
    validation = long(60)
    validation.cost_stated_from = 50
    with warns(CostWarning, 60):
        validation.plan([0.5])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        validation.plan([0.5])


def test_the_offset_of_a_start_is_measured_as_the_distance_measures_states() -> None:
    validation = make_validation()
    plan = validation.plan([0.5])
    moved = plan.model_trajectory.copy()
    moved.states[0, 0] += 0.5
    weights = [2.0, *[1.0] * (moved.states.shape[-1] - 1)]
    offset = start_offset(validation.with_parts(distance=FinalState(weights=weights)), [0.5], moved)
    assert (offset.size, offset.text) == (pytest.approx(1.0), "0.5 in x0")
    alone = start_offset(validation.with_parts(distance=lambda m, s, t: 0.0), [0.5], moved)
    assert alone.size == pytest.approx(0.5)
