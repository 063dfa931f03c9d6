"""What every search offers, and the bookkeeping that most of them share."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np

from ctxval._util.arrays import Array, ArrayLike, Rows, as_floats
from ctxval._util.representation import call, options, record
from ctxval.errors import InputError, ShapeError
from ctxval.gp.surrogate import Surrogate

Note = dict[str, Any]
"""What a search thought when it chose a point, plain enough for JSON."""


@dataclass(frozen=True, eq=False)
class Prediction:
    """What is expected of values before they are known, as a plain function of points of the unit cube.

    Attributes:
        expected: points ``(m, d)`` -> the values expected ``(m,)``, and the doubt in what leads to each, ``(m,)``: 0
            if all of it was seen before, about 1 if nothing was. Both are NaN if nothing can be predicted.
        left_out: rows ``(k,)`` of the points with a known value, in the order of asking -> what would be expected
            there, ``(k,)``, had each not been evaluated.
        budget: how many points may be asked about in choosing one, the known ones not counted; each may cost a
            controller's design.
        otherwise: returns what may be used instead if leaving points out shows that this one is no good.
    """

    expected: Callable[[Array], tuple[Array, Array]]
    left_out: Callable[[Rows], Array]
    budget: int
    otherwise: Callable[[], Prediction | None] | None = None

    def __repr__(self) -> str:
        return record(self)


@runtime_checkable
class Search(Protocol):
    """Chooses the next points of the unit cube to evaluate, seeking the largest value.

    The state of a search is a function of the seed and of the history of points and values, in their order: a new
    search that is reset with the same seed and told the same history asks for the same points. So a campaign
    resumes by telling, and saves no search.

    These three methods are all that a search needs. One that has more to tell a campaign, such as independent draws or
    notes, inherits :class:`BaseSearch`; attributes and methods of other classes are their own, whatever their names.
    """

    def reset(self, dimension: int, seed: int) -> None:
        """Forget everything and start on the unit cube of this dimension."""

    def ask(self, n: int = 1) -> Array:
        """Return the next points, shape ``(n, d)``; they are pending until told."""

    def tell(self, points: ArrayLike, values: ArrayLike) -> None:
        """Learn the values ``(n,)`` at points ``(n, d)``; NaN for an evaluation that is pending or has failed."""


class BaseSearch(ABC):
    """Base class of searches that tell a campaign more than their next points; all ready-made ones inherit it.

    A subclass has the three methods of :class:`Search`. Everything else has a default, which does nothing.

    Attributes:
        iid: whether every point is an independent uniform draw.
        initial: how many first points are an initial design.
        discard: how many of the largest values its estimate of the maximum leaves out.
    """

    iid: bool = False
    initial: int = 0
    discard: int = 0

    @staticmethod
    def of(search: Search) -> BaseSearch:
        """Return a search of this class as it is, and any other one with the defaults of this class."""
        return search if isinstance(search, BaseSearch) else _WithDefaults(search)

    @abstractmethod
    def reset(self, dimension: int, seed: int) -> None:
        """Forget everything and start on the unit cube of this dimension."""

    @abstractmethod
    def ask(self, n: int = 1) -> Array:
        """Return the next points, shape ``(n, d)``; they are pending until told."""

    @abstractmethod
    def tell(self, points: ArrayLike, values: ArrayLike) -> None:
        """Learn the values ``(n,)`` at points ``(n, d)``; NaN for an evaluation that is pending or has failed."""

    @property
    def uses_prediction(self) -> bool:
        """Whether a prediction is made before each question: it is costly, and only who takes it needs it.

        By default, whether the subclass has its own :meth:`use_prediction`.
        """
        return type(self).use_prediction is not BaseSearch.use_prediction

    def use_prediction(self, prediction: Prediction | None) -> None:  # noqa: B027
        """Take what is expected of values before the next question; None if nothing is."""

    def note(self) -> Note | None:
        """Return what it thought when it chose the point asked for last, plain enough for JSON; None if nothing."""
        return None

    def remember(self, notes: Sequence[Note | None]) -> None:  # noqa: B027
        """Take back the note of each point of a history that was told, in their order."""

    def estimate(self, points: Array, values: Array) -> float | None:
        """Return the estimate of the maximum from known values, without the ``discard`` largest ones.

        Args:
            points: of the unit cube, shape ``(n, d)``.
            values: shape ``(n,)``, finite.

        Returns:
            None if there are too few values.
        """
        ordered = np.sort(values)[::-1]
        return float(ordered[self.discard]) if len(ordered) > self.discard else None

    def surrogate(self) -> Surrogate | None:
        """Return the Gaussian process of the values that it searches by; None if it has none of its own.

        Raises:
            InputError: too few values are known.
        """
        return None


class _WithDefaults(BaseSearch):
    """A search of another class, of which only the three methods of the protocol are used."""

    def __init__(self, search: Search) -> None:
        self._search = search

    def reset(self, dimension: int, seed: int) -> None:
        self._search.reset(dimension, seed)

    def ask(self, n: int = 1) -> Array:
        return self._search.ask(n)

    def tell(self, points: ArrayLike, values: ArrayLike) -> None:
        self._search.tell(points, values)


class SequentialSearch(BaseSearch):
    """A search that proposes one point at a time from the history of all points."""

    def reset(self, dimension: int, seed: int) -> None:
        """Forget everything and start on the unit cube of this dimension."""
        if dimension < 1:
            raise InputError(f"a search needs at least one dimension, got {dimension}.")
        self._dimension, self._seed = dimension, seed
        self._points: list[Array] = []
        self._values: list[float] = []
        self._notes: list[Note | None] = []
        self._slots: dict[bytes, list[int]] = {}
        self._thought: Note | None = None

    def ask(self, n: int = 1) -> Array:
        """Return the next points, shape ``(n, d)``; they are pending until told."""
        self._require_reset()
        if n < 1:
            raise InputError(f"a search is asked for at least one point, got n = {n}.")
        proposals = []
        for _ in range(n):
            rng = np.random.default_rng(np.random.SeedSequence([self._seed, len(self._points)]))
            self._thought = None
            proposals.append(self.propose(rng))
            self._append(proposals[-1], np.nan, self._thought)
        return np.array(proposals)

    def tell(self, points: ArrayLike, values: ArrayLike) -> None:
        """Learn the values ``(n,)`` at points ``(n, d)``; NaN for an evaluation that is pending or has failed.

        Raises:
            ShapeError: points and values do not fit together or the dimension.
            InputError: a point is outside the unit cube, or the search was never reset.
        """
        self._require_reset()
        rows, scalars = as_floats("points", points), as_floats("values", values)
        if rows.ndim != 2 or rows.shape[1] != self._dimension or scalars.shape != (len(rows),):
            raise ShapeError(
                f"tell needs points (n, {self._dimension}) and values (n,), got {rows.shape} and {scalars.shape}."
            )
        if not ((rows >= 0) & (rows <= 1)).all():
            raise InputError(f"a search is told points of the unit cube, got {rows.tolist()}.")
        for point, value in zip(rows, scalars.tolist(), strict=True):
            slot = self._waiting_slot(point)
            if slot is None:
                self._append(point, value, None)
            else:
                self._values[slot] = value

    def note(self) -> Note | None:
        """Return what it thought when it chose the point asked for last; None if nothing worth keeping."""
        self._require_reset()
        return self._thought

    def remember(self, notes: Sequence[Note | None]) -> None:
        """Take back the note of each point told so far, in their order.

        Raises:
            ShapeError: there are not as many notes as points.
        """
        self._require_reset()
        if len(notes) != len(self._points):
            raise ShapeError(f"there must be one note for each of {len(self._points)} points, got {len(notes)}.")
        self._notes = list(notes)

    def _append(self, point: Array, value: float, note: Note | None) -> None:
        self._slots.setdefault(_key(point), []).append(len(self._points))
        self._points.append(point)
        self._values.append(value)
        self._notes.append(note)

    def _require_reset(self) -> None:
        if not hasattr(self, "_points"):
            raise InputError("reset(dimension, seed) must come before ask and tell.")

    def _waiting_slot(self, point: Array) -> int | None:
        return next((slot for slot in self._slots.get(_key(point), []) if np.isnan(self._values[slot])), None)

    @abstractmethod
    def propose(self, rng: np.random.Generator) -> Array:
        """Return the next point ``(d,)``, given ``self.points``, ``self.values`` and this point's own randomness."""

    @property
    def dimension(self) -> int:
        """The dimension d of the unit cube."""
        return self._dimension

    @property
    def points(self) -> Array:
        """All points asked for or told, shape ``(n, d)``."""
        return np.array(self._points).reshape(-1, self._dimension)

    @property
    def values(self) -> Array:
        """Their values, shape ``(n,)``; NaN where pending or failed."""
        return np.array(self._values)

    @property
    def notes(self) -> tuple[Note | None, ...]:
        """What was thought when each was chosen; None if nothing was, or if the point was told by hand."""
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
    """Return what equal points have in common."""
    return (point + 0.0).tobytes()  # minus zero is zero
