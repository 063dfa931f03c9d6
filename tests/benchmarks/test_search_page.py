"""The page on the search `auto` is what the stored campaigns give."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import numpy as np
import pytest

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
sys.path.insert(0, str(BENCHMARKS))

import search_page  # noqa: E402
import search_versions_part  # noqa: E402
from json_lines import JsonLines  # noqa: E402
from reproduce.jobs import AUTO, provenance  # noqa: E402
from study_auto import CASES, KEY, first_within, results_of, stored  # noqa: E402

TARGETS = search_page.targets()


def test_its_links_and_pictures_lead_somewhere() -> None:
    path = search_page.DOCS / "searches.md"
    for link in re.findall(r"\]\(([^)#:]+)\)", path.read_text()):
        assert (path.parent / link).exists(), link


def test_every_case_of_the_study_has_a_target() -> None:
    assert {target.case for target in TARGETS if target.study == "auto"} == set(CASES)


@pytest.mark.parametrize("study", ["auto", "scalar", "misleading", "ablations"])
def test_stored_campaigns_end_within_one_per_cent_or_with_their_budget(study: str) -> None:
    results = results_of(study)
    assert results
    for key, result in results.items():
        ended = len(result["distances"])
        assert ended <= result["budget"], key
        assert ended == result["budget"] or first_within(result, 1.0) == ended, key


def test_what_is_stored_is_not_run_again_and_what_is_run_is_stored(tmp_path: Path) -> None:
    run = {"truth": 1.0, "budget": 2, "distances": [0.5, 1.0], "seconds": 0.1}
    results, computed = JsonLines(tmp_path / "study.jsonl", KEY), []
    for seed in (0, 1, 0):
        found = stored(results, "pendulum", seed, "no climbs", lambda: computed.append(1) or run)
        assert found == {"case": "pendulum", "seed": seed, "search": "no climbs", **run, **provenance(AUTO)}
    assert len(computed) == 2
    again = JsonLines(tmp_path / "study.jsonl", KEY)
    assert stored(again, "pendulum", 1, "no climbs", dict)["distances"] == [0.5, 1.0]


def test_a_target_is_met_by_the_median_or_by_all() -> None:
    counts = [3.0, 5.0, np.inf]
    assert search_page.within(5)(counts)
    assert not search_page.within(4)(counts)
    assert not search_page.all_within(30)(counts)


def test_numbers_of_executions_are_shown_with_the_budget_where_it_did_not_suffice() -> None:
    counts = [3.0, 5.0, 9.0, np.inf]
    assert search_page.spread(counts, 30) == "3 to 9"
    assert search_page.spread([3.0, np.inf, np.inf, np.inf], 30) == "3 to > 30"
    assert search_page.reached(counts) == "3 of 4"


def test_more_seeds_than_the_table_has_are_reported_beside_it() -> None:
    text = search_page.more_seeds()
    for case, *_ in search_page.MORE_SEEDS:
        campaigns = results_of("scalar").select(case=case, search="scalar")
        assert f", {len(campaigns)} seeds: within" in text


def test_what_is_missing_goes_on_flat_where_a_campaign_ended() -> None:
    result = {"truth": 2.0, "budget": 4, "distances": [1.0, None, 2.0]}
    np.testing.assert_allclose(search_page.missing([result]), [[50.0, 50.0, 1.0, 1.0]])
    assert first_within(result, 1.0) == 3


def test_campaigns_of_the_earlier_code_are_compared_seed_by_seed() -> None:
    def campaign(*distances: float) -> dict[str, object]:
        return {"truth": 1.0, "budget": 4, "distances": list(distances)}

    earlier = [campaign(0.5, 1.0), campaign(1.0), campaign(0.5, 0.5, 0.5, 0.5)]
    now = [campaign(1.0), campaign(0.5, 1.0), campaign(0.5, 0.5, 0.5, 0.5)]
    assert search_versions_part.fewer_and_more(earlier, now) == "1 / 1"
