"""What a person sees at a prompt and in a notebook: short, informative, and safe whatever the content."""

from __future__ import annotations

import functools
import importlib
import inspect
import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ctxval
from conftest import make_validation
from ctxval import (
    Campaign,
    Comparison,
    Experiment,
    Labels,
    Normal,
    Store,
    Task,
    TaskSpace,
    Trajectory,
    Transitions,
    Trial,
    Truth,
    Validation,
    Verdict,
    certificates,
    comparison,
    controllers,
    data,
    distances,
    fitting,
    learning,
    models,
    refinement,
    replay,
    report,
    searches,
    systems,
)
from ctxval._util.describe import describe
from ctxval._util.representation import WIDTHS, ShortRepr, shown
from ctxval.certificates import Certificate, Sample
from ctxval.core.trial import Change
from ctxval.errors import InputError
from facts import assert_names, refuses
from faulty_rig import FaultyRig
from rig_thorough import some

PACKAGES = (
    "",
    ".searches",
    ".systems",
    ".models",
    ".controllers",
    ".distances",
    ".learning",
    ".certificates",
    ".data",
    ".studies.fitting",
    ".studies.comparison",
    ".studies.replay",
    ".testing",
    ".report",
    ".studies.refinement",
)

DATA = Transitions(np.linspace(-1, 1, 80).reshape(40, 2) ** 3, np.linspace(-5, 5, 40)[:, None] ** 2, np.zeros((40, 2)))

LINEAR = models.Linear([[1, 0.1], [0, 1]], [[0], [0.1]], data=DATA)
TASK = Task([1.0, 0.0], goal=[0.5, 0.0], horizon=25, dt=0.02)
PID = controllers.PID(2.0, [0.5], 1.0, limits=3.0)
BATCH = Task([np.zeros(3), 0.0], horizon=25, dt=0.02)
SPACE = TaskSpace(goal=(-3.0, np.pi, "rad"), offset=([0, 0], [1, 2], "m"), mass=(1, 2))
TRAJECTORY = Trajectory(TASK.times, np.linspace(-1, 2, 52).reshape(26, 2), np.zeros((25, 1)))
FAILED = Trial(3, "initial", "failed", np.array([0.5]), {"goal": 0.25}, 2, True, failure="motor stalled")
CERTIFICATE = Certificate("audit", "99 % of the tasks have at most 0.30004.", 0.30004, 0.95, 0.01, 300, ("a", "b"))


def policy(t: int, x: Any, task: Task) -> Any:
    return -x[..., :1]


def no_execution(controller: Any, task: Task) -> Any:
    raise RuntimeError("there is no robot here")


@functools.cache
def campaign() -> Campaign:
    return Campaign(make_validation(horizon=10), seed=1, name="pendulum").run(7, explore=True)


@functools.cache
def sample() -> Sample:
    return Sample.of(campaign().trials)


def network() -> bytes:
    """Return ``xu -> xu W`` as ONNX, from three numbers to two."""
    onnx = pytest.importorskip("onnx")
    pytest.importorskip("onnxruntime")
    double, helper = onnx.TensorProto.DOUBLE, onnx.helper
    graph = helper.make_graph(
        [helper.make_node("MatMul", ["xu", "W"], ["y"])],
        "network",
        [helper.make_tensor_value_info("xu", double, ["N", 3])],
        [helper.make_tensor_value_info("y", double, ["N", 2])],
        [onnx.numpy_helper.from_array(np.ones((3, 2)), "W")],
    )
    content: bytes = helper.make_model(
        graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8
    ).SerializeToString()
    return content


def fmu() -> systems.FMU:
    """Return an FMU of which only the settings are there."""
    made = object.__new__(systems.FMU)
    made.path, made.states, made.inputs = Path("/somewhere/cart.fmu"), {"position": "m", "speed": "m/s"}, {"force": "N"}
    made._digest = "0" * 16
    made.start, made.parameters, made.substeps = {"position": "x0"}, {"mass": 2.0}, 10
    return made


def gymnasium() -> systems.Gymnasium:
    pytest.importorskip("gymnasium")
    pytest.importorskip("mujoco")
    return systems.Gymnasium("InvertedPendulum-v5", max_episode_steps=-1)


BODY = '<body><joint name="hinge" axis="0 1 0"/><geom size="0.1"/></body>'
MJCF = f'<mujoco><worldbody>{BODY}</worldbody><actuator><motor joint="hinge"/></actuator></mujoco>'


def mujoco() -> systems.MuJoCo:
    pytest.importorskip("mujoco")
    return systems.MuJoCo(MJCF, substeps=5)


def pybullet() -> systems.PyBullet:
    pytest.importorskip("pybullet")
    return systems.PyBullet(MJCF, substeps=5)


def mpc() -> controllers.MPC:
    pytest.importorskip("casadi")
    return controllers.MPC([1, 1], [1], steps=10, limits=5.0)


def scikit_learn() -> models.ScikitLearn:
    linear_model = pytest.importorskip("sklearn.linear_model")
    return models.ScikitLearn.fit(linear_model.LinearRegression(), DATA)


def gaussian_process() -> models.GaussianProcessModel:
    covariance = models.SquaredExponential(2.0, np.array([0.5, 1.5, 3.0]))
    return models.GaussianProcessModel(covariance, np.zeros((4, 3)), np.zeros((4, 2)), models.IncrementScaling.of(DATA))


def neural_network() -> models.FeedforwardReLU:
    scaling = models.IncrementScaling.of(DATA)
    return models.FeedforwardReLU([np.ones((3, 8)), np.ones((8, 2))], [np.ones(8), np.ones(2)], scaling)


def diagnosis() -> certificates.Diagnosis:
    return certificates.Diagnosis(0.5, 4, 1.1, 0.2, None)


def nonlinear(x: Any, u: Any) -> Any:
    return LINEAR.step(x, u) + 0.05 * np.sin(2 * x)


@functools.cache
def learned() -> learning.LearnedDynamics:
    """Return what one execution teaches of a system that M does not explain."""
    found = Validation(
        space=TaskSpace(start=([-2.0, -1.0], [2.0, 1.0])),
        task=lambda p: Task(p.start, goal=[0.3, 0.0], horizon=10, dt=0.1),
        system=systems.Simulated(nonlinear, vectorized=True),
        model=models.Linear(LINEAR.A, LINEAR.B),
        synthesizer=controllers.LQR([1, 0.1], [0.1]),
        distance=distances.MeanDeviation(),
    )
    point = np.array([0.2, 0.7])
    taught = learning.DynamicsStudy(found).learn(
        [(point, found.outcome(found.space.from_unit(point)).system_trajectory)]
    )
    assert taught is not None
    return taught


@functools.cache
def predicted() -> learning.ExecutionPrediction:
    found = learned().predict(np.array([0.9, 0.1]))
    assert found is not None
    return found


def evidence() -> certificates.Evidence:
    return certificates.Evidence(
        np.linspace(0.9, 1, 40), np.zeros((40, 2)), 0.95, np.zeros((5, 2)), 9000, 4, 0.01, 1e-6, (CHECKED,), COVERED
    )


RECORDED = Transitions(DATA.x, DATA.u, nonlinear(DATA.x, DATA.u))
CHECKED = certificates.CheckedPrediction(3, 0.5, 0.52, 0.53, 0.5)
GAP = certificates.StateInputGap(0.1, ("u[0]",), {"x[0]": 1.0, "u[0]": 3.0})
COVERED = certificates.StateInputCoverage(GAP, GAP, None, {"x[0]": 0.1, "u[0]": 0.2}, np.zeros(2), 1024)
BY_POSTERIOR = certificates.CertificateOptions(certificates.DistanceBound())

LOG = data.MemoryTable(
    "run.csv", {"t": 0.1 * np.arange(41), "x": np.sin(np.arange(82)).reshape(41, 2), "u": np.ones(40)}
)
MAPPING = data.LogMapping({"x": data.Field("x", unit="m")}, {"force": data.Field("u")}, dt=0.1, delay=0.2)


def recordings() -> data.Recordings:
    return data.recordings_of([LOG])


@functools.cache
def compared() -> Comparison:
    one, other = (
        comparison.CandidateResult(name, 9, 2, 0, 0.1, {"goal": 0.5}, 0.12, 4, 0.05) for name in ("gp", "linear")
    )
    pair = comparison.PairResult("mean", "gp", "linear", "gp", "the interval excludes 0", -0.1, -0.2, -0.05, 9, 0.1)
    return Comparison((one, other), (pair,), 0.95, 18, 100, "m", ("the system does not change",))


@functools.cache
def replayed() -> replay.ReplayReport:
    return replay.replay(LINEAR, recordings(), steps=[1])


@functools.cache
def fitted() -> fitting.FitReport:
    rng = np.random.default_rng(0)
    columns = {"t": 0.1 * np.arange(41), "x": rng.normal(size=(41, 2)), "u": rng.normal(size=40)}
    return fitting.fit(data.recordings_of([data.MemoryTable("run.csv", columns)]), ["linear"], steps=[1])


CORRECTION = models.Correction(
    *(np.zeros(3), np.ones(3), np.zeros((4, 3)), np.ones(3), np.ones((4, 2)), np.zeros((4, 2))),
    *(-np.ones(3), np.ones(3), np.ones(3), np.ones(2)),
)
HELD_OUT = refinement.HeldOut(*(np.ones((60, 3)), *[np.full((60, 2), 0.1)] * 5))
RESIDUAL = refinement.measure_residual(HELD_OUT, {"x": "m", "v": "m/s"}, {"u": "N"})


@functools.cache
def refined() -> refinement.Refinement:
    """Return a refinement that ended at once, because its budget is spent."""
    return ctxval.refine(campaign(), 1e-9, campaign().executions)


EXAMPLES: dict[str, Callable[[], object]] = {
    "models.Corrected": lambda: models.Corrected(LINEAR, CORRECTION, data=DATA),
    "models.Correction": lambda: CORRECTION,
    "models.Refined": lambda: models.Refined(LINEAR, DATA, LINEAR),
    "studies.refinement.HeldOut": lambda: HELD_OUT,
    "studies.refinement.Learned": lambda: refinement.Learned(LINEAR, HELD_OUT),
    "studies.refinement.MeasuredResidual": lambda: RESIDUAL,
    "studies.refinement.ParameterFit": lambda: refinement.ParameterFit({"mass": (0.5, 2.0)}),
    "studies.refinement.Records": lambda: refinement.Records((TRAJECTORY,)),
    "studies.refinement.Refinement": refined,
    "studies.refinement.Refit": lambda: refinement.Refit("linear"),
    "studies.refinement.ResidualCorrection": refinement.ResidualCorrection,
    "studies.refinement.ResidualRegion": lambda: RESIDUAL.whole,
    "studies.refinement.Round": lambda: refined().last,
    "studies.refinement.UserFit": lambda: refinement.UserFit(models.Linear.fit),
    "Campaign": campaign,
    "Comparison": compared,
    "Experiment": lambda: Experiment("pendulum", make_validation(), threshold=0.5, units="rad"),
    "Labels": lambda: Labels(("angle [rad]", "rate [rad/s]"), ("torque [N m]",), "rad"),
    "OpenTrial": lambda: Campaign(make_validation()).ask({"goal": 0.5}),
    "Outcome": lambda: make_validation().outcome([0.5]),
    "Parameters": lambda: SPACE.parameters([1, 2, 3, 4]),
    "Plan": lambda: make_validation().plan([0.5]),
    "Store": lambda: campaign().store,
    "Normal": lambda: Normal(0.0, [0.3, 0.5]),
    "Task": lambda: TASK,
    "TaskSpace": lambda: SPACE,
    "Trajectory": lambda: TRAJECTORY,
    "Transitions": lambda: DATA,
    "Trial": lambda: FAILED,
    "Truth": lambda: Truth(0.321, SPACE.parameters([1, 2, 3, 4]), "dense grid of 2,001 points, refined 6 times"),
    "Validation": make_validation,
    "Verdict": lambda: Verdict("falsified", 0.5, "trial 3 was executed.", FAILED, CERTIFICATE),
    "searches.Auto": searches.Auto,
    "searches.BayesianOptimisation": searches.BayesianOptimisation,
    "searches.CMAES": searches.CMAES,
    "searches.Costs": lambda: searches.Costs(0.01, 2.0),
    "searches.GPUCB": searches.GPUCB,
    "searches.Prediction": lambda: searches.Prediction(lambda points: (points, points), lambda rows: rows, 150),
    "searches.Random": searches.Random,
    "searches.SamplingDiscarding": searches.SamplingDiscarding,
    "searches.TrustRegion": searches.TrustRegion,
    "systems.FMU": fmu,
    "systems.Function": lambda: systems.Function(no_execution),
    "systems.Gymnasium": gymnasium,
    "systems.Manual": lambda: systems.Manual(states={"angle": "rad"}, inputs={"torque": "N m"}, dt=0.02),
    "systems.MuJoCo": mujoco,
    "systems.PyBullet": pybullet,
    "systems.Simulated": lambda: systems.Simulated(LINEAR),
    "systems.Subprocess": lambda: systems.Subprocess([sys.executable, "a b.py"], timeout=2.0),
    "models.FeedforwardReLU": neural_network,
    "models.Function": lambda: models.Function(lambda x, u: x),
    "models.GaussianProcessModel": gaussian_process,
    "models.IncrementScaling": lambda: models.IncrementScaling.of(DATA),
    "models.Linear": lambda: LINEAR,
    "models.MuJoCo": lambda: models.MuJoCo(MJCF),
    "models.Onnx": lambda: models.Onnx(network()),
    "models.Parametric": lambda: models.Parametric(lambda x, u, theta: x, {"mass": 1.2, "friction": 0.3}),
    "models.ScikitLearn": scikit_learn,
    "models.SquaredExponential": lambda: models.SquaredExponential(2.0, np.arange(1.0, 9.0)),
    "controllers.AffineFeedback": lambda: controllers.LQR([1, 1], [1], limits=2.0).design(TASK, LINEAR),
    "controllers.BoundPolicy": lambda: controllers.OnnxPolicy(network()).design(TASK, LINEAR),
    "controllers.ControllerFile": lambda: controllers.ControllerFile(
        controllers.LQR([1, 1], [1]).design(TASK, LINEAR), 0.02, {"x0": "m", "x1": "m/s"}, {"u0": "N"}
    ),
    "controllers.ControllerRun": lambda: controllers.started(PID.design(TASK, LINEAR), TASK),
    "controllers.ILQR": lambda: controllers.ILQR([1, 1], [1]),
    "controllers.ILQRSolution": lambda: controllers.ILQR([1, 1], [1]).solve(BATCH, LINEAR),
    "controllers.LQR": lambda: controllers.LQR([1, 0.1], [0.01], limits=controllers.Limits([-1], [2])),
    "controllers.Limits": lambda: controllers.Limits(-np.inf, [1.0, 2.0]),
    "controllers.MPC": mpc,
    "controllers.OnnxPolicy": lambda: controllers.OnnxPolicy(network(), scale=5.0),
    "controllers.PID": lambda: PID,
    "controllers.PIDFeedback": lambda: PID.design(TASK, LINEAR),
    "controllers.Policy": lambda: controllers.Policy(policy, limits=2.0),
    "controllers.RecedingHorizon": lambda: mpc().design(TASK, LINEAR),
    "controllers.StationaryLQR": lambda: controllers.StationaryLQR([[2, 1], [1, 2]], [1]),
    "distances.AtCrossing": lambda: distances.AtCrossing(state=1, level=0.5, scales=[0.1, 2.0]),
    "distances.AtTimes": lambda: distances.AtTimes(times=[0.1, 0.2]),
    "distances.CrossingTime": distances.CrossingTime,
    "distances.FinalState": distances.FinalState,
    "distances.GoalError": distances.GoalError,
    "distances.TrackingError": distances.TrackingError,
    "distances.MaximumDeviation": distances.MaximumDeviation,
    "distances.MeanDeviation": distances.MeanDeviation,
    "distances.RelativeDeviation": lambda: distances.RelativeDeviation(least=[0.1, 1.0]),
    "distances.StateNorm": lambda: distances.StateNorm(2, weights=[1.0, 2.0], angles=[0]),
    "distances.WholeTrajectory": distances.WholeTrajectory,
    "learning.DynamicsDraws": lambda: learned().posterior.mean,
    "learning.DynamicsPosterior": lambda: learned().posterior,
    "learning.DynamicsStudy": lambda: learned().study,
    "learning.ExecutionPrediction": predicted,
    "learning.LearnedDynamics": learned,
    "learning.PosteriorSettings": learning.PosteriorSettings,
    "learning.PredictionScore": lambda: learning.PredictionScore(1.5, 0.35, 0.98),
    "learning.Replay": lambda: learning.Replay(TASK, None, 0.5),
    "report.Axis": lambda: report.Axis("goal [rad]", 0.0, 3.0),
    "report.Chart": lambda: report.Chart("Distance", report.Axis("goal", 0.0, 3.0), report.Axis("distance", 0.0, 1.0)),
    "report.Finding": lambda: report.Finding("Goals of M", "good", "M reaches its goals.", {"missed": 0}),
    "report.ReportContext": lambda: report.context_of_campaign(campaign()),
    "certificates.Assessment": lambda: certificates.assess(campaign().trials, BY_POSTERIOR),
    "certificates.AnytimeAudit": certificates.AnytimeAudit,
    "certificates.Audit": certificates.Audit,
    "certificates.Automatic": certificates.Automatic,
    "certificates.Certificate": lambda: CERTIFICATE,
    "certificates.CertificateOptions": lambda: BY_POSTERIOR,
    "certificates.CheckedPrediction": lambda: CHECKED,
    "certificates.Dynamics": certificates.Dynamics,
    "certificates.Evidence": evidence,
    "certificates.Neighbour": lambda: certificates.Neighbour(Path("other.sqlite")),
    "certificates.DistanceBound": certificates.DistanceBound,
    "certificates.Provenance": lambda: certificates.Provenance(remarks=("fuse replaced",)),
    "certificates.SamplingDiscarding": lambda: certificates.SamplingDiscarding(2),
    "certificates.Scenario": certificates.Scenario,
    "certificates.StateInputCoverage": lambda: COVERED,
    "certificates.StateInputGap": lambda: GAP,
    "certificates.UnsampledParameter": lambda: certificates.UnsampledParameter("load", 0.4, np.zeros(2)),
    "certificates.StoppingDecision": lambda: certificates.StoppingDecision(next_point=np.zeros(3)),
    "certificates.StoppingRule": lambda: certificates.StoppingRule(0.5),
    "certificates.Diagnosis": diagnosis,
    "certificates.Forecast": lambda: certificates.Forecast(12, 0.75),
    "certificates.RecoveredFailure": lambda: certificates.RecoveredFailure(3, 7, "fuse replaced"),
    "certificates.Maxima": lambda: certificates.draw_maxima(sample(), draws=12, paths=4),
    "certificates.Sample": sample,
    "certificates.Verdict": lambda: certificates.judge(
        campaign().trials, 0.01, certificates.CertificateOptions(certificates.DistanceBound())
    ),
    "data.Break": lambda: data.Break("run.csv", 0.5, 0.2, "angle", "has no value in row 7"),
    "data.Channel": lambda: data.Channel("angle", "rad", False, np.arange(9.0), np.arange(9.0)),
    "data.Clock": data.Clock,
    "data.Field": lambda: data.Field("/joints.position[0]", unit="rad", recorded="deg"),
    "data.LogMapping": lambda: MAPPING,
    "data.MemoryTable": lambda: LOG,
    "data.Message": lambda: data.Message("/joints", 10**18, 10**18, {"position": [0.5]}),
    "data.Recording": lambda: recordings().runs[0],
    "data.Recordings": recordings,
    "data.Signal": lambda: data.Signal(np.arange(9.0), np.zeros((9, 2))),
    "data.Table": lambda: data.Table("run.csv", ("t", "x"), lambda names: dict.fromkeys(names, np.arange(9.0))),
    "studies.fitting.FailedFit": lambda: fitting.FailedFit("linear", "too few steps"),
    "studies.fitting.FitReport": fitted,
    "studies.fitting.FittedModel": lambda: fitted().fitted[0],
    "studies.fitting.FittedParameter": lambda: fitting.FittedParameter("mass", 1.2, 1.1, 1.3, "at its upper bound"),
    "studies.comparison.CandidateResult": lambda: compared().candidates[0],
    "studies.comparison.Comparison": compared,
    "studies.comparison.PairResult": lambda: compared().pairs[0],
    "studies.replay.PredictedTask": lambda: replay.PredictedTask({"goal": 1.5}, 0.4, 0.3, 0.6, 0.9),
    "studies.replay.PredictedTasks": lambda: replay.PredictedTasks((), 0.4, 0.6, (), 64, 0.0, 0.1, 1),
    "studies.replay.RecordedData": lambda: replayed().data,
    "studies.replay.RegionalError": lambda: replayed().regions[0],
    "studies.replay.ReplayReport": lambda: replayed(),
    "studies.replay.ResidualShare": lambda: replayed().residuals[0],
    "studies.replay.StepError": lambda: replayed().errors[0],
    "studies.replay.Suggestion": lambda: replay.Suggestion("delay", 0.04, 0.5, "the inputs act later"),
}

INSIDE: dict[str, Callable[[], object]] = {
    "a surrogate": lambda: campaign().surrogate(),
    "a search that was told values": lambda: campaign().search,
    "a bound policy": lambda: controllers.Policy(policy).design(TASK, LINEAR),
    "a change of a store": lambda: Change("accepted", "same code", {"differences": ["model"], "trials": 3}),
    "hyperparameters": lambda: certificates.draw_maxima(sample(), draws=12, paths=4).conditioned[0],
    "an ONNX network": lambda: models.Onnx(network()).network,
    "the weights of LQR": lambda: controllers.LQR([1, 1], [1]).cost,
}


def public_classes() -> Iterator[tuple[str, type]]:
    """Yield the classes that users make or are given, without protocols, exceptions and abstract bases."""
    for package in PACKAGES:
        module = importlib.import_module(f"ctxval{package}")
        for name in getattr(module, "__all__", [name for name in vars(module) if name[0] != "_"]):
            found = getattr(module, name)
            alias = inspect.isclass(found) and found.__name__ != name
            own = (
                inspect.isclass(found)
                and not alias
                and (hasattr(module, "__all__") or found.__module__ == module.__name__)
            )
            if own and not (getattr(found, "_is_protocol", False) or inspect.isabstract(found)):
                yield f"{package}.{name}".lstrip("."), found


CLASSES = dict(public_classes())


def require_readable(text: str) -> None:
    """Check what holds for every object, whatever is in it."""
    first, *rest = text.splitlines()
    assert len(first) <= WIDTHS.call
    assert len(rest) <= 1  # what a verdict rests on
    assert sum(map(len, rest)) <= 332
    assert " at 0x" not in text
    assert "array(" not in text
    assert text.replace("\n", "").isprintable()


def test_every_example_is_of_a_public_class() -> None:
    assert set(EXAMPLES) <= set(CLASSES)


def test_a_dataclass_shows_its_fields() -> None:
    @dataclass
    class Report(ShortRepr):
        name: str
        values: Any = None
        note: str = ""

    assert repr(Report("a")) == "Report(name='a')"
    assert repr(Report("a", np.eye(2))) == "Report(name='a', values=diag(1, 1))"
    long = Report("a" * 500, "c" * 500, "b" * 500)
    require_readable(repr(long))


@pytest.mark.slow
@pytest.mark.parametrize("name", some(sorted(EXAMPLES), 2))
def test_public_objects_show_themselves_in_a_line(name: str) -> None:
    found = EXAMPLES[name]()
    assert type(found) is CLASSES[name]
    assert repr(found).startswith(name.rpartition(".")[2])
    require_readable(repr(found))


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(INSIDE))
def test_what_is_inside_them_does_so_too(name: str) -> None:
    found = INSIDE[name]()
    assert repr(found).startswith(type(found).__name__)
    require_readable(repr(found))


EXACT = {
    "Parameters": "Parameters(goal=1 rad, offset=[2, 3] m, mass=4)",
    "Store": "Store(in memory, trials=7, open=0)",
    "Task": "Task(initial_state=[1, 0], goal=[0.5, 0], horizon=25, dt=0.02)",
    "TaskSpace": "TaskSpace(goal=(-3, 3.142, 'rad'), offset=([0, 0], [1, 2], 'm'), mass=(1, 2))",
    "Trajectory": "Trajectory(25 steps in 0.5 s, 'complete', states=(26, 2) in [-1, 2], inputs=(25, 1) all 0)",
    "Transitions": "Transitions(x=(40, 2) in [-1, 1], u=(40, 1) in [0.01644, 25], x_next=(40, 2) all 0)",
    "Trial": "Trial(3, origin='initial', state='failed', attempts=2, parameters={'goal': 0.25}, "
    "failure='motor stalled')",
    "systems.FMU": "FMU(path='/somewhere/cart.fmu', states={'position': 'm', 'speed': 'm/s'}, inputs={'force': 'N'}, "
    "start={'position': 'x0'}, parameters={'mass': 2}, substeps=10)",
    "systems.Simulated": "Simulated(model=Linear(A=(2, 2) in [0, 1], B=(2, 1) in [0, 0.1], c=[0, 0], "
    "data=Transitions(x=(40, 2) in [-1, 1], u=(40, 1) in [0.01644, 25], x_next=(40, 2) all 0)))",
    "controllers.AffineFeedback": "AffineFeedback(gains=(25, 1, 2) in [-1.595, 0], inputs=(25, 1) in [0, 0.4234], "
    "states=(25, 2) all 0, limits=Limits(low=[-2], high=[2]))",
    "controllers.LQR": "LQR(cost=QuadraticCost(Q=diag(1, 0.1), R=diag(0.01), Q_final=diag(1, 0.1)), "
    "limits=Limits(low=[-1], high=[2]))",
    "controllers.Policy": "Policy(policy=policy, batched=True, limits=Limits(low=-2, high=2))",
    "certificates.Certificate": "Certificate('audit', upper_bound=0.3001, confidence=0.95, volume=0.01, trials=300)",
    "Verdict": "Verdict('falsified', threshold=0.5, reason=trial 3 was executed.)",
}


@pytest.mark.parametrize("name", sorted(EXACT))
def test_what_is_shown_says_what_matters(name: str) -> None:
    assert repr(EXAMPLES[name]()) == EXACT[name]


def test_a_validation_shows_its_parts() -> None:
    space = "TaskSpace(goal=(-3, 3, 'rad'))"
    parts = "system=Simulated, model=Linear, synthesizer=LQR, distance=FinalState"
    assert repr(make_validation()) == f"Validation({space}, {parts})"


@pytest.mark.slow
def test_a_campaign_shows_how_far_it_is() -> None:
    worst = campaign().worst
    assert worst is not None
    facts = f"name='pendulum', seed=1, trials=7, worst={worst.distance:.4g}, store=Store("
    assert repr(campaign()).startswith(f"Campaign(TaskSpace(goal=(-3, 3, 'rad')), {facts}")


def test_a_search_shows_what_it_was_told() -> None:
    search = searches.Random()
    assert repr(search) == "Random()"
    search.reset(2, 0)
    assert repr(search) == "Random(dimension=2, points=0)"
    search.tell([[0.1, 0.2], [0.3, 0.4]], [1.23456, np.nan])
    assert repr(search) == "Random(dimension=2, points=2, largest=1.235)"


def test_a_store_that_is_closed_says_that_it_cannot_be_read(tmp_path: Path) -> None:
    store = Store(tmp_path / "a.sqlite")
    assert repr(store).endswith("a.sqlite', trials=0, open=0)")
    store.close()
    assert_names(repr(store), "a.sqlite")


def test_arrays_that_are_not_finite_say_so() -> None:
    broken = Trajectory(TASK.times, np.full((26, 2), np.nan), np.r_[np.nan, np.arange(24.0)][:, None], "fell over")
    assert_names(repr(broken), 0.5, "fell over", (26, 2), (25, 1))


# Hostile content

HOSTILE = "<img src=x onerror=alert(1)>\x1b[31m\u202e\r\n\t'\"&" + "A" * 1_000_000


class Endless:
    def __repr__(self) -> str:
        return "\x1b]0;" + "B" * 1_000_000


class Broken:
    def __repr__(self) -> str:
        raise RuntimeError("no")


class Addressed:
    """Shown as Python shows it by default, with its address."""

    def execute(self, controller: Any, task: Task) -> Trajectory:
        raise NotImplementedError


def hostile_certificate() -> Certificate:
    return Certificate(HOSTILE, HOSTILE, 1.0, 0.95, 0.0, 3, (HOSTILE,) * 100, {HOSTILE: HOSTILE}, HOSTILE)


def hostile_trial() -> Trial:
    at = {HOSTILE: 0.5, **{f"p{i}": [0.1] * 1000 for i in range(1000)}}
    texts: dict[str, Any] = {"failure": HOSTILE, "note": {HOSTILE: HOSTILE}, "because": HOSTILE}
    return Trial(3, "initial", "failed", np.zeros(1), at, **texts)


def hostile_validation() -> ctxval.Validation:
    space = TaskSpace(**{HOSTILE: (0, 1, HOSTILE)}, wide=([0] * 1000, [1] * 1000, HOSTILE))
    search = functools.partial(policy, task=None)
    return ctxval.Validation(
        space=space,
        task=lambda p: TASK,
        system=Addressed(),
        model=LINEAR,
        synthesizer=controllers.Policy(search),
        distance=distances.FinalState(components=tuple(range(10_000))),
    )


ATTACKS: dict[str, Callable[[], object]] = {
    "trial": hostile_trial,
    "change": lambda: Change("accepted", HOSTILE, {HOSTILE: [HOSTILE] * 1000}),
    "certificate": hostile_certificate,
    "verdict": lambda: Verdict("falsified", 1.0, HOSTILE, hostile_trial(), hostile_certificate(), rests_on=HOSTILE),
    "validation": hostile_validation,
    "experiment": lambda: Experiment(HOSTILE, hostile_validation(), units=HOSTILE),
    "campaign": lambda: Campaign(hostile_validation(), name=HOSTILE),
    "many parameters": lambda: TaskSpace(**{f"parameter_{i}": (0, 1, "rad") for i in range(10_000)}),
    "trajectory": lambda: Trajectory(TASK.times, np.zeros((26, 2)), np.zeros((25, 1)), HOSTILE),
    "truth": lambda: Truth(1.0, SPACE.parameters([1, 2, 3, 4]), HOSTILE),
    "made good": lambda: certificates.RecoveredFailure(1, 2, HOSTILE),
    "diagnosis": lambda: certificates.Diagnosis(0.0, 1, 1.0, 1.0, "far_task", HOSTILE),
    "manual": lambda: systems.Manual(states={"x": HOSTILE}, inputs={}, dt=1.0),
    "command": lambda: systems.Subprocess([sys.executable, HOSTILE], timeout=1.0),
    "model": lambda: models.Function(type(HOSTILE, (), {"__call__": policy})()),
    "class": lambda: type(HOSTILE, (searches.Random,), {})(),
}


@pytest.mark.parametrize("name", sorted(ATTACKS))
def test_hostile_content_is_shortened_and_made_visible(name: str) -> None:
    require_readable(repr(ATTACKS[name]()))


def test_values_of_other_people_are_shown_by_name_if_they_say_nothing_readable() -> None:
    assert shown(Broken()) == "Broken"
    assert shown(Addressed()) == "Addressed"
    assert shown([np.arange(3), lambda: None]).endswith("<lambda>]")
    assert shown(Endless()).startswith("\\x1b]0;BBB")
    assert len(shown(Endless())) < 200


def test_collections_are_shown_by_their_first_items() -> None:
    endless: list[Any] = []
    endless.append(endless)
    assert shown(endless) == "[[[list of 1]]]"
    assert shown(list(range(1000))) == "[0, 1, 2, 3, 4, 5, ... 994 more]"
    assert shown({"a": (1.23456, None), "b": "c"}) == "{'a': (1.235, None), 'b': 'c'}"
    assert shown((1,)) == "(1,)"
    assert shown(b"abc") == "3 bytes"
    assert shown(functools.partial(policy, 1)) == "partial(policy)"
    assert shown(10**5000) == "2**16609..."
    assert shown(np.float64(2.0)) == "2"
    assert shown(np.array(["a"])) == "(1,)"
    assert shown(np.array([True, False])) == "[True, False]"


@pytest.mark.slow
@pytest.mark.thorough
def test_what_identifies_an_object_in_a_store_does_not_depend_on_what_it_shows(monkeypatch: pytest.MonkeyPatch) -> None:
    names = [name for name in EXAMPLES if name not in ("Campaign", "Store", "OpenTrial")]
    objects = {name: EXAMPLES[name]() for name in names}
    objects["in an array"] = np.array([controllers.Limits(-1, 1.00001), {"a": LINEAR}], dtype=object)
    before = {name: json.dumps(describe(found)) for name, found in objects.items()}

    def refuse(self: object) -> str:
        raise AssertionError("a description asked what an object shows")

    for cls in CLASSES.values():
        monkeypatch.setattr(cls, "__repr__", refuse)
    assert {name: json.dumps(describe(found)) for name, found in objects.items()} == before
    assert "1.00001" in before["in an array"]


# Tables of pandas


def test_trials_become_a_table_of_pandas() -> None:
    pytest.importorskip("pandas", reason="pandas is not installed")
    plane = ctxval.Validation(
        space=TaskSpace(goal=(-1.0, 1.0, "rad"), distance=([0, 0], [1, 1], "m")),
        task=lambda p: Task([p.goal, 0.0], horizon=5, dt=0.1),
        system=FaultyRig(systems.Simulated(LINEAR), {1: "raise"}),
        model=models.Linear(LINEAR.A, 0.9 * LINEAR.B),
        synthesizer=controllers.LQR([1, 1], [1]),
        distance=distances.FinalState(),
    )
    run = Campaign(plane, search=searches.Random()).run(3)
    run.ask({"goal": 0.25, "distance": [0.5, 1.0]})
    frame = run.to_dataframe()
    assert list(frame.columns[:6]) == ["number", "origin", "state", "goal", "distance[0]", "distance[1]"]
    assert list(frame.columns[6:]) == ["distance", "seconds", "attempts", "failure"]
    assert list(frame["number"]) == [0, 1, 2, 3]
    assert list(frame["state"]) == ["completed", "failed", "completed", "open"]
    assert list(frame["distance"].isna()) == [False, True, False, True]
    assert frame["distance"].max() == run.worst.distance  # type: ignore[union-attr]
    assert frame.loc[3, ["goal", "distance[0]", "distance[1]"]].tolist() == [0.25, 0.5, 1.0]
    assert_names(frame.loc[1, "failure"], "RuntimeError")
    assert frame["failure"].isna().tolist() == [True, False, True, True]


def test_a_table_without_trials_has_its_columns_and_parameters_keep_apart() -> None:
    pytest.importorskip("pandas", reason="pandas is not installed")
    from ctxval.campaign.display import to_dataframe

    frame = to_dataframe([], TaskSpace(distance=(0, 1), goal=(0, 1)))
    assert list(frame.columns)[3:6] == ["parameters.distance", "goal", "distance"]
    assert frame.shape == (0, 9)
    assert frame["goal"].dtype == np.float64


def test_a_missing_pandas_is_an_input_error_with_the_command(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pandas", None)
    with refuses(InputError, "trials", "pandas"):
        campaign().to_dataframe()


def test_showing_objects_loads_neither_pandas_nor_matplotlib() -> None:
    code = (
        "import sys, ctxval; from ctxval import cases; "
        "campaign = ctxval.Campaign(cases.by_name('pendulum').validation); "
        "repr(campaign); print({'pandas', 'matplotlib'} & set(sys.modules))"
    )
    output = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert output.strip() == "set()"
