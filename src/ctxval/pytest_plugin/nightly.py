"""The fixture ``nightly``: campaigns whose stores are in pytest's cache, and whose verdicts are outcomes of tests."""

from __future__ import annotations

import json
import os
import re
import shlex
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Literal, TypeVar

import pytest

from ctxval import Array, Campaign, Comparison, Experiment, Trial, Validation, Verdict, compare
from ctxval._util.checked import NonNegativeFloat, PositiveFloat, PositiveInt, Seconds, checked
from ctxval._util.describe import describe
from ctxval._util.representation import task_text
from ctxval._util.texts import markdown_text, visible
from ctxval.certificates.options import CONFIDENCE, CertificateOptions
from ctxval.certificates.sentences import summary
from ctxval.cli.config.settings import ExperimentSettings, read_settings
from ctxval.errors import InputError, StoreMismatchError
from ctxval.report import context_of_campaign, picture, write_page
from ctxval.searches import Auto
from ctxval.studies.comparison.candidates import Candidate
from ctxval.studies.comparison.compare import BUDGET

Target = Validation | Experiment | str | Path
"""A validation, an experiment, or what ``ctxval run`` takes: an experiment file, a case or ``module:attr``."""

Opened = TypeVar("Opened")

_ICONS = {"validated": ":white_check_mark:", "falsified": ":x:", "failed": ":x:", "undecided": ":grey_question:"}
_REPEAT = "repeat it"


class Nightly:
    """The campaigns of one test; each method may be called once in a test.

    A campaign makes at most ``--ctxval-budget`` executions in a run, and goes on in the next run until it is decided or
    its budget is spent. If the model, the controllers or the system's description change, it begins anew, and the
    earlier store is kept beside the new one.
    """

    def __init__(self, request: pytest.FixtureRequest) -> None:
        self._node, self._config = request.node, request.config
        cache = request.config.cache
        if cache is None:
            raise InputError("pytest has no cache, in which stores are kept: remove `-p no:cacheprovider`.")
        name = re.sub(r"[^\w.-]+", "-", self._node.nodeid).strip("-")
        self._folder = cache.mkdir("ctxval") / name
        self._folder.mkdir(exist_ok=True)

    @checked
    def validate(
        self,
        target: Target,
        threshold: PositiveFloat | None = None,
        *,
        budget: PositiveInt | None = None,
        confidence: float | None = None,
        workers: PositiveInt | None = None,
        timeout: Seconds | None = None,
    ) -> Verdict:
        """Let the test fail if the model is falsified, and pass if it is validated; return the verdict.

        Args:
            target: a validation, an experiment, or the name of an experiment as for ``ctxval run``.
            threshold: tau, in the units of the distance; that of the experiment by default.
            budget: the largest number of executions in all runs together; that of the experiment by default, or 25.
            confidence: the confidence of the verdict; that of the experiment file by default, or 0.95.
            workers, timeout: as in :meth:`ctxval.Campaign.run`.
        """
        settings, experiment = _experiment(target)
        tau = threshold or (settings and settings.threshold) or experiment.threshold
        if tau is None:
            raise InputError("a threshold is needed: it is the largest acceptable distance.")
        self._only_task(experiment, lambda point: tau)

        def opened(path: Path) -> Campaign:
            if settings is not None:
                return settings.campaign(experiment, path)
            return Campaign(experiment.validation, store=path, name=experiment.name)

        path = self._folder / "campaign.sqlite"
        campaign = self._anew(lambda: opened(path), path)
        total = budget or (settings and settings.budget) or experiment.budget
        before = campaign.executions
        limit = self._limit(total, before)
        options = CertificateOptions() if settings is None else settings.certificate_options
        options = options if confidence is None else replace(options, confidence=confidence)
        if limit > before:
            campaign.run(limit, tau, certificate=options, workers=workers, timeout=timeout, progress=False)
        verdict, units = campaign.verdict(tau, certificate=options), experiment.units
        context = context_of_campaign(campaign, verdict, budget=total)
        report = write_page(context, path.with_suffix(".report.html"))
        made = f"{campaign.executions} of at most {total}, {campaign.executions - before} in this run"
        facts = {**summary.rows(verdict, units), "executions": made}
        if campaign.worst is not None:
            facts |= self._repeated("worst task", campaign.worst, units)
        facts |= {"store": _shown(path), "report": _shown(report)}
        answer: str = verdict.answer
        sentence = answer.upper() + summary.headline(verdict, units)
        if campaign.failed and not campaign.completed:
            answer = "failed"
            sentence = f"all {len(campaign.failed)} executions failed: {campaign.failed[-1].failure}"
        self._end(answer, sentence, facts, picture(context))
        return verdict

    @checked
    def not_worse(
        self,
        candidate: Target,
        than: Target,
        *,
        tolerance: NonNegativeFloat = 0.05,
        question: Literal["mean", "worst"] = "mean",
        budget: PositiveInt = BUDGET,
        confidence: float = CONFIDENCE,
    ) -> Comparison:
        """Let the test fail if a candidate is worse than a pinned baseline; return the comparison.

        Both execute the same tasks on one system (:func:`ctxval.compare`).

        Args:
            candidate: the new model, controller or checkpoint.
            than: the baseline.
            tolerance: by which share of the baseline's expected distance that of the candidate may be larger; with 0,
                two equal candidates are never decided. The question ``worst`` has none.
            question: ``mean`` for the expected distance, or ``worst`` for the largest one.
            budget: the largest number of executions of both in all runs together.
            confidence: the confidence of the decision.
        """
        targets = {"candidate": _experiment(candidate)[1], "baseline": _experiment(than)[1]}
        pinned = targets["baseline"].validation
        self._only_task(targets["candidate"], lambda point: (1 + tolerance) * pinned.outcome(point).distance)
        paths = {name: self._folder / f"{name}.sqlite" for name in targets}

        def opened() -> dict[str, Campaign]:
            return {
                name: Campaign(each.validation, search=Auto(thinking="fast"), store=paths[name], name=name)
                for name, each in targets.items()
            }

        campaigns = self._anew(opened, *paths.values())  # a comparison is about two fixed candidates
        before = made = sum(len(Candidate(name, each, 0).executed()) for name, each in campaigns.items())
        limit, decided = self._limit(budget, before), ""
        while not decided:
            made = min(made + 4, max(limit, 1))  # between two looks at whether it is decided
            compared = compare(campaigns, question=question, budget=made, confidence=confidence, progress=False)
            pair, allowed = compared.pairs[0], tolerance * (compared.candidates[1].mean or 0.0)
            if pair.smaller == "candidate" or (pair.high is not None and pair.high <= allowed):
                decided = "validated"
            elif pair.smaller == "baseline":
                decided = "falsified"
            elif made >= limit or compared.executions < made:
                decided = "undecided"
        units, worst = targets["candidate"].units, campaigns["candidate"].worst
        is_known = {"validated": "is", "falsified": "is not", "undecided": "is not yet known to be"}[decided]
        facts = {"executions": f"{compared.executions} of at most {budget}, {compared.executions - before} in this run"}
        if worst is not None:
            facts |= self._repeated("worst task of the candidate", worst, units)
        facts["stores"] = _shown(self._folder)
        sentence = f"the candidate {is_known} as good as the baseline: {pair.reason}."
        self._end(decided, sentence, facts)
        return compared

    def _limit(self, total: int, before: int) -> int:
        tonight = self._config.getoption("ctxval_budget")
        return total if tonight is None else min(total, before + tonight)

    def _anew(self, opened: Callable[[], Opened], *paths: Path) -> Opened:
        """Open stores; those of an earlier experiment are renamed, and new ones are made."""
        try:
            return opened()
        except StoreMismatchError:
            for path in filter(Path.exists, paths):
                count = len([*self._folder.glob(f"{path.stem}.*.sqlite")]) + 1
                path.rename(path.with_suffix(f".{count}.sqlite"))
            return opened()

    def _only_task(self, experiment: Experiment, limit: Callable[[Array], float]) -> None:
        """With ``--ctxval-task``, execute this task alone, and end the test."""
        if (text := self._config.getoption("ctxval_task")) is None:
            return
        try:
            parameters = json.loads(text)
        except ValueError as error:
            raise InputError(f"--ctxval-task must be a JSON object, got {text!r}.") from error
        point = experiment.validation.space.point(parameters)
        distance, most = experiment.validation.outcome(point).distance, limit(point)
        sentence = visible(f"{task_text(parameters)}: {distance:.6g}, limit {most:.6g} {experiment.units}".rstrip())
        self._node.user_properties.append(("ctxval", f"one task   {self._node.nodeid}: {sentence}"))
        if distance > most:
            pytest.fail(sentence, pytrace=False)
        pytest.skip(f"{sentence}; one task validates nothing")

    def _repeated(self, name: str, trial: Trial, units: str) -> dict[str, str]:
        distance = f"{trial.distance:.4g} {units}".rstrip()
        task = json.dumps(describe(trial.parameters))
        command = shlex.join(["pytest", "--ctxval", self._node.nodeid, "--ctxval-task", task])
        return {name: f"{task_text(trial.parameters)}: {distance} (trial {trial.number})", _REPEAT: command}

    def _end(self, answer: str, sentence: str, facts: Mapping[str, str], picture: str = "") -> None:
        name, width = self._node.nodeid, max(map(len, facts), default=0)
        self._node.user_properties.append(("ctxval", f"{answer:9}  {name}: {facts['executions']}"))
        if (path := os.environ.get("GITHUB_STEP_SUMMARY")) is not None:
            rows = [f"| {each} | {markdown_text(value)} |" for each, value in facts.items() if each != _REPEAT]
            table = "\n".join(["| | |", "|---|---|", *rows])
            command = f"```console\n$ {visible(facts[_REPEAT])}\n```" if _REPEAT in facts else ""
            parts = f"## {_ICONS[answer]} {markdown_text(name)}", markdown_text(sentence), picture, table, command
            with open(path, "a", encoding="utf-8") as file:
                file.write("\n\n".join(filter(None, parts)) + "\n\n")
        text = "\n".join([visible(sentence), *(f"{each:{width}}  {visible(value)}" for each, value in facts.items())])
        undecided = self._config.getoption("ctxval_undecided")
        if answer in ("falsified", "failed") or (answer == "undecided" and undecided == "fail"):
            pytest.fail(text, pytrace=False)
        if answer == "undecided" and undecided == "xfail":
            pytest.xfail(text)
        if answer == "undecided":
            pytest.skip(text)
        print(text)


def _shown(path: Path) -> str:
    """Return a path for a message: relative to the current folder, if it is in that."""
    return str(path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path)


def _experiment(target: Target) -> tuple[ExperimentSettings | None, Experiment]:
    if isinstance(target, str | Path):
        settings = read_settings(str(target), {})
        return settings, settings.load()
    return None, Experiment("test", target) if isinstance(target, Validation) else target
