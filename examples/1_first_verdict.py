"""A first verdict: a cart with air drag, a linear model learned from gentle runs, and the worst positioning task."""

import numpy as np

import ctxval
from ctxval import controllers, distances, models, systems

DT = 0.05  # s


def cart(x, u):
    """Return the next position [m] and speed [m/s]; the drag grows with the square of the speed."""
    position, speed = x[..., 0], x[..., 1]
    acceleration = u[..., 0] - 0.5 * speed * np.abs(speed)
    return np.stack([position + DT * speed, speed + DT * acceleration], axis=-1)


system = systems.Simulated(cart, vectorized=True)

# Learn the model: 20 runs of 1 s from rest, under small random forces. The cart is slow in them, and the drag is small.
forces = np.random.default_rng(0).uniform(-0.5, 0.5, (20, 20, 1))
gentle = system.execute(lambda t, x: forces[t], ctxval.Task(np.zeros((20, 2)), horizon=20, dt=DT))
model = models.Linear.fit(gentle.transitions())

validation = ctxval.Validation(
    space=ctxval.TaskSpace(goal=(-3.0, 3.0, "m")),
    task=lambda p: ctxval.Task([0.0, 0.0], goal=[p.goal, 0.0], horizon=40, dt=DT),
    system=system,
    model=model,
    synthesizer=controllers.LQR(Q=[10.0, 1.0], R=[0.1]),
    distance=distances.WholeTrajectory(norm=np.inf, components=[0]),  # the largest gap between the positions, in m
)
campaign = ctxval.Campaign(validation, seed=0).run(budget=25, threshold=0.5)

worst = campaign.worst
print(f"{campaign.executions} executions of the cart. The worst task: go to {worst.parameters['goal']:.2f} m.")
print(f"There the cart is up to {100 * worst.distance:.0f} cm from where the model said.\n")

for tolerance in (0.1, 0.5):
    print(f"May the model be trusted to {100 * tolerance:.0f} cm?")
    print(f"{campaign.verdict(threshold=tolerance)}\n")
