"""``ctxval compare``: which of several models, controllers or distances is better on one system."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ctxval import plot
from ctxval._util.files import write_text
from ctxval._util.texts import reason_of
from ctxval.campaign.campaign import Campaign
from ctxval.certificates.options import CONFIDENCE
from ctxval.cli.base import command, err, failures_of, out, print_columns, print_failures
from ctxval.cli.config.settings import read_settings
from ctxval.cli.options import named_values, require_outputs
from ctxval.errors import InputError
from ctxval.studies.comparison import compare as run_comparison
from ctxval.studies.comparison.candidates import require_comparable
from ctxval.studies.comparison.compare import BUDGET, store_name
from ctxval.studies.comparison.result import CANDIDATES, PAIRS, WORDS, Comparison


@command()
def compare(
    candidates: list[str],
    question: str = "both",
    budget: int = BUDGET,
    confidence: float | None = None,
    seed: int = 0,
    stores: Path = Path("runs/compare"),
    largest_possible: float | None = None,
    stochastic: bool = False,
    out_: Path | None = None,
    force: bool = False,
    option: list[str] | None = None,
) -> Any:
    """Compare models, controllers or distances on one system, with as few executions of it as possible.

    The comparison stops when all pairs are decided or the budget is spent. If it is interrupted, run it again: it
    continues from the stores.
    """
    picture = None if out_ is None else out_.with_suffix(".png")
    require_outputs({"--out .md": out_, "its picture": picture}, candidates, force=force)
    made = _candidates(_named(candidates), stores, seed, named_values(option))
    comparison = run_comparison(
        made,
        question=question,  # type: ignore[arg-type]  # it refuses other words
        budget=budget,
        confidence=CONFIDENCE if confidence is None else confidence,
        seed=seed,
        largest_possible=largest_possible,
        stochastic=stochastic,
    )
    failures = {name: failures_of(campaign.failed) for name, campaign in made.items()}
    _print(comparison)
    for value in failures.values():
        print_failures(value)
    files = []
    if out_ is not None:
        files.append(str(write_text(out_, comparison.to_markdown())))
        try:
            files.append(str(plot.save(comparison.plot(), out_.with_suffix(".png"))))
        except Exception as error:  # it must not hide the decisions, for which executions were paid
            err.say(f"no picture: {reason_of(error)}")
    paths = {name: str(campaign.store.path) for name, campaign in made.items()}
    return {**comparison.to_dict(), "stores": paths, "failures": failures, "files": files}


def _named(texts: Sequence[str]) -> dict[str, str]:
    """Return the candidates by name: the name that is given, or else the text without folder and suffix."""
    targets: dict[str, str] = {}
    for text in texts:
        before, equals, after = text.partition("=")
        given = bool(equals) and before.isidentifier()
        target = after if given else text
        name = before if given else os.path.basename(target).removesuffix(".toml")
        if name in targets:
            raise InputError(f"two candidates are called {name}: give one another name, as in NAME={target}.")
        targets[name] = target
    return targets


def _candidates(targets: Mapping[str, str], folder: Path, seed: int, options: dict[str, Any]) -> dict[str, Campaign]:
    """Return the campaigns of the candidates. A refused comparison leaves no store that a later one would find."""
    settings = {}
    for name, target in targets.items():
        case, colon, rest = target.partition(":")
        if colon and "=" in rest:  # a case with options of its own, such as arm:model=gp
            given = {"seed": seed, "options": {**options, **named_values(rest.split(","))}}
            settings[name] = read_settings(case, given)
        else:
            settings[name] = read_settings(target, {"seed": seed, "options": options})
    loaded = {name: each.load() for name, each in settings.items()}
    require_comparable({name: experiment.validation for name, experiment in loaded.items()})
    return {name: each.campaign(loaded[name], folder / f"{store_name(name)}.sqlite") for name, each in settings.items()}


def _print(comparison: Comparison) -> None:
    for question in comparison.questions:
        out.say((f"{WORDS[question]}: ", "bold"), comparison.ranking_text(question), wrap=True)
    for headers, results in ((CANDIDATES, comparison.candidates), (PAIRS, comparison.pairs)):
        out.say("")
        print_columns(headers, [result.cells for result in results], left=len(headers))
    out.say("")
    for pair in comparison.pairs:
        out.say(f"{pair.first}, {pair.second}: {pair.reason}.", wrap=True)
    units = f" The distances are in {comparison.units}." if comparison.units else ""
    out.say(
        f"{comparison.executions} executions of at most {comparison.budget}. All decisions hold together with "
        f"confidence {comparison.confidence:.6g}.{units} They assume that",
        wrap=True,
    )
    for assumption in comparison.assumptions:
        out.say(f"- {assumption};", wrap=True)
