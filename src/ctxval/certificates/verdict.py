"""The verdict on a threshold: validated, falsified or undecided."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from ctxval._util.checked import PositiveFloat, checked
from ctxval._util.representation import call, line, lines, shown
from ctxval.certificates.base import Certificate
from ctxval.certificates.bounds import at_most, of_tasks, with_error
from ctxval.certificates.forecast import Forecast
from ctxval.certificates.options import CertificateOptions, require_confidence, require_volume
from ctxval.certificates.provenance import Provenance
from ctxval.certificates.registry import KINDS
from ctxval.core.space import TaskSpace
from ctxval.core.trial import Trial, designs_sentence
from ctxval.errors import CertificateError

_ASSUMPTIONS = 350
"""Characters of the assumptions in a representation; the text of a verdict has them whole."""

Answer = Literal["validated", "falsified", "undecided"]
"""The answer of a verdict to the question whether d* <= tau."""


@dataclass(frozen=True, eq=False)
class Verdict:
    """The answer of the trials to the question whether d* <= tau.

    Attributes:
        answer: "falsified" if an executed distance exceeds tau, "validated" if a certificate keeps tau with its
            confidence, else "undecided".
        threshold: tau, in the distance's units.
        reason: the reason for the answer, in one sentence.
        witness: the executed trial with d(p) > tau; None if the answer is not "falsified".
        certificate: the certificate that validates or does not suffice; None if there is none.
        expected: a forecast of further executions; None if the answer is decided or nothing can be predicted.
        rests_on: one sentence on the conditions of a validation; None if the answer is not "validated".
        next_task: the parameters of the task to execute next, if the answer is "undecided" and learned dynamics choose
            it; else None.
    """

    answer: Answer
    threshold: float
    reason: str
    witness: Trial | None = None
    certificate: Certificate | None = None
    expected: Forecast | None = None
    rests_on: str | None = None
    next_task: Mapping[str, Any] | None = None

    @property
    def bound(self) -> float | None:
        """The bound on d* of its certificate; None if there is none, it is withdrawn, or it leaves out a volume."""
        return usable_bound(self.certificate)

    def __str__(self) -> str:
        return f"{self.answer}: {self.reason}" + (f" {self.rests_on}" if self.rests_on else "")

    def __repr__(self) -> str:
        head, reason = call(self, self.answer, threshold=self.threshold), f"reason: {line(self.reason)}"
        if self.rests_on:
            return "\n  ".join([head, reason, line(self.rests_on, _ASSUMPTIONS)])
        found = {"witness": self.witness, "certificate": self.certificate, "expected": self.expected}
        return lines(head, reason, *(f"{name}: {shown(part)}" for name, part in found.items() if part is not None))

    def to_json(self) -> dict[str, Any]:
        """Return the answer and its reasons, ready for JSON; the certificate has its own."""
        return {
            "verdict": self.answer,
            "reason": self.reason,
            "rests_on": self.rests_on,
            "threshold": self.threshold,
            "next_task": self.next_task,
        }


def usable_bound(found: Certificate | None) -> float | None:
    """Return the bound on d* of a certificate; None if there is none, it is withdrawn, or it leaves out a volume."""
    usable = found is not None and found.doubt is None and not found.volume and np.isfinite(found.upper_bound)
    return found.upper_bound if found is not None and usable else None


@checked
def counterexample(trials: Sequence[Trial], threshold: PositiveFloat) -> Verdict | None:
    """Return the verdict "falsified" by the largest distance above the threshold; None if no distance is above it."""
    tau = float(threshold)
    above = [trial for trial in trials if trial.distance is not None and trial.distance > tau]
    if not above:
        return None
    worst = max(above, key=lambda trial: trial.distance or 0.0)
    distance, limit = _distinguishable(worst.distance or 0.0, tau)
    reason = f"trial {worst.number} was executed and its distance {distance} exceeds {limit}."
    return Verdict("falsified", tau, reason, worst)


def _distinguishable(value: float, tau: float) -> tuple[str, str]:
    """Return two numbers as texts, with enough digits to show which one is larger."""
    for digits in range(4, 17):
        texts = at_most(value, digits) if value <= tau else f"{value:.{digits}g}", f"{tau:.{max(digits, 6)}g}"
        if np.sign(float(texts[0]) - float(texts[1])) == np.sign(value - tau):
            return texts
    return repr(value), repr(tau)


@checked
def judge_by(
    certificate: Certificate,
    trials: Sequence[Trial],
    threshold: PositiveFloat,
    *,
    volume: float = 0.0,
    space: TaskSpace | None = None,
) -> Verdict:
    """Return the verdict by the trials and a certificate.

    Args:
        certificate: a certificate of any kind.
        trials: all trials of the campaign.
        threshold: tau, in the distance's units.
        volume: the share of the task space that may exceed the threshold; if it is 0, only bounds on d* validate.
        space: the task space, to state a resolution in its units; None if it is not known.

    Raises:
        InputError: if the volume is negative or above 0.5, or the certificate's confidence is below 0.5.
    """
    tau = float(threshold)
    require_confidence(certificate.confidence)
    found = counterexample(trials, tau)
    if found is not None:
        return Verdict("falsified", tau, found.reason, found.witness, certificate)
    if certificate.covers(tau, require_volume(volume)):
        but = (
            f", but for {at_most(100 * certificate.volume, 3)} % {of_tasks(certificate.distribution)}"
            if certificate.volume
            else ""
        )
        upper, limit = _bound_and_limit(certificate, tau)
        kind = KINDS.of(certificate)
        evidence = "audited" if certificate.volume else kind.evidence
        reason = (
            f"{_untested(certificate)}{evidence}, the {certificate.kind} bound of {certificate.trials} trials is "
            f"{upper}, at most {limit}, with confidence {certificate.confidence}{but}"
            f"{kind.qualification(certificate, space)}{_tested(certificate, tau)}."
        )
        return Verdict("validated", tau, reason, certificate=certificate, rests_on=_rests_on(certificate, space, tau))
    return Verdict("undecided", tau, _why_not(certificate, tau, volume), certificate=certificate)


def _bound_and_limit(certificate: Certificate, tau: float) -> tuple[str, str]:
    """Return a bound and the threshold as texts, the bound with its error if it has one."""
    upper = with_error(certificate.upper_bound, certificate.error)
    return (upper, f"{tau:.6g}") if "±" in upper else _distinguishable(certificate.upper_bound, tau)


def _why_not(certificate: Certificate, tau: float, volume: float) -> str:
    if certificate.doubt is not None:
        support = KINDS.of(certificate).support(certificate, tau)
        return f"{support}; but {certificate.doubt}." if support else f"{certificate.doubt}."
    if KINDS.of(certificate).never_validates:
        return f"{KINDS.of(certificate).never_validates}."
    upper, limit = _bound_and_limit(certificate, tau)
    shortfall = KINDS.of(certificate).shortfall(certificate)
    if certificate.upper_bound > tau:
        return f"no distance above {limit} was executed, but d* may be up to {upper}{shortfall}."
    if not certificate.covers(tau, certificate.volume):
        return (
            f"the {certificate.kind} bound is {upper}, and {limit} is too near to it for the random draws that it is "
            "computed from; more executions tighten it."
        )
    return (
        f"the {certificate.kind} bound of {certificate.trials} trials leaves out "
        f"{at_most(100 * certificate.volume, 3)} % {of_tasks(certificate.distribution)}, more than "
        f"the {100 * volume:.3g} % that are acceptable{shortfall}; it is no bound "
        "on d*."
    )


def _rests_on(certificate: Certificate, space: TaskSpace | None, tau: float) -> str:
    """Return what a validation rests on, in one sentence."""
    said = KINDS.of(certificate).rests_on(certificate, space)
    made_good = certificate.details.get("failures", {}).get("made_good", [])
    if made_good:
        numbers = ", ".join(str(one["trial"]) for one in made_good)
        said.append(f"your word that what made trial {numbers} fail is removed for good")
    rests_on = f"It rests on {'; on '.join([*said, 'this campaign not being chosen among several'])}."
    return f"{rests_on}{_without_assumptions(certificate, tau)}"


def _untested(certificate: Certificate) -> str:
    tests = certificate.details.get("tests")
    if tests is None or tests["drawn"]:
        return ""
    return "no prediction was tested where nobody chose to look (tests = 0); "


def _tested(certificate: Certificate, tau: float) -> str:
    """Return what tests of predictions have shown, as the end of a sentence."""
    tests = certificate.details.get("tests")
    if tests is None or not tests["drawn"]:
        return ""
    where = f"{tests['drawn']} of them at tasks drawn over the whole task space"
    if tests["largest_error"] is None:
        return f"; {where}"
    share = at_most(100 * tests["largest_error"] / tau, 2)
    return f"; {where}, each predicted beforehand to {share} % of the threshold"


def _without_assumptions(certificate: Certificate, tau: float) -> str:
    """Return what independent draws say whatever the system is: none of them exceeds the threshold.

    This holds at any time: a share of v is missed by the first n draws with probability (1 - v)^n.
    """
    draws = certificate.details.get("tests", {}).get("independent", 0)
    if not draws:
        return ""
    share = at_most(100 * (1 - (1 - certificate.confidence) ** (1 / draws)), 2)
    return (
        f" Without any of this: with {100 * certificate.confidence:g} % confidence, at most {share} % "
        f"{of_tasks(certificate.distribution)} exceeds {tau:.6g} (independent draws: {draws})."
    )


@checked
def judge(
    trials: Sequence[Trial],
    threshold: PositiveFloat,
    options: CertificateOptions | None = None,
    provenance: Provenance | None = None,
) -> Verdict:
    """Return the verdict by an executed counterexample, or by the certificate that the options ask for.

    Args:
        trials: all trials of the campaign.
        threshold: tau, in the distance's units.
        options: the kind of certificate, its confidence and the acceptable volume; ``auto`` by default. If the theory
            of the certificate refuses the trials, the verdict is undecided.
        provenance: the task space, the search and remarks on the campaign, as far as they are known.
    """
    chosen, known = options or CertificateOptions(), provenance or Provenance()
    verdict, designs = _judged(trials, threshold, chosen, known), designs_sentence(trials)
    reason = verdict.reason if designs is None else f"{verdict.reason.removesuffix('.')}; {designs}."
    return replace(verdict, reason=f"{reason}{known.caution(threshold)}")


def _judged(trials: Sequence[Trial], threshold: float, chosen: CertificateOptions, known: Provenance) -> Verdict:
    found = counterexample(trials, threshold)
    if found is not None:
        return found
    try:
        sample = known.sample(trials)
        certificate, expected = chosen.kind.certify_against(sample, threshold, chosen.confidence)
    except CertificateError as error:
        return Verdict("undecided", float(threshold), str(error))
    certificate = certificate.with_remarks(known.remarks)
    verdict = judge_by(certificate, trials, threshold, volume=chosen.volume, space=known.space)
    if expected is None:
        return verdict
    return replace(verdict, reason=f"{verdict.reason.removesuffix('.')}; {expected}.", expected=expected)
