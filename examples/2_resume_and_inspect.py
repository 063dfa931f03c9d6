"""Stop a campaign, resume it from its file, and look at the task in which the model was most wrong."""

import tempfile
from pathlib import Path

from ctxval import Campaign, cases, searches

# The paper's running example: an inverted pendulum, and a linear model that was learned from it.
validation = cases.by_name("pendulum", seed=7).validation


def open_campaign(store):
    """Open the campaign in the file, or begin it: it is the same call."""
    return Campaign(validation, search=searches.GPUCB(), store=store, seed=7)


with tempfile.TemporaryDirectory() as folder:
    store = Path(folder) / "pendulum.sqlite"

    monday = open_campaign(store).run(budget=6)
    print(f"Monday: {monday.executions} executions, largest distance {monday.worst.distance:.2f}.")
    monday.store.close()

    # Every execution was stored as it ended, so only 9 of these 15 are left. The search goes on as if never stopped.
    tuesday = open_campaign(store)
    print(f"Tuesday: {tuesday.executions} executions are stored.")
    tuesday.run(budget=15)
    worst = tuesday.worst
    print(f"Tuesday: {tuesday.executions} executions, largest distance {worst.distance:.2f}.\n")

    print("trial  chosen as    goal [rad]  distance")
    for trial in sorted(tuesday.completed, key=lambda trial: -trial.distance)[:5]:
        print(f"{trial.number:5d}  {trial.origin:11s}  {trial.parameters['goal']:10.3f}  {trial.distance:8.3f}")

    nominal, happened = tuesday.trajectories(worst)
    print(f"\nThe worst task, trial {worst.number}: swing to {worst.parameters['goal']:.2f} rad.")
    print("time [s]  model [rad]  system [rad]")
    for t in range(0, len(nominal.times), 25):
        print(f"{nominal.times[t]:8.2f}  {nominal.states[t, 0]:11.3f}  {happened.states[t, 0]:12.3f}")
    tuesday.store.close()
