"""Kinds of certificates by name, including those of other packages."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any, TypeVar

from ctxval._util.registry import Registry
from ctxval.certificates.base import Certificate, CertificateKind
from ctxval.errors import CertificateError, InputError, UnknownNameError

Kind = TypeVar("Kind", bound=type[CertificateKind])


class KindRegistry(Registry[CertificateKind]):
    """Kinds of certificates by name: built-in ones, those of installed packages, and those registered by a decorator.

    A registered kind is the user's own code, so :meth:`is_data` returns False for it.
    """

    def __init__(self) -> None:
        super().__init__("certificate", "ctxval.certificates", method="certify")
        self._registered: dict[str, type[CertificateKind]] = {}

    def register(self, kind: Kind) -> Kind:
        """Add a kind; it is used as a decorator of the class."""
        name = _required(kind).name
        known = self.find(name) if name in self.built_in else self._registered.get(name, kind)
        if (known.__module__, known.__qualname__) != (kind.__module__, kind.__qualname__):
            raise InputError(f"there is a kind of certificate called {name!r} already: {known.__qualname__}.")
        if name not in self.built_in:
            self._registered[name] = kind  # a cell that is run again replaces its own class
        return kind

    def find(self, name: str) -> type[CertificateKind]:
        """Return the kind of a name."""
        kind = self._registered.get(name) or _required(super().find(name))
        if kind.name != name:
            raise InputError(f"the certificate {name!r} calls itself {kind.name!r}.")
        return kind

    @property
    def imported(self) -> tuple[str, ...]:
        """The names of the kinds that are imported: built-in and registered ones."""
        return (*self.built_in, *self._registered)

    def of(self, certificate: Certificate) -> type[CertificateKind]:
        """Return the kind of a certificate; the base class :class:`CertificateKind` if the kind is not known."""
        return self.find(certificate.kind) if certificate.kind in self else CertificateKind

    def with_option(self, option: str) -> tuple[str, ...]:
        """Return the names of the imported kinds that have an option."""
        return tuple(name for name in self.imported if option in self.find(name).options())

    def __contains__(self, name: object) -> bool:
        return name in self._registered or super().__contains__(name)

    def __iter__(self) -> Iterator[str]:
        return iter(dict.fromkeys((*self.imported, *self.installed)))

    def __len__(self) -> int:
        return len(list(iter(self)))


def _required(kind: Any) -> type[CertificateKind]:
    if isinstance(kind, type) and issubclass(kind, CertificateKind) and isinstance(getattr(kind, "name", None), str):
        return kind
    raise InputError(f"a kind of certificate must be a subclass of CertificateKind with a name, got {kind!r}.")


KINDS = KindRegistry()
"""Kinds of certificates by name."""


def require_use(kind: str, given: Iterable[str]) -> None:
    """Refuse options that a kind would ignore: a user who gives one expects it to have an effect."""
    options = KINDS.find(kind).options()
    for option in given:
        kinds = " or ".join(KINDS.with_option(option))
        if option not in options and not kinds:
            raise UnknownNameError.among(f"option of the certificate {kind!r}", option, options)
        if option not in options:
            raise CertificateError(f"{option} is for certificates of the kind {kinds}; the kind here is {kind}.")
