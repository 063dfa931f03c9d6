"""``ctxval compare``: which of several models, controllers or distances is better on one system."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from ctxval import plot
from ctxval._util.files import write_text
from ctxval._util.texts import reason_of
from ctxval.certificates.options import CONFIDENCE
from ctxval.cli.base import command, err, failures_of, out, print_columns, print_failures
from ctxval.cli.commands import app
from ctxval.cli.options import AsJson, Confidence, PartOptions, named_values
from ctxval.cli.outputs import Force, require_outputs
from ctxval.comparison.candidates import Candidate, require_comparable
from ctxval.comparison.compare import BUDGET, store_name
from ctxval.comparison.race import Race
from ctxval.comparison.result import WORDS, Comparison
from ctxval.comparison.tables import CANDIDATES, PAIRS, candidate_rows, markdown, pair_rows
from ctxval.config.settings import Settings, read_settings
from ctxval.errors import InputError

Targets = Annotated[
    list[str],
    typer.Argument(
        metavar="CANDIDATE...",
        help="Two or more candidates: cases, experiment files or references to objects in Python. NAME=CANDIDATE gives "
        "a candidate a name. CASE:OPTION=VALUE is a case with an option, such as arm:model=gp.",
    ),
]
QuestionName = Annotated[
    str,
    typer.Option(
        help="Question: worst (which has the smaller largest distance d*), mean (which has the smaller expected "
        "distance over the distribution of tasks), or both."
    ),
]
Budget = Annotated[
    int,
    typer.Option(
        help="Maximum number of executions of the system for all candidates together, including earlier ones in the "
        "stores. An execution that several candidates share counts once."
    ),
]
Seed = Annotated[int, typer.Option(min=0, help="Seed of the random numbers of the data, the models and the draws.")]
Stores = Annotated[
    Path,
    typer.Option(
        "--stores",
        metavar="FOLDER",
        help="Folder of the stores, one for each candidate. If they exist, the comparison is resumed.",
    ),
]
LargestPossible = Annotated[
    float | None,
    typer.Option(
        help="A number that no distance can exceed, if one is known. Decisions on expected distances are then valid "
        "for any number of tasks, and a failed execution counts as this distance."
    ),
]
Stochastic = Annotated[
    bool,
    typer.Option("--stochastic", help="State that two executions of one task may differ; only with --question mean."),
]
Out = Annotated[
    Path | None,
    typer.Option(
        "--out", metavar="FILE.md", help="Also write the tables to this Markdown file, and a picture next to it."
    ),
]


@app.command()
@command
def compare(
    candidates: Targets,
    question: QuestionName = "both",
    budget: Budget = BUDGET,
    confidence: Confidence = None,
    seed: Seed = 0,
    stores: Stores = Path("runs/compare"),
    largest_possible: LargestPossible = None,
    stochastic: Stochastic = False,
    out_file: Out = None,
    force: Force = False,
    as_json: AsJson = False,
    option: PartOptions = None,
) -> Any:
    """Compare models, controllers or distances on one system, with as few executions of it as possible.

    The comparison stops when all pairs are decided or the budget is spent. If it is interrupted, run it again: it
    continues from the stores.
    """
    picture = None if out_file is None else out_file.with_suffix(".png")
    require_outputs({"--out .md": out_file, "its picture": picture}, candidates, force=force)
    made = _candidates(_named(candidates), stores, seed, named_values(option))
    race = Race(
        made,
        question,  # type: ignore[arg-type]  # the constructor refuses other words
        budget=budget,
        confidence=CONFIDENCE if confidence is None else confidence,
        seed=seed,
        largest_possible=largest_possible,
        stochastic=stochastic,
    )
    found = race.run()
    failures = {candidate.name: failures_of(candidate.campaign.failed) for candidate in made}
    if not as_json:
        _print(found)
        for value in failures.values():
            print_failures(value)
    files = []
    if out_file is not None:
        files.append(str(write_text(out_file, markdown(found))))
        try:
            files.append(str(plot.save(found.plot(), out_file.with_suffix(".png"))))
        except Exception as error:  # it must not hide the decisions, for which executions were paid
            err.say(f"no picture: {reason_of(error)}")
    paths = {candidate.name: str(candidate.campaign.store.path) for candidate in made}
    return {**found.to_dict(), "stores": paths, "failures": failures, "files": files}


def _named(texts: Sequence[str]) -> dict[str, str]:
    """Return the candidates by name: the name that is given, or else the text without folder and suffix."""
    found: dict[str, str] = {}
    for text in texts:
        before, equals, after = text.partition("=")
        given = bool(equals) and before.isidentifier()
        target = after if given else text
        name = before if given else os.path.basename(target).removesuffix(".toml")
        if name in found:
            raise InputError(f"two candidates are called {name}: give one another name, as in NAME={target}.")
        found[name] = target
    return found


def _candidates(named: Mapping[str, str], folder: Path, seed: int, options: dict[str, Any]) -> list[Candidate]:
    """Return the candidates with their stores. A refused comparison leaves no store that a later one would find."""
    found = {name: _settings(target, seed, options) for name, target in named.items()}
    loaded = {name: settings.load() for name, settings in found.items()}
    require_comparable({name: experiment.validation for name, experiment in loaded.items()})
    return [
        Candidate(name, settings.campaign(loaded[name], folder / f"{store_name(name)}.sqlite"))
        for name, settings in found.items()
    ]


def _settings(target: str, seed: int, options: dict[str, Any]) -> Settings:
    """Return the settings of a case with options (``arm:model=gp``), an experiment file or a reference."""
    case, colon, rest = target.partition(":")
    if colon and "=" in rest:
        options = {**options, **named_values(rest.split(","))}
        target = case
    return read_settings(target, {"seed": seed, "options": options})


def _print(found: Comparison) -> None:
    for question in found.questions:
        out.say((f"{WORDS[question]}: ", "bold"), found.ranking_text(question), wrap=True)
    for headers, rows in ((CANDIDATES, candidate_rows(found)), (PAIRS, pair_rows(found))):
        out.say("")
        print_columns(headers, (), rows)
    out.say("")
    for pair in found.pairs:
        out.say(f"{pair.first}, {pair.second}: {pair.reason}.", wrap=True)
    units = f" The distances are in {found.units}." if found.units else ""
    out.say(
        f"{found.executions} executions of at most {found.budget}. All decisions hold together with confidence "
        f"{found.confidence:.6g}.{units} They assume that",
        wrap=True,
    )
    for assumption in found.assumptions:
        out.say(f"- {assumption};", wrap=True)
