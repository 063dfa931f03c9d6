"""The certificate, the base class of all kinds of certificates, and kinds by name."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field, fields
from typing import TYPE_CHECKING, Any, ClassVar, Self

from ctxval._util.arrays import Array
from ctxval._util.registry import Registry
from ctxval._util.representation import ShortRepr, Shown, call
from ctxval._util.texts import as_text
from ctxval._util.version import VERSION
from ctxval.certificates.bounds import ERRORS, at_most, with_error
from ctxval.certificates.sample import Sample
from ctxval.certificates.sentences import verdicts as sentences
from ctxval.certificates.sentences.statements import ONE_CAMPAIGN
from ctxval.core.quantiles import QUANTILE
from ctxval.core.space import TaskSpace
from ctxval.core.target import Target
from ctxval.core.trial import Origin
from ctxval.errors import CertificateError, InputError, UnknownNameError

if TYPE_CHECKING:
    from ctxval.certificates.forecast import Forecast


@dataclass(frozen=True, repr=False)
class Certificate:
    """A statement about d* with its assumptions; ``str`` returns the text that the command line prints."""

    kind: str  #: the name of its :class:`CertificateKind`
    statement: str  #: the statement, in one sentence
    upper_bound: float  #: the bound h on the distance, in the distance's units
    confidence: float  #: the probability of the statement, over what ``assumptions`` say is random
    volume: float  #: the share of the task space that the statement leaves out; 0 if it covers all of it
    trials: int  #: the number n of trials that it is computed from
    assumptions: tuple[str, ...]  #: conditions under which the statement holds, one sentence each
    details: dict[str, Any] = field(default_factory=dict)  #: the numbers from which the statement is computed
    doubt: str | None = None  #: why it is withdrawn, so that its statement must not be used; None if it is not
    withdrawn_by: str | None = None  #: the code of the check that withdraws it; None if it is not withdrawn
    error: float = 0.0  #: standard error of ``upper_bound`` if it is computed from random draws; else 0
    version: str = VERSION  #: the version of ctxval that computed it
    distribution: str | None = None  #: the distribution of tasks as a text, which ``volume`` is of; None if uniform
    expected: Forecast | None = None  #: a forecast of further executions; None if it decides, or can predict nothing

    @property
    def bound(self) -> float | None:
        """The bound on d*; None if it is withdrawn, is infinite, or leaves out a volume."""
        usable = self.doubt is None and not self.volume and math.isfinite(self.upper_bound)
        return self.upper_bound if usable else None

    @property
    def target(self) -> Target:
        """What it bounds: the largest distance, or a quantile of executions, or the distance of a share of tasks."""
        return Target.from_json(self.details)

    def covers(self, threshold: float, volume: float = 0.0) -> bool:
        """Return whether it bounds the distance by the threshold, except on at most this share of the task space.

        A bound that is computed from random draws must stay below the threshold by two of its standard errors.
        """
        return self.doubt is None and self.volume <= volume and self.upper_bound + ERRORS * self.error <= threshold

    def to_json(self) -> dict[str, Any]:
        """Return all attributes but the forecast, ready for JSON."""
        return {name: value for name, value in asdict(self).items() if name != "expected"}

    @property
    def numbers(self) -> dict[str, Any]:
        """The numbers that are printed; failures, which the assumptions list, and long lists are only in JSON."""
        shown = {
            name: value for name, value in self.details.items() if name not in ("failures", "checked", "open_checks")
        }
        return {**shown, "trials": self.trials, "version": self.version}

    def __str__(self) -> str:
        width = max(map(len, self.numbers))
        texts = [
            f"{self.kind}: {self.statement}",
            *([] if self.doubt is None else [f"withdrawn: {self.doubt}."]),
            "It assumes that",
            *(f"- {assumption};" for assumption in self.assumptions),
            *(f"{name.replace('_', ' '):{width}}  {as_text(value)}" for name, value in self.numbers.items()),
        ]
        # Further lines of a text are indented, so that none looks like a line of the certificate.
        return "\n".join(text.replace("\r\n", "\n").replace("\n", "\n  ") for text in texts)

    def __repr__(self) -> str:
        bound, volume = Shown(with_error(self.upper_bound, self.error)), Shown(at_most(self.volume, 3))
        known = {"upper_bound": bound, "confidence": self.confidence, "volume": volume, "trials": self.trials}
        return call(self, self.kind, **known, withdrawn=self.doubt)


@dataclass(frozen=True)
class CertificateKind(ShortRepr, ABC):
    """A kind of certificate. Its fields are its options: its inputs besides the trials and the confidence.

    The defaults suit a bound on d* that is computed from the distances alone. If a kind uses what the experiment's
    model predicts, it sets ``needs_model`` and reads :attr:`Sample.learned`.
    """

    name: ClassVar[str]
    """The name of the kind in files, on the command line and on its certificates."""

    bounds_maximum: ClassVar[bool] = True
    """Whether it bounds d* itself. If not, it leaves out a share of the task space, which the user must accept."""

    uses_threshold: ClassVar[bool] = False
    """Whether its statement is about a threshold, if there is one."""

    needs_model: ClassVar[bool] = False
    """Whether it uses what the experiment's model predicts, so that the experiment must be loaded."""

    sorts_draws: ClassVar[bool] = False
    """Whether its sample has all independent draws; else only those whose number did not depend on results, and the
    others are like trials of a search."""

    takes_suites: ClassVar[bool] = False
    """Whether it certifies suites of tasks, of which each is executed once and none is drawn at random."""

    quantile = QUANTILE
    """The share of the executions of each task that a threshold is about, if they differ by noise."""

    share = 1.0
    """The share of the tasks that a threshold is about; 1 for all of them, whose largest distance is d*."""

    @property
    def target(self) -> Target:
        """What a threshold is about, before it is known whether the system is noisy."""
        return Target.asked(self.quantile, self.share)

    @classmethod
    def options(cls) -> tuple[str, ...]:
        """Return the names of its options: its fields, and ``volume`` if it validates but for a share of the tasks."""
        return (*(option.name for option in fields(cls)), *(() if cls.bounds_maximum else ("volume",)))

    @classmethod
    def of(cls, stated: Mapping[str, Any]) -> Self:
        """Return an instance from those of the options that are its own; an option that is None keeps its default."""
        known = ((option.name, stated.get(option.name)) for option in fields(cls))
        return cls(**{name: value for name, value in known if value is not None})

    def needs_evidence(self, sample: Sample) -> bool:
        """Return whether the certificate of a sample reads what the executions teach of the dynamics."""
        return False

    def without_dynamics(self, target: Target, suite: Array | None) -> CertificateKind:
        """Return the kind that judges without learned dynamics, of a target and the tasks ``(n, d)`` of a suite."""
        return self

    @abstractmethod
    def certify(self, sample: Sample, confidence: float = 0.95) -> Certificate:
        """Return the certificate of trials, precise enough for the threshold of the sample if there is one.

        A CertificateError is raised if the trials or the options do not allow one.
        """

    def certificate(
        self,
        sample: Sample,
        statement: str,
        upper_bound: float,
        confidence: float,
        assumptions: Iterable[str],
        details: Mapping[str, Any],
        **others: Any,
    ) -> Certificate:
        """Return a certificate of all tasks and trials, or with ``others`` of its attributes.

        What all kinds share is added: remarks on failures, the assumption of one campaign, the distribution of tasks.
        """
        values = {
            "volume": 0.0,
            "trials": len(sample),
            "assumptions": (*assumptions, *sample.remarks, ONE_CAMPAIGN),
            "details": {**details, "failures": sample.failures},
            "distribution": None if self.bounds_maximum else sample.distribution,
        }
        return Certificate(self.name, statement, upper_bound, confidence, **{**values, **others})

    def require_usable(self, confidence: float, executions: int, beside: Iterable[Origin] = ()) -> None:
        """Raise a CertificateError if so many trials could never be certified, before they are paid for.

        There may be others ``beside`` them, of these origins.
        """

    @classmethod
    def rests_on(cls, certificate: Certificate, space: TaskSpace | None = None) -> list[str]:
        """Return what a validation rests on, each as the end of "It rests on ..."; the space gives units."""
        return sentences.conditions(certificate, space)


class KindRegistry(Registry[CertificateKind]):
    """Kinds of certificates by name: built-in ones, and those of installed packages."""

    def find(self, name: str) -> type[CertificateKind]:
        """Return the kind of a name."""
        kind: Any = super().find(name)
        if name not in self._exported:
            if not isinstance(kind, type) or not issubclass(kind, CertificateKind):
                raise InputError(f"a kind of certificate must be a subclass of CertificateKind, got {kind!r}.")
            if getattr(kind, "name", None) != name:
                raise InputError(f"the certificate {name!r} calls itself {getattr(kind, 'name', None)!r}.")
        return kind  # type: ignore[no-any-return]


KINDS = KindRegistry("certificate", "ctxval.certificates", method="certify")
"""Kinds of certificates by name."""


def require_use(kind: str, given: Iterable[str]) -> None:
    """Refuse options that a kind would ignore: a user who gives one expects it to have an effect.

    Raises:
        CertificateError: if the option is for other kinds.
    """
    options = KINDS.find(kind).options()
    for option in given:
        kinds = " or ".join(name for name in KINDS.built_in if option in KINDS.find(name).options())
        if option not in options and not kinds:
            raise UnknownNameError.among(f"option of the certificate {kind!r}", option, options)
        if option not in options:
            raise CertificateError(f"{option} is for certificates of the kind {kinds}; the kind here is {kind}.")
