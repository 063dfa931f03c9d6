"""Effects of inputs that no smooth residual has, found in executions: delay, lag, backlash, dead zone and others.

With them, what S does in a step is no smooth function of the state and the command. It is one of the state and the
input that acts, which follows from the recorded commands. Of all effects of the dictionary, those are found with which
the residual of M is most probably such a function: a greedy search by the evidence of the Gaussian process of the
residual, with steps back.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from ctxval._util.arrays import Array, Mask, Rows
from ctxval.core.model import Model
from ctxval.core.state_geometry import geometry_of
from ctxval.core.trajectory import Transitions
from ctxval.learning.effects.dictionary import kinds
from ctxval.learning.effects.effect import EffectCandidate, Observed, OfInput, all_sized, with_one_more
from ctxval.learning.effects.inputs import InputEffects
from ctxval.learning.effects.plant import Plant
from ctxval.learning.effects.transport import Delay, Late
from ctxval.learning.histories import Record
from ctxval.learning.hyperparameters import FAMILIES, HyperparameterPosterior, Mode, learning_rows, log_posterior
from ctxval.learning.residual_data import floors
from ctxval.learning.settling import SettlingModel
from ctxval.models.increments import standard_deviations


@dataclass(frozen=True)
class InputEffectSettings:
    """How clearly effects of inputs must explain the residual, and how many are tried."""

    better: float = 0.3  # by which each effect must raise the log evidence per recorded value
    close: float = 0.1  # by which it may lower it before its sizes are refined
    most: int = 2  # effects
    single: int = 4  # inputs up to which effects of single ones are tried: each has about 20 first guesses
    smooth: float = 20.0  # length-scale of inputs in their deviations, with which kinks are looked for first
    learned_from: int = 150  # transitions
    climbed: int = 4  # candidates whose hyperparameters are searched for
    evaluations: int = 80  # of the residual while sizes are refined, twice
    estimated: int = 30  # the same if states have to be estimated each time


Found = tuple[EffectCandidate, ...]
RecordsOf = Callable[[InputEffects], Sequence[Record]]
"""Returns executions with the inputs that act, and with states that are estimated with these if they must be."""


def input_candidates(
    model: Model, dt: float, inputs: Sequence[tuple[str, str]], commands: Array, seconds: float, *, together: bool
) -> Found:
    """Return the effects that inputs may have and no smooth residual has, for commands ``(N, m)`` and their names.

    Only those of all inputs ``together`` are returned if each costs too much.
    """
    plant = Plant(model, dt, [], list(inputs), (), (), np.empty(0), np.maximum(np.abs(commands).max(axis=0), 1e-9))
    observed = Observed(plant, np.empty((0, 0)), commands, np.empty(0), seconds, estimated=False)
    of_inputs = [kind for kind in kinds() if issubclass(kind, Late if together else (Late, OfInput))]
    every = [each for kind in of_inputs for each in kind.candidates(observed)]
    return tuple(each for each in every if (each.effect.remembers or each.effect.kinked) and not each.effect.in_parts)


def found_effects(
    model: Model,
    records_of: RecordsOf,
    candidates: Found,
    before: Found = (),
    *,
    estimated: bool = False,
    settings: InputEffectSettings = InputEffectSettings(),
) -> Found:
    """Return the effects of inputs with which the residual of M is most probably a function; none if they do not help.

    Each raises the log evidence per recorded value, with the hyperparameters at their mode, clearly. Those that were
    found ``before``, in fewer executions, are the first guess. A LinAlgError is raised if states cannot be estimated.
    """
    evaluations = settings.estimated if estimated else settings.evaluations
    search = _Search.of(model, records_of, candidates, evaluations, settings)
    if search is None:
        return ()
    best: Found = ()
    needed, mode = search.settings.better * search.values, search.mode(())
    if before:
        refined, of_refined = search.refined(before)
        if of_refined.height > mode.height + needed:
            best, mode = refined, of_refined
    while len(best) < settings.most:
        longer = search.longer(best, mode, needed)
        if longer is None:
            break
        best, mode = longer
        for each in best if len(best) > 1 else ():  # one may explain alone, or with another one, what two explain
            others = tuple(other for other in best if other is not each)
            shorter, of_shorter = search.refined(others)
            if of_shorter.height > mode.height - needed:
                best, mode = shorter, of_shorter
                break
            exchanged = search.longer(shorter, of_shorter, mode.height - of_shorter.height + 1.0)
            if exchanged is not None:
                best, mode = exchanged
                break
    return best


@dataclass(frozen=True, eq=False)
class _Search:
    """The evidence of effects of inputs."""

    model: Model
    records_of: RecordsOf
    candidates: Found
    rows: Rows  # of the transitions that hyperparameters are learned from
    live: Mask  # which states have a residual that is no rounding
    sizes: Array  # of the residuals if commands act at once, (n,)
    inputs: int
    evaluations: int
    settings: InputEffectSettings

    @classmethod
    def of(
        cls, model: Model, records_of: RecordsOf, candidates: Found, evaluations: int, settings: InputEffectSettings
    ) -> _Search | None:
        """Return the search; None if M misses nothing."""
        steps, teaches = _transitions(model, records_of(InputEffects()))
        steps, inputs = steps[teaches], steps.u.shape[1]
        Z, E = _missed(model, steps)
        sizes = np.sqrt((E**2).mean(axis=0))
        live = sizes > floors(steps.x_next, geometry_of(model).difference(steps.x_next, steps.x))
        if not live.any() or not np.isfinite(sizes).all():
            return None
        rows = teaches[learning_rows(_standardised(Z), inputs, settings.learned_from)]
        return cls(model, records_of, candidates, rows, live, sizes, inputs, evaluations, settings)

    @property
    def values(self) -> int:
        """The number of recorded values that are explained."""
        return len(self.rows) * int(self.live.sum())

    def data(self, effects: Found) -> tuple[Array, Array]:
        """Return states and acting inputs ``(N, n + m)``, and residuals over their sizes if commands act at once."""
        records = self.records_of(InputEffects(tuple(each.effect for each in effects)))
        Z, E = _missed(self.model, _transitions(self.model, records)[0][self.rows])
        if not np.isfinite(E).all():
            raise np.linalg.LinAlgError
        return Z, E[:, self.live] / self.sizes[self.live]

    def mode(self, effects: Found) -> Mode:
        """Return the most probable hyperparameters with effects."""
        Z, E = self.data(effects)
        return HyperparameterPosterior.given(_standardised(Z), E, self.inputs, FAMILIES[:1]).highest

    def longer(self, effects: Found, mode: Mode, needed: float) -> tuple[Found, Mode] | None:
        """Return effects with the one more that explains most, and their mode; None if it explains too little."""
        tried = [self._ordered(each) for each in with_one_more(effects, self.candidates, _starts)]
        if len(tried) > self.settings.climbed:  # those that explain most with the hyperparameters that are known
            of_tried = [self.data(each) for each in tried]
            heights = [log_posterior(mode.kernel, mode.place, _standardised(Z), E)[0] for Z, E in of_tried]
            tried = [tried[k] for k in sorted(range(len(tried)), key=lambda k: -heights[k])]
        climbed = [(self.mode(each), each) for each in tried[: self.settings.climbed]]
        if not climbed:
            return None
        highest, best = max(climbed, key=lambda pair: pair[0].height)
        if highest.height < mode.height - self.settings.close * self.values:
            return None
        best, highest = self.refined(best, highest)
        return (best, highest) if highest.height > mode.height + needed else None

    def _ordered(self, effects: Found) -> Found:
        """Return effects in the order of the dictionary, in which they act."""
        kinds_of = [each.effect.kind for each in self.candidates]
        return tuple(sorted(effects, key=lambda each: kinds_of.index(each.effect.kind)))

    def refined(self, effects: Found, mode: Mode | None = None) -> tuple[Found, Mode]:
        """Return effects with their most likely sizes, and their mode."""
        mode = self.mode(effects) if mode is None else mode
        if any(each.effect.kinked for each in effects):  # a residual that is rough in inputs imitates kinks elsewhere
            smooth = mode.place.copy()
            inputs = slice(len(smooth) - 3 - self.inputs, len(smooth) - 3)
            smooth[inputs] = np.maximum(smooth[inputs], np.log(self.settings.smooth))
            other = self._most_likely(effects, mode, smooth)
            of_other = self.mode(other)
            if of_other.height > mode.height:
                effects, mode = other, of_other
        for _ in range(2):  # the noise that wrong sizes seem to add is less the second time
            effects = self._most_likely(effects, mode, mode.place)
            mode = self.mode(effects)
        return effects, mode

    def _most_likely(self, effects: Found, mode: Mode, place: Array) -> Found:
        Z, _ = self.data(effects)
        shift, scale = Z.mean(axis=0), standard_deviations(Z)
        parameters = [parameter for each in effects for parameter in each.parameters]
        low, high, steps = (np.array([getattr(p, name) for p in parameters]) for name in ("low", "high", "scale"))

        def unlikely(values: Array) -> float:
            Z, E = self.data(all_sized(effects, np.clip(values[:-1], low, high).tolist()))
            return -log_posterior(mode.kernel, np.append(place[:-1], values[-1]), (Z - shift) / scale, E)[0]

        # The noise changes with the sizes: what wrong sizes leave is no smooth function.
        at = np.array([*(size for each in effects for size in each.effect.sizes), place[-1]])
        moves = np.append(np.where(at[:-1] + steps <= high, steps, -steps), -2.0)
        simplex = at + np.concatenate([np.zeros((1, len(at))), np.diag(moves)])
        options = {"initial_simplex": simplex, "maxfev": self.evaluations, "xatol": 1e-5, "fatol": 1e-3}
        best = scipy.optimize.minimize(unlikely, at, method="Nelder-Mead", options=options).x
        best[:-1] = np.clip(best[:-1], low, high)
        # Delays of whole steps are preferred as by the Bayesian information criterion.
        are_delays = [*(isinstance(each.effect, Delay) for each in effects for _ in each.parameters), False]
        whole = np.where(are_delays, np.round(best), best)
        near = [(best, 0.5 * np.log(len(self.rows)) * sum(are_delays)), (whole, 0.0)]
        likely, _ = min(near, key=lambda pair: unlikely(pair[0]) + pair[1])
        return all_sized(effects, likely[:-1].tolist())


def _transitions(model: Model, records: Sequence[Record]) -> tuple[Transitions, Rows]:
    """Return all steps with the inputs that act, and the rows of those that teach what M misses."""
    states, u = [each.states for each in records], np.concatenate([each.inputs for each in records])
    steps = Transitions(np.concatenate([x[:-1] for x in states]), u, np.concatenate([x[1:] for x in states]))
    if not isinstance(model, SettlingModel):
        return steps, np.arange(len(steps))
    steps, teaches = model.teaching(steps)
    return steps, np.flatnonzero(teaches)


def _missed(model: Model, steps: Transitions) -> tuple[Array, Array]:
    """Return states and inputs as regressors ``(N, k)``, and what M misses of the next states ``(N, n)``."""
    model, geometry = model.given if isinstance(model, SettlingModel) else model, geometry_of(model)
    missed = geometry.missed(steps.x_next, np.asarray(model.step(steps.x, steps.u)), steps.x)
    return np.concatenate([geometry.features(steps.x), steps.u], axis=1), missed


def _standardised(Z: Array) -> Array:
    return np.asarray((Z - Z.mean(axis=0)) / standard_deviations(Z))


def _starts(candidate: EffectCandidate) -> list[tuple[float, ...]]:
    """Return first guesses of sizes; without any but 0, a few steps of a fit to both sides."""
    if any(any(start) for start in candidate.starts):
        return list(candidate.starts)
    return [tuple(sign * 4 * parameter.scale for parameter in candidate.parameters) for sign in (-1, 1)]
