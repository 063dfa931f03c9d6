from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctxval import cases, searches
from ctxval.errors import InputError
from ctxval.reproduce.jobs import DISCARDED, Job, Results, case_digest, distances_of, records, run_job
from ctxval.reproduce.study import running_estimate

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


def test_results_are_stored_once_and_reused(tmp_path: Path) -> None:
    results, done = Results(tmp_path / "results"), []
    results.fill([PROFILE, PROFILE], 1, done.append)
    assert done == [PROFILE]
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "results").iterdir()}
    results.fill([PROFILE], 1, done.append)
    assert done == [PROFILE]
    assert {path: path.stat().st_mtime_ns for path in (tmp_path / "results").iterdir()} == before
    case = cases.by_name("pendulum", 0)
    assert results[PROFILE]["distances"] == pytest.approx(case.validation.distances(case.validation.space.grid(21)))


def test_a_result_of_a_case_that_has_changed_is_run_again(tmp_path: Path) -> None:
    results, done = Results(tmp_path), []
    results.fill([PROFILE], 1, done.append)
    (path,) = tmp_path.iterdir()
    path.write_text(path.read_text().replace(case_digest("pendulum"), "0" * 16))
    assert PROFILE not in results
    results.fill([PROFILE], 1, done.append)
    assert done == [PROFILE, PROFILE]


def test_every_job_has_its_own_file() -> None:
    jobs = [
        Job("search", "linear", seed, (("dim", dim),), search, 10)
        for seed in (0, 1)
        for dim in (1, 11)
        for search in ("gp-ucb", "random")
    ]
    assert len({job.key for job in jobs}) == len(jobs)


def test_an_unknown_kind_is_refused() -> None:
    with pytest.raises(InputError, match="no kind of job 'dance'"):
        run_job(Job("dance", "pendulum", 0))


def test_sd_discards_the_papers_five() -> None:
    assert searches.SamplingDiscarding().discard == DISCARDED == 5
