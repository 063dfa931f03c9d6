"""Refinement: rounds, confidence, and that nothing but executions under a model's own controllers validates it."""

from __future__ import annotations

import contextlib
import json
import sqlite3
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ctxval
from ctxval import Campaign, Store, Trajectory, Transitions, models, searches, systems
from ctxval.certificates.sentences.withdrawals import REFINED
from ctxval.errors import InputError, ModelError, UnknownNameError
from ctxval.studies.refinement import ParameterFit, Refinement, Refit, ResidualCorrection, UserFit, refine
from ctxval.studies.refinement.methods import method_of
from ctxval.studies.refinement.refine import confidence_of_round
from ctxval.studies.refinement.rounds import write_refined
from facts import assert_names, refuses
from rig_refine import BUDGET, FIRST, THRESHOLD, campaign, cart, make_cart, memory, refined

RIG = Path(__file__).parents[2] / "rig_refine.py"


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The store of the refinement that most tests look at."""
    return tmp_path_factory.mktemp("refined") / "a.sqlite"


@pytest.fixture(scope="module")
def found(store: Path) -> Refinement:
    return refined(store)


@pytest.mark.slow
def test_a_falsified_model_is_refined_until_it_is_validated(found: Refinement) -> None:
    assert (found.rounds[0].verdict.answer, found.answer) == ("falsified", "validated")
    assert found.executions <= BUDGET
    before, after = (one.campaign.validation.distances([[0.5], [1.2], [2.0]]).max() for one in found.rounds[::2] or ())
    assert after < 0.1 * before or len(found.rounds) == 2


@pytest.mark.slow
def test_the_refined_model_is_better_in_truth(found: Refinement) -> None:
    first, last = found.rounds[0].campaign.validation, found.last.campaign.validation
    goals = np.linspace(0.5, 2.0, 40)[:, None]
    assert last.distances(goals).max() < 0.2 * first.distances(goals).max()
    assert last.distances(goals).max() <= THRESHOLD


@pytest.mark.slow
def test_only_executions_under_own_controllers_are_counted(found: Refinement) -> None:
    certificate = found.last.verdict.certificate
    assert certificate is not None
    assert certificate.trials == found.last.executions == len(found.last.campaign.trials)
    assert REFINED in certificate.assumptions
    assert_names(found.statement, "executions", found.last.executions)
    assert all(trial.origin != "manual" for trial in found.last.campaign.trials)


@pytest.mark.slow
def test_the_confidence_of_a_round_is_that_of_the_whole_sequence(found: Refinement) -> None:
    assert found.rounds[1].confidence == pytest.approx(0.975)
    assert found.last.verdict.certificate is not None
    assert found.last.verdict.certificate.confidence == found.last.confidence
    assert "at most 0.05" in found.statement


def test_the_shares_of_the_rounds_sum_up_to_alpha() -> None:
    shares = [1 - confidence_of_round(0.9, k) for k in range(1, 2000)]
    assert sum(shares) < 0.1
    assert sum(shares) == pytest.approx(0.1, rel=1e-3)


@pytest.mark.slow
@pytest.mark.thorough
def test_a_fit_that_memorises_is_not_validated() -> None:
    """Its distance is zero on each task that it has seen, which is no evidence on any other task."""
    found = refine(campaign(), THRESHOLD, 4, method=memory)
    assert found.answer != "validated"
    assert len(found.rounds) > 1
    goals = np.linspace(0.5, 2.0, 20)[:, None]
    assert found.last.campaign.validation.distances(goals).max() > THRESHOLD
    for one in found.rounds[1:]:  # it is falsified at tasks that it has not seen
        assert one.verdict.answer == "falsified" or one is found.last


@pytest.mark.slow
def test_a_model_that_is_wrong_on_what_it_has_learned_from_ends_the_refinement() -> None:
    """The controller is that of the first model, so the recorded distance is known without an execution."""
    found = refined(method=lambda data: FIRST)
    assert (found.answer, len(found.rounds)) == ("falsified", 1)


@pytest.mark.slow
def test_a_model_that_is_good_enough_is_not_refined() -> None:
    true = models.Function(cart, vectorized=True)
    found = refined(model=models.Corrected(true, _no_correction()))
    assert len(found.rounds) == 1
    assert found.answer in ("validated", "undecided")
    with refuses(InputError, "model"):
        write_refined("model.npz", found)


def _no_correction() -> models.Correction:
    zero = np.zeros((1, 2))
    return models.Correction(
        *(np.zeros(3), np.ones(3), np.zeros((1, 3)), np.ones(3), zero, np.zeros((4, 2))),
        *(-np.ones(3), np.ones(3), np.ones(3), np.ones(2)),
    )


@pytest.mark.thorough
def test_a_mass_that_is_20_per_cent_off_is_found() -> None:
    def step(x: np.ndarray, u: np.ndarray, theta: np.ndarray) -> np.ndarray:
        return np.stack([x[..., 0] + 0.1 * x[..., 1], x[..., 1] + 0.1 * u[..., 0] / theta[0]], axis=-1)

    off = models.Parametric(step, {"mass": 1.2}, vectorized=True)
    true = systems.Simulated(lambda x, u: step(x, u, np.array([1.0])), vectorized=True)
    found = refined(method=ParameterFit({"mass": (0.5, 2.0)}), model=off, system=true)
    (mass,) = found.parameters
    assert mass.low - 1e-9 <= 1.0 <= mass.high + 1e-9
    assert mass.value == pytest.approx(1.0, abs=1e-6)
    assert isinstance(found.model, models.Parametric)
    assert found.last.campaign.validation.distances([[2.0]]).max() < 1e-6


def test_a_model_that_was_refined_before_is_learned_again_from_the_first_one() -> None:
    data = campaign().run(1)
    seen = _steps(data)
    again = campaign(model=models.Refined(models.Linear.fit(seen, intercept=False), seen, FIRST)).run(1)
    threshold = 0.5 * (again.worst.distance or 0.0)  # type: ignore[union-attr]
    found = refine(again, threshold, 2, method="linear")
    model = found.last.campaign.validation.model
    assert isinstance(model, models.Refined)
    assert model.before is FIRST
    assert len(model.data) == 60  # those of the earlier refinement, and of this execution


# Files


@pytest.mark.slow
def test_a_refinement_is_resumed_from_its_files_with_the_same_choices(found: Refinement, store: Path) -> None:
    assert store.with_name("a.round-1.npz").exists()
    assert store.with_name("a.round-1.sqlite").exists()
    again = refined(store)
    assert again.executions == found.executions
    assert again.to_json() == found.to_json()


def content(store: Path) -> list[tuple[Any, ...]]:
    rows = []
    for path in sorted(store.parent.glob(f"{store.stem}*.sqlite")):
        opened = Store(path)
        rows += [(one.number, one.origin, one.state, one.unit_point.tobytes(), one.distance) for one in opened.trials()]
        opened.close()
    return rows


def executions(store: Path) -> int:
    """Return how many executions the stores of all rounds have, without waiting for their locks."""
    found = 0
    for path in store.parent.glob(f"{store.stem}*.sqlite"):
        with contextlib.suppress(sqlite3.Error):
            reading = sqlite3.connect(f"file:{path}?mode=ro", uri=True)
            with contextlib.closing(reading):
                found += reading.execute("SELECT COUNT(*) FROM trials WHERE state = 'completed'").fetchone()[0]
    return found


@pytest.mark.slow
@pytest.mark.thorough
def test_a_killed_refinement_resumes_with_the_same_choices(
    found: Refinement, store: Path, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    kills = max(1, request.config.getoption("--kills") // 5)
    expected, rng = content(store), np.random.default_rng(7)
    for number in range(kills):
        killed = tmp_path / f"{number}.sqlite"
        process = start(killed)
        wanted = int(rng.integers(1, len(expected)))  # it is killed some time after so many executions
        while executions(killed) < wanted and process.poll() is None:
            time.sleep(0.02)
        time.sleep(float(rng.uniform(0.0, 1.0)))
        process.kill()
        process.wait()
        before = content(killed)
        refined(killed)
        after = content(killed)
        assert after == expected
        assert all(row in after for row in before if row[2] == "completed"), "an execution was lost"


def start(store: Path) -> subprocess.Popen[str]:
    command = [sys.executable, str(RIG), str(store)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, cwd=RIG.parent)
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"
    process.stdout.close()
    return process


@pytest.mark.slow
def test_the_model_and_its_residual_are_written(found: Refinement, tmp_path: Path) -> None:
    pytest.importorskip("onnxruntime")
    files = write_refined(tmp_path / "m.onnx", found)
    assert [Path(one).name for one in files] == ["m.onnx", "m.data.npz", "m.residual.json", "m.residual.txt"]
    about = json.loads((tmp_path / "m.residual.json").read_text())
    assert about["residual"]["guaranteed"] is False
    assert about["verdict"] == "validated"
    assert "not guaranteed" in (tmp_path / "m.residual.txt").read_text().replace("not\n", "not ")
    x, u = np.array([[0.3, 0.5]]), np.array([[0.2]])
    np.testing.assert_allclose(models.Onnx(tmp_path / "m.onnx").step(x, u), found.model.step(x, u), atol=1e-10)


@pytest.mark.slow
def test_the_residual_is_measured_on_executions_that_were_not_learned_from(found: Refinement) -> None:
    assert found.residual is not None
    assert found.residual.left_out is not None
    assert found.residual.whole.steps == 30 * found.last.executions  # new to the last model
    assert found.residual.left_out.steps == 30 * (found.executions - found.last.executions)
    name = list(found.accuracy)[1]
    before, after = found.accuracy[name]
    assert after < before


# Refusals


def test_the_files_of_another_method_are_refused(tmp_path: Path) -> None:
    store = tmp_path / "a.sqlite"
    made = campaign(store).run(2)
    models.write_model(tmp_path / "a.round-1.npz", models.Linear.fit(_steps(made)), {"method": "linear"})
    with refuses(InputError, "linear", "method"):
        refine(made, THRESHOLD, BUDGET)
    assert made.executions == 2


@pytest.mark.slow
def test_a_damaged_file_of_a_later_round_is_an_error_and_not_the_end(tmp_path: Path) -> None:
    made = campaign(tmp_path / "a.sqlite").run(2)
    models.write_model(tmp_path / "a.round-1.npz", models.Linear(FIRST.A, 1.3 * FIRST.B), {"method": "residual"})
    (tmp_path / "a.round-2.npz").write_bytes(b"damaged")
    with refuses(InputError, "a.round", "2.npz"):
        refine(made, THRESHOLD, BUDGET)


def _steps(made: Campaign) -> Transitions:
    return Transitions.joined([made.trajectories(one)[1].transitions() for one in made.completed])  # type: ignore[union-attr]


def told(distance: float = 1.0) -> Campaign:
    made = Campaign(make_cart(), seed=3)
    made.add({"goal": 2.0}, distance=distance)
    return made


def raises(data: Transitions) -> models.Model:
    raise RuntimeError("no convergence")


@pytest.mark.parametrize(
    ("method", "error", "facts"),
    [
        (raises, InputError, ("RuntimeError", "fit")),
        (lambda data: lambda x, u: x * np.nan, ModelError, ("NaN",)),
        (lambda data: lambda x, u: x[:1], ModelError, (2, 1)),
        (lambda data: 3, InputError, ("step", 3)),
        ("residul", UnknownNameError, ("residual", "method")),
        ("parameters", InputError, ("method", "parameters")),
        ("fit", InputError, ("method", "fit")),
        (3, InputError, ("method", 3)),
        (ParameterFit({"mass": (0.5, 2.0)}), InputError, ("method", "parameters")),
    ],
)
def test_a_method_that_cannot_be_used_is_named_and_nothing_is_lost(
    method: Any, error: type[Exception], facts: tuple[object, ...]
) -> None:
    made = campaign().run(1)
    with refuses(error, *facts):
        refine(made, THRESHOLD, BUDGET, method=method)
    assert made.executions == 1


def test_executions_without_trajectories_teach_nothing() -> None:
    with refuses(InputError):
        refine(told(), THRESHOLD, BUDGET)


@pytest.mark.parametrize("budget", [0, -1, 2.5, True])
def test_a_budget_that_is_no_number_of_executions_is_refused(budget: Any) -> None:
    with refuses(InputError, "budget"):
        refine(campaign(), THRESHOLD, budget)


def test_a_budget_below_the_executions_is_refused() -> None:
    with refuses(InputError, 2, 1):
        refine(campaign().run(2), THRESHOLD, 1)


def test_a_spent_budget_ends_the_refinement_before_a_model_is_learned() -> None:
    found = ctxval.refine(campaign().run(1), THRESHOLD, 1)
    assert len(found.rounds) == 1
    assert_names(found.ended, 1)
    assert found.residual is None
    assert found.to_json()["residual"] is None


def test_what_is_no_campaign_or_no_threshold_is_refused() -> None:
    with refuses(InputError, "campaign", "Validation"):
        refine(make_cart(), THRESHOLD, BUDGET)  # type: ignore[arg-type]
    with refuses(InputError, "threshold", -1.0):
        refine(campaign(), -1.0, BUDGET)


def test_methods_are_found_by_name() -> None:
    assert isinstance(method_of("residual"), ResidualCorrection)
    assert isinstance(method_of("linear"), Refit)
    assert isinstance(method_of(memory), UserFit)
    assert method_of("network").name == "network"
    with refuses(UnknownNameError, "linaer", "linear"):
        Refit("linaer")  # type: ignore[arg-type]


def test_people_get_the_tasks_of_the_refined_model(tmp_path: Path) -> None:
    manual = systems.Manual(states={"x": "m", "v": "m/s"}, inputs={"f": "N"}, dt=0.1)
    made = Campaign(make_cart(system=manual), store=tmp_path / "hand.sqlite", seed=3)
    plan = make_cart().plan([2.0])
    executed: Trajectory = make_cart().execute(plan)
    made.add({"goal": 2.0}, executed)
    found = refine(made, THRESHOLD, BUDGET)
    assert (found.answer, len(found.rounds), found.last.executions) == ("undecided", 2, 0)
    assert "ctxval ask" in found.ended
    assert "hand.round-1.sqlite" in found.ended


class _Memorised(models.Linear):
    """The linear model, except at the transitions that it has seen: its controllers are those of the linear model."""

    def __init__(self, data: Transitions) -> None:
        super().__init__([[1.0, 0.1], [0.0, 1.0]], [[0.0], [0.1]])
        self._seen = np.concatenate([data.x, data.u], axis=1)
        self._next = data.x_next

    def step(self, x: Any, u: Any) -> Any:
        gaps = np.abs(self._seen - np.concatenate([x, u], axis=-1)[..., None, :]).max(axis=-1)
        known = (gaps.min(axis=-1) < 1e-6)[..., None]
        return np.where(known, self._next[gaps.argmin(axis=-1)], super().step(x, u))


def test_the_initial_tasks_of_a_round_are_not_those_that_its_model_has_learned_from() -> None:
    first = Campaign(make_cart(), search=searches.by_name("bayesian-optimisation")).run(3)
    found = refine(first, THRESHOLD, 8, method=_Memorised)
    assert len(found.rounds) > 1
    before = np.array([trial.unit_point for trial in found.rounds[0].campaign.trials])
    for trial in found.rounds[1].campaign.trials:
        assert np.abs(before - trial.unit_point).max(axis=1).min() > 1e-6
    assert found.rounds[1].verdict.answer == "falsified"
