"""Independent draws follow the distribution of tasks, and every text says what a volume then is."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from conftest import make_validation
from ctxval import Campaign, Normal, Validation, searches
from ctxval.certificates import (
    AnytimeAudit,
    Audit,
    CertificateKind,
    CertificateOptions,
    SamplingDiscarding,
    Scenario,
)
from ctxval.cli import app
from ctxval.cli.config.settings import read_settings
from ctxval.core.space import DISTRIBUTION
from ctxval.core.task_distribution import distribution_text
from ctxval.errors import CtxvalError, InputError, StoreMismatchError, UnknownNameError
from facts import assert_names, refuses

NARROW = Normal(1.0, 0.05)
"""The bounds of the goal are -3 and 3."""


def narrow() -> Validation:
    whole = make_validation()
    return whole.with_parts(space=whole.space.distributed(goal=NARROW))


def goals(campaign: Campaign) -> np.ndarray:
    return np.array([trial.parameters["goal"] for trial in campaign.trials if trial.origin == "iid"])


def test_audits_asked_draws_and_a_random_search_follow_it_and_searches_do_not() -> None:
    audited = Campaign(narrow(), search=searches.CMAES(), seed=2).run(4).audit(6)
    asked = audited.ask(draw=True)
    drawn = Campaign(narrow(), search=searches.Random(), seed=2).run(10)
    assert len(goals(audited)) == 7
    assert len(goals(drawn)) == 10
    for found in (goals(audited), goals(drawn), np.array([asked.trial.parameters["goal"]])):
        assert (np.abs(found - 1.0) < 0.3).all()
    assert len(np.unique(goals(drawn))) == 10
    searched = np.array([trial.parameters["goal"] for trial in audited.trials if trial.origin != "iid"])
    assert np.abs(searched - 1.0).max() > 0.3


def test_a_resumed_random_search_draws_the_same_tasks(tmp_path: Path) -> None:
    whole = Campaign(narrow(), search=searches.Random(), seed=2).run(6)
    Campaign(narrow(), search=searches.Random(), seed=2, store=tmp_path / "a.sqlite").run(3)
    resumed = Campaign(narrow(), search=searches.Random(), seed=2, store=tmp_path / "a.sqlite").run(6)
    np.testing.assert_array_equal(goals(resumed), goals(whole))
    assert [trial.note.draws for trial in resumed.trials[3:]] == [6] * 3


def test_a_store_keeps_it_and_refuses_another_one(tmp_path: Path) -> None:
    made = Campaign(narrow(), search=searches.Random(), seed=2, store=tmp_path / "a.sqlite").run(2)
    assert made.store.description()["validation"]["space"][DISTRIBUTION]["goal"]["deviation"] == 0.05
    plain = Campaign(make_validation(), search=searches.Random(), seed=2).run(1)
    assert DISTRIBUTION not in plain.store.description()["validation"]["space"]
    with refuses(StoreMismatchError, "a.sqlite", "validation.space._distribution"):
        Campaign(make_validation(), search=searches.Random(), seed=2, store=tmp_path / "a.sqlite")


@pytest.fixture(scope="module")
def drawn() -> Campaign:
    """A campaign of independent draws, to which the tests add nothing."""
    return Campaign(narrow(), search=searches.Random(), seed=2).run(40)


@pytest.mark.slow
@pytest.mark.parametrize("kind", [Audit(), AnytimeAudit(), Scenario(), SamplingDiscarding(2)])
def test_every_text_says_that_a_volume_is_a_probability_under_it(kind: CertificateKind, drawn: Campaign) -> None:
    accepted = drawn.verdict(1e3, certificate=CertificateOptions(kind, volume=0.4))
    refused = drawn.verdict(1e3, certificate=CertificateOptions(kind, volume=0.01))
    assert accepted.answer == "validated"
    assert accepted.certificate is not None
    for text in (accepted.reason, refused.reason, accepted.certificate.statement):
        assert_names(text, "stated", "distribution")
        assert "of the task space" not in text
    stated = " ".join(accepted.certificate.assumptions)
    assert_names(stated, "stated", "distribution")
    assert "uniform over the task space" not in stated
    assert accepted.certificate.to_json()["distribution"].startswith("goal normal")


FILE = """
experiment = "pendulum"
[search]
type = "random"
[distribution]
goal = { type = "normal", mean = 0.5, deviation = 0.1 }
"""


@pytest.mark.thorough
def test_an_experiment_file_states_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("p.toml").write_text(FILE)
    invoke = CliRunner().invoke
    assert invoke(app, ["run", "p.toml", "--budget", "5", "--store", "p.sqlite"]).exit_code == 0
    shown = invoke(app, ["certify", "p.sqlite", "--kind", "scenario"])
    assert shown.exit_code == 0, shown.output
    assert_names(" ".join(shown.output.split()), "goal normal (mean 0.5, deviation 0.1)")
    space = read_settings("p.toml", {}).load().validation.space
    assert np.abs(space.iid(200, np.random.default_rng(0)) - 0.5).max() < 0.6


@pytest.mark.parametrize(
    ("table", "error", "facts"),
    [
        ('goal = { type = "normal", mean = 0.5 }', InputError, ("goal", "mean")),
        ('goal = { type = "norml", mean = 0.5, deviation = 1 }', UnknownNameError, ("normal", "norml")),
        (
            'goal = { type = "normal", mean = 0.5, sigma = 1 }',
            UnknownNameError,
            ("goal", "sigma"),
        ),
        ('gaol = { type = "uniform" }', UnknownNameError, ("goal", "gaol")),
        ('goal = { type = "normal", mean = "x", deviation = 1 }', InputError, ("distribution", "x")),
    ],
)
def test_a_wrong_distribution_in_a_file_is_named(
    tmp_path: Path, table: str, error: type[CtxvalError], facts: tuple[object, ...]
) -> None:
    file = tmp_path / "p.toml"
    file.write_text(FILE.partition("goal")[0] + table)
    with refuses(error, *facts):
        read_settings(str(file), {}).load()


MODULE = """
import numpy as np
from scipy import stats

loads = stats.triang(0.5, loc=-1.0, scale=2.0)

def draw(rng, n):
    return rng.choice([-0.5, 0.5], (n, 1)) + 0.01 * rng.uniform(size=(n, 1))
"""


@pytest.mark.parametrize(
    ("table", "most", "text"),
    [
        ('goal = { ref = "drawn_tasks:loads" }', 1.0, "goal scipy.stats.triang"),
        ('sampler = { ref = "drawn_tasks:draw" }', 0.51, "draw"),
    ],
)
def test_a_file_names_any_distribution_of_scipy_or_a_function_that_draws_tasks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, table: str, most: float, text: str
) -> None:
    monkeypatch.delitem(sys.modules, "drawn_tasks", raising=False)
    (tmp_path / "drawn_tasks.py").write_text(MODULE)
    (tmp_path / "p.toml").write_text(FILE.partition("goal")[0] + table)
    settings = read_settings(str(tmp_path / "p.toml"), {})
    space = settings.load().validation.space
    drawn = space.iid(300, np.random.default_rng(0))
    assert np.abs(drawn).max() <= most
    assert drawn.std() > 0.3
    assert text in str(distribution_text(space.describe()[DISTRIBUTION]))


def test_uniform_may_be_stated(tmp_path: Path) -> None:
    file = tmp_path / "p.toml"
    file.write_text(FILE.partition("goal")[0] + 'goal = { type = "uniform" }')
    assert read_settings(str(file), {}).load().validation.space.distribution is None
