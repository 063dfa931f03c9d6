"""The table ``[certificate]`` of an experiment file, and what the command line states over it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator
from pydantic_core import PydanticCustomError

from ctxval.certificates import KINDS, RESOLUTION, CertificateKind, CertificateOptions, require_use
from ctxval.certificates.options import MOST_VOLUME
from ctxval.config.parts import require_types
from ctxval.errors import CertificateError, InputError, UnknownNameError

_OF_ANY_KIND = ("stochastic", "resolution", "volume")
"""Settings of a file that hold for a certificate of another kind too, if that has a use for them."""


class CertificateTable(BaseModel):
    """The table ``[certificate]``: what a validation is to rest on, chosen before it is run.

    Kinds of certificates from other packages have their own options in it.

    Attributes:
        kind: which certificate.
        stochastic: whether two executions of one task may differ.
        volume: share of the task space that may exceed the threshold.
        resolution: how far from every trial a task may be, in diagonals of the task space.
        discard, constant: of some kinds.
    """

    model_config = ConfigDict(extra="allow")

    kind: str = "posterior"
    stochastic: bool = False
    volume: float = Field(default=0.0, ge=0, le=MOST_VOLUME, strict=True)
    resolution: float = Field(default=RESOLUTION, gt=0, allow_inf_nan=False, strict=True)
    discard: int | None = Field(default=None, ge=0)
    constant: float | None = None

    @field_validator("kind")
    @classmethod
    def _known(cls, kind: str) -> str:
        if kind not in KINDS:
            raise PydanticCustomError("kind", f"the kind must be one of {', '.join(KINDS)}")
        return kind

    @model_validator(mode="after")
    def _used(self) -> CertificateTable:
        if self.kind not in KINDS.imported:
            return self  # its options are checked when it is used: reading settings imports nothing
        try:
            for name in self.model_extra or {}:
                self._require_known(name)
            require_use(self.kind, sorted(self._changed()))
            typed(KINDS[self.kind], self.model_extra or {})
        except (CertificateError, InputError) as error:
            raise PydanticCustomError("use", str(error)) from error
        return self

    def _require_known(self, name: str) -> None:
        names = {*type(self).model_fields, *KINDS[self.kind].options()}
        if name not in names:
            raise UnknownNameError.among("setting", name, names)

    def _changed(self) -> set[str]:
        """Return the options that are not as they are by default."""
        fields = {name: field for name, field in type(self).model_fields.items() if name != "kind"}
        changed = {name for name, field in fields.items() if getattr(self, name) != field.default}
        return changed | set(self.model_extra or {})

    def options(
        self, confidence: float, *, kind: str | None = None, stated: Mapping[str, Any] | None = None
    ) -> CertificateOptions:
        """Return by which certificate trials are to be judged.

        Args:
            confidence: of the certificate.
            kind: in place of the table's; the table's own options of a kind are then left out.
            stated: options over those of the table; none of them is None.

        Raises:
            UnknownNameError: there is no such kind, or no such option.
            CertificateError: an option is for other kinds, or has a value that the kind does not allow.
            InputError: an option has another type, or the confidence or the volume are out of range.
        """
        given, chosen = dict(stated or {}), KINDS.find(kind or self.kind)
        if kind is None and self.kind not in KINDS.imported:
            typed(chosen, self.model_extra or {})
        require_use(chosen.name, given)
        planned = self.model_dump() if kind is None else self.model_dump(include=set(_OF_ANY_KIND))
        merged = {**planned, **typed(chosen, given)}
        return CertificateOptions(chosen.of(merged), confidence, merged["volume"])


def typed(kind: type[CertificateKind], options: Mapping[str, Any]) -> dict[str, Any]:
    """Return options of a kind, lists made tuples if it wants tuples.

    Raises:
        InputError: an option has another type than the kind says.
    """
    return require_types(f"certificate {kind.name!r}", kind, options)
