"""An appendix for the file, in the vocabulary of NASA-STD-7009B and of ASME V&V 10 and V&V 20."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from markupsafe import Markup

from ctxval._util.arrays import Array
from ctxval._util.texts import enumerated
from ctxval._util.version import VERSION
from ctxval.certificates.bounds import at_most, with_error
from ctxval.report.context import ReportContext
from ctxval.report.distance_model import distance_of
from ctxval.report.findings import WORDS
from ctxval.report.markup import UNCUT, joined, number, paragraph, quantity, table, text
from ctxval.report.sections.repeat import command_of, identity

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
    yield Entry(
        "Intended use",
        f"{_NASA}, {_V10}",
        f"The model predicts closed loops under controllers that are designed on it{design}, for the tasks of "
        f"{context.name or 'this experiment'}: {_box(context, space.low, space.high)}. Distribution of tasks: "
        f"{context.provenance.distribution or 'uniform'}.",
    )
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
    yield Entry(
        "Referent data",
        f"{_NASA}, {_V10}",
        f"{context.executions} executions of the system in {len(context.trials)} trials ({listed or 'none'}), of which "
        f"{len(context.completed)} gave a distance and {len(context.recordings)} a recorded trajectory. Digest of the "
        f"description of the system: {digests.get('digest of the system', 'not known')}.",
    )
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
    yield Entry(
        "Verification",
        f"{_NASA}, {_V10}",
        "Software and solution verification of the model itself are not part of this campaign. Diagnostics of the "
        f"campaign: {lights or 'nothing is unusual'}.",
    )
    yield Entry("Changes during the campaign", _NASA, changes or "None is recorded.")
    yield Entry(
        "Provenance",
        _NASA,
        f"Store {context.store.name}; ctxval {VERSION}; command: {command_of(context) or 'none'}; digest of the "
        f"description of the model: {digests.get('digest of the model', 'not known')}.",
    )
    conclusion = str(context.verdict or "No verdict, because no threshold was stated.")
    yield Entry("Conclusion", f"{_NASA}, {_V10}", conclusion)


def _box(context: ReportContext, low: Array, high: Array) -> str:
    if context.suite is not None:
        return f"a suite of {len(context.suite)} tasks, {enumerated(context.suite.task_names, 40)}"
    ends = zip(context.space.labels, low.tolist(), high.tolist(), strict=True)
    return "; ".join(f"{label} from {number(first)} to {number(last)}" for label, first, last in ends)
