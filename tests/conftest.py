"""What several tests share: small experiments on the pendulum."""

from __future__ import annotations

import functools
import itertools
import os
import shutil
import signal
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

# Before numpy is imported: small algebra is faster on one thread.
os.environ.setdefault("OMP_NUM_THREADS", "1")
# Tests start hundreds of processes, which would each compile the package again.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
# Each trial waits until the disk has its store. Where a folder in memory has space, that takes no time.
if os.access("/dev/shm", os.W_OK) and shutil.disk_usage("/dev/shm").free > 2**31:
    os.environ.setdefault("PYTEST_DEBUG_TEMPROOT", "/dev/shm")

import numpy as np
import pytest
import typer.main
from hypothesis import settings

from ctxval import Task, TaskSpace, Transitions, Validation, controllers, distances, models, systems
from ctxval.campaign.thinking import CampaignThinking
from ctxval.certificates import (
    CheckedPrediction,
    Evidence,
    Learned,
    StateInputCoverage,
    StateInputGap,
)
from ctxval.core.controller import Controller
from ctxval.core.model import Model
from ctxval.paper.cases import pendulum
from small_searches import run_few_loops, take_few_draws

# A shell starts what is in the background deaf to Ctrl-C, and tests may run there.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

pytest_plugins = ["browser", "pytester"]
"""Fixtures that tests of several folders use."""

settings.register_profile("short", deadline=None, derandomize=True, max_examples=12)
settings.register_profile("thorough", deadline=None, derandomize=True, max_examples=300)
settings.load_profile("short")


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--thorough", action="store_true", help="what `make thorough` runs: more seeds and sizes")
    parser.addoption("--manual", help="a folder with the built manual, whose pages are checked")
    parser.addoption("--kills", type=int, default=1, help="how many campaigns are killed and resumed")
    parser.addoption("--switches", type=int, default=1, help="how often two processes on one store are switched")


@pytest.fixture(autouse=True)
def _unlimited_thinking(monkeypatch: pytest.MonkeyPatch) -> None:
    """Lift the default limit of thinking: no test may depend on the speed of the machine."""
    limited = CampaignThinking.limited
    monkeypatch.setattr(
        CampaignThinking, "limited", lambda self, stated: limited(self, np.inf if stated is None else stated)
    )


TESTS = Path(__file__).parent
IN_FULL = ("certificates", "gp", "learning", "searches")
"""Folders whose subject are the draws and the closed loops."""
LONGEST = ("test_page_in_browser.py", "test_recipes.py", "test_report_browser.py", "test_clusters.py")

get_group = typer.main.get_group
groups: dict[tuple[int, int], Any] = {}


def get_group_once(app: typer.Typer) -> Any:
    """Return the commands of an application, which typer would put together again for each call of the tests."""
    key = id(app), len(app.registered_commands)
    if key not in groups:
        group = get_group(app)
        groups[key] = group, [*group.params]
    group, parameters = groups[key]
    group.params = [*parameters]  # typer 0.15 adds those of completion each time
    return group


typer.main.get_group = get_group_once

STATE = "LOCALAPPDATA" if os.name == "nt" else "XDG_STATE_HOME"
"""The variable that says where the user's key is."""


def pytest_configure(config: pytest.Config) -> None:
    """Keep the user's key out of the real home, also in processes whose environment is taken before a test begins."""
    folder = tempfile.TemporaryDirectory()
    os.environ[STATE] = folder.name
    config.add_cleanup(folder.cleanup)
    settings.load_profile("thorough" if config.getoption("thorough") else "short")


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers() -> int | None:
    """Use one process more than there are cores, because some tests wait for processes and browsers."""
    return None if "PYTEST_XDIST_AUTO_NUM_WORKERS" in os.environ else (os.cpu_count() or 1) + 1


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Put the longest tests first, and leave out those that only `make thorough` runs."""
    # The longest ones first: otherwise one process still has them if the others have nothing left.
    items.sort(key=lambda item: item.path.name not in LONGEST)
    if not config.getoption("thorough"):
        left_out = [item for item in items if item.get_closest_marker("thorough")]
        config.hook.pytest_deselected(items=left_out)
        items[:] = [item for item in items if not item.get_closest_marker("thorough")]


@functools.cache
def recorded_swings() -> Transitions:
    """Return the data of the model, which many tests learn again."""
    return pendulum.record(pendulum.Pendulum(), pendulum.Settings(), seed=1)


def make_validation(
    system: object = None, model: object = None, distance: object = None, horizon: int = 25
) -> Validation:
    """Return a short pendulum validation, with parts replaced."""
    settings_ = pendulum.Settings(horizon=horizon)
    rod = pendulum.Pendulum()
    step = systems.rk4(rod.derivative, settings_.dt)
    return Validation(
        space=TaskSpace(goal=(-3.0, 3.0, "rad")),
        task=lambda p: Task([np.pi, 0.0], goal=[p.goal, 0.0], horizon=horizon, dt=0.02),
        system=system or systems.Simulated(step, vectorized=True),
        model=model or models.Linear.fit(recorded_swings()),
        synthesizer=controllers.LQR([1.0, 0.1], [1e-2], [10.0, 1.0]),
        distance=distance or distances.FinalState(norm=1),
    )


@dataclass(frozen=True)
class NoInput:
    """Designs the controllers of systems without inputs."""

    batched: bool = True

    def design(self, task: Task, model: Model) -> Controller:
        return lambda t, x: np.empty((*np.shape(x)[:-1], 0))


def make_validation_without_inputs(batched: bool = True) -> Validation:
    """Return a validation of an autonomous linear system against a linear model, whose tasks are initial states."""
    A, M = np.array([[0.97, 0.1], [-0.12, 0.9]]), np.array([[0.95, 0.1], [-0.1, 0.9]])
    return Validation(
        space=TaskSpace(a=(0.0, 1.0), b=(0.5, 1.0)),
        task=lambda p: Task(np.stack([p.a, p.b], axis=-1), goal=[0.0, 0.0], horizon=20, dt=0.1),
        system=systems.Simulated(lambda x, u: x @ A.T, vectorized=True),
        model=models.Function(lambda x, u: x @ M.T, vectorized=True),
        synthesizer=NoInput(batched),
        distance=distances.MaximumDeviation(),
    )


def evidence_on(d: int) -> Learned:
    """Return evidence on tasks of d parameters that opens no check, with 2000 draws of d* between 2 and 3."""
    rng = np.random.default_rng(4)
    gap = StateInputGap(0.01, ("x[0]",), {"x[0]": 0.0})
    covered = StateInputCoverage(gap, gap, gap, {"x[0]": 0.1}, rng.random(d), 99)
    tasks = [(k / 9,) * d for k in range(1, 9)]
    checked = tuple(
        CheckedPrediction(k, 0.5, 1.0, 1.2, 1.0, origin="spread", point=task) for k, task in enumerate(tasks)
    )
    drawn, local_maxima = rng.random((2000, d)), rng.random((3, d))
    evidence = Evidence(np.linspace(2, 3, 2000), drawn, 1.9, local_maxima, 999, 5, 0.0, 0.0, checked, covered)
    return Learned(evidence)


def interrupt_at_once() -> None:
    """Do what a person does who presses Ctrl-C twice."""
    signal.raise_signal(signal.SIGINT)
    signal.raise_signal(signal.SIGINT)


@pytest.fixture(scope="session")
def state_folders(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Folders, one for each test; pytest would look through all earlier ones to number the next."""
    root = tmp_path_factory.mktemp("state")
    return (root / str(number) for number in itertools.count())


@pytest.fixture(autouse=True)
def state_folder(state_folders: Iterator[Path], monkeypatch: pytest.MonkeyPatch) -> Path:
    """Give each test a user who has allowed nothing yet."""
    folder = next(state_folders)
    folder.mkdir()
    monkeypatch.setenv(STATE, str(folder))
    return folder


@pytest.fixture
def validation() -> Validation:
    return make_validation()


@pytest.fixture(scope="session", autouse=True)
def smaller() -> Iterator[pytest.MonkeyPatch]:
    """Take few draws of d* and of the learned dynamics, and run few closed loops on them, unless a test undoes it."""
    with pytest.MonkeyPatch.context() as patch:
        make_smaller(patch)
        yield patch


def make_smaller(patch: pytest.MonkeyPatch) -> None:
    take_few_draws(patch.setattr)
    run_few_loops(patch.setattr)


def is_of_draws(request: pytest.FixtureRequest) -> bool:
    """Return whether the subject of a module are draws and loops, by its folder."""
    return request.path.relative_to(TESTS).parts[0] in IN_FULL


@pytest.fixture(scope="module", autouse=True)
def module_in_full(request: pytest.FixtureRequest, smaller: pytest.MonkeyPatch) -> Iterator[None]:
    """Compute as users do, with the fixtures of a module whose subject are draws and loops."""
    in_full = is_of_draws(request) or request.node.get_closest_marker("in_full") is not None
    if in_full:
        smaller.undo()
    yield
    if in_full:
        make_smaller(smaller)


@pytest.fixture(autouse=True)
def one_in_full(request: pytest.FixtureRequest, smaller: pytest.MonkeyPatch, module_in_full: None) -> Iterator[None]:
    """Compute as users do in a test that is marked."""
    in_full = not is_of_draws(request) and any(mark.name == "in_full" for mark in request.node.own_markers)
    if in_full:
        smaller.undo()
    yield
    if in_full:
        make_smaller(smaller)


@pytest.fixture
def without_costs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Check experiments without measuring what a suggestion costs, which takes longer than all else."""
    monkeypatch.setattr("ctxval.cli.config.check._cost", lambda validation, plans: iter(()))


@pytest.fixture
def few_draws(monkeypatch: pytest.MonkeyPatch) -> None:
    """Take few draws of d*, where tests compute in full otherwise, and those of the same trials once."""
    take_few_draws(monkeypatch.setattr, once=True)


@pytest.fixture
def few_loops(few_draws: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Run few closed loops on few draws of the learned dynamics, where tests compute in full otherwise."""
    run_few_loops(monkeypatch.setattr)
