from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctxval import cases, searches
from reproduce.frameworks import PAPER
from reproduce.jobs import Job, Results, case_digest, distances_of, records, run_job
from reproduce.study import running_estimate

PROFILE = Job("profile", "pendulum", 0, budget=21)


@given(st.lists(st.one_of(st.floats(0, 10), st.just(np.nan)), min_size=1, max_size=60))
def test_records_give_the_estimates_of_all_the_distances(distances: list[float]) -> None:
    kept = distances_of({"executions": len(distances), "records": records(np.array(distances))})
    for search in ("random", "sampling-discarding"):
        np.testing.assert_array_equal(running_estimate(kept, search), running_estimate(distances, search))


def test_a_batched_random_search_is_the_search_of_the_same_seed() -> None:
    result = run_job(Job("search", "pendulum", 3, search="random", budget=12))
    validation, search = cases.by_name("pendulum", 3).validation, searches.Random()
    search.reset(validation.space.dimension, 3)
    distances = validation.distances(validation.space.from_unit(search.ask(12)))
    np.testing.assert_allclose(running_estimate(distances_of(result), "random"), np.maximum.accumulate(distances))


@pytest.mark.thorough
def test_results_are_stored_once_and_reused_until_their_case_has_changed(tmp_path: Path) -> None:
    results, done = Results(tmp_path / "results"), []
    results.fill([PROFILE, PROFILE], 1, done.append)
    assert done == [PROFILE]
    before = (tmp_path / "results" / "profile.jsonl").read_bytes()
    for again in (results, Results(tmp_path / "results")):
        again.fill([PROFILE], 1, done.append)
    assert done == [PROFILE]
    assert (tmp_path / "results" / "profile.jsonl").read_bytes() == before
    case = cases.by_name("pendulum", 0)
    assert results[PROFILE]["distances"] == pytest.approx(case.validation.distances(case.validation.space.grid(21)))
    path = tmp_path / "results" / "profile.jsonl"
    path.write_text(path.read_text().replace(case_digest("pendulum"), "0" * 16))
    outdated = Results(tmp_path / "results")
    assert PROFILE not in outdated
    outdated.fill([PROFILE], 1, done.append)
    assert done == [PROFILE, PROFILE]
    assert PROFILE in Results(tmp_path / "results")


@pytest.fixture
def edited(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[str, str], str]]:
    """Return the digest of a case in whose source one passage has been replaced."""
    source = Path(cases.pendulum.__file__).read_text()

    def edit(before: str, after: str) -> str:
        assert before in source
        monkeypatch.setattr(inspect, "getsource", lambda module: source.replace(before, after, 1))
        case_digest.cache_clear()
        return case_digest("pendulum")

    yield edit
    case_digest.cache_clear()


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ("import numpy as np\n", "import math\n\nimport numpy as np\n"),
        ('"""', '"""Documented at more length: '),
        ("horizon: int = 150", "horizon: float = 150"),
    ],
)
def test_imports_docstrings_and_annotations_make_no_result_outdated(
    edited: Callable[[str, str], str], before: str, after: str
) -> None:
    assert edited(before, after) == edited(before, before)


def test_a_constant_makes_results_outdated(edited: Callable[[str, str], str]) -> None:
    assert edited("horizon: int = 150", "horizon: int = 151") != edited("horizon: int = 150", "horizon: int = 150")


def test_every_job_has_its_own_key() -> None:
    jobs = [
        Job("search", "linear", seed, (("dim", dim),), search, 10)
        for seed in (0, 1)
        for dim in (1, 11)
        for search in ("gp-ucb", "random")
    ]
    assert len({job.key for job in jobs}) == len(jobs)


def test_sd_discards_the_papers_five() -> None:
    assert searches.SamplingDiscarding().discard == PAPER.discarded
