"""The paper's robotic arm (Sec. VI-B): two joints on a table in MuJoCo, and three models learned from the same data."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ctxval import (
    Array,
    Experiment,
    Parameters,
    Task,
    TaskSpace,
    Transitions,
    Validation,
    controllers,
    distances,
    grid_truth,
    models,
    systems,
)
from ctxval.errors import UnknownNameError

MODELS = ("fnn", "gp", "linear")
"""The paper's three: a feedforward network of 2 x 8 ReLU units, a Gaussian process, a linear model."""

# The values are those of Gymnasium's Reacher: the links' lengths, thickness and density (0.1 m each, the fingertip
# 0.01 m beyond), the joints' armature and damping, the elbow's range, the motors' gear and range, gravity, integrator
# and timestep. Reacher's walls and target are left out, because nothing touches them; the site marks its fingertip.
MJCF = """
<mujoco model="arm">
  <compiler angle="radian"/>
  <option timestep="0.01" integrator="RK4" gravity="0 0 -9.81"/>
  <default>
    <joint type="hinge" axis="0 0 1" armature="1" damping="1"/>
    <geom type="capsule" size="0.01" density="1000" contype="0" conaffinity="0"/>
    <motor gear="200" ctrllimited="true" ctrlrange="-1 1"/>
  </default>
  <worldbody>
    <body name="upper" pos="0 0 0.01">
      <joint name="shoulder" limited="false"/>
      <geom fromto="0 0 0 0.1 0 0"/>
      <body name="lower" pos="0.1 0 0">
        <joint name="elbow" limited="true" range="-3 3"/>
        <geom fromto="0 0 0 0.1 0 0"/>
        <geom type="sphere" pos="0.11 0 0"/>
        <site name="fingertip" pos="0.11 0 0"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor joint="shoulder"/><motor joint="elbow"/></actuator>
</mujoco>
"""

END_EFFECTOR = (4, 5)  #: indices of y and z in the state; these are the paper's names of the coordinates on the table


@dataclass(frozen=True)
class Settings:
    """Every free parameter of the case, with the reason for its value; the paper gives none of them."""

    #: MuJoCo steps in one control step; dt is 0.1 s, a tenth of the joints' time constant (armature over damping).
    #: Reacher's 20 ms would take five times as many steps, over which the network's errors add up.
    substeps: int = 10
    #: steps; in 1.5 s iLQR ends within 3 cm of the targets (median 8 mm) on a model without error. The exception are
    #: targets straight ahead (z = 0 exactly), for which the extended arm has no reason to bend to either side.
    horizon: int = 15
    #: m; the table in front of the arm. All of it is within the arm's reach of 0.21 m: the far corners are 0.206 m
    #: away. All of it is also at least 4 cm from the shoulder; the elbow's stops keep the fingertip out of that circle.
    #: So every target can be reached. Targets behind the shoulder would have no single best way.
    y: tuple[float, float] = (0.04, 0.18)
    z: tuple[float, float] = (-0.1, 0.1)
    position_weight: float = 1.0  #: weight of the end effector's deviation, 1/m^2; the task is about this deviation
    #: s^2/rad^2; small. Without it, passing the target at full speed would be as good as stopping there.
    rate_weight: float = 1e-3
    #: weight of the torque in units of the motors' 200 N m; with it at most an eighth of them is used, about as much as
    #: in the recordings
    torque_weight: float = 1.0
    final_position_weight: float = 10.0  #: weights of the last state, ten times those of the other states
    final_rate_weight: float = 1e-2
    #: largest number of iLQR iterations; on smooth models more iterations gain almost nothing, on the network they
    #: follow its kinks
    iterations: int = 15
    rollouts: int = 500  #: recorded for learning: 500 x 4 transitions from rest, 200 s in all
    steps: int = 4
    #: recorded torques are uniform within +-0.12 of the motors' range, which gives joint rates like those of the closed
    #: loop, 5 rad/s
    torque: float = 0.12
    #: rad; recordings start at any angle of the shoulder and at elbow angles within +-2.2. They cover the bent arm, and
    #: fewer than one in a hundred reaches the elbow's stops at 3 rad.
    elbow: float = 2.2
    points: int = 200  #: number of data points of the Gaussian process; with more points it is slower and more accurate
    #: number of trainings of the network, of which the best is kept, and largest number of iterations of one training
    restarts: int = 4
    training: int = 1000


def arm(settings: Settings) -> systems.MuJoCo:
    """Return the system, with the states (th1, th2, th1', th2', y, z) in rad, rad/s and m."""
    return systems.MuJoCo(MJCF, substeps=settings.substeps, sites=("fingertip",))


def record(system: systems.MuJoCo, settings: Settings, seed: int) -> Transitions:
    """Return transitions of the arm under seeded random torques, from rest in random configurations."""
    rng = np.random.default_rng(seed)
    bounds = np.array([np.pi, settings.elbow])
    start = system.state(rng.uniform(-bounds, bounds, (settings.rollouts, 2)))
    torques = rng.uniform(-settings.torque, settings.torque, (settings.steps, settings.rollouts, 2))
    return system.execute(lambda t, x: torques[t], Task(start, horizon=settings.steps, dt=system.dt)).transitions()


def learn(model: str, data: Transitions, settings: Settings, seed: int) -> models.Model:
    """Return one of the three models, learned from recorded transitions."""
    if model == "fnn":
        return models.FeedforwardReLU.fit(
            data, (8, 8), seed=seed, restarts=settings.restarts, iterations=settings.training
        )
    if model == "gp":
        return models.GaussianProcessModel.fit(data, settings.points, seed=seed)
    if model == "linear":
        return models.Linear.fit(data)
    raise UnknownNameError.among("model", model, MODELS)


def experiment(seed: int = 0, model: str = "fnn", settings: Settings | None = None) -> Experiment:
    """Return the case with one of the three models; the seed draws the data, which are the same for all models."""
    settings = Settings() if settings is None else settings
    system = arm(settings)
    rest = system.state([0.0, 0.0])  # extended along y
    rates, positions = settings.rate_weight, settings.position_weight
    final_rates, final_positions = settings.final_rate_weight, settings.final_position_weight

    def reach(p: Parameters) -> Task:
        return Task(rest, goal=[0.0, 0.0, 0.0, 0.0, p.y, p.z], horizon=settings.horizon, dt=system.dt)

    validation = Validation(
        space=TaskSpace(y=(*settings.y, "m"), z=(*settings.z, "m")),
        task=reach,
        system=system,
        model=learn(model, record(system, settings, seed), settings, seed),
        # The angles themselves have no weight, because the task prescribes only the position of the end effector.
        synthesizer=controllers.ILQR(
            [0.0, 0.0, rates, rates, positions, positions],
            [settings.torque_weight, settings.torque_weight],
            [0.0, 0.0, final_rates, final_rates, final_positions, final_positions],
            iterations=settings.iterations,
        ),
        distance=distances.FinalState(norm=2, components=END_EFFECTOR),
    )
    return Experiment(
        f"arm-{model}",
        validation,
        budget=50,
        threshold=0.03,
        truth=lambda: grid_truth(validation, per_axis=81, refinements=3),
        units="m",
        states=("shoulder [rad]", "elbow [rad]", "shoulder rate [rad/s]", "elbow rate [rad/s]", "y [m]", "z [m]"),
        inputs=("shoulder torque [200 N m]", "elbow torque [200 N m]"),
    )


@dataclass(frozen=True, eq=False)
class Aspects:
    """The final distances of the closed loops from their targets ``(N, 2)`` in m, the two aspects of Remark 1."""

    targets: Array
    model_error: Array  #: Aspect-1, the final distance of the model's end effector from its target, shape ``(N,)``, m
    system_error: Array  #: the same distance of the arm under the same controllers; NaN if the execution failed

    def __str__(self) -> str:
        return "; ".join(
            f"{name} {np.nanmedian(error):.4f} m (median), {np.nanmax(error):.4f} m (largest)"
            for name, error in (("model", self.model_error), ("system", self.system_error))
        )


def aspects(seed: int = 0, model: str = "fnn", settings: Settings | None = None, *, per_axis: int = 21) -> Aspects:
    """Return the final distances of model and arm from a grid of targets. S is executed for each target."""
    validation = experiment(seed, model, settings).validation
    targets = validation.space.grid(per_axis)
    task = validation.task(validation.space.parameters(targets))
    controller = validation.synthesizer.design(task, validation.model)
    miss = distances.GoalError(norm=2, components=END_EFFECTOR)
    promised = systems.Simulated(validation.model).execute(controller, task)
    executed = validation.system.execute(controller, task)
    return Aspects(targets, miss(promised, promised, task), miss(promised, executed, task))
