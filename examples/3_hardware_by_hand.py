"""Hardware that people operate: ask for a task and its controller, run the rig, tell what happened; also failures."""

import numpy as np

from ctxval import Campaign, Task, TaskSpace, Trajectory, Validation, controllers, distances, models, searches, systems

DT, STEPS = 0.1, 25

validation = Validation(
    space=TaskSpace(goal=(0.5, 2.0, "m"), load=(0.0, 2.0, "kg")),
    task=lambda p: Task([0.0, 0.0], goal=[p.goal, 0.0], horizon=STEPS, dt=DT),
    system=systems.Manual(states={"position": "m", "speed": "m/s"}, inputs={"force": "N"}, dt=DT),
    model=models.Linear(A=[[1.0, DT], [0.0, 1.0]], B=[[0.0], [DT]]),  # a slide of 1 kg without friction
    synthesizer=controllers.LQR(Q=[10.0, 1.0], R=[0.1], limits=5.0),
    distance=distances.FinalState(components=[0]),
)


def run_the_rig(controller, load, fuse):
    """Stand in for you and your rig: put the load on the slide, run the controller, record what happens."""
    if fuse == "weak" and load > 1.5:
        raise RuntimeError("the fuse has blown")
    states, inputs = [np.zeros(2)], []
    for t in range(STEPS):
        position, speed = states[-1]
        force = controller(t, states[-1])  # limited to 5 N
        inputs.append(force)
        acceleration = (force[0] - 0.3 * np.tanh(10 * speed)) / (1.0 + 0.2 * load)
        states.append(np.array([position + DT * speed, speed + DT * acceleration]))
    return Trajectory(DT * np.arange(STEPS + 1), np.array(states), np.array(inputs))


def execute(opened, fuse):
    """Carry out one trial and tell the campaign how it ended."""
    goal, load = (opened.trial.parameters[name] for name in ("goal", "load"))
    print(f"Trial {opened.number}: load {load:.2f} kg, go to {goal:.2f} m ... ", end="")
    try:
        recorded = run_the_rig(opened.plan.controller, load, fuse)
    except RuntimeError as error:
        campaign.tell(opened, failed=str(error))
        print(f"failed: {error}.")
    else:
        trial = campaign.tell(opened, recorded)
        print(f"{100 * trial.distance:.1f} cm from where the model said.")


campaign = Campaign(validation, search=searches.BayesianOptimisation(), seed=0)  # store="rig.sqlite" keeps it
heavy = {"goal": 1.0, "load": 2.0}
execute(campaign.ask(heavy), "weak")  # a task of your own choice
execute(campaign.ask(heavy, because="the fuse was replaced"), "strong")  # a failure counts until its cause is removed
for _ in range(6):
    execute(campaign.ask(), "strong")  # the search's choice

print(f"\nWorst: {100 * campaign.worst.distance:.1f} cm at {campaign.worst.parameters}.")
print(campaign.verdict(threshold=0.02))
