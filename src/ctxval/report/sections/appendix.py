"""An appendix for the file, in the vocabulary of NASA-STD-7009B and of ASME V&V 10 and V&V 20."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from markupsafe import Markup

from ctxval._util.representation import call
from ctxval.certificates.bounds import at_most, with_error
from ctxval.report.context import ReportContext, distance_of
from ctxval.report.diagnostics import diagnostics, not_tested
from ctxval.report.findings import WORDS
from ctxval.report.markup import UNCUT, joined, number, paragraph, quantity, table, text
from ctxval.report.sections.repeat import command_of, digest
from ctxval.version import VERSION

_NASA, _V10, _V20 = "NASA-STD-7009B", "ASME V&V 10", "ASME V&V 20"


@dataclass(frozen=True)
class Entry:
    """One entry of the appendix: a term, the standards that use it, and what this campaign has to say about it."""

    term: str
    standard: str
    content: str


class AppendixSection:
    """What a file on the credibility of a model holds, as far as this campaign knows it."""

    title = "For the file"

    def render(self, context: ReportContext) -> Markup:
        """Return the entries as a table."""
        rows = [(entry.term, text(entry.content, UNCUT), entry.standard) for entry in appendix(context)]
        return joined(
            [
                paragraph(
                    "The entries use the vocabulary of the named standards. They state what this campaign knows; they "
                    "are no claim of conformance."
                ),
                table("Appendix for the file", ("Term", "Content", "Vocabulary of"), rows, class_="facts"),
            ]
        )

    __repr__ = call


def appendix(context: ReportContext) -> list[Entry]:
    """Return the entries of the appendix."""
    changes = [f"{change.at[:19]} {change.what}: {change.why}" for change in context.changes]
    certificate = context.certificate
    assumed = ["None beyond the recorded executions"] if certificate is None else certificate.assumptions
    checks = "; ".join(f"{finding.name}: {WORDS[finding.light]}" for finding in diagnostics(context))
    verification = (
        "Software and solution verification of the model itself are not part of this campaign. Diagnostics of the "
        f"campaign: {checks or 'nothing is unusual'}."
    )
    provenance = (
        f"Store {context.store.name}; ctxval {VERSION}; command: {command_of(context) or 'none'}; digest of the "
        f"description of the model: {_part_digest(context, 'model')}."
    )
    return [
        Entry("Intended use", f"{_NASA}, {_V10}", _intended_use(context)),
        Entry("Response quantity of interest and validation metric", f"{_V10}, {_V20}", _metric(context)),
        Entry("Acceptance criterion (accuracy requirement)", f"{_NASA}, {_V10}", _criterion(context)),
        Entry("Referent data", f"{_NASA}, {_V10}", _referent(context)),
        Entry("Comparison error E = S \u2212 D (here: M \u2212 S)", _V20, _error(context)),
        Entry("Domain of validation, and what lies outside it", f"{_NASA}, {_V10}, {_V20}", _domain(context)),
        Entry("Uncertainty characterization", f"{_NASA}, {_V10}, {_V20}", _uncertainty(context)),
        Entry("Results robustness (sensitivity)", _NASA, _robustness(context)),
        Entry("Assumptions", f"{_NASA}, {_V10}", f"{'; '.join(assumed)}."),
        Entry("Limits of the assessment: what was not tested", f"{_NASA}, {_V10}", " ".join(not_tested(context))),
        Entry("Verification", f"{_NASA}, {_V10}", verification),
        Entry("Changes during the campaign", _NASA, "; ".join(changes) or "None is recorded."),
        Entry("Provenance", _NASA, provenance),
        Entry("Conclusion", f"{_NASA}, {_V10}", str(context.verdict or "No verdict, because no threshold was stated.")),
    ]


def _intended_use(context: ReportContext) -> str:
    space = context.space
    ranges = "; ".join(
        f"{label} from {number(low)} to {number(high)}"
        for label, low, high in zip(space.labels, space.low.tolist(), space.high.tolist(), strict=True)
    )
    spread = context.provenance.distribution
    how = "uniform" if spread is None else spread
    design = ""
    if context.validation is not None:
        design = f", with the synthesizer {type(context.validation.synthesizer).__name__}"
    return (
        f"The model predicts closed loops under controllers that are designed on it{design}, for the tasks of "
        f"{context.name or 'this experiment'}: {ranges}. Distribution of tasks: {how}."
    )


def _metric(context: ReportContext) -> str:
    parts = context.description.get("validation")
    described = parts.get("distance") if isinstance(parts, dict) else None
    kind = described.get("type", "a function") if isinstance(described, dict) else described or "not known"
    return (
        f"The context-specific distance d(p) between the trajectories of model and system under the same controller "
        f"({kind}{f', in {context.labels.units}' if context.labels.units else ''}); the quantity of interest is its "
        "largest value d* over all tasks."
    )


def _criterion(context: ReportContext) -> str:
    if context.verdict is None:
        return "None was stated."
    tau, certificate = quantity(context.verdict.threshold, context.labels.units), context.certificate
    confidence = "" if certificate is None else f", with confidence {number(certificate.confidence)}"
    return f"d* is at most {tau}{confidence}."


def _referent(context: ReportContext) -> str:
    origins = {
        origin: sum(trial.origin == origin for trial in context.trials)
        for origin in sorted({t.origin for t in context.trials})
    }
    listed = ", ".join(f"{count} {origin}" for origin, count in origins.items())
    return (
        f"{context.executions} executions of the system in {len(context.trials)} trials ({listed or 'none'}), of which "
        f"{len(context.completed)} gave a distance and {len(context.recordings)} a recorded trajectory. Digest of the "
        f"description of the system: {_part_digest(context, 'system')}."
    )


def _error(context: ReportContext) -> str:
    if not context.completed:
        return "No distance is known."
    units, values = context.labels.units, context.distances
    worst = context.worst_first[0]
    return (
        f"Largest distance {quantity(distance_of(worst), units)} (trial {worst.number}), median "
        f"{quantity(float(np.median(values)), units)}, smallest {quantity(float(values.min()), units)}, over "
        f"{len(values)} executed tasks. The tasks were chosen by a search for large distances, so the median is not "
        "that of all tasks."
    )


def _domain(context: ReportContext) -> str:
    if not len(context.points):
        return "Nothing was executed."
    low, high = context.coordinates(context.completed).min(axis=0), context.coordinates(context.completed).max(axis=0)
    executed = "; ".join(
        f"{label} from {number(a)} to {number(b)}"
        for label, a, b in zip(context.space.labels, low.tolist(), high.tolist(), strict=True)
    )
    return f"Executed: {executed}. Nothing is said about tasks outside the intended use."


def _uncertainty(context: ReportContext) -> str:
    found = context.certificate
    if found is None:
        return "No certificate was computed, so no uncertainty is stated for tasks that were not executed."
    bound = with_error(found.upper_bound, found.error)
    said = (
        f"By the certificate {found.kind}, d* is at most {bound} with confidence {number(found.confidence)}"
        f"{f', except for {at_most(100 * found.volume, 3)} % of the tasks' if found.volume else ''}. The uncertainty "
        "of the measured trajectories themselves is not part of it."
    )
    return f"{said} The certificate is withdrawn: {found.doubt}." if found.doubt is not None else said


def _robustness(context: ReportContext) -> str:
    model = context.distance_model
    if model is None:
        return "Not known: fewer than two distances."
    order = np.argsort(-model.sensitivity, kind="stable")[:5]
    listed = "; ".join(f"{context.space.labels[j]} {number(float(model.sensitivity[j]), 2)}" for j in order)
    return f"Total Sobol indices of the predicted distance, the largest first: {listed}."


def _part_digest(context: ReportContext, part: str) -> str:
    parts = context.description.get("validation")
    return digest(parts[part]) if isinstance(parts, dict) and part in parts else "not known"
