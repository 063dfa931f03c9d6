"""Audit a model on random tasks, learn it again from them, and audit the new one on other tasks."""

import numpy as np

from ctxval import Campaign, Task, TaskSpace, Transitions, Validation, controllers, distances, models, searches, systems
from ctxval.certificates import Audit, Sample

DT = 0.1  # s
DRAWS = 59  # fixed beforehand: so many bound the tasks that are worse than all of them to 5 % with confidence 95 %


def slide(x, u):
    """Return the next position [m] and speed [m/s] of a slide with viscous friction and a little drag."""
    position, speed = x[..., 0], x[..., 1]
    friction = 0.8 * speed + 0.1 * speed * np.abs(speed)
    return np.stack([position + DT * speed, speed + DT * (u[..., 0] - friction)], axis=-1)


def audited(model):
    """Return a campaign that executes nothing but independent random tasks."""
    validation = Validation(
        space=TaskSpace(goal=(0.5, 2.0, "m"), speed=(-1.0, 1.0, "m/s")),
        task=lambda p: Task([0.0, p.speed], goal=[p.goal, 0.0], horizon=30, dt=DT),
        system=systems.Simulated(slide, vectorized=True),
        model=model,
        synthesizer=controllers.LQR(Q=[1.0, 0.1], R=[0.1]),
        distance=distances.WholeTrajectory(norm=np.inf, components=[0]),
    )
    # The random tasks depend on the model, so that a model is never audited on the tasks that it was learned from.
    return Campaign(validation, search=searches.Random(), seed=0).audit(DRAWS)


def report(title, campaign):
    """Print what the audit proves, and return its certificate."""
    certificate = Audit().certify(Sample.of(campaign.trials))
    print(f"{title}: the largest gap in {campaign.executions} random tasks is {certificate.upper_bound:.2g} m.")
    print(f"  {certificate.statement}")
    return certificate


frictionless = models.Linear(A=[[1.0, DT], [0.0, 1.0]], B=[[0.0], [DT]])
first = audited(frictionless)
report("Model without friction", first)

recorded = [first.trajectories(trial)[1] for trial in first.completed]
learned = models.Linear.fit(Transitions.joined([trajectory.transitions() for trajectory in recorded]))
print(f"\nLearned again: the slide loses {100 * (1 - learned.A[1, 1]) / DT:.0f} % of its speed in a second.\n")

second = audited(learned)
certificate = report("Model learned again", second)
print("\nWhat this rests on:")
for assumption in certificate.assumptions:
    print(f"- {assumption}")
