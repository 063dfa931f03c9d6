"""Every exception that ctxval raises, in one tree.

::

    CtxvalError
    ├── InputError (also ValueError)        a value given by the user cannot be used
    │   ├── ShapeError                      ... because of its shape
    │   └── UnknownNameError                ... because nothing has that name (also AttributeError)
    ├── ModelError                          the model M gave something unusable
    ├── DesignError                         no controller could be designed for a task
    ├── ExecutionError                      an execution of S failed; a campaign records it as a failed trial
    ├── DistanceError                       the distance gave something unusable
    ├── CertificateError (also ValueError)  the theory of a certificate does not allow what it was given
    ├── StoreError
    │   ├── StoreAccessError                the file cannot be opened, read or written
    │   ├── ForeignStoreError               the file is not a store that this version can read
    │   └── StoreMismatchError              the store was made by another experiment
    ├── CampaignError                       the campaign cannot go on
    └── ConformanceError (also AssertionError)  an own part breaks the contract of its protocol
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class CtxvalError(Exception):
    """Base of every error that ctxval raises on purpose."""


class InputError(CtxvalError, ValueError):
    """A value given by the user cannot be used."""


class ShapeError(InputError):
    """An array has the wrong shape."""


class UnknownNameError(InputError, AttributeError):
    """Nothing has the name that was given."""

    @classmethod
    def among(cls, kind: str, name: str, known: Iterable[str]) -> UnknownNameError:
        """Say that ``name`` is no ``kind``, and which known name is nearest to it."""
        names = sorted(known)
        near = difflib.get_close_matches(name, names, n=1, cutoff=0.4)
        hint = f"did you mean {near[0]!r}?" if near else f"known: {', '.join(names)}."
        return cls(f"no {kind} is called {name!r}; {hint}")


class ModelError(CtxvalError):
    """The model M gave something unusable."""


class DesignError(CtxvalError):
    """No controller could be designed for a task."""


class ExecutionError(CtxvalError):
    """An execution of the system S failed; a campaign records it as a failed trial."""


class DistanceError(CtxvalError):
    """The distance gave something unusable."""


class CertificateError(CtxvalError, ValueError):
    """The theory of a certificate does not allow what it was given."""


class StoreError(CtxvalError):
    """Something is wrong with a store."""


class StoreAccessError(StoreError):
    """The store's file cannot be opened, read or written."""


class ForeignStoreError(StoreError):
    """The file is not a store that this version can read."""


class StoreMismatchError(StoreError):
    """The store was made by another experiment."""


class CampaignError(CtxvalError):
    """The campaign cannot go on."""


class ConformanceError(CtxvalError, AssertionError):
    """An own model, system, synthesizer, distance or search breaks the contract of its protocol."""
