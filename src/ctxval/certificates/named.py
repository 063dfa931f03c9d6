"""Certificates by name, for the command line."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from ctxval._util.representation import record
from ctxval.certificates.base import Certificate, Sample
from ctxval.certificates.convergence import TheoremConstants, certify_convergence
from ctxval.certificates.covering import RESOLUTION
from ctxval.certificates.posterior import certify_posterior
from ctxval.certificates.scenario import certify_audit, certify_scenario
from ctxval.core.trial import Origin
from ctxval.errors import CertificateError, UnknownNameError

KINDS = ("posterior", "audit", "scenario", "sampling-discarding", "convergence")
"""What can be certified, the bound that people will use first."""

USES: dict[str, tuple[str, ...]] = {
    "discard": ("sampling-discarding",),
    "constant": ("convergence",),
    "theorem": ("convergence",),
    "stochastic": ("posterior",),
    "resolution": ("posterior",),
    "volume": ("audit", "scenario", "sampling-discarding"),
}
"""Which kinds have a use for an option."""

_NO_DISCARD = "sampling and discarding needs to be told how many to discard, at least 1."


@dataclass(frozen=True)
class Options:
    """What some kinds need to be told.

    Attributes:
        stochastic: posterior: whether two executions of one task may differ.
        resolution: posterior: how far from every trial a task may be, in diagonals of the task space.
        discard: sampling-discarding: how many of the largest distances are discarded.
        constant: convergence: C, in the distance's units.
        theorem: convergence: what C is computed from, in place of it.
        search: convergence: the type of the search that chose the tasks, if it is known.
        remarks: sentences that the certificate lists among its assumptions, such as what was changed on the system.
    """

    stochastic: bool = False
    discard: int | None = None
    constant: float | None = None
    theorem: TheoremConstants | None = None
    search: str | None = None
    resolution: float = RESOLUTION
    remarks: tuple[str, ...] = ()

    def __repr__(self) -> str:
        return record(self)


def certify(sample: Sample, kind: str, confidence: float, options: Options | None = None) -> Certificate:
    """Return the certificate of a kind.

    Raises:
        UnknownNameError: there is no such kind.
        CertificateError: its theory does not allow these trials, or something that it needs is not given.
    """
    chosen = Options() if options is None else options
    return _certified(sample, kind, confidence, chosen).with_remarks(chosen.remarks)


def _certified(sample: Sample, kind: str, confidence: float, chosen: Options) -> Certificate:
    if kind == "posterior":
        return certify_posterior(sample, confidence, stochastic=chosen.stochastic, resolution=chosen.resolution)
    if kind == "audit":
        return certify_audit(sample, confidence)
    if kind == "scenario":
        return certify_scenario(sample, confidence)
    if kind == "sampling-discarding":
        if not chosen.discard:
            raise CertificateError(_NO_DISCARD)
        return certify_scenario(sample, confidence, chosen.discard)
    if kind == "convergence":
        if chosen.search not in (None, "GPUCB"):
            raise CertificateError(f"Proposition 1 is about tasks that GP-UCB chose; {chosen.search} chose these.")
        return certify_convergence(sample, _constant(chosen), confidence, search=chosen.search)
    raise UnknownNameError.among("certificate", kind, KINDS)


def require_use(kind: str, given: Iterable[str]) -> None:
    """Refuse options that a kind would ignore: somebody who gives one believes that it counts.

    Raises:
        CertificateError: one is given that is for other kinds.
    """
    for name in given:
        if kind not in USES[name]:
            kinds = " or ".join(USES[name])
            raise CertificateError(f"{name} is for certificates of the kind {kinds}; the kind here is {kind}.")


def require_possible(origins: Iterable[Origin], kind: str, options: Options) -> None:
    """Make sure, before draws are paid for, that a certificate could use them.

    Raises:
        CertificateError: none could, however they come out.
    """
    if kind == "sampling-discarding" and not options.discard:
        raise CertificateError(_NO_DISCARD)
    if kind in ("scenario", "sampling-discarding") and any(origin != "iid" for origin in origins):
        raise CertificateError(f"a {kind} bound takes independent draws alone, and there are others; say --kind audit.")
    if kind == "convergence":
        raise CertificateError("Proposition 1 is about tasks that GP-UCB chose: it has no use for an audit.")


def _constant(options: Options) -> float | TheoremConstants:
    if options.constant is not None:
        return options.constant
    if options.theorem is not None:
        return options.theorem
    raise CertificateError(
        "Proposition 1 needs its constant C, which the paper does not give: state what it is computed from (--theorem)."
    )
