r"""The paper's Proposition 1 and Corollary 1: a bound on the gap between the best distance of GP-UCB and d*.

With the information gain gamma_n of the kernel, and |P| the dimension of the task space,

    Pr(d* > best_n + r_n for some n) < eps,   r_n = C sqrt(|P| gamma_n / n).

The paper prints "for all n", from which its corollary would not follow; its proof gives "for some n".

For a Matern kernel of smoothness nu, gamma_n = O(n^(e) log n) with e = |P|(|P|+1) / (2 nu + |P|(|P|+1)); without the
logarithm, nu = 3/2 gives the printed r_n = C sqrt(|P| / n^(3 / (3 + |P|(|P|+1)))). For the squared exponential,
gamma_n = O((log n)^(|P|+1)).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass, fields
from typing import ClassVar, Literal

import numpy as np

from ctxval._util.registry import part
from ctxval.certificates.base import ONE_CAMPAIGN, Certificate, CertificateKind
from ctxval.certificates.bounds import at_most, require_probability
from ctxval.certificates.sample import Sample
from ctxval.core.space import TaskSpace
from ctxval.core.trial import Origin
from ctxval.errors import CertificateError, InputError

KernelName = Literal["matern-3/2", "matern-5/2", "squared-exponential"]

_FIXED = ("GPUCB",)
"""Types of searches that fix beta and estimate the hyperparameters."""

_SMOOTHNESS: dict[str, float] = {"matern-3/2": 1.5, "matern-5/2": 2.5}
"""The smoothness nu of each Matern kernel."""


def rate(n: int, dimension: int, kernel: KernelName = "matern-3/2") -> float:
    """Return ``r_n / C``.

    Raises:
        CertificateError: if n or the dimension is not positive, or the kernel is unknown.
    """
    if n < 1 or dimension < 1:
        raise CertificateError(f"n and the dimension must be at least 1, got {n} and {dimension}.")
    if kernel == "squared-exponential":
        return float(np.sqrt(dimension * np.log(max(n, np.e)) ** (dimension + 1) / n))
    if kernel not in _SMOOTHNESS:
        raise CertificateError(f"the information gain of {kernel!r} is not known; known: {', '.join(_SMOOTHNESS)}.")
    double = 2 * _SMOOTHNESS[kernel]
    return float(np.sqrt(dimension / n ** (double / (double + dimension * (dimension + 1)))))


@dataclass(frozen=True)
class TheoremConstants:
    """Constants of the theorem behind Proposition 1, for a task space scaled to the unit cube.

    Attributes:
        scale: standard deviation of the distance under the prior, in the distance's units.
        noise: variance of the observations' noise, divided by the square of ``scale``; it must be positive.
        a, b: constants of the tail of the paths' slopes, ``Pr(sup |df/dx_j| > scale L) <= a exp(-(L / b)^2)`` for each
            j and L > 0.
        gain: factor of the information gain, ``gamma_n <= gain n^e``.

    Raises:
        CertificateError: if a constant is not a positive number.
    """

    scale: float
    noise: float
    a: float
    b: float
    gain: float

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            if not (value > 0 and np.isfinite(value)):
                raise CertificateError(f"{name} of the theorem must be a positive number, got {value!r}.")

    @classmethod
    def parse(cls, text: str) -> TheoremConstants:
        """Return the constants from a text: five numbers in the order of the attributes, separated by commas.

        Raises:
            InputError: if the text is not five numbers.
            CertificateError: if one of them is not positive.
        """
        try:
            numbers = [float(part) for part in text.split(",")]
        except ValueError:
            numbers = []
        if len(numbers) != len(fields(cls)):
            raise InputError(f"--theorem must be five numbers SCALE,NOISE,A,B,GAIN, got {text!r}.")
        return cls(*numbers)

    def constant(self, n: int, dimension: int, confidence: float, kernel: KernelName = "matern-3/2") -> float:
        """Return the C with which ``r_n`` is the theorem's bound ``sqrt(C_1 beta_n gamma_n / n) + 2 / n`` on the gap.

        Theorem 2 of Srinivas, Krause, Kakade and Seeger 2012 bounds the mean gap of n executions, with its C_1 and
        beta_n; the smallest gap is at most the mean one. C grows with the logarithm of n, which the paper treats as
        constant.
        """
        eps = 1 - require_probability("confidence", confidence)
        first = 8 / np.log1p(1 / self.noise)
        slopes = dimension * self.b * np.sqrt(np.log(max(4 * dimension * self.a / eps, np.e)))
        beta = 2 * np.log(n**2 * 2 * np.pi**2 / (3 * eps)) + 2 * dimension * np.log(max(n**2 * slopes, 1.0))
        gain = self.gain * n * rate(n, dimension, kernel) ** 2 / dimension
        gap = np.sqrt(first * beta * gain / n) + 2 / n
        return float(self.scale * gap / rate(n, dimension, kernel))


@part("convergence")
@dataclass(frozen=True, repr=False)
class Convergence(CertificateKind):
    """Bound on d* by Proposition 1 of the paper, for trials of GP-UCB.

    Attributes:
        constant: C, in the distance's units; nothing supports a stated C, so a bound that uses it is withdrawn.
        theorem: the constants from which C is computed if ``constant`` is not given.
    """

    name: ClassVar[str] = "convergence"

    constant: float | None = None
    theorem: TheoremConstants | None = None

    def certify(self, sample: Sample, confidence: float = 0.95) -> Certificate:
        """Return :func:`certify_convergence` of the trials.

        Raises:
            CertificateError: if C is missing, if another search than GP-UCB chose the tasks, or if the theory does not
                allow the trials.
        """
        if sample.search not in (None, "GPUCB"):
            raise CertificateError(f"Proposition 1 is about tasks that GP-UCB chose; {sample.search} chose these.")
        constant = self.theorem if self.constant is None else self.constant
        if constant is None:
            raise CertificateError(
                "Proposition 1 needs its constant C, which the paper does not give; state the constants of the theorem "
                "from which C is computed (--theorem)."
            )
        return certify_convergence(sample, constant, confidence, search=sample.search)

    def require_audit_helps(self, origins: Iterable[Origin]) -> None:
        """Refuse an audit: the proposition cannot use independent draws.

        Raises:
            CertificateError: always.
        """
        raise CertificateError("Proposition 1 is about tasks that GP-UCB chose; it has no use for an audit.")

    @classmethod
    def rests_on(cls, certificate: Certificate, space: TaskSpace | None = None) -> list[str]:
        """Return that it rests on the theorem."""
        return ["the theorem's assumptions, with the constants that you stated"]


def certify_convergence(
    sample: Sample,
    constant: float | TheoremConstants,
    confidence: float = 0.95,
    kernel: KernelName = "matern-3/2",
    *,
    search: str | None = None,
) -> Certificate:
    """Return the bound ``best_n + r_n`` of Proposition 1, withdrawn if the theorem does not cover it.

    Args:
        sample: the trials of a GP-UCB campaign; n counts those that the acquisition function chose.
        constant: the constants from which C is computed, or C itself in the distance's units. The paper does not give
            C, and the trials do not determine it, so the bound is withdrawn if C itself is stated.
        confidence: 1 - eps, the probability with which the bound holds.
        kernel: the kernel of the prior.
        search: the type of the search that chose the tasks, if it is known. The bound is withdrawn if that search
            fixes beta and estimates the hyperparameters.

    Raises:
        CertificateError: if no distance is known, an execution failed, no task was chosen by an acquisition function,
            or C is not positive.
    """
    require_probability("confidence", confidence)
    _require_usable(sample, constant)
    n, dimension = require_iterations(sample), sample.points.shape[1]
    computed = isinstance(constant, TheoremConstants)
    C = constant.constant(n, dimension, confidence, kernel) if isinstance(constant, TheoremConstants) else constant
    best, gap = float(sample.distances.max()), C * rate(n, dimension, kernel)
    return Certificate(
        kind="convergence",
        statement=f"With probability {confidence} under the prior, d* is at most {at_most(best + gap)}.",
        upper_bound=best + gap,
        confidence=confidence,
        volume=0.0,
        trials=len(sample),
        assumptions=(
            f"the distance is a draw from a Gaussian process with zero mean and a {kernel} kernel",
            "the kernel's hyperparameters are known; ctxval's own GP-UCB estimates them",
            "every task was chosen by GP-UCB with the theorem's growing beta_n; with a fixed beta it does not hold",
            "the theorem needs sample paths smoother than Matern 3/2 gives (nu > 2)",
            f"C = {C:g} is {'computed from the constants of the theorem that you state' if computed else 'yours'}",
            *sample.remarks,
            ONE_CAMPAIGN,
        ),
        details={
            **{"best": best, "gap": gap, "iterations": n, "constant": C, "kernel": kernel},
            "failures": sample.failures,
        },
        doubt=_doubt(C, computed, search),
    )


def _require_usable(sample: Sample, constant: float | TheoremConstants) -> None:
    """Refuse a constant that is not positive, and trials without a distance.

    Raises:
        CertificateError: if the constant is not positive, if a trial has no distance, or if there is no trial.
    """
    if not isinstance(constant, TheoremConstants) and not (constant > 0 and np.isfinite(constant)):
        raise CertificateError(f"the constant C of Proposition 1 must be a positive number, got {constant!r}.")
    if sample.failed or not len(sample):
        raise CertificateError(
            f"Proposition 1 needs a distance from every execution, but {sample.failed} of {len(sample)} trials have "
            "none."
        )


def _doubt(constant: float, computed: bool, search: str | None) -> str | None:
    """Return why the theorem does not apply to these trials; None if it applies under its assumptions."""
    if not computed:
        return (
            f"C = {constant:g} is a number of yours that no theorem and no trial supports, so the bound is withdrawn; "
            "--theorem computes C from the constants of the theorem"
        )
    if search in _FIXED:
        return (
            f"{search} took a fixed beta and estimated the kernel's hyperparameters, while the theorem needs a growing "
            "beta_n and known hyperparameters, so the bound is withdrawn; --kind posterior needs neither"
        )
    return None


def require_iterations(sample: Sample) -> int:
    """Return the number of tasks that an acquisition function chose.

    Raises:
        CertificateError: if it chose none of them.
    """
    count = len(sample.only("acquisition"))
    if not count:
        raise CertificateError("Proposition 1 is about tasks that GP-UCB chose, but none of these was.")
    return count
