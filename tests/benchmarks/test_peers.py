"""The benchmark beside other tools: the page is what is stored, and the functions are the cases."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ctxval import cases
from ctxval._util.arrays import Array
from facts import refuses

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
sys.path.insert(0, str(BENCHMARKS))

from peers import page, pictures, run  # noqa: E402
from peers.functions import CASES, SEEDS, function  # noqa: E402
from peers.methods import METHODS  # noqa: E402
from peers.ours import vector  # noqa: E402
from peers.recorder import Recorder, Suggesting  # noqa: E402
from study_auto import experiment  # noqa: E402

HERE = ("auto", "vector", "scalar", "gp-ucb", "cma-es", "dual-annealing", "direct", "random")


@pytest.mark.parametrize("case", [case for case in CASES if page.cells(case)])
def test_every_function_with_results_has_a_picture(case: str) -> None:
    assert (page.PICTURES / f"{case}.png").exists()


@pytest.mark.parametrize("case", CASES)
def test_stored_results_are_runs_of_known_methods(case: str) -> None:
    results = run.STORED.select(case=case)
    keys = [(result["method"], result["seed"]) for result in results]
    assert len(set(keys)) == len(keys)
    for result in results:
        assert result["seed"] in SEEDS
        assert run.applies(result["method"], case)
        assert result["executions"] <= CASES[case].budget
        # No search finds more than the maximum; that of the arm is the best of a grid, and its peaks are narrow.
        assert max(value for _, value in result["improvements"]) <= 1.01 * result["maximum"]


@pytest.mark.parametrize(
    ("case", "name", "options"),
    [
        ("pendulum", "pendulum", {}),
        ("linear-5", "linear", {"dim": 5}),
        ("linear-10", "linear", {"dim": 10}),
    ],
)
def test_functions_agree_with_the_cases(case: str, name: str, options: dict[str, Any], tmp_path: Path) -> None:
    validation = cases.by_name(name, 3, **options).validation
    found = function(case, 3, tmp_path)
    points = np.random.default_rng(0).random((5, CASES[case].dimension))
    expected = validation.distances(validation.space.from_unit(points))
    np.testing.assert_allclose(found.values(points), expected, rtol=1e-12)
    np.testing.assert_allclose([found.execute(point).distance for point in points], expected, rtol=1e-9)
    assert expected.max() <= found.maximum


@pytest.mark.slow
@pytest.mark.parametrize(
    "case", [pytest.param(case, marks=[pytest.mark.thorough] * (case == "arm-fnn")) for case in CASES]
)
def test_what_is_said_of_the_functions_is_so(case: str) -> None:
    validation = experiment(case, 0).validation
    assert validation.space.dimension == CASES[case].dimension
    assert hasattr(validation.distance, "compose") == CASES[case].vector
    assert (getattr(validation.model, "data", None) is not None) == CASES[case].data


@pytest.mark.slow
@pytest.mark.parametrize("name", HERE)
@pytest.mark.thorough
def test_methods_stop_with_the_budget_and_repeat_themselves(name: str) -> None:
    first, again = (
        run.record(METHODS[name].load(), Recorder(function("linear-5", 1), 6), seed=1)[0].values for _ in range(2)
    )
    assert len(first) == 6
    assert first == again


def test_a_run_ends_where_it_is_close_enough() -> None:
    found = function("pendulum", 0)
    recorder, error = run.record(METHODS["random"].load(), Recorder(found, 30, 0.5 * found.maximum), seed=0)
    assert error is None
    assert recorder.values[-1] >= 0.5 * found.maximum
    assert all(value < 0.5 * found.maximum for value in recorder.values[:-1])


def test_what_breaks_a_method_is_recorded() -> None:
    def breaking(dimension: int, seed: int) -> Any:
        def suggest(points: Array, values: Array) -> Array:
            if len(points) == 2:
                raise RuntimeError("singular")
            return np.full(dimension, 0.5)

        return suggest

    recorder, error = run.record(Suggesting(breaking), Recorder(function("pendulum", 0), 5), seed=0)
    assert len(recorder.values) == 2
    assert error == "RuntimeError: singular"


def test_methods_begin_with_what_is_known() -> None:
    recorder = Recorder(function("linear-5", 0), 9)
    for point in np.random.default_rng(0).random((8, 10)):
        recorder.know(point)
    run.record(vector, recorder, seed=0)
    assert len(recorder.values) == 9
    assert len(recorder.seconds) == 1


def test_a_function_that_differs_from_that_of_the_stored_runs_is_an_error() -> None:
    run.require_same("arm, seed 9", 1.0005, 1.0)
    for here in (1.002, float("nan")):
        with refuses(SystemExit, 9, "OPENBLAS_CORETYPE"):
            run.require_same("arm, seed 9", here, 1.0)


def test_the_function_of_the_stored_runs_is_recognised() -> None:
    found = run.the_function("linear-5", 0)
    assert found.maximum == pytest.approx(run.STORED["linear-5", "auto", 0]["maximum"])


def test_regret_and_first_within() -> None:
    result = {"maximum": 2.0, "improvements": [[1, 1.0], [3, 1.9], [4, 1.99]], "executions": 4}
    np.testing.assert_allclose(page.regret(result, 6), [50.0, 50.0, 5.0, 0.5, 0.5, 0.5])
    assert [page.first_within(result, percent) for percent in (5, 2, 1)] == [3.0, 4.0, 4.0]
    assert page.spread([3.0, 4.0, 4.0, page.NEVER], 6) == "4 [3, 4] (3/4)"
    assert page.spread([page.NEVER] * 2, 6) == "- (0/2)"
    assert run.improvements([1.0, 0.5, 1.0, 2.0]) == [(1, 1.0), (4, 2.0)]


def test_styles_tell_methods_of_one_panel_apart_without_colour() -> None:
    for names in pictures.PANELS.values():
        looks = [pictures.style(name).marker for name in names]
        assert len(set(looks)) == len(looks)
    drawn = {name for names in pictures.PANELS.values() for name in names}
    assert drawn == set(METHODS)
