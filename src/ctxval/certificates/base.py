"""What every certificate says, and what every kind of certificate must be able to do."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any, ClassVar, Self

from ctxval._util.representation import Shown, call, line, lines, record, table
from ctxval.certificates.bounds import ERRORS, as_text, at_most, with_error
from ctxval.certificates.sample import Sample
from ctxval.core.space import TaskSpace
from ctxval.core.trial import Origin
from ctxval.version import VERSION

if TYPE_CHECKING:
    from ctxval.certificates.forecast import Forecast

ONE_CAMPAIGN = "this campaign was fixed beforehand: the best of several is wrong more often than stated"
"""What every certificate assumes."""

_INDENT = "\n  "
"""Before further lines of a text, so that none looks like a line of the certificate."""


@dataclass(frozen=True, repr=False)
class Certificate:
    """A statement on d*, with everything it rests on; as text, what the command line prints of it.

    Attributes:
        kind: the name of its :class:`CertificateKind`.
        statement: what it says, in one sentence.
        upper_bound: h, in the distance's units.
        confidence: the probability of the statement, over what ``assumptions`` say is random.
        volume: the share of the task space that the statement leaves out; 0 if it covers all of it.
        trials: n.
        assumptions: what must hold, in plain words.
        details: the numbers behind it.
        doubt: why it is withdrawn, if the trials speak against what it assumes; a user must not believe it then.
        error: standard error of ``upper_bound`` if it is computed from random draws, in the distance's units.
        version: of ctxval.
    """

    kind: str
    statement: str
    upper_bound: float
    confidence: float
    volume: float
    trials: int
    assumptions: tuple[str, ...]
    details: dict[str, Any] = field(default_factory=dict)
    doubt: str | None = None
    error: float = 0.0
    version: str = VERSION

    def covers(self, threshold: float, volume: float = 0.0) -> bool:
        """Return whether it bounds the distance by the threshold for sure, but for a volume that is acceptable."""
        return self.doubt is None and self.volume <= volume and self.upper_bound + ERRORS * self.error <= threshold

    def with_remarks(self, remarks: Sequence[str]) -> Certificate:
        """Return the certificate with more sentences among its assumptions: what the user states and must know."""
        return replace(self, assumptions=(*self.assumptions, *remarks))

    def to_json(self) -> dict[str, Any]:
        """Return everything, ready for JSON."""
        return asdict(self)

    @property
    def numbers(self) -> dict[str, Any]:
        """The numbers that are shown to people; failures are among the assumptions."""
        shown = {name: value for name, value in self.details.items() if name != "failures"}
        return {**shown, "trials": self.trials, "version": self.version}

    def __str__(self) -> str:
        return "\n".join(one.replace("\r\n", "\n").replace("\n", _INDENT) for one in self._lines())

    def _lines(self) -> Iterator[str]:
        yield f"{self.kind}: {self.statement}"
        if self.doubt is not None:
            yield f"withdrawn: {self.doubt}."
        yield "It assumes that"
        yield from (f"- {assumption};" for assumption in self.assumptions)
        width = max(map(len, self.numbers))
        yield from (f"{name.replace('_', ' '):{width}}  {as_text(value)}" for name, value in self.numbers.items())

    def __repr__(self) -> str:
        bound, volume = Shown(with_error(self.upper_bound, self.error)), Shown(at_most(self.volume, 3))
        head = call(self, self.kind, upper_bound=bound, confidence=self.confidence, volume=volume, trials=self.trials)
        withdrawn = [] if self.doubt is None else [f"withdrawn: {line(self.doubt)}"]
        return lines(head, *withdrawn, line(self.statement), f"assumptions: {len(self.assumptions)}")

    def _repr_html_(self) -> str:
        return table(
            f"Certificate: {self.kind}",
            [
                ("withdrawn", self.doubt),
                ("statement", self.statement),
                ("upper bound", with_error(self.upper_bound, self.error)),
                ("confidence", Shown(f"{self.confidence:.6g}")),
                ("volume left out", at_most(self.volume, 3)),
                ("trials", self.trials),
                *(("assumes", assumption) for assumption in self.assumptions),
                ("version", self.version),
            ],
        )


@dataclass(frozen=True)
class CertificateKind(ABC):
    """A kind of certificate. Its fields are its options: what it must be told besides the trials and the confidence.

    A kind is a frozen dataclass with a name and a method that makes a certificate of trials. The other methods say what
    a verdict by it rests on, and refuse what cannot succeed before it is paid for; their defaults suit a bound on d*
    that is computed from the distances alone. A kind that needs numbers which the trials do not carry takes them as a
    field; draws of d* under a learned model of the dynamics are such numbers.
    """

    name: ClassVar[str]
    """What it is called in files, on the command line and on its certificates."""

    bounds_maximum: ClassVar[bool] = True
    """Whether it bounds d* itself. Otherwise it leaves out a volume of the task space, which a user must accept."""

    needs_threshold: ClassVar[bool] = False
    """Whether its statement is about a threshold, so that there is none without one."""

    @classmethod
    def options(cls) -> tuple[str, ...]:
        """Return the names of what may be stated for it: its fields, and ``volume`` if it leaves one out."""
        own = tuple(one.name for one in fields(cls))
        return own if cls.bounds_maximum else (*own, "volume")

    @classmethod
    def of(cls, stated: Mapping[str, Any]) -> Self:
        """Return it with those of the options that are its own; what is None or missing has its default."""
        return cls(**{one.name: stated[one.name] for one in fields(cls) if stated.get(one.name) is not None})

    @abstractmethod
    def certify(self, sample: Sample, confidence: float = 0.95) -> Certificate:
        """Return the certificate of trials.

        Raises:
            CertificateError: its theory does not allow these trials, or an option that it needs is missing.
        """

    def certify_against(
        self, sample: Sample, threshold: float, confidence: float = 0.95
    ) -> tuple[Certificate, Forecast | None]:
        """Return the certificate as exact as a threshold asks for, and what is expected of further executions.

        The forecast is None if the threshold is kept, or nothing can be foreseen.

        Raises:
            CertificateError: as :meth:`certify` does.
        """
        return self.certify(sample, confidence), None

    def require_audit_helps(self, origins: Iterable[Origin]) -> None:  # noqa: B027 (most kinds can use draws)
        """Make sure, before independent draws are executed, that this certificate could use them.

        Args:
            origins: of the trials that there are already.

        Raises:
            CertificateError: it could not, however they come out.
        """

    @classmethod
    def rests_on(cls, certificate: Certificate, space: TaskSpace | None = None) -> list[str]:
        """Return what a validation by its certificate rests on: ends of a sentence that begins with "It rests on".

        Args:
            certificate: one of this kind.
            space: the tasks, to tell lengths in their units.
        """
        return ["what its certificate assumes"]

    @classmethod
    def qualification(cls, certificate: Certificate, space: TaskSpace | None = None) -> str:
        """Return what a validation says of options that are not the usual ones: the end of a sentence, or nothing."""
        return ""

    @classmethod
    def shortfall(cls, certificate: Certificate) -> str:
        """Return why the volume left out is larger than it might be: the end of a sentence, or nothing."""
        return ""

    def __repr__(self) -> str:
        return record(self)
