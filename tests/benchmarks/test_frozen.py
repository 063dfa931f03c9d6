"""The frozen campaigns: a few of each group end as they did, and choose the same tasks, with nothing executed."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
sys.path.insert(0, str(BENCHMARKS))

import frozen_replay  # noqa: E402
from freeze import FROZEN, frozen_campaign, path_of, read, recipes, write  # noqa: E402

SAMPLE = (
    "strangers/salt-bath 0 0.95",
    "strangers/ground-effect 0 0.95",
    "noise/tanks, lag 2 0 0.95",
    "friction/sealed-gantry 0 0.95",
    "outputs/pendulum, none 0 0.95",
    "paper/linear-1 0 1.05",
    "paper/linear-2 0 1.5",
)


@pytest.mark.in_full
@pytest.mark.parametrize("name", SAMPLE)
def test_a_frozen_campaign_ends_as_it_did(name: str) -> None:
    result = frozen_replay.replay(path_of(name))
    assert result["differs"] == []


def test_every_file_is_that_of_its_campaign() -> None:
    names = {one.name for one in recipes()}
    files = sorted(FROZEN.glob("*/*"))
    assert {path_of(name) for name in names} >= set(files)
    assert {path_of(name) for name in SAMPLE} <= set(files)


@pytest.mark.in_full
def test_a_replay_tells_another_verdict_and_another_task(tmp_path: Path) -> None:
    frozen = read(path_of(SAMPLE[0]))
    frozen["outcome"]["answer"] = "undecided"
    frozen["trials"][-1]["point"][0] += 2e-6
    write(tmp_path / "changed.json.xz", frozen)
    differs = frozen_replay.replay(tmp_path / "changed.json.xz")["differs"]
    assert [sentence.split()[0] for sentence in differs] == ["after", "answer"]


def test_a_replay_executes_nothing() -> None:
    frozen = read(path_of(SAMPLE[0]))
    campaign = frozen_replay.loaded(frozen)
    assert campaign.executions == len(frozen["trials"])
    with pytest.raises(RuntimeError, match="executes nothing"):
        campaign.validation.system.execute(None, None)


def test_numbers_agree_up_to_a_millionth() -> None:
    assert frozen_replay.same({"a": [1.0, None]}, {"a": [1.0000005, None]})
    assert not frozen_replay.same({"a": [1.0, None]}, {"a": [1.000005, None]})
    assert not frozen_replay.same(1.0, None)


@pytest.mark.in_full
def test_a_campaign_that_is_frozen_now_replays(tmp_path: Path) -> None:
    (recipe,) = [one for one in recipes() if one.name == "paper/linear-1 0 1.05"]
    write(tmp_path / "now.json.xz", frozen_campaign(recipe))
    assert frozen_replay.replay(tmp_path / "now.json.xz")["differs"] == []
