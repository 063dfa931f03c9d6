"""Your own distance and your own search: a function and a short class, each with the check that comes with ctxval."""

import numpy as np

from ctxval import Campaign, Task, TaskSpace, Validation, controllers, models, searches, systems, testing

DT = 0.02  # s


def overshoot(model_trajectory, system_trajectory, task):
    """Return by how many rad the system overshoots its goal more than the model does; 0 if it does not."""
    goal = task.goal[..., 0]

    def beyond(trajectory):
        return np.max((trajectory.states[..., 0] - goal[..., None]) * np.sign(goal)[..., None], axis=-1).clip(min=0)

    return (beyond(system_trajectory) - beyond(model_trajectory)).clip(min=0)


class Bisection(searches.SequentialSearch):
    """Tries the middle of the largest gap beside the best task; in turn with the largest gap of all (one parameter)."""

    def propose(self, rng):
        """Return the next point of the unit cube, shape ``(1,)``."""
        if len(self.points) < 2:
            return np.array([float(len(self.points))])  # both ends first
        known = np.sort(self.points[:, 0])
        gaps = np.diff(known)
        if len(self.points) % 2 and np.isfinite(self.values).any():
            best = np.searchsorted(known, self.points[np.nanargmax(self.values), 0])
            gaps = np.where(np.isin(np.arange(len(gaps)), [best - 1, best]), gaps, 0.0)
        widest = np.argmax(gaps)
        return np.array([known[widest] + gaps[widest] / 2])


def arm(x, u):
    """Return the next angle [rad] and rate [rad/s] of a joint that carries a weight."""
    return np.array([x[0] + DT * x[1], x[1] + DT * (u[0] + 4.0 * np.sin(x[0]) - 0.5 * x[1])])


validation = Validation(
    space=TaskSpace(goal=(0.2, 2.5, "rad")),
    task=lambda p: Task([0.0, 0.0], goal=[p.goal, 0.0], horizon=150, dt=DT),
    system=systems.Simulated(arm),
    model=models.Linear(A=[[1.0, DT], [0.0, 1.0 - 0.5 * DT]], B=[[0.0], [DT]]),  # knows nothing of the weight
    synthesizer=controllers.LQR(Q=[20.0, 1.0], R=[0.1]),
    distance=overshoot,
)
testing.check_search(Bisection(), dimension=1)
print("The search keeps the contract.")

campaign = Campaign(validation, search=Bisection(), seed=0).run(budget=13)
for trial in campaign.completed:
    bar = "#" * round(100 * trial.distance)
    print(f"goal {trial.parameters['goal']:.2f} rad: overshoots by {trial.distance:.3f} rad more than promised {bar}")
print(f"Worst goal: {campaign.worst.parameters['goal']:.3f} rad.")
