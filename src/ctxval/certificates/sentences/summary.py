"""A verdict on one screen: a headline, rows of numbers, and the conditions that a validation rests on."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ctxval._util.representation import counted
from ctxval.certificates.bounds import at_most, percent, with_error
from ctxval.certificates.sentences.verdicts import push_in_words, tolerances

if TYPE_CHECKING:
    from ctxval.certificates.verdict import Verdict


def headline(verdict: Verdict, units: str = "") -> str:
    """Return the answer and its reason in one sentence; for a validation, the statement alone."""
    threshold = f"{verdict.threshold:g} {units}".rstrip()
    if verdict.answer != "validated" or verdict.certificate is None:
        return f" against {threshold}: {verdict.reason}"
    certificate = verdict.certificate
    details, share = certificate.details, certificate.volume
    which = f"at least {100 * (1 - share):.4g} % of the tasks stay" if share else "every task stays"
    if certificate.kind == "suite" and details.keys().isdisjoint(("repeats", "not_executed")):
        which = "every task of the suite was executed and stays"
    return f": {which} at or below {threshold}{certificate.target.often}."


def rows(verdict: Verdict, units: str = "") -> dict[str, str]:
    """Return the numbers of a validation by their names; empty for other verdicts, whose reason has them."""
    certificate = verdict.certificate
    if verdict.answer != "validated" or certificate is None:
        return {}
    details, tau, level = certificate.details, verdict.threshold, percent(certificate.confidence)
    bound = f"{with_error(certificate.upper_bound, certificate.error)} {units}".rstrip()
    shown = {"bound": f"{bound} ({certificate.kind}, {level})"}
    if (best := details.get("best")) is not None:
        largest = f"{best:.4g} {units}".rstrip()
        allowed = " (some tasks may exceed the threshold)" if certificate.volume and best > tau else ""
        shown["largest executed"] = f"{largest} in {counted(certificate.trials, 'execution')}{allowed}"
    tests = details.get("tests") or {}
    if tests.get("drawn"):
        shown["tests"] = f"{tests['drawn']} at drawn tasks"
        if (error := tests.get("largest_error")) is not None:
            shown["tests"] += f"; predictions erred by at most {at_most(100 * error / tau, 2)} % of the threshold"
    if (pushes := tolerances(certificate, tau)) is not None:
        shown["survives"] = f"a further error of M of {push_in_words(pushes[0])} at every step"
    if (missed := tests.get("share_missed")) is not None:
        shown["without assumptions"] = (
            f"at most {at_most(100 * missed, 2)} % of the {certificate.target.drawn} exceed it ({level})"
        )
    if (number := details.get("missed_by_tests")) is not None:
        shown["without assumptions"] = (
            f"at most {number} of the {details['not_executed']} other tasks exceed it ({level})"
        )
    return shown
