"""The paper's linear systems (Sec. VI-C): a random system, a random model and a random feedback, n = 1 to 10 states."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import expm

from ctxval import (
    Array,
    Experiment,
    Parameters,
    Task,
    TaskSpace,
    Truth,
    Validation,
    controllers,
    distances,
    models,
    systems,
)
from ctxval.errors import InputError

DIMENSIONS = range(1, 11)
"""The numbers of states in the paper."""


@dataclass(frozen=True)
class Settings:
    """Every free parameter of the case, with the reason for its value.

    The paper gives none of them; it only says that A, B and K are random.
    """

    #: s; the discretisation is exact, so dt only sets how long an input is held. 50 ms are short against the closed
    #: loops' time constants, of which the shortest is typically 0.4 s.
    dt: float = 0.05
    #: steps; 1 s is half of the longest time constant, so that the final state depends both on the initial state and on
    #: the goal
    horizon: int = 20
    #: 1/s; both closed loops decay at least this fast. Draws that decay more slowly are shifted, ``A - s I``. Rejecting
    #: them would take too long, because few random closed loops of 10 states are stable.
    decay: float = 0.5
    spread: float = 1.0  #: 1/s; about the modulus of the largest eigenvalue of A and of B K, for any n
    #: the threshold is this times the number of states; it is a quarter of the way from the centre of P to its edge
    tolerance: float = 0.25


@dataclass(frozen=True, eq=False)
class LinearSystem:
    """The system ``x' = A x + B u`` with the matrices A ``(n, n)`` and B ``(n, m)`` in 1/s."""

    A: Array
    B: Array

    def discretised(self, dt: float) -> models.Linear:
        """Return the exact step of dt seconds under a held input: the first n rows of ``exp([[A, B], [0, 0]] dt)``."""
        n, m = self.B.shape
        generator = np.block([[self.A, self.B], [np.zeros((m, n + m))]])
        rows = expm(generator * dt)[:n]
        return models.Linear(rows[:, :n], rows[:, n:])


@dataclass(frozen=True, eq=False)
class Feedback:
    """The feedback ``u = K (x - x_final)`` with the gain K, shape ``(m, n)``."""

    gain: Array

    def __call__(self, t: int, x: Array, task: Task) -> Array:
        """Return inputs ``(..., m)`` for states ``(..., n)``."""
        return (x - task.goal) @ self.gain.T


def draw(rng: np.random.Generator, gain: Array, settings: Settings) -> LinearSystem:
    """Return a random system whose closed loop under a gain ``(m, n)`` decays.

    The entries are normal, with a variance for which the largest eigenvalues do not grow with n (the circular law).
    """
    m, n = gain.shape
    A = rng.normal(scale=settings.spread / np.sqrt(n), size=(n, n))
    B = rng.normal(scale=settings.spread / np.sqrt(m), size=(n, m))
    abscissa = np.linalg.eigvals(A + B @ gain).real.max()
    return LinearSystem(A - max(0.0, abscissa + settings.decay) * np.eye(n), B)


def final_state_map(step: models.Linear, gain: Array, horizon: int) -> Array:
    """Return the matrix ``(n, 2 n)`` that maps p = (x_init, x_final) to the final state of the closed loop."""
    n = len(step.A)
    response = np.hstack([np.eye(n), np.zeros((n, n))])
    by_goal = np.hstack([np.zeros((n, n)), step.B @ gain])
    for _ in range(horizon):
        response = (step.A + step.B @ gain) @ response - by_goal
    return np.asarray(response)


def largest_norm(C: Array, space: TaskSpace) -> Truth:
    """Return the exact maximum of ``||C p||_1`` over the box of p.

    ``||e||_1`` is the largest ``s'e`` over the 2^n sign vectors s, and each ``s'C p`` is largest at a vertex.
    """
    center, radius = (space.high + space.low) / 2, (space.high - space.low) / 2
    signs = np.stack(np.meshgrid(*[(-1.0, 1.0)] * len(C), indexing="ij"), axis=-1).reshape(-1, len(C))
    slopes = signs @ C
    values = slopes @ center + np.abs(slopes) @ radius
    best = int(np.argmax(values))
    vertex = np.where(slopes[best] < 0, space.low, space.high)
    return Truth(float(values[best]), space.parameters(vertex), f"closed form: vertices by {len(signs)} sign vectors")


def experiment(seed: int = 0, dim: int = 4, settings: Settings | None = None) -> Experiment:
    """Return the case with n = ``dim`` states, whose task space has 2 n dimensions.

    The seed draws K, then independently A and B of the system and A and B of the model.
    """
    if not isinstance(dim, int | np.integer) or isinstance(dim, bool) or dim not in DIMENSIONS:
        raise InputError(f"dim, the number of states, must be an integer from 1 to 10, got {dim!r}.")
    settings = Settings() if settings is None else settings
    of_gain, of_system, of_model = np.random.default_rng(seed).spawn(3)
    gain = of_gain.normal(scale=1 / np.sqrt(dim), size=(dim, dim))
    system = draw(of_system, gain, settings).discretised(settings.dt)
    model = draw(of_model, gain, settings).discretised(settings.dt)
    space = TaskSpace(x_init=(-np.ones(dim), np.ones(dim)), x_final=(-np.ones(dim), np.ones(dim)))

    def regulate(p: Parameters) -> Task:
        return Task(p.x_init, goal=p.x_final, horizon=settings.horizon, dt=settings.dt)

    def truth() -> Truth:
        error = final_state_map(system, gain, settings.horizon) - final_state_map(model, gain, settings.horizon)
        return largest_norm(error, space)

    validation = Validation(
        space=space,
        task=regulate,
        system=systems.Simulated(system),
        model=model,
        synthesizer=controllers.Policy(Feedback(gain)),
        distance=distances.FinalState(norm=1),
    )
    return Experiment("linear", validation, budget=50, threshold=settings.tolerance * dim, truth=truth)
