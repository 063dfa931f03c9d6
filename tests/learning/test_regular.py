"""The split of recorded transitions into regular ones and contacts, and where the regular part ends."""

from __future__ import annotations

from functools import cache

import numpy as np

from ctxval import Trajectory, Transitions, models
from ctxval.learning.closed_loops import Loops
from ctxval.learning.dynamics_posterior import PosteriorSettings
from ctxval.learning.regular import RegularTransitions, split_transitions

MODEL = models.Linear([[1.0, 0.05], [0.0, 1.0]], [[0.0], [0.05]])
SETTINGS = PosteriorSettings(learned_from=60, centres=120)
WALL = 0.8


def step(x: np.ndarray, u: np.ndarray, stiffness: float = 300.0) -> np.ndarray:
    """A cart with drag, and a stiff wall."""
    for _ in range(5):
        position, speed = x[..., 0], x[..., 1]
        pushed = u[..., 0] - 0.5 * speed * np.abs(speed) - stiffness * np.maximum(position - WALL, 0)
        x = x + 0.01 * np.stack([speed, pushed], axis=-1)
    return x


def runs(goals: np.ndarray, stiffness: float = 300.0) -> Trajectory:
    """Closed loops to some goals."""
    states, inputs = [np.zeros((len(goals), 2))], []
    for _ in range(40):
        x = states[-1]
        inputs.append((6 * (goals - x[:, 0]) - 4 * x[:, 1])[:, None])
        states.append(step(x, inputs[-1], stiffness))
    return Trajectory(0.05 * np.arange(41), np.stack(states, axis=1), np.stack(inputs, axis=1))


def split_of(goals: np.ndarray, stiffness: float = 300.0) -> tuple[Transitions, RegularTransitions | None]:
    loops = runs(goals, stiffness)
    known = loops.transitions()
    sources = np.repeat(np.arange(len(goals)), 40)
    return known, split_transitions(MODEL, known, sources, (0,), SETTINGS)


GOALS = np.array([-1.0, -0.6, -0.2, 0.3, 0.5, 0.7, 0.95, 1.1])


@cache
def usual_split() -> tuple[Transitions, RegularTransitions | None]:
    return split_of(GOALS)


def test_steps_that_touch_a_wall_are_irregular_and_the_others_are_not() -> None:
    known, split = usual_split()
    assert split is not None
    touching = np.maximum(known.x[:, 0], known.x_next[:, 0]) > WALL
    assert touching.sum() > 15
    assert (split.regular == touching).sum() <= 3
    assert split.irregular == (~split.regular).sum()
    parts = split.posterior()
    assert parts is not None
    assert parts[0].noise < 0.01


def test_runs_cross_the_boundary_if_and_only_if_they_come_to_the_wall() -> None:
    _, split = usual_split()
    assert split is not None
    parts = split.posterior()
    assert parts is not None
    posterior, boundary = parts
    goals = np.array([-0.9, 0.0, 0.6, 0.72, 0.9, 1.2])
    free = runs(goals, stiffness=0.0)  # as the regular part has them
    crossed = boundary.crossed(posterior, Loops(np.zeros((1, 6)), free.states[None], free.inputs[None]))
    assert (crossed[:3] <= 0).all()
    assert (crossed[4:] > 0).all()
    diverged = free.states[None].copy()
    diverged[:, 0, 5:] = np.nan
    assert boundary.crossed(posterior, Loops(np.zeros((1, 6)), diverged, free.inputs[None]))[0] > 0


def test_executions_that_touched_it_can_be_left_out() -> None:
    _, split = usual_split()
    assert split is not None
    without = split.posterior([6, 7])
    assert without is not None
    assert not without[1].discriminants  # nothing irregular is known
    assert set(without[0].data.sources) == set(range(6))


def test_there_is_no_split_without_irregular_steps() -> None:
    assert split_of(GOALS[:6])[1] is None
