"""Every exception that ctxval raises, in one tree.

::

    CtxvalError
    ├── InputError (also ValueError)        a value given by the user cannot be used
    │   ├── ShapeError                      ... because of its shape
    │   └── UnknownNameError                ... because nothing has that name (also AttributeError)
    ├── ModelError                          the model M failed or returned an unusable result
    ├── DesignError                         no controller could be designed for a task
    ├── ExecutionError                      an execution of S failed; a campaign records it as a failed trial
    ├── DistanceError                       the distance failed or returned an unusable result
    ├── CertificateError (also ValueError)  the trials or options do not meet the assumptions of a certificate
    ├── StoreError
    │   ├── StoreAccessError                the file cannot be opened, read or written
    │   ├── ForeignStoreError               the file is not a store that this version can read
    │   └── StoreMismatchError              the store was made by another experiment
    ├── CampaignError                       the campaign cannot continue
    └── ConformanceError (also AssertionError)  a part breaks the contract of its protocol

Every public constructor and function raises an InputError for an argument or a file that cannot be used. Docstrings
name the other exceptions.
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
        """Return the error that ``name`` is unknown; its message gives the nearest known name, or all of them."""
        names = sorted(known)
        near = difflib.get_close_matches(name, names, n=1, cutoff=0.4)
        hint = f"did you mean {near[0]!r}?" if near else f"known: {', '.join(names) or 'none'}."
        return cls(f"no {kind} is called {name!r}; {hint}")


class ModelError(CtxvalError):
    """The model M failed or returned an unusable result."""


class DesignError(CtxvalError):
    """No controller could be designed for a task."""


class ExecutionError(CtxvalError):
    """An execution of the system S failed; a campaign records it as a failed trial."""


class DistanceError(CtxvalError):
    """The distance failed or returned an unusable result."""


class CertificateError(CtxvalError, ValueError):
    """The trials or options do not meet the assumptions of a certificate."""


class StoreError(CtxvalError):
    """A store cannot be used."""


class StoreAccessError(StoreError):
    """The store's file cannot be opened, read or written."""


class ForeignStoreError(StoreError):
    """The file is not a store that this version can read."""


class StoreMismatchError(StoreError):
    """The store was made by another experiment."""


class CampaignError(CtxvalError):
    """The campaign cannot continue."""


class ConformanceError(CtxvalError, AssertionError):
    """A model, system, synthesizer, distance or search breaks the contract of its protocol."""
