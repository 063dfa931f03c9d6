from __future__ import annotations

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from ctxval import Parameters, Task, TaskSpace, Truth, Validation, controllers, distances, grid_truth, systems
from ctxval.core.truth import cached_truth, search_truth
from ctxval.errors import InputError
from facts import assert_names, refuses
from rig_thorough import more

Surface = Callable[[np.ndarray], np.ndarray]
TOP = np.array([0.3, 0.8, 1.0])


def of_surface(surface: Surface) -> Validation:
    """Return a validation on [0, 2] x [0, 1]^2 whose distance is a function of the point: S moves, M stands still."""
    return Validation(
        space=TaskSpace(wide=(0.0, 2.0), pair=(np.zeros(2), np.ones(2))),
        task=lambda p: Task(p.points, horizon=1, dt=0.1),
        system=systems.Simulated(lambda x, u: x + surface(x)[..., None], vectorized=True),
        model=lambda x, u: x,
        synthesizer=controllers.Policy(lambda t, x, task: np.zeros((*x.shape[:-1], 1))),
        distance=distances.FinalState(norm=np.inf),
    )


def hill(x: np.ndarray) -> np.ndarray:
    """Return a function whose maximum, 2, is at TOP, on a face of the box."""
    return 2 - 0.3 * ((x - TOP) ** 2).sum(axis=-1)


def two_peaks(x: np.ndarray) -> np.ndarray:
    """Return the hill with a wide one beside it that is 65 % as high."""
    steep = 2 * np.exp(-8 * ((x - TOP) ** 2).sum(axis=-1))
    return np.maximum(steep, 1.3 - 0.2 * ((x - [2.0, 0.0, 0.0]) ** 2).sum(axis=-1))


# On a grid


def test_a_grid_finds_what_a_much_denser_one_finds(validation: Validation) -> None:
    truth, denser = grid_truth(validation, per_axis=401), grid_truth(validation, per_axis=20_001)
    assert truth.distance == pytest.approx(denser.distance, rel=1e-6)
    assert validation.outcome(truth.parameters.points).distance == pytest.approx(truth.distance, rel=1e-9)
    assert_names(truth.method, 401, "points", 6)


def test_refinement_finds_the_maximum_between_grid_points() -> None:
    truth = grid_truth(of_surface(hill), per_axis=6)
    assert truth.distance == pytest.approx(2, abs=1e-5)
    assert_names(truth.method, 6)


def test_a_grid_of_failures_has_no_truth() -> None:
    with refuses(InputError, "truth"):
        grid_truth(of_surface(lambda x: np.full(x.shape[:-1], np.nan)), per_axis=3)


# By search


@pytest.mark.parametrize("surface", [*more(hill), two_peaks])
def test_a_search_finds_a_known_maximum(surface: Surface) -> None:
    validation = of_surface(surface)
    truth = search_truth(validation, generations=60)
    assert truth.distance == pytest.approx(2, abs=1e-7)
    assert truth.distance == validation.outcome(truth.parameters.points).distance
    np.testing.assert_allclose(truth.parameters.points, TOP, atol=1e-3)
    assert truth.parameters.wide == truth.parameters.points[0]


def test_it_says_that_it_is_a_best_known_value_and_how_it_was_found() -> None:
    method = search_truth(of_surface(hill), generations=60).method
    assert_names(method, 2, 60)
    evaluations = int(method.removeprefix("best known value of ").split()[0].replace(",", ""))
    # Two repeats of 61 generations of 60 points and 61 climbs, each from the best of 16 points in steps of 7.
    assert 1000 < evaluations < 2 * (61 * 60 + 61 * (16 + 30 * 7))


@pytest.mark.slow
def test_repeats_that_never_agree_end_at_the_limit_and_leave_a_doubt() -> None:
    def noise(x: np.ndarray) -> np.ndarray:
        return np.mod(1e6 * np.sin(1e4 * x).sum(axis=-1), 1.0)

    truth = search_truth(of_surface(noise), agreement=1e-12, repeats=3, population=4, generations=2, climbs=4)
    assert "3 repeats" in truth.method


def test_the_seed_decides_and_the_space_is_searched_in_batches() -> None:
    validation = of_surface(two_peaks)
    calls: list[int] = []

    def counted(points: np.ndarray) -> np.ndarray:
        calls.append(len(points))
        return Validation.distances(validation, points)

    validation.distances = counted  # type: ignore[method-assign, assignment]
    settings = {"agreement": 1.0, "population": 8, "generations": 3, "climbs": 2}
    first, again, other = (search_truth(validation, seed=seed, **settings) for seed in (1, 1, 2))  # type: ignore[arg-type]
    np.testing.assert_array_equal(first.parameters.points, again.parameters.points)
    assert not np.array_equal(first.parameters.points, other.parameters.points)
    # Generations of 8 d points, starts of 16, gradients of 2 d + 1, and each climb's end once more alone.
    assert set(calls) == {24, 16, 7, 1}
    assert calls.count(1) == 3 * 2 * 3


@pytest.mark.thorough
def test_climbs_find_a_narrow_peak_that_evolution_passes_by() -> None:
    def surface(x: np.ndarray) -> np.ndarray:
        """A wide hill of 1 in the middle, and in a corner a slope of small basin that leads to 1.5."""
        wide = np.exp(-4 * ((x - 0.5) ** 2).sum(axis=-1))
        corner = np.abs(x - 1).max(axis=-1)
        return np.where(corner < 0.12, 0.9 + 5 * (0.12 - corner), wide)

    found = [search_truth(of_surface(surface), climbs=climbs, agreement=1.0).distance for climbs in (0, 200)]
    assert found[1] == pytest.approx(1.5, abs=1e-6)
    assert found[0] <= found[1]


@pytest.mark.thorough
def test_failed_executions_are_searched_around() -> None:
    truth = search_truth(of_surface(lambda x: np.where(x[..., 0] < 0.5, np.nan, hill(x))), generations=60)
    assert truth.distance == pytest.approx(2 - 0.3 * 0.2**2, abs=1e-4)


def test_a_search_of_failures_has_no_truth() -> None:
    broken = of_surface(lambda x: np.full(x.shape[:-1], np.nan))
    with refuses(InputError, "truth"):
        search_truth(broken, repeats=2, population=4, generations=2)


def test_where_model_and_system_agree_the_truth_is_zero() -> None:
    truth = search_truth(of_surface(lambda x: np.zeros(x.shape[:-1])), population=4, generations=2)
    assert truth.distance == 0
    assert "2 repeats" in truth.method


# Found once


class Counted:
    """A way to find the truth that counts how often it is asked."""

    def __init__(self, height: float = 2.0) -> None:
        self.height = height
        self._calls = 0

    def __call__(self, validation: Validation) -> Truth:
        self._calls += 1
        return Truth(self.height, validation.space.parameters(TOP), "known")

    @property
    def calls(self) -> int:
        return self._calls


def only_file(folder: Path) -> Path:
    (path,) = folder.iterdir()
    return path


def test_a_truth_is_found_once(tmp_path: Path) -> None:
    validation, compute = of_surface(hill), Counted()
    first = cached_truth(validation, compute, tmp_path / "new" / "folder")
    second = cached_truth(of_surface(hill), compute, tmp_path / "new" / "folder")
    assert compute.calls == 1
    assert (second.distance, second.method) == (first.distance, first.method)
    np.testing.assert_array_equal(second.parameters.points, TOP)
    np.testing.assert_array_equal(second.parameters.pair, TOP[1:])
    assert only_file(tmp_path / "new" / "folder").suffix == ".json"


@pytest.mark.thorough
def test_another_validation_and_other_settings_have_other_truths(tmp_path: Path) -> None:
    def narrower(p: Parameters) -> Task:
        return Task(0.5 * p.points, horizon=1, dt=0.1)

    other = of_surface(hill)
    other.task = narrower
    few = partial(search_truth, population=4, generations=1, repeats=1)
    for validation, compute in [
        (of_surface(hill), few),
        (other, few),
        (of_surface(hill), partial(few, seed=1)),
        (of_surface(hill), partial(few, generations=2)),
    ]:
        cached_truth(validation, compute, tmp_path)
    assert len(list(tmp_path.iterdir())) == 4


@pytest.mark.parametrize(
    "content",
    [
        "",
        "{",
        "[]",
        '"text"',
        "{}",
        '[{"distance": "?", "parameters": {"wide": 0.3, "pair": [0.8, 1.0]}, "method": "known", "probes": []}]',
        '[{"distance": 2.0, "parameters": 3, "method": "known", "probes": []}]',
        '[{"distance": 2.0, "parameters": {"wide": 9.0, "pair": [0.8, 1.0]}, "method": "outside", "probes": []}]',
        '[{"distance": 2.0, "parameters": {"wide": 0.3, "pear": [0.8, 1.0]}, "method": "another space", "probes": []}]',
        '[{"distance": 2.1, "parameters": {"wide": 0.3, "pair": [0.8, 1.0]}, "method": "another S", "probes": []}]',
        '[{"distance": NaN, "parameters": {"wide": 0.3, "pair": [0.8, 1.0]}, "method": "not a number", "probes": []}]',
    ],
)
def test_a_file_that_cannot_be_believed_is_written_again(tmp_path: Path, content: str) -> None:
    compute = Counted()
    cached_truth(of_surface(hill), compute, tmp_path)
    only_file(tmp_path).write_text(content)
    assert cached_truth(of_surface(hill), compute, tmp_path).method == "known"
    assert compute.calls == 2
    assert json.loads(only_file(tmp_path).read_text())[-1]["distance"] == 2.0


def test_systems_that_differ_in_numbers_have_truths_of_their_own(tmp_path: Path) -> None:
    def lower(gain: float) -> Validation:
        return of_surface(lambda points: gain * hill(points))

    heights = [cached_truth(lower(gain), Counted(2.0 * gain), tmp_path).distance for gain in (1.0, 0.5, 1.0, 0.5)]
    assert heights == [2.0, 1.0, 2.0, 1.0]
    assert len(json.loads(only_file(tmp_path).read_text())) == 2


def test_a_folder_that_cannot_be_written_does_not_cost_the_answer(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("no folder")
    compute = Counted()
    assert cached_truth(of_surface(hill), compute, tmp_path / "file").distance == 2.0
    assert compute.calls == 1


def test_a_write_that_fails_halfway_leaves_nothing_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(source: object, target: object) -> None:
        raise OSError("no space left on device")

    monkeypatch.setattr("pathlib.Path.replace", full)
    assert cached_truth(of_surface(hill), Counted(), tmp_path).distance == 2.0
    assert list(tmp_path.iterdir()) == []
