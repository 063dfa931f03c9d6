"""CPU seconds of thinking for each choice and for the verdict, as shares of the budget (`--thinking`).

Robots are chains of joints, up to a humanoid's number of states. A controller takes a stated time in each call, as a
sampling MPC does; in a batch, one call serves all tasks. A share above 1.2 is one that the budget does not keep.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np

from ctxval import Campaign, Task, TaskSpace, Validation, distances
from ctxval._util.arrays import Array
from ctxval.campaign.interval_search import IntervalSearch
from ctxval.campaign.trials import TrialRecorder

DT, HORIZON = 0.02, 50
MOST = 1.2
EXECUTIONS = 12


class Chain:
    """Joints in a row with springs between them; S has gravity and dry couplings that M lacks.

    With ``hidden`` joints, S has some more at its end, which are not recorded.
    """

    def __init__(self, states: int, lacks: bool, noise: float = 0.0, hidden: int = 0) -> None:
        self.joints, self.lacks, self.noise, self.hidden = states // 2, lacks, noise, hidden
        self.actuated = min(self.joints, 12)

    def step(self, x: Array, u: Array) -> Array:
        k = x.shape[-1] // 2
        q, v = x[..., :k], x[..., k:]
        torque = np.zeros_like(q)
        torque[..., : self.actuated] = u
        left = np.concatenate([np.zeros_like(q[..., :1]), q[..., :-1]], axis=-1)
        right = np.concatenate([q[..., 1:], q[..., -1:]], axis=-1)
        force = torque + 2.0 * (left - 2 * q + right) - 1.5 * v
        if self.lacks:
            force = force - 0.8 * np.sin(q) - 0.1 * v * np.abs(v)
        v = v + DT * force
        return np.concatenate([q + DT * v, v], axis=-1)

    def execute(self, controller: Any, task: Task) -> Any:
        rng = np.random.default_rng(abs(int(1e6 * task.reference[1, 0])))
        n, extra = 2 * self.joints, self.hidden

        def recorded(x: Array) -> Array:
            k = self.joints + extra
            return np.concatenate([x[: self.joints], x[k : k + self.joints]])

        from ctxval import Trajectory
        from ctxval.core.controller import started

        x, pi = np.zeros(n + 2 * extra), started(controller, task)
        states, inputs = [recorded(x)], []
        for t in range(task.horizon):
            u = np.asarray(pi(t, states[-1].copy()))
            x = self.step(x, u) + self.noise * rng.normal(size=len(x))
            states.append(recorded(x))
            inputs.append(u)
        return Trajectory(task.times, np.array(states), np.array(inputs))


@dataclass(frozen=True)
class Tracking:
    """Computed torques with PD feedback, which take so many seconds of CPU a call."""

    reference: Array
    actuated: int
    seconds: float

    def __call__(self, t: int, x: Array) -> Array:
        until = time.process_time() + self.seconds
        k = x.shape[-1] // 2
        u = 20.0 * (self.reference[..., t, :k] - x[..., :k]) - 4.0 * x[..., k:]
        while self.seconds and time.process_time() < until:
            pass
        return np.asarray(u[..., : self.actuated])


@dataclass(frozen=True)
class Tracker:
    seconds: float
    batched: bool
    actuated: int

    def design(self, task: Task, model: Any) -> Tracking:
        return Tracking(task.reference, self.actuated, self.seconds)


def validation(states: int, seconds: float, batched: bool, noise: float = 0.0, hidden: int = 0) -> Validation:
    chain, k = Chain(states, lacks=True, noise=noise, hidden=hidden), states // 2

    def task(p: Any) -> Task:
        t = DT * np.arange(HORIZON + 1)
        amplitude, rate = np.asarray(p["amplitude"])[..., None], np.asarray(p["rate"])[..., None]
        q = amplitude * np.sin(rate * t)
        reference = np.zeros((*q.shape, 2 * k))
        reference[..., :k] = q[..., None] * np.linspace(1, 0.4, k)
        return Task(np.zeros((*q.shape[:-1], 2 * k)), horizon=HORIZON, dt=DT, reference=reference)

    return Validation(
        space=TaskSpace(amplitude=(0.2, 1.0), rate=(1.0, 5.0)),
        task=task,
        system=chain,
        model=Chain(states, lacks=False).step,
        synthesizer=Tracker(seconds, batched, chain.actuated),
        distance=distances.MaximumDeviation(),
    )


@contextmanager
def timed(kind: type, name: str, spent: list[float]) -> Iterator[None]:
    """Add the CPU seconds of each call of a method to a list."""
    original = getattr(kind, name)

    def wrapped(self: Any, *arguments: Any, **options: Any) -> Any:
        begun = time.process_time()
        try:
            return original(self, *arguments, **options)
        finally:
            spent.append(time.process_time() - begun)

    setattr(kind, name, wrapped)
    try:
        yield
    finally:
        setattr(kind, name, original)


def measured(threshold: float, budget: int, **parts: Any) -> dict[str, Any]:
    thinking = parts.pop("thinking", None)
    options = {} if thinking is None else {"thinking": thinking}
    campaign = Campaign(validation(**parts), seed=0)
    chosen, opened = list[float](), list[float]()
    with timed(IntervalSearch, "choose", chosen), timed(TrialRecorder, "_next_trial", opened):
        campaign.run(budget, threshold, **options)
        begun, before = time.process_time(), len(chosen)
        verdict = campaign.verdict(threshold, **options)
    seconds = time.process_time() - begun
    choices = [a + b for a, b in zip(chosen[:before], [*opened, 0.0], strict=False)]
    return {
        "answer": verdict.answer,
        "executions": campaign.executions,
        "verdict": seconds,
        "choices": choices,
        "bound": verdict.bound,
        "reason": verdict.reason[:300],
        "notes": [trial.note.thinking for trial in campaign.trials],
        "shortage": getattr(verdict, "shortage", None),
    }


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("states", type=int)
    parser.add_argument("--ms", type=float, default=0.0)
    parser.add_argument("--batched", action="store_true")
    parser.add_argument("--noise", type=float, default=0.0)
    parser.add_argument("--hidden", type=int, default=0)
    parser.add_argument("--thinking", type=float)
    parser.add_argument("--budget", type=int, default=EXECUTIONS)
    parser.add_argument("--threshold", type=float, default=0.5)
    a = parser.parse_args()
    found = measured(
        a.threshold,
        a.budget,
        states=a.states,
        seconds=a.ms / 1000,
        batched=a.batched,
        noise=a.noise,
        hidden=a.hidden,
        **({} if a.thinking is None else {"thinking": a.thinking}),
    )
    print(
        [round(x, 2) for x in found["choices"]],
        round(found["verdict"], 2),
        found["answer"],
        found["executions"],
        found["bound"],
        found["reason"],
    )
    if a.thinking is not None:
        share = max([*found["choices"], found["verdict"]]) / a.thinking
        print(f"largest share of the budget: {share:.2f} ({'kept' if share <= MOST else 'NOT KEPT'})")
    print("speed", found["notes"][0] and found["notes"][0]["speed"], found["shortage"])
    for choice, note in zip(found["choices"], found["notes"], strict=False):
        if note and "spent" in note:
            print(round(choice, 2), note["spent"], note["replaced"])
