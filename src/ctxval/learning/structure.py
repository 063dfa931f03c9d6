"""The structure of the dynamics beside a smooth residual: which parts explain what M misses.

A part is a set of effects of inputs, dry friction, the data that M was made from (which may belong to another system),
or a task parameter that changes the dynamics. One greedy search adds parts by one criterion: the errors of the next
states of each execution when it is predicted from the others. A structure is the :class:`DynamicsStudy` that learns
with its parts.
"""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from ctxval._util.arrays import Mask, Rows, single_threaded
from ctxval.errors import InputError
from ctxval.learning.effects.dry_friction import DryFriction, FrictionSettings, found_friction
from ctxval.learning.effects.effect import EffectCandidate
from ctxval.learning.effects.inputs import InputEffects
from ctxval.learning.extended import ExtendedValidation
from ctxval.learning.histories import Record
from ctxval.learning.input_effects import Found, InputEffectSettings, found_effects
from ctxval.learning.learned_dynamics import LearnedDynamics
from ctxval.learning.prediction import Executed
from ctxval.learning.recorded import digest, schedule
from ctxval.learning.settling import SettlingModel
from ctxval.learning.stage_costs import Costs, Ledger
from ctxval.models.corrected import before_refinement

if TYPE_CHECKING:
    from ctxval.learning.dynamics_study import DynamicsStudy


@dataclass(frozen=True)
class PartLimits:
    """When a part is looked for, and how much of the left-out errors it must explain; errors are shares of M's."""

    after: int  # executions from which on it is looked for
    error: float  # left-out error above which it is
    share: float  # of this error that it must leave at most
    most: float = np.inf  # left-out error that it must leave at most


@dataclass(frozen=True)
class StructureSettings:
    """When parts are looked for, and how much of the left-out errors each must explain.

    Errors are shares of those of M.
    """

    inputs: PartLimits = PartLimits(3, 0.02, 0.95)  # the evidence decides
    friction: PartLimits = PartLimits(4, 0.1, 0.5)
    data: PartLimits = PartLimits(3, 0.1, 1 / 3, 0.1)
    parameter: PartLimits = PartLimits(6, 0.1, 1 / 3, 0.1)
    enough: float = 0.02  # left-out error below which no further part is compared
    kept: float = 2.0  # share of parts found before: single steps tell less of dry friction than loops do
    noise: float = 0.75  # largest share of the squares of errors that counts as noise
    estimated_from: int = 5  # latest executions, if states are estimated: it costs as much as hundreds of steps
    dry_friction: FrictionSettings = field(default_factory=FrictionSettings)
    input_effects: InputEffectSettings = field(default_factory=InputEffectSettings)


@dataclass(frozen=True)
class Part:
    """A part that dynamics may have."""

    name: str  # as the budget of thinking names it
    limits: PartLimits
    seconds: Callable[[Costs], float]
    add: Callable[[DynamicsStudy, Executed], DynamicsStudy | None]  # a study with it; None if it explains nothing
    has: Callable[[DynamicsStudy], bool]
    last: bool = False  # whether it is tried only if no other one explains enough


class StructureSearch:
    """Finds the structures of growing sets of executions; each is a function of these."""

    def __init__(self, plain: DynamicsStudy, settings: StructureSettings) -> None:
        self.plain, self.settings = plain, settings
        self._known: dict[bytes, DynamicsStudy] = {}
        names, single = len(plain.given.space.units) + 1, settings.input_effects.single
        friction = [
            Part(
                "dry friction", settings.friction, Costs.friction,
                functools.partial(self.with_friction, beside=beside), lambda study: bool(study.within_steps), beside,
            )
            for beside in (False, True)
        ]  # fmt: skip
        self.parts = [
            Part(
                "inputs that act late", settings.inputs, lambda costs: costs.input_effects(single),
                self.with_inputs, lambda study: bool(study.of_inputs),
            ),
            *([] if plain.given.outputs.hide_states else friction),
            Part("the data of M", settings.data, Costs.learning, _without_data, lambda study: not study.with_data),
            Part(
                "parameters that change the dynamics", settings.parameter, lambda costs: names * costs.learning(),
                lambda study, executed: most_telling(study, executed)[0],
                lambda study: len(study.given.physical) > len(plain.given.physical),
            ),
        ]  # fmt: skip

    def best(self, executed: Executed, learned: LearnedDynamics, ledger: Ledger) -> LearnedDynamics:
        """Return what executions teach with the structure that they show, for what they teach without."""
        settings, count = self.settings, len(executed)
        asked = [
            part
            for part in self.parts
            if count < part.limits.after
            or not learned.left_out_error > part.limits.error
            or ledger.learns("learning", part.name, part.seconds)
        ]
        study, key_of_parts = self.plain, bytes(part in asked for part in self.parts)
        for some in (executed[:number] for number in schedule(min(part.limits.after for part in self.parts), count)):
            key = digest(trajectory for _, trajectory in some) + key_of_parts
            if key not in self._known:
                self._known[key] = study  # also if the search fails
                with contextlib.suppress(np.linalg.LinAlgError, InputError, ValueError):
                    is_all = study is self.plain and len(some) == count
                    self._known[key] = self._searched(some, study, asked, learned if is_all else None)
            study = self._known[key]
        found = None if study is self.plain else study.learned_alone(executed, ledger)
        return learned if found is None or not share_left(found, learned, settings) < settings.kept else found

    def _searched(
        self, executed: Executed, before: DynamicsStudy, asked: list[Part], known: LearnedDynamics | None
    ) -> DynamicsStudy:
        """Return the structure of executions, for that of fewer ones before; what it teaches may be known."""
        study = self._fitted_again(executed, before)
        learned = study.learned_alone(executed) if known is None and asked else known
        for _ in asked:
            best: tuple[float, LearnedDynamics] | None = None
            if learned is None:
                break
            for part in sorted(asked, key=lambda part: part.last):
                limits = part.limits
                if part.has(study) or len(executed) < limits.after or not learned.left_out_error > limits.error:
                    continue
                tried = None if part.last and best is not None else part.add(study, executed)
                found = None if tried is None else tried.learned_alone(executed)
                if found is None:
                    continue
                left = share_left(found, learned, self.settings)
                if left < limits.share and found.left_out_error < limits.most and (best is None or left < best[0]):
                    best = left, found
                    if found.left_out_error < self.settings.enough:
                        break
            if best is None:
                break
            learned = best[1]
            study = learned.study
        return study

    def _fitted_again(self, executed: Executed, before: DynamicsStudy) -> DynamicsStudy:
        """Return a study with the parts of one before, with sizes for these executions."""
        if before is self.plain:
            return before
        study = self.plain.made(given=before.given, with_data=before.with_data)
        if before.of_inputs:
            with_friction = study.made(effects=before.within_steps)
            study = self.with_inputs(with_friction, executed, before.of_inputs) or study
        if before.within_steps and not study.within_steps:
            study = self._with_friction_again(study, executed, before.within_steps)
        return study

    # Parts

    def with_inputs(self, study: DynamicsStudy, executed: Executed, before: Found = ()) -> DynamicsStudy | None:
        """Return a study with the effects of inputs that executions show; those found before are the first guess."""
        given, estimated = study.given, study.given.outputs.hide_states
        among = executed[-self.settings.estimated_from :] if estimated else executed
        commanded = [trajectory.inputs for _, trajectory in among]
        alike = len({u.shape for u in commanded}) == 1

        def with_inputs(effects: InputEffects) -> list[Record]:
            acting = effects.acting(np.stack(commanded)) if alike else map(effects.acting, commanded)
            return [Record(record.states, u, record.start) for record, u in zip(plain, acting, strict=True)]

        def estimated_with(effects: InputEffects) -> list[Record]:
            extended = ExtendedValidation(given, effects)
            known = extended.executions(among, len(among))
            if known is None:
                raise np.linalg.LinAlgError
            return extended.records(known)

        # If states are recorded, they are the same with all effects.
        plain = [] if estimated else estimated_with(InputEffects())
        # If states have to be estimated each time, or with many inputs, single ones cost too much.
        together = estimated or commanded[0].shape[-1] > self.settings.input_effects.single
        candidates = before  # what friction leaves in steps that teach imitates others
        if not (before and study.within_steps):
            candidates = study.input_candidates([trajectory for _, trajectory in among], together=together)
        with single_threaded(), np.errstate(all="ignore"):
            found = found_effects(
                study.model, estimated_with if estimated else with_inputs, candidates, before,
                estimated=estimated, settings=self.settings.input_effects,
            )  # fmt: skip
        if not found:
            return None
        late = study.made(effects=found)
        return self._with_friction_again(late, executed, study.within_steps) if study.within_steps else late

    def with_friction(self, study: DynamicsStudy, executed: Executed, beside: bool = False) -> DynamicsStudy | None:
        """Return a study with the dry friction that executions show, which may be hidden beside what M misses."""
        found = self._friction(study, executed, beside)
        study = study.made(effects=(*study.of_inputs, *found))
        # Effects of inputs that were found without friction have sizes that make up for it.
        late = self.with_inputs(study, executed, study.of_inputs) if found and study.of_inputs else None
        return late or (study if found else None)

    def _with_friction_again(self, study: DynamicsStudy, executed: Executed, before: Found) -> DynamicsStudy:
        """Return a study with dry friction as it was found before, with sizes for these executions."""
        known = any(isinstance(each.effect, DryFriction) and each.effect.beside for each in before)
        ways = (self._friction(study, executed, beside) for beside in (known, True))
        return study.made(effects=(*study.effects, *next(filter(None, ways), before)))

    def _friction(self, study: DynamicsStudy, executed: Executed, beside: bool) -> Found:
        extended, model = study.extended.executions(executed), before_refinement(study.validation.model)
        recorded = study.transitions_of(extended, with_data=False) if extended else None
        learned = study.made(effects=study.of_inputs).learned_alone(executed) if beside else None
        if recorded is None or (beside and learned is None):
            return ()
        prior = None if learned is None else learned.posterior.prior
        # Least squares may fail, and so may the factor of a covariance.
        with single_threaded(), np.errstate(all="ignore"), contextlib.suppress(RuntimeError, InputError):
            friction = found_friction(model, recorded[0], self.settings.dry_friction, prior)
            return () if friction is None else (EffectCandidate(friction),)
        return ()


def _without_data(study: DynamicsStudy, executed: Executed) -> DynamicsStudy | None:
    return study.made(with_data=False) if study.has_data and not study.of_inputs else None


def most_telling(study: DynamicsStudy, executed: Executed) -> tuple[DynamicsStudy | None, float, float]:
    """Return the study with the task parameter with which predictions err least, and left-out errors with and without.

    The data that M was made from tell no parameters.
    """
    without = study.made(with_data=False)
    best, least = None, np.inf
    for name in study.given.space.units:
        if name not in study.given.physical:
            other = without.made(given=study.given.with_parts(physical=[*study.given.physical, name]))
            learned = other.learned_alone(executed)
            if learned is not None and learned.left_out_error < least:
                best, least = other, learned.left_out_error
    learned = without.learned_alone(executed)
    return best, least, 0.0 if learned is None else learned.left_out_error


def share_left(found: LearnedDynamics, without: LearnedDynamics, settings: StructureSettings) -> float:
    """Return the left-out error with more parts as a share of that without; infinity if one is not known.

    What the Gaussian processes take for noise is no part of them. Of dry friction, only the rates that it slows count:
    where a joint stops within a step changes its position a little, which nothing predicts.
    """
    model, n = found.study.model, len(without.error_units)
    states: Rows | Mask = without.posterior.data.learned
    if isinstance(model, SettlingModel) and not isinstance(without.study.model, SettlingModel):
        states = model.rates
    units = without.error_units
    noise = float(((found.posterior.deviations[:n] / units)[states] ** 2).sum())
    squares, squares_without = (
        float(((each.left_out_errors * each.error_units)[:n][states] ** 2 / units[states] ** 2).sum())
        for each in (found, without)
    )
    noise = min(noise, settings.noise * min(squares, squares_without))
    left = np.sqrt((squares - noise) / max(squares_without - noise, 1e-300))
    return float(left) if np.isfinite(left) else np.inf
