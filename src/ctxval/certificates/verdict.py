"""The verdict on a threshold: validated, falsified or undecided; and the result of ``ctxval certify``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

from ctxval._util.checked import PositiveFloat, checked, require
from ctxval._util.representation import ShortRepr, Shown, call, line
from ctxval.certificates.base import KINDS, Certificate, CertificateKind
from ctxval.certificates.bets import Bets, bets_against
from ctxval.certificates.bounds import NO_UNITS, Quantities
from ctxval.certificates.forecast import Forecast
from ctxval.certificates.options import CONFIDENCE, CertificateOptions, Confidence, Volume
from ctxval.certificates.provenance import Provenance
from ctxval.certificates.sample import Sample, without_success
from ctxval.certificates.sentences import verdicts as sentences
from ctxval.certificates.task_share import ShareBets, bets_on_share
from ctxval.core.space import TaskSpace
from ctxval.core.target import LARGEST_DISTANCE, Target
from ctxval.core.trial import Trial, designs_sentence
from ctxval.errors import CertificateError

Answer = Literal["validated", "falsified", "undecided"]
"""The answer of a verdict to the question whether d* <= tau."""


@dataclass(frozen=True, eq=False)
class Verdict:
    """The answer of the trials to the question whether d* <= tau."""

    #: "falsified" if an executed distance exceeds tau, "validated" if a certificate keeps tau with its confidence, else
    #: "undecided"
    answer: Answer
    threshold: float  #: tau, in the distance's units
    reason: str  #: the reason for the answer, in one or two sentences
    witness: Trial | None = None  #: the executed trial with d(p) > tau of a falsification; else None
    certificate: Certificate | None = None  #: the certificate that validates or does not suffice; None if there is none
    expected: Forecast | None = None  #: a forecast of further executions; None if nothing can be predicted
    rests_on: str | None = None  #: the evidence for a validation, its conditions, and what holds without; else None
    remarks: tuple[str, ...] = ()  #: what the reason says beside the statement of a validation
    conditions: tuple[str, ...] = ()  #: the conditions of a validation, each as the end of "It rests on ..."
    next_task: Mapping[str, Any] | None = None  #: the task to execute next, if learned dynamics choose it; else None
    shortage: Mapping[str, Any] | None = None  #: the code and the seconds of thinking that are missing; else None

    @property
    def bound(self) -> float | None:
        """The bound on d* of its certificate; None if there is none."""
        return None if self.certificate is None else self.certificate.bound

    def __str__(self) -> str:
        return f"{self.answer}: {self.reason}" + (f" {self.rests_on}" if self.rests_on else "")

    def __repr__(self) -> str:
        text = call(self, self.answer, threshold=self.threshold, reason=Shown(line(self.reason)))
        return f"{text}\n  {line(self.rests_on, 330)}" if self.rests_on else text

    def to_json(self) -> dict[str, Any]:
        """Return the answer and its reasons, ready for JSON; the certificate has its own."""
        names = ("reason", "rests_on", "threshold", "next_task")
        thinking = {} if self.shortage is None else {"thinking": dict(self.shortage)}
        return {"verdict": self.answer, **{name: getattr(self, name) for name in names}, **thinking}


@checked
def counterexample(
    trials: Sequence[Trial],
    threshold: PositiveFloat,
    quantities: Quantities = NO_UNITS,
    confidence: float = CONFIDENCE,
    target: Target = LARGEST_DISTANCE,
) -> Verdict | None:
    """Return the verdict "falsified" by the largest distance above the threshold; None if no distance is above it.

    The distance of the steps before a failure counts, but less than that of whole executions. With noise, a single one
    does not suffice (:mod:`ctxval.certificates.bets`), except in a suite without repeats. Nor does it if the target is
    the distance of a share of the tasks (:mod:`ctxval.certificates.task_share`).
    """
    tau = float(threshold)
    bets = _bets(trials, tau, target, quantities, confidence)
    if bets is not None and not bets.falsify(confidence):
        return None
    failed = without_success(trials)
    above = [
        each
        for each in trials
        if each.least > tau and (each.distance is not None or each.ended_alone is not None or each in failed)
    ]
    if not above:
        return None
    worst = max(above, key=lambda trial: (trial.distance is not None, trial.least))
    return Verdict("falsified", tau, sentences.falsified(worst, trials, tau, quantities, bets, confidence), worst)


@checked
def judge_by(
    certificate: Certificate,
    trials: Sequence[Trial],
    threshold: PositiveFloat,
    *,
    volume: Volume = 0.0,
    provenance: Provenance | None = None,
    kind: CertificateKind | None = None,
) -> Verdict:
    """Return the verdict by a certificate; only bounds on d* validate if the acceptable ``volume`` is 0.

    Its kind says what a validation rests on; by default, it is found by its name.
    """
    tau, known = float(threshold), provenance or Provenance()
    require("confidence", Confidence, certificate.confidence)
    by_name = KINDS.find(certificate.kind) if certificate.kind in KINDS else CertificateKind
    quantities = known.quantities
    quantile = certificate.details.get("quantile") or (kind or by_name).quantile
    share = certificate.details.get("share", 1.0) if kind is None else kind.share
    falsified = counterexample(trials, tau, quantities, certificate.confidence, Target.asked(quantile, share))
    if falsified is not None:
        return replace(falsified, certificate=certificate)
    if not certificate.covers(tau, volume):
        why_not = sentences.undecided(certificate, tau, volume, quantities)
        return Verdict("undecided", tau, why_not, certificate=certificate, expected=certificate.expected)
    of_kind = (kind or by_name).rests_on(certificate, known.space)
    conditions = sentences.all_conditions(of_kind, certificate, tau, known, trials)
    rests_on = sentences.rests_on(conditions, certificate, tau, known)
    looked = sentences.looked(known, certificate, tau, trials, volume)
    reason = "; ".join([sentences.validated(certificate, tau, quantities).removesuffix("."), *looked])
    tests = certificate.details.get("tests")
    untested = ["no prediction was tested at drawn tasks"] if tests is not None and not tests["drawn"] else []
    validated = Verdict("validated", tau, f"{reason}.", certificate=certificate, rests_on=rests_on)
    return replace(validated, conditions=conditions, remarks=(*untested, *looked))


@checked
def judge(
    trials: Sequence[Trial],
    threshold: PositiveFloat,
    options: CertificateOptions | None = None,
    provenance: Provenance | None = None,
) -> Verdict:
    """Return the verdict by an executed counterexample, or by the certificate of the options; by default, of ``auto``.

    All trials of the campaign are given. If the theory of the certificate refuses them, the verdict is undecided.
    """
    known, chosen = provenance or Provenance(), options or CertificateOptions()
    target = chosen.kind.target
    if target.by_draws:  # the largest distance of another store falsifies no share of the tasks
        known = replace(known, beside=tuple(replace(each, worst=None) for each in known.beside))
    verdict = counterexample(trials, threshold, known.quantities, chosen.confidence, target)
    if verdict is None:
        try:
            certificate = _certified(trials, chosen, known, threshold)
            left_out, kind = chosen.left_out, chosen.kind
            verdict = judge_by(certificate, trials, threshold, volume=left_out, provenance=known, kind=kind)
        except CertificateError as error:
            verdict = Verdict("undecided", float(threshold), str(error))
    designs, remarks = designs_sentence(trials), list(verdict.remarks)
    parts = [verdict.reason.removesuffix("."), verdict.expected, designs]
    remarks += [] if designs is None else [designs]
    bets = _bets(trials, float(threshold), target, known.quantities, chosen.confidence)
    if verdict.answer != "falsified" and isinstance(bets, Bets) and bets.above:
        above = sentences.noise_may_explain(bets, float(threshold), known.quantities, chosen.confidence)
        parts.insert(0 if verdict.answer == "undecided" else len(parts), above)
        remarks.append(above)
    reason, caution = "; ".join(str(part) for part in parts if part is not None), sentences.caution(known, threshold)
    remarks += [caution.strip().removesuffix(".")] if caution else []
    return replace(verdict, reason=f"{reason}.{caution}", remarks=tuple(remarks))


def _bets(
    trials: Sequence[Trial], threshold: float, target: Target, quantities: Quantities, confidence: float
) -> Bets | ShareBets | None:
    """Return the bets against a threshold; None if one execution above it suffices."""
    if target.by_draws:
        return bets_on_share(trials, threshold, target.share, confidence)
    space = quantities.space
    if space is None or space.members is None:
        return bets_against(trials, threshold, target.quantile)
    return bets_against(trials, threshold, target.quantile, noisy=True) if space.repeats > 1 else None


def _certified(
    trials: Sequence[Trial], options: CertificateOptions, known: Provenance, threshold: float | None
) -> Certificate:
    """Return a certificate, for a threshold if there is one. Most kinds see countable draws only."""
    suite, repeats = (None, 1) if known.space is None else (known.space.members, known.space.repeats)
    sample, kind = Sample.of(trials, known.learned), options.kind
    sample = replace(sample, distribution=known.distribution, suite=suite, repeats=repeats, threshold=threshold)
    require_possible(kind, known.space)
    # No statement may count draws whose number depended on their distances.
    sample = sample if kind.sorts_draws else sample.with_countable_draws()
    certificate = kind.certify(sample, options.confidence)
    return replace(certificate, assumptions=(*certificate.assumptions, *known.remarks))


def require_possible(kind: CertificateKind, space: TaskSpace | None) -> None:
    """Refuse a kind of certificate, or its target, that is not for suites of tasks if the space is one."""
    if space is None or space.members is None:
        return
    if not kind.takes_suites:
        kinds = ", ".join(name for name in KINDS.built_in if KINDS.find(name).takes_suites)
        raise CertificateError(
            f"a certificate of the kind {kind.name!r} is not for a suite of tasks, each of which is executed once; use "
            f"one of {kinds}."
        )
    if kind.share < 1:
        raise CertificateError("tasks of a suite are executed one by one, so no share of them is bounded.")


@dataclass(frozen=True, eq=False)
class Assessment(ShortRepr):
    """A certificate and a verdict of the same trials."""

    kind: str  #: the name of the certificate's kind
    certificate: Certificate | None  #: the certificate; None if its theory refuses the trials
    verdict: Verdict | None = None  #: the verdict; None if no threshold was given
    refusal: str | None = None  #: why there is no certificate; None if there is one

    def to_json(self) -> dict[str, Any]:
        """Return the certificate, the verdict and the forecast as one flat table, ready for JSON."""
        certificate = None if self.certificate is None else self.certificate.to_json()
        expected = None if self.verdict is None or self.verdict.expected is None else asdict(self.verdict.expected)
        return {
            **({} if self.verdict is None else self.verdict.to_json()),
            **(certificate or {"kind": self.kind, "refused": self.refusal}),
            "expected": expected,
        }


def assess(
    trials: Sequence[Trial],
    options: CertificateOptions,
    threshold: float | None = None,
    provenance: Provenance | None = None,
) -> Assessment:
    """Return a certificate of the trials and, if there is a threshold, a verdict; arguments as in :func:`judge`.

    Raises:
        CertificateError: if the certificate's theory refuses the trials and none of them exceeds the threshold.
    """
    known, kind = provenance or Provenance(), options.kind
    falsified = None
    if threshold is not None:
        falsified = counterexample(trials, threshold, known.quantities, options.confidence, kind.target)
        if falsified is None:
            verdict = judge(trials, threshold, options, known)
            if verdict.certificate is None:
                raise CertificateError(verdict.reason)
            return Assessment(kind.name, verdict.certificate, verdict)
    try:
        certificate = _certified(trials, options, known, threshold if kind.uses_threshold else None)
    except CertificateError as error:
        if falsified is None:
            raise
        return Assessment(kind.name, None, falsified, str(error))
    return Assessment(kind.name, certificate, falsified and replace(falsified, certificate=certificate))
