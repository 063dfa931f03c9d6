"""The tables ``[certificate]``, ``[search]`` and ``[aspect1]`` of an experiment file."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, model_validator
from pydantic_core import PydanticCustomError

from ctxval.certificates import KINDS, RESOLUTION, CertificateKind, CertificateOptions, require_use
from ctxval.certificates.options import MOST_VOLUME
from ctxval.certificates.prediction_tests import TESTS
from ctxval.cli.config.parts import argument, require_types
from ctxval.errors import CertificateError, InputError, UnknownNameError
from ctxval.searches import DEFAULT as DEFAULT_SEARCH
from ctxval.searches import REGISTRY as SEARCHES
from ctxval.searches import Search, by_name
from ctxval.studies.aspect1 import TASKS

_OF_ANY_KIND = ("stochastic", "resolution", "volume", "tests")
"""Settings of a file that also apply to a certificate of another kind, if that kind has these options."""


class CertificateTable(BaseModel):
    """The table ``[certificate]``: the certificate for the verdict, chosen before the campaign is run.

    A kind of certificate from another package has its own options in the table.

    Attributes:
        volume: the share of the task space that may exceed the threshold.
        tests: the number of executions that must have been predicted beforehand at tasks drawn over the task space.
        resolution: the largest distance between a task and its nearest trial, in diagonals of the task space.
        discard: the number of largest distances to discard, for ``sampling-discarding``.
    """

    model_config = ConfigDict(extra="allow")

    kind: str = "auto"
    stochastic: bool = False
    volume: float = Field(default=0.0, ge=0, le=MOST_VOLUME, strict=True)
    tests: int = Field(default=TESTS, ge=0, strict=True)
    resolution: float = Field(default=RESOLUTION, gt=0, allow_inf_nan=False, strict=True)
    discard: int | None = Field(default=None, ge=0)

    @model_validator(mode="after")
    def _used(self) -> CertificateTable:
        if self.kind not in KINDS.imported:
            return self  # it is checked when it is used: reading imports nothing, and a store must stay readable
        fields = {name: field for name, field in type(self).model_fields.items() if name != "kind"}
        changed = [name for name, field in fields.items() if getattr(self, name) != field.default]
        try:
            for name in self.model_extra or {}:
                if name not in (names := {*type(self).model_fields, *KINDS[self.kind].options()}):
                    raise UnknownNameError.among("setting", name, names)
            require_use(self.kind, sorted({*changed, *(self.model_extra or {})}))
            typed(KINDS[self.kind], self.model_extra or {})
        except (CertificateError, InputError) as error:
            raise PydanticCustomError("use", str(error)) from error
        return self

    def options(
        self, confidence: float, *, kind: str | None = None, stated: Mapping[str, Any] | None = None
    ) -> CertificateOptions:
        """Return the kind, the options and the confidence of the certificate for the verdict."""
        given, chosen = dict(stated or {}), KINDS.find(kind or self.kind)
        planned_kind = kind is None or kind == self.kind
        if planned_kind and self.kind not in KINDS.imported:
            typed(chosen, self.model_extra or {})
        require_use(chosen.name, given)
        planned = self.model_dump() if planned_kind else self.model_dump(include=set(_OF_ANY_KIND))
        merged = {**planned, **typed(chosen, given)}
        return CertificateOptions(chosen.of(merged), confidence, merged["volume"])


def typed(kind: type[CertificateKind], options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options of a kind, with lists converted to tuples if the kind takes tuples."""
    return require_types(f"certificate {kind.name!r}", kind, options)


class SearchTable(BaseModel):
    """The table ``[search]``: the name of a search, and its options."""

    model_config = ConfigDict(extra="allow")

    name: str = DEFAULT_SEARCH
    repeats: int = Field(default=1, ge=1)

    def build(self, folder: Path | None = None) -> Search:
        """Return the search."""
        options = {key: argument(value, folder) for key, value in (self.model_extra or {}).items()}
        options = require_types(f"search {self.name!r}", SEARCHES.find(self.name), options)
        return by_name(self.name, repeats=self.repeats, **options)


class Aspect1Table(BaseModel):
    """The table ``[aspect1]``, which ``ctxval check --aspect1`` reads; a campaign does not use it.

    The distance is ``module:attr`` or a table: how far a trajectory is from completing its task. By default it is
    derived from the distance of the experiment. The threshold is in the units of the goal.
    """

    model_config = ConfigDict(extra="forbid")

    distance: str | dict[str, Any] | None = None
    threshold: float | None = Field(default=None, gt=0, allow_inf_nan=False, strict=True)
    tasks: int = Field(default=TASKS, ge=2)
