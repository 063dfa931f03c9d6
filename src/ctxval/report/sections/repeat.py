"""What repeats the campaign and each of its worst tasks, and an appendix for the file.

The appendix has the vocabulary of NASA-STD-7009B and of ASME V&V 10 and V&V 20.
"""

from __future__ import annotations

import hashlib
import json
import platform
import shlex
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import scipy
from markupsafe import Markup

from ctxval._util.arrays import Array
from ctxval._util.texts import enumerated
from ctxval._util.version import VERSION
from ctxval.certificates import Automatic
from ctxval.certificates.bounds import at_most, with_error
from ctxval.certificates.options import CONFIDENCE, WITHIN
from ctxval.core.trial import Trial
from ctxval.report.context import ReportContext
from ctxval.report.distance_model import distance_of
from ctxval.report.findings import WORDS
from ctxval.report.markup import UNCUT, code, heading, joined, number, paragraph, quantity, table, text
from ctxval.searches import DEFAULT as DEFAULT_SEARCH


def repeat(context: ReportContext) -> Markup:
    """Return the command, the seed, the versions, the digests and a snippet for each of the worst tasks."""
    parts = [paragraph("No command made this store, so there is none that repeats it.")]
    if command := repeating_command(context):
        same = (
            "The command makes the same choices again, into a new store, with the same versions of the libraries on "
            "the same kind of processor. The option thinking of the search auto must then be a number, fast or "
            "thorough: balanced measures times."
        )
        parts = [paragraph(same), code(command, "Command that repeats the campaign")]
        if not context.settings.get("experiment"):
            named = "The store keeps its content, but not its name, so its name is assumed here."
            parts.append(paragraph(f"The experiment is described in a file. {named}"))
    parts += [
        table("What identifies this campaign", ("Name", "Value"), identity(context).items(), class_="facts"),
        heading("The worst tasks"),
        paragraph(
            "Each snippet executes the system once. For a system that people operate, the command opens the task "
            "again as a new trial, and writes its controller to files."
        ),
    ]
    for trial in context.worst_tasks(5):
        parts += [
            heading(f"Trial {trial.number}, distance {quantity(distance_of(trial), context.labels.units)}", 4),
            code(python_snippet(context, trial), f"Python for trial {trial.number}"),
            code(command_snippet(context, trial), f"Command for trial {trial.number}"),
        ]
    return joined(parts)


def identity(context: ReportContext) -> dict[str, str]:
    """Return the seed, the versions and the digests by name."""
    search = context.description.get("search")
    known = ("space", "task", "system", "model", "synthesizer", "distance")
    digests = {f"digest of the {name}": digest(part) for name, part in context.parts.items() if name in known}
    trials = [[trial.number, trial.state, trial.unit_point.tolist(), trial.distance] for trial in context.trials]
    return {
        "store": str(context.store.name),
        "search": str(search.get("type")) if isinstance(search, Mapping) else "not known",
        "seed": str(context.description.get("seed", "not known")),
        "version of ctxval": VERSION,
        "version of Python": platform.python_version(),
        "version of numpy": np.__version__,
        "version of scipy": scipy.__version__,
        "processor": platform.machine(),
        **digests,
        "digest of the trials": digest(trials),
    }


def digest(value: Any) -> str:
    """Return the SHA-256 of a value for JSON."""
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()


def repeating_command(context: ReportContext) -> str:
    """Return the command that runs the campaign again, into a store in a folder of its own; empty if none made it."""
    path = Path(path_of(context))
    return command_of(context, None, "--store", str(path.parent / "again" / path.name))


def command_of(context: ReportContext, budget: int | None = None, *others: str) -> str:
    """Return the command that runs the campaign; empty if no command made the store."""
    settings = context.settings
    return run_command(settings, budget or settings.get("budget") or context.budget, *others) if settings else ""


def run_command(settings: Mapping[str, Any], budget: int | None, *others: str, target: str = "") -> str:
    """Return the command that runs a campaign with settings as a store keeps them, and with ``others`` beside them.

    ``target`` is the experiment, if it must be named otherwise than in the settings.
    """
    file = settings.get("file")
    named = None if file else settings.get("experiment")
    words = ["ctxval", "run", str(target or file or named or f"{settings.get('name') or 'experiment'}.toml")]
    # A store may hold anything.
    tables = {name: table for name, table in settings.items() if isinstance(table, Mapping)}
    search, certificate, options = (tables.get(name, {}) for name in ("search", "certificate", "options"))
    # The value of each option, and its default, with which it is left out.
    values = {
        "--search": (search.get("name"), DEFAULT_SEARCH if named else None),
        "--seed": (settings.get("seed"), 0 if named else None),
        "--budget": (budget, None),
        "--threshold": (settings.get("threshold"), None),
        "--confidence": (settings.get("confidence"), CONFIDENCE),
        **{f"--{option.name}": (certificate.get(option.name), option.default) for option in fields(Automatic)},
        "--within": (settings.get("within"), WITHIN),
    }
    for option, (value, default) in values.items():
        words += [] if value is None or value == default else [option, str(value)]
    explore = settings.get("explore")
    words += ["--explore"] if explore is True else ["--decide"] if explore is False else []
    for name, value in options.items():
        words += ["--option", f"{name}={value}"]
    return shlex.join([*words, *others])


def python_snippet(context: ReportContext, trial: Trial) -> str:
    """Return Python that executes the task of a trial once. Texts of the store are literals in it."""
    made = "validation = ...  # the Validation of the campaign"
    if context.settings:
        made = (
            "from ctxval import Store\nfrom ctxval.cli.config.stored_settings import trusted_settings\n\n"
            f"store = Store.existing({str(path_of(context))!r})\n"
            "validation = trusted_settings(store).load().validation"
        )
    return (
        f"{made}\npoint = validation.space.point({trial.parameters!r})\noutcome = validation.outcome(point)\n"
        f"print(outcome.distance)  # {distance_of(trial)!r} in the store"
    )


def command_snippet(context: ReportContext, trial: Trial) -> str:
    """Return the command that opens the task of a trial again, and writes its controller to files."""
    return shlex.join(["ctxval", "ask", str(path_of(context)), "--again", str(trial.number)])


def path_of(context: ReportContext) -> Path | str:
    """Return the path of the store, for a command."""
    return context.store.name if context.store.path is not None else "campaign.sqlite"


# The appendix

_NASA, _V10, _V20 = "NASA-STD-7009B", "ASME V&V 10", "ASME V&V 20"


class Entry(NamedTuple):
    """One entry of the appendix."""

    term: str
    standard: str
    content: str


def for_the_file(context: ReportContext) -> Markup:
    """Return what a file on the credibility of a model holds, as far as this campaign knows it, as a table."""
    meaning = (
        "The entries use the vocabulary of the named standards. They state what this campaign knows; they are no claim "
        "of conformance."
    )
    rows = [(entry.term, text(entry.content, UNCUT), entry.standard) for entry in appendix(context)]
    headers = ("Term", "Content", "Vocabulary of")
    return joined([paragraph(meaning), table("Appendix for the file", headers, rows, class_="facts")])


def appendix(context: ReportContext) -> Iterator[Entry]:
    """Yield the entries of the appendix: the purpose, the evidence, and its limits."""
    space, units, certificate, digests = context.space, context.labels.units, context.certificate, identity(context)
    synthesizer = None if context.validation is None else type(context.validation.synthesizer).__name__
    design = "" if synthesizer is None else f", with the synthesizer {synthesizer}"
    use = (
        f"The model predicts closed loops under controllers that are designed on it{design}, for the tasks of "
        f"{context.name or 'this experiment'}: {_box(context, space.low, space.high)}. Distribution of tasks: "
        f"{context.provenance.distribution or 'uniform'}."
    )
    yield Entry("Intended use", f"{_NASA}, {_V10}", use)
    described = context.parts.get("distance")
    kind = described.get("type", "a function") if isinstance(described, dict) else described or "not known"
    yield Entry(
        "Response quantity of interest and validation metric",
        f"{_V10}, {_V20}",
        "The context-specific distance d(p) between the trajectories of model and system under the same controller "
        f"({kind}{f', in {units}' if units else ''}); the quantity of interest is its largest value d* over all tasks.",
    )
    criterion = "None was stated."
    if context.verdict is not None:
        confidence = "" if certificate is None else f", with confidence {number(certificate.confidence)}"
        criterion = f"d* is at most {quantity(context.verdict.threshold, units)}{confidence}."
    yield Entry("Acceptance criterion (accuracy requirement)", f"{_NASA}, {_V10}", criterion)
    origins = Counter(trial.origin for trial in context.trials)
    listed = ", ".join(f"{count} {origin}" for origin, count in sorted(origins.items()))
    referent = (
        f"{context.executions} executions of the system in {len(context.trials)} trials ({listed or 'none'}), of which "
        f"{len(context.completed)} gave a distance and {len(context.recordings)} a recorded trajectory. Digest of the "
        f"description of the system: {digests.get('digest of the system', 'not known')}."
    )
    yield Entry("Referent data", f"{_NASA}, {_V10}", referent)
    error, executed = "No distance is known.", "Nothing was executed."
    if context.completed:
        worst = context.worst_first[0]
        error = (
            f"Largest distance {quantity(distance_of(worst), units)} (trial {worst.number}), median "
            f"{quantity(float(np.median(context.distances)), units)}, smallest "
            f"{quantity(float(context.distances.min()), units)}, over {len(context.distances)} executed tasks. The "
            "tasks were chosen by a search for large distances, so the median is not that of all tasks."
        )
        points = context.coordinates(context.completed)
        ranges = _box(context, points.min(axis=0), points.max(axis=0))
        if context.suite is not None:
            ranges = f"{len(context.suite) - len(context.suite.remaining(context.points))} tasks of the suite"
        executed = f"Executed: {ranges}. Nothing is said about tasks outside the intended use."
    yield Entry("Comparison error E = S \u2212 D (here: M \u2212 S)", _V20, error)
    yield Entry("Domain of validation, and what lies outside it", f"{_NASA}, {_V10}, {_V20}", executed)
    uncertainty = "No certificate was computed, so no uncertainty is stated for tasks that were not executed."
    assumptions, robustness = "None beyond the recorded executions", "Not known: fewer than two distances."
    if certificate is not None:
        bound, volume = with_error(certificate.upper_bound, certificate.error), certificate.volume
        except_for = f", except for {at_most(100 * volume, 3)} % of the tasks" if volume else ""
        withdrawn = "" if certificate.doubt is None else f" The certificate is withdrawn: {certificate.doubt}."
        uncertainty = (
            f"By the certificate {certificate.kind}, d* is at most {bound} with confidence "
            f"{number(certificate.confidence)}{except_for}. The uncertainty of the measured trajectories themselves is "
            f"not part of it.{withdrawn}"
        )
        assumptions = "; ".join(certificate.assumptions)
    if (model := context.distance_model) is not None and context.suite is None:
        shares = ((context.space.labels[j], number(float(model.sensitivity[j]), 2)) for j in model.influence[:5])
        listed = "; ".join(f"{label} {share}" for label, share in shares)
        robustness = f"Total Sobol indices of the predicted distance, the largest first: {listed}."
    lights = "; ".join(f"{finding.name}: {WORDS[finding.light]}" for finding in context.diagnostics)
    changes = "; ".join(f"{change.at[:19]} {change.what}: {change.why}" for change in context.store.history())
    yield Entry("Uncertainty characterization", f"{_NASA}, {_V10}, {_V20}", uncertainty)
    yield Entry("Results robustness (sensitivity)", _NASA, robustness)
    yield Entry("Assumptions", f"{_NASA}, {_V10}", f"{assumptions}.")
    yield Entry("Limits of the assessment: what was not tested", f"{_NASA}, {_V10}", " ".join(context.not_tested))
    verification = "Software and solution verification of the model itself are not part of this campaign."
    unusual = f"Diagnostics of the campaign: {lights or 'nothing is unusual'}."
    yield Entry("Verification", f"{_NASA}, {_V10}", f"{verification} {unusual}")
    yield Entry("Changes during the campaign", _NASA, changes or "None is recorded.")
    described_as = f"digest of the description of the model: {digests.get('digest of the model', 'not known')}"
    command = f"command: {command_of(context) or 'none'}"
    yield Entry("Provenance", _NASA, f"Store {context.store.name}; ctxval {VERSION}; {command}; {described_as}.")
    conclusion = str(context.verdict or "No verdict, because no threshold was stated.")
    yield Entry("Conclusion", f"{_NASA}, {_V10}", conclusion)


def _box(context: ReportContext, low: Array, high: Array) -> str:
    if context.suite is not None:
        return f"a suite of {len(context.suite)} tasks, {enumerated(context.suite.task_names, 40)}"
    ends = zip(context.space.labels, low.tolist(), high.tolist(), strict=True)
    return "; ".join(f"{label} from {number(first)} to {number(last)}" for label, first, last in ends)
