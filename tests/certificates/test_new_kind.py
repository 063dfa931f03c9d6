"""The recipe of a new kind of certificate: one file of fewer than 40 lines, as CONTRIBUTING.md has it."""

from __future__ import annotations

import importlib
import sys
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import ClassVar

import numpy as np
import pytest
from pydantic import ValidationError
from typer.testing import CliRunner

from conftest import make_validation
from ctxval import Campaign, certificates, searches
from ctxval.certificates import (
    KINDS,
    Certificate,
    CertificateKind,
    CertificateOptions,
    Sample,
    judge,
)
from ctxval.cli import app
from ctxval.cli.config.settings import CertificateTable
from ctxval.core.trial import Trial
from ctxval.core.trial_note import TrialNote
from ctxval.errors import CertificateError, ConformanceError
from ctxval.testing import check_certificate
from facts import assert_names, refuses

RECIPE = '''
"""A bound on d* for a distance whose slope is known."""

from dataclasses import dataclass
from typing import ClassVar

from ctxval import part
from ctxval.certificates import Certificate, CertificateKind, Sample, farthest_task
from ctxval.errors import CertificateError


@part("lipschitz")
@dataclass(frozen=True)
class Lipschitz(CertificateKind):
    """No task is worse than the worst one known by more than the slope over the largest gap between trials.

    Attributes:
        slope: by how much the distance changes over one diagonal of the task space at most.
    """

    name: ClassVar[str] = "lipschitz"

    slope: float | None = None

    def certify(self, sample: Sample, confidence: float = 0.95) -> Certificate:
        """Return the certificate of trials."""
        if self.slope is None or sample.failed:
            raise CertificateError("a lipschitz bound needs the slope, and a distance from every trial.")
        gap = farthest_task(sample.points)
        bound = sample.best + self.slope * gap
        statement = f"d* is at most {bound:.4g}."
        assumptions = (f"the distance changes by at most {self.slope:g} over one diagonal", *sample.remarks)
        details = {"best": sample.best, "largest_gap": gap}
        return Certificate(self.name, statement, bound, confidence, 0.0, len(sample), assumptions, details)

    @classmethod
    def rests_on(cls, certificate, space=None):
        """Return what a validation by it rests on."""
        return ["the slope that you stated"]
'''


@pytest.fixture
def recipe(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """Import the file of the recipe as if the package exported the kind, and forget it afterwards."""
    (tmp_path / "lipschitz.py").write_text(RECIPE)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "lipschitz", raising=False)
    module = importlib.import_module("lipschitz")
    monkeypatch.setattr(KINDS, "_exported", {**KINDS._exported, "lipschitz": module.Lipschitz})
    return module


def test_the_recipe_is_short() -> None:
    assert len(RECIPE.strip().splitlines()) < 40


@dataclass(frozen=True)
class Counting(CertificateKind):
    """Counts all draws, or only those that count."""

    name: ClassVar[str] = "counting"
    all_of_them: bool = True

    def certify(self, sample: Sample, confidence: float = 0.95) -> Certificate:
        """Return the scenario bound of the draws."""
        if sample.failed:
            raise CertificateError("a failure exceeds any bound.")
        drawn = len(sample.only("iid") if self.all_of_them else sample.countable)
        volume = certificates.volume_bound(drawn, 0, 1 - confidence)
        return Certificate(self.name, "", sample.best, confidence, volume, drawn, ())


@pytest.mark.slow
def test_a_kind_that_counts_draws_whose_number_depended_on_results_is_noticed() -> None:
    trials = Sample(np.linspace(0, 1, 9)[:, None], np.linspace(0, 0.9, 9), ["initial"] * 9, ["completed"] * 9)
    for kind in (Counting(all_of_them=False), certificates.Audit(), certificates.Scenario()):
        check_certificate(kind, trials)
    with refuses(ConformanceError, "sample.rows", "sample.countable"):
        check_certificate(Counting(), trials)
    check_certificate(Counting(all_of_them=False))
    with refuses(ConformanceError, "sample.rows", "sample.countable"):
        check_certificate(Counting())


@dataclass(frozen=True)
class Unsound(CertificateKind):
    """Bounds the share of the tasks above a limit, by rows of trials that it should not count alone."""

    name: ClassVar[str] = "unsound"
    rows: str = "all"
    limit: float = 0.5

    def certify(self, sample: Sample, confidence: float = 0.95) -> Certificate:
        """Return the bound of Clopper and Pearson."""
        counted = sample.rows(range(len(sample)) if self.rows == "all" else sample.countable)
        if self.rows == "measured":
            counted = counted.rows(np.flatnonzero(np.isfinite(counted.distances)).tolist())
        above = int((~(counted.distances <= self.limit)).sum())
        if above >= len(counted):
            raise CertificateError("all tasks exceed the limit.")
        volume = certificates.volume_bound(len(counted), above, 1 - confidence)
        return Certificate(self.name, "", self.limit, confidence, volume, len(counted), ())


@dataclass(frozen=True)
class Narrower(CertificateKind):
    """A bound on the same share of the tasks that more draws lower."""

    name: ClassVar[str] = "narrower"

    def certify(self, sample: Sample, confidence: float = 0.95) -> Certificate:
        """Return the mean and three standard errors."""
        drawn = sample.only("iid").distances
        if not len(drawn):
            raise CertificateError("there are no draws.")
        bound = float(drawn.mean() + 3 * drawn.std() / np.sqrt(len(drawn)))
        return Certificate(self.name, "", bound, confidence, 0.1, len(drawn), ())


@pytest.mark.slow
def test_kinds_whose_statements_are_false_too_often_are_noticed() -> None:
    check_certificate(Unsound("countable"))
    with refuses(ConformanceError, 20, 100, 10):
        check_certificate(Unsound("all"))
    with refuses(ConformanceError, 100, 20):
        check_certificate(Unsound("measured"))
    with refuses(ConformanceError, "sample.rows", "sample.countable"):
        check_certificate(Narrower())


def test_a_check_in_which_a_kind_refuses_everything_is_no_check() -> None:
    with refuses(ConformanceError, "discarding", 1):
        check_certificate(certificates.SamplingDiscarding())


@pytest.mark.parametrize(
    ("planned", "trials"), [([0] * 5, None), ([0, 0, 5, 5, 5], 3), ([3, 3, 3, 5, 5], 2), ([5] * 5, 5)]
)
def test_a_verdict_gives_any_kind_only_draws_whose_number_did_not_depend_on_results(
    planned: list[int], trials: int | None
) -> None:
    drawn = [
        Trial(k, "iid", "completed", np.array([0.2 * k]), {"p": 0.2 * k}, distance=0.1 * k, note=TrialNote(draws=draws))
        for k, draws in enumerate(planned)
    ]
    verdict = judge(drawn, 1.0, CertificateOptions(Counting(), 0.9, volume=0.5))
    assert (None if verdict.certificate is None else verdict.certificate.trials) == trials


@pytest.mark.slow
def test_the_new_kind_is_found_by_name_and_judges(recipe: ModuleType) -> None:
    campaign = Campaign(make_validation(), search=searches.GPUCB(), seed=1).run(8)
    kind = KINDS.find("lipschitz").of({"slope": 2.0})
    assert kind == recipe.Lipschitz(2.0)
    verdict = campaign.verdict(1e3, certificate=CertificateOptions(kind))
    assert verdict.answer == "validated"
    assert_names(verdict.reason, "lipschitz")
    assert verdict.rests_on is not None
    assert_names(verdict.rests_on, "slope")
    missing = campaign.verdict(1e3, certificate=CertificateOptions(recipe.Lipschitz()))
    assert missing.answer == "undecided"
    assert_names(missing.reason[:23], "lipschitz", "bound")
    assert campaign.verdict(1e-6, certificate=CertificateOptions(kind)).answer == "falsified"


@pytest.mark.slow
def test_the_command_line_and_files_know_the_new_kind(
    recipe: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    store = Campaign(make_validation(), search=searches.GPUCB(), store="own.sqlite", seed=1).run(8).store.path
    result = CliRunner().invoke(app, ["certify", str(store), "--kind", "lipschitz", "--option", "slope=2.0"])
    assert result.exit_code == 0, result.stderr
    assert_names(result.stdout, "lipschitz")
    assert "largest gap" in result.stdout
    for option, facts in (
        ("slope=high", ()),
        ("slop=1", ("slope",)),
        ("5", ("NAME", "VALUE")),
    ):
        refused = CliRunner().invoke(app, ["certify", str(store), "--kind", "lipschitz", "--option", option])
        assert refused.exit_code == 2
        assert_names(refused.stderr.replace("\n", " "), *facts)
    stated = {"kind": "lipschitz", "slope": 2.0}
    assert CertificateTable.model_validate(stated).model_dump()["slope"] == 2.0
    assert CertificateTable.model_validate(stated).options(0.9).kind == recipe.Lipschitz(2.0)
    for wrong in ({"slop": 2.0}, {"slope": "steep"}, {"discard": 2}):
        with pytest.raises(ValidationError):
            CertificateTable.model_validate({**stated, **wrong})


@dataclass(frozen=True)
class Trusting(CertificateKind):
    """Nothing is worse than what was executed."""

    name: ClassVar[str] = "trusting"

    def certify(self, sample: Sample, confidence: float = 0.95) -> Certificate:
        """Return the largest distance found."""
        return Certificate(self.name, "", sample.best, confidence, 0.0, len(sample), ())

    @classmethod
    def rests_on(cls, certificate: Certificate, space: object = None) -> list[str]:
        """Return what a validation by it rests on."""
        return ["your trust"]


def test_a_kind_that_is_not_found_by_name_says_what_a_validation_rests_on() -> None:
    known = [Trial(0, "manual", "completed", np.array([0.5]), {"p": 0.5}, 1, True, 0.1)]
    verdict = judge(known, 1.0, CertificateOptions(Trusting()))
    assert verdict.answer == "validated"
