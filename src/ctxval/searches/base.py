"""The interface of all searches, and the base classes that the ready-made ones share."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np

from ctxval._util.arrays import Array, ArrayLike, as_floats
from ctxval._util.checked import NonNegativeInt, PositiveInt, checked
from ctxval._util.representation import ShortRepr, call, options
from ctxval.errors import InputError, ShapeError
from ctxval.gp.surrogate import Surrogate

Note = dict[str, Any]  #: what a search records about the choice of a point, in types that JSON has


@dataclass(frozen=True)
class Costs:
    """What predictions and one evaluation cost, in seconds; of predictions, seconds of CPU time."""

    prediction: float  # of one point in a batch
    evaluation: float | None  # infinity if people make it, and None if none was timed
    rough: float | None = None  # of the rough prediction of one point; that of the prediction if None
    batch: float = 0.0  # of each batch besides those of its points


@dataclass(frozen=True, eq=False)
class Pending(ShortRepr):
    """Points that are being evaluated."""

    points: Array
    prediction: Callable[[], Prediction]  # as if they had the expected values: the doubt near them is less


@dataclass(frozen=True, eq=False)
class Prediction(ShortRepr):
    """A prediction of values at points of the unit cube that have not been evaluated."""

    expected: Callable[[Array], tuple[Array, Array]]
    """Points ``(m, d)`` -> expected values ``(m,)`` and their doubt ``(m,)``, both NaN if a value cannot be predicted.
    The doubt is 0 if all that leads to a value was seen before, and about 1 if nothing was."""
    left_out: Callable[[Array], Array]
    """Points ``(k, d)`` with known values -> predictions ``(k,)``, each as if that point had not been evaluated."""
    budget: int  # number of points that may be predicted to choose one, known points not counted
    otherwise: Callable[[], Prediction | None] | None = None  # another one, if leave-one-out errors show a bad one
    costs: Callable[[], Costs] | None = None  # measures the costs, which takes some predictions
    rough: Callable[[Array], tuple[Array, Array]] | None = None  # an approximation of ``expected`` that is cheaper
    steady: Callable[[Array], bool] | None = None  # whether a point has the value of its neighbours; None if all have
    pending: Pending | None = None  # the points that are being evaluated
    thinking: float | None = None  # seconds that the choice may take; None if they are not stated
    candidates: Array | None = None  # the only points that may be evaluated (r, d); None if all may


@runtime_checkable
class Search(Protocol):
    """A search for the largest value over the unit cube: it chooses the next points to evaluate.

    The state of a search is a function of the seed and of the history of points and values, in their order: a new
    search that is reset with the same seed and told the same history asks for the same points. So a campaign saves no
    search, and resumes by telling the history.

    A campaign may execute a point that differs by 1e-9 from the one that was asked for, and tells that one.

    These three methods are all that a search needs. A search that offers more, such as independent draws or notes,
    inherits :class:`BaseSearch`. A campaign ignores other attributes and methods of other classes, whatever their
    names.
    """

    @abstractmethod
    def reset(self, dimension: int, seed: int) -> None:
        """Forget everything and start on the unit cube of this dimension."""

    @abstractmethod
    def ask(self, n: int = 1) -> Array:
        """Return the next points, shape ``(n, d)``; they are pending until told."""

    @abstractmethod
    def tell(self, points: ArrayLike, values: ArrayLike) -> None:
        """Learn the values ``(n,)`` at points ``(n, d)``; NaN for an evaluation that is pending or has failed."""


class BaseSearch(Search):
    """Base class of searches with more than the three methods of :class:`Search`; all ready-made ones inherit it.

    A subclass implements these three methods. All others have a default, which does nothing.
    """

    #: whether every point is an independent uniform draw. If the task space has a distribution of tasks, a campaign
    #: replaces the points by draws from it.
    iid: bool = False
    initial: int = 0  #: number of points at the start that are an initial design
    discard: int = 0  #: number of the largest values that the estimate of the maximum leaves out

    def __init__(self) -> None:
        """Take no options; a protocol without a constructor would take any."""

    @staticmethod
    def of(search: Search) -> BaseSearch:
        """Return the search itself if it is of this class; else wrap it with the defaults of this class."""
        return search if isinstance(search, BaseSearch) else _WithDefaults(search)

    @property
    def uses_prediction(self) -> bool:
        """Whether a campaign computes a costly prediction: if the subclass has its own :meth:`use_prediction`."""
        return type(self).use_prediction is not BaseSearch.use_prediction

    def use_prediction(self, prediction: Prediction | None) -> None:
        """Take the prediction for the points that are asked for next; None if there is none."""

    def note(self) -> Note | None:
        """Return the note on the point that was asked for last, in types that JSON has; None if there is none."""
        return None

    def remember(self, notes: Sequence[Note | None]) -> None:
        """Take the notes on a history that was told: one for each point, in the order of the points."""

    def estimate(self, points: Array, values: Array) -> float | None:
        """Return the largest of values ``(N,)`` but for the ``discard`` largest; None if there are too few."""
        ordered = np.sort(values)[::-1]
        return float(ordered[self.discard]) if len(ordered) > self.discard else None

    def surrogate(self) -> Surrogate | None:
        """Return the Gaussian process of the values that the search uses; None if it uses none."""
        return None


class _WithDefaults(BaseSearch):
    """A search of another class, of which a campaign uses only the three methods of the protocol."""

    def __init__(self, search: Search) -> None:
        self._search = search

    def reset(self, dimension: int, seed: int) -> None:
        self._search.reset(dimension, seed)

    def ask(self, n: int = 1) -> Array:
        return self._search.ask(n)

    def tell(self, points: ArrayLike, values: ArrayLike) -> None:
        self._search.tell(points, values)


class SequentialSearch(BaseSearch):
    """Base class of searches that propose one point at a time from the history of all points."""

    @checked
    def reset(self, dimension: PositiveInt, seed: NonNegativeInt) -> None:
        self._dimension, self._seed = dimension, seed
        self._points: list[Array] = []
        self._values: list[float] = []
        self._notes: list[Note | None] = []
        self._slots: dict[bytes, list[int]] = {}
        self._last_note: Note | None = None

    @checked
    def ask(self, n: PositiveInt = 1) -> Array:
        self._require_reset()
        proposals = []
        for _ in range(n):
            rng = np.random.default_rng(np.random.SeedSequence([self._seed, len(self._points)]))
            self._last_note = None
            proposals.append(self.propose(rng))
            self._append(proposals[-1], np.nan, self._last_note)
        return np.array(proposals)

    def tell(self, points: ArrayLike, values: ArrayLike) -> None:
        self._require_reset()
        rows, scalars = as_floats("points", points), as_floats("values", values)
        if rows.ndim != 2 or rows.shape[1] != self._dimension or scalars.shape != (len(rows),):
            got = f"{rows.shape} and {scalars.shape}"
            raise ShapeError(f"tell needs points (n, {self._dimension}) and values (n,), got {got}.")
        if not ((rows >= 0) & (rows <= 1)).all():
            raise InputError(f"points must be in the unit cube, got {rows.tolist()}.")
        for point, value in zip(rows, scalars.tolist(), strict=True):
            waiting = [slot for slot in self._slots.get(_key(point), []) if np.isnan(self._values[slot])]
            if waiting:
                self._values[waiting[0]] = value
            else:
                self._append(point, value, None)

    def amend(self, point: Array) -> None:
        """Replace the point ``(d,)`` that was asked for last by the one that is evaluated, which has fewer digits."""
        last = len(self._points) - 1
        key = _key(self._points[last])
        self._slots[key].remove(last)
        if not self._slots[key]:
            del self._slots[key]
        self._slots.setdefault(_key(point), []).append(last)
        self._points[last] = point

    def note(self) -> Note | None:
        self._require_reset()
        return self._last_note

    def remember(self, notes: Sequence[Note | None]) -> None:
        self._notes = list(notes)

    def _append(self, point: Array, value: float, note: Note | None) -> None:
        self._slots.setdefault(_key(point), []).append(len(self._points))
        self._points.append(point)
        self._values.append(value)
        self._notes.append(note)

    def _require_reset(self) -> None:
        if not hasattr(self, "_points"):
            raise InputError("reset(dimension, seed) must come before ask and tell.")

    @abstractmethod
    def propose(self, rng: np.random.Generator) -> Array:
        """Return the next point ``(d,)``, given ``self.points``, ``self.values`` and a generator for this point."""

    @property
    def dimension(self) -> int:
        return self._dimension

    @property
    def points(self) -> Array:
        """All points asked for or told, shape ``(n, d)``."""
        return np.array(self._points).reshape(-1, self._dimension)

    @property
    def values(self) -> Array:
        """The values of all points, shape ``(n,)``; NaN if pending or failed."""
        return np.array(self._values)

    @property
    def notes(self) -> tuple[Note | None, ...]:
        """The note on each point; None if there is none, or if the point was told by hand."""
        return tuple(self._notes)

    def __repr__(self) -> str:
        if not hasattr(self, "_points"):
            return call(self, **options(self))
        known = self.values[np.isfinite(self.values)]
        largest = float(known.max()) if known.size else None
        return call(self, **options(self), dimension=self.dimension, points=len(self._points), largest=largest)


def best_first(points: Array, values: Array) -> Array:
    """Return points ``(n, d)``, the largest value first, pending and failed ones last."""
    return np.asarray(points[np.argsort(-np.nan_to_num(values, nan=-np.inf), kind="stable")])


def _key(point: Array) -> bytes:
    return (point + 0.0).tobytes()  # minus zero is zero
