"""Dry friction that M lacks: what holds a joint until an input overcomes it, found in executions.

Its force changes by a jump where a joint stops or turns, so it is no smooth function of state and input, and few
recorded runs do not teach it to a Gaussian process. Here it is a part of the inputs, as in the time stepping of Moreau
(1988): the inputs ``u - f`` act, with ``|f_j| <= c_j``, where f_j brings the rate that input j drives to rest if it
can, and opposes it as strongly as it can otherwise. The limit c_j may grow with the input, as that of a gear does, and
may be larger at low rates (Stribeck 1902). What M misses is a smooth function of the state and the inputs
that act. It is learned of steps in which all these rates move, because f is known there.

What holds a joint at rest may be larger than what any motion shows, as that of seals and guides. Steps at rest bound
it in each direction: it is at least the largest force that a joint withstood, and less than the smallest one that set
it in motion.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar, Self

import numpy as np
import scipy

from ctxval._util.arrays import Array, ArrayLike, Mask, Rows
from ctxval.core.model import Model
from ctxval.core.trajectory import Transitions
from ctxval.gp.cholesky import CholeskyFactor
from ctxval.learning.effects.effect import Effect
from ctxval.learning.effects.friction import slowness
from ctxval.learning.settling import SettlingModel
from ctxval.models.increments import standard_deviations


@dataclass(frozen=True)
class FrictionSettings:
    """When friction explains what M misses, and how exactly its force is computed.

    Shares of rates are those of their root mean squares.
    """

    explained: float = 0.7  # share of the squared residuals, beside a linear function, that must be left at most
    explained_beside: float = 0.5  # the same, beside a Gaussian process
    better_shape: float = 0.5  # the same, if friction has one more shape
    per_coefficient: int = 5  # fewest recorded steps for each coefficient of the linear function
    most: int = 400  # recorded steps beside a Gaussian process
    varied: float = 0.1  # least share of the squares of inputs that no linear function of the state has
    at_rest: float = 0.05  # share of a rate below which the joint is at rest
    held: float = 0.2  # share of at_rest below which a joint is held; one that stops is faster
    fast: float = 0.25  # share of a rate from which on friction is not larger than at high rates
    errors: float = (
        3.0  # median errors of forces by which the bounds of what holds a joint are apart from what was seen
    )
    withstood: float = 0.05  # share of a force up to which it counts as withstood
    rounds: int = 2  # the residual is evaluated at forces that follow from it
    sweeps: int = 4  # each time, of the inputs, whose frictions act on each other's rates
    slips: int = 3  # times that the friction of a joint that slips follows from its rate
    integral: float = 0.99  # least correlation of a rate with the changes of its integral
    newton_steps: int = 4  # steps to the forces that recorded steps had


@dataclass(frozen=True, eq=False)
class Pushes:
    """What acts on m joints in N steps, and what they do; arrays have the shape ``(N, m)``."""

    force: Array  # what friction must withstand to hold a joint, without its part that grows with the input
    up: Mask  # whether it pushes above 0
    held: Mask  # whether the joint stays at rest
    started: Mask  # whether it leaves rest
    turned: Mask  # whether it turns, and moves before and afterwards
    errors: Array  # the usual errors of these forces (m,)


@dataclass(frozen=True, eq=False)
class AtRest:
    """What steps tell of the friction that holds joints, against pushes below and above 0 ``(2, m)``."""

    least: Array
    largest: Array
    uneven: Array  # ratios of a force that was withstood to one that moved the joint; 1 if it may be even everywhere
    pushes: Pushes  # of these steps
    missed: Callable[[Array, Array], Array]  # what M misses at states and acting inputs


@dataclass(frozen=True, eq=False)
class DryFriction(Effect, SettlingModel):
    """Dry friction at the m inputs, in their units; it is also M with this friction.

    Sizes: for each input the largest friction if its joint moves fast and no input acts, by how much it grows with a
    unit of the input, by how much it is larger at rest, and the rate at which this excess has fallen to 37 %.
    """

    name: ClassVar[str] = "dry friction"
    sliding: Array = field(init=False, repr=False)
    load: Array = field(init=False, repr=False)
    excess: Array = field(init=False, repr=False)
    slow: Array = field(init=False, repr=False)
    given: Model
    rates: Rows  # the state that each input drives (m,)
    signs: Array  # -1 if an input drives its joint backwards, or 1 (m,)
    creep: Array  # the rate at which a held joint creeps under a unit of its input (m,)
    change: Array  # by which inputs are changed to see what they do (m,)
    still: Array  # the largest rate of a joint at rest (m,)
    rest: Array  # the largest friction at rest against pushes below and above 0 (2, m), or of draws (S, 1, 2, m)
    passed: Array  # the largest friction that holds a joint as it turns (m,)
    settings: FrictionSettings = FrictionSettings()
    beside: bool = False  # whether it was found beside a Gaussian process, and not a linear function
    told: AtRest | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        each_input = np.array(self.sizes, dtype=np.float64).reshape(-1, 4).T
        for name, values in zip(("sliding", "load", "excess", "slow"), each_input, strict=True):
            object.__setattr__(self, name, values)  # (m,)

    def model(self, model: Model) -> Model:
        return replace(self, given=model)

    def __getitem__(self, rows: ArrayLike) -> Self:
        """Return the frictions of some draws."""
        return replace(self, rest=self.rest[np.asarray(rows)])

    def following(self, x: Array, u: Array, missed: Callable[[Array], Array]) -> Array:
        reached, effects = _reached(self.given, x, u, self.change)
        force, residuals = np.zeros_like(u), np.zeros_like(reached)
        for _ in range(self.settings.rounds):  # what is missed depends on the force, which it changes little
            force = self._force(x, u, reached + residuals, effects, force)
            residuals = missed(u - force)
        force = self._force(x, u, reached + residuals, effects, force)
        following = self.geometry.corrected(reached, residuals, x)
        return np.asarray(following - (effects * force[..., None, :]).sum(axis=-1))

    def _force(self, x: Array, u: Array, reached: Array, effects: Array, force: Array) -> Array:
        """Return the friction ``(..., m)`` that holds joints, but for their creep, if it can, from a first guess."""
        m, of_rates, force = len(self.rates), effects[..., self.rates, :], force.copy()
        before = x[..., self.rates]
        with np.errstate(all="ignore"):  # states of draws that diverge
            at_first = self._limits(u, before, before)
            for j in [*range(m)] * (self.settings.sweeps if m > 1 else 1):  # projected Gauss-Seidel
                own, limit = of_rates[..., j, j], at_first[..., j]
                rate = reached[..., self.rates[j]] - (of_rates[..., j, :] * force).sum(axis=-1)
                free = rate + own * force[..., j]
                stopping = np.nan_to_num(free / (own + np.sign(own) * self.creep[j]))
                if self.excess[j]:
                    slips, after = np.abs(stopping) > limit, before.copy()
                    for _ in range(self.settings.slips):
                        after[..., j] = free - own * np.clip(stopping, -limit, limit)
                        limit = np.where(slips, self._limits(u, before, after)[..., j], limit)
                # A joint at rest, or one that turns, is held if friction withstands what acts on it then.
                rests = np.abs(before[..., j]) <= self.still[j]
                turns = (free - own * np.clip(stopping, -limit, limit)) * before[..., j] <= 0
                push = np.nan_to_num((free - before[..., j]) / own)
                most = np.where(push > 0, self.rest[..., 1, j], self.rest[..., 0, j])
                most = np.where(rests, most, np.minimum(most, self.passed[j]))
                held = (rests | turns) & (np.abs(push) - self.load[j] * np.abs(u[..., j]) <= most)
                force[..., j] = np.where(held, stopping, np.clip(stopping, -limit, limit))
        return force

    def _limits(self, u: Array, before: Array, after: Array) -> Array:
        """Return the largest friction in steps with these inputs and between these rates; shapes ``(..., m)``."""
        largest = self.sliding + self.load * np.abs(u)
        return largest + self.excess * slowness(before, after, self.slow) if self.excess.any() else largest

    def pushes(
        self, transitions: Transitions, missed: Callable[[Array, Array], Array], errors: Array | None = None
    ) -> Pushes:
        """Return what acts on joints in transitions if M misses ``missed(states, acting inputs)``.

        The errors of these forces ``(m,)`` follow from steps in which all joints move, if they are not given.
        """
        x, u, m = transitions.x, transitions.u, len(self.rates)
        before, after = x[:, self.rates], transitions.x_next[:, self.rates]
        reached, effects = _reached(self.given, x, u, self.change)
        of_rates, force = effects[:, self.rates, :], np.zeros_like(u)
        inverse = np.linalg.pinv(of_rates)

        def rates_with(forces: Array) -> Array:
            free = (reached + missed(x, u - forces))[:, self.rates]
            return np.asarray(free - (of_rates * forces[:, None]).sum(axis=2))

        for _ in range(self.settings.newton_steps):  # the frictions that these steps had
            force += (inverse * (rates_with(force) - after)[:, None]).sum(axis=2)
        if errors is None:
            moves = _directions(transitions, self.rates, self.settings) * self.signs
            wrong = np.abs(force - self._limits(u, before, after) * moves)[(moves != 0).all(axis=1)]
            errors = self.settings.errors * np.median(wrong, axis=0)
        holding = np.repeat(force[None], m, axis=0)  # what would have kept each joint at its rate
        for j in range(m):
            holding[j, :, j] += (after - before)[:, j] / of_rates[:, j, j]
            for _ in range(self.settings.newton_steps):
                holding[j, :, j] += (rates_with(holding[j]) - before)[:, j] / of_rates[:, j, j]
        held = np.stack([holding[j, :, j] for j in range(m)], axis=1)
        withstood, own = np.abs(held) - self.load * np.abs(u), np.abs(np.diagonal(of_rates, axis1=1, axis2=2))
        # A held joint creeps, and rates below what little of the force changes cannot be told apart.
        little, creeping = np.maximum(errors, self.settings.withstood * withstood) * own, self.creep * withstood
        slow, first, last = np.maximum(little, 2 * creeping), np.abs(before), np.abs(after)
        return Pushes(
            withstood,
            up=held > 0,
            held=np.maximum(first, last) <= np.maximum(little, creeping),
            started=(first <= slow) & (last > np.maximum(2 * little, slow)),
            turned=(before * after < 0) & (np.minimum(first, last) > slow),
            errors=errors,
        )

    def told_by(self, steps: Transitions, missed: Callable[[Array, Array], Array]) -> Self:
        """Return the same with the least and the largest friction at rest, and that of turning joints, in some steps.

        Friction that depends on the place or on the time at rest holds at one force and not at a smaller one: then only
        larger forces that set a joint in motion count for the largest one.
        """
        m, pushes = len(self.rates), self.pushes(steps, missed)
        least, largest = np.stack([self.sliding] * 2), np.stack([np.abs(steps.u).max(axis=0)] * 2)
        passed, uneven = np.full(m, np.inf), np.ones((2, m))
        for j in range(m):
            withstood, usual = pushes.force[:, j], pushes.errors[j]
            for i, pushed in enumerate((~pushes.up[:, j], pushes.up[:, j])):
                most = float(withstood[pushed & pushes.held[:, j]].max(initial=0.0))
                least[i, j] = max(self.sliding[j], most - usual)
                started = pushed & pushes.started[:, j]
                moved = withstood[started & (withstood > most)].min(initial=largest[i, j])
                largest[i, j] = max(least[i, j], moved + usual)
                smallest = withstood[started].min(initial=most) + 2 * usual
                uneven[i, j] = max(1.0, most / smallest if smallest > 0 else 1.0)
            passed[j] = withstood[pushes.turned[:, j]].min(initial=np.inf) + usual
        return replace(self, passed=passed, told=AtRest(least, largest, uneven, pushes, missed))

    def between(self, shares: ArrayLike) -> Self:
        """Return the same with friction at rest between its bounds, of which nothing else is known."""
        assert self.told is not None
        least, largest = self.told.least, self.told.largest
        rest = least + np.asarray(shares)[..., None, None] * (largest - least)
        return replace(self, rest=rest[:, None] if np.ndim(shares) else rest)

    def coordinates(self, transitions: Transitions) -> list[int | None]:
        """Return the state that is the integral of each rate; None if no state is."""
        x, changes = transitions.x, transitions.x_next - transitions.x
        found = list[int | None]()
        for rate in self.rates.tolist():
            mean = x[:, rate] + 0.5 * changes[:, rate]
            products = (changes * mean[:, None]).sum(axis=0)
            like = np.abs(products) / np.maximum(np.linalg.norm(changes, axis=0) * np.linalg.norm(mean), 1e-300)
            like[self.rates] = 0.0
            found.append(int(like.argmax()) if like.max() > self.settings.integral else None)
        return found

    def teaching(self, transitions: Transitions) -> tuple[Transitions, Mask]:
        """Return transitions with the inputs that act, and in which friction is known: all joints move."""
        directions = _directions(transitions, self.rates, self.settings) * self.signs
        limits = self._limits(transitions.u, transitions.x[:, self.rates], transitions.x_next[:, self.rates])
        acting = transitions.u - limits * directions
        return replace(transitions, u=acting), (directions != 0).all(axis=1)


def found_friction(
    model: Model,
    transitions: Transitions,
    settings: FrictionSettings = FrictionSettings(),
    prior: Callable[[Array, Array], CholeskyFactor] | None = None,
) -> DryFriction | None:
    """Return M with the friction that explains transitions best; None if friction does not explain much of them.

    It is estimated beside a linear function of state and input and drag, because M may be wrong in other ways, too; or
    beside a Gaussian process whose ``prior`` at states and inputs ``(N, N)`` is given.
    """
    x, u = transitions.x, transitions.u
    ranges = np.abs(u).max(axis=0, initial=0.0)
    if not len(ranges) or not (ranges > 0).all():
        return None
    reached, effects = _reached(model, x, u, 1e-3 * ranges)
    strength = np.sqrt((effects**2).mean(axis=0)) / standard_deviations(transitions.x_next - x)[:, None]
    rates = strength.argmax(axis=0)
    signs = np.where(effects.mean(axis=0)[rates, np.arange(len(rates))] < 0, -1.0, 1.0)
    directions = _directions(transitions, rates, settings) * signs
    moving = np.flatnonzero((directions != 0).all(axis=1))
    if prior is not None:
        moving = moving[:: -(-len(moving) // settings.most) or 1]
    usual = np.sqrt((transitions.x_next[:, rates] ** 2).mean(axis=0))
    fast = x[:, rates] / np.maximum(usual, 1e-300)
    plain = [np.ones(len(x)), x / standard_deviations(x)]
    features = np.column_stack([*plain, fast * np.abs(fast), u / ranges])[moving]
    if len(set(rates.tolist())) < len(rates) or len(features) < settings.per_coefficient * features.shape[1]:
        return None
    residuals, of_rates = (transitions.x_next - reached)[moving][:, rates], effects[moving][:, rates]
    sizes = np.sqrt((residuals**2).mean(axis=0))
    if not (np.isfinite(of_rates).all() and np.isfinite(sizes).all() and (sizes > 0).all()):
        return None
    m, inputs = len(rates), features[:, -len(rates) :]
    before, after = x[moving][:, rates], transitions.x_next[moving][:, rates]
    linear, by_state = np.linalg.qr(features)[0], np.linalg.qr(features[:, :-m])[0]
    # Under feedback with fixed gains, what inputs change cannot be told from what states do.
    known = ((_beside(by_state, inputs) ** 2).sum(axis=0) > settings.varied * (inputs**2).sum(axis=0)).all()
    factor = None if prior is None else prior(x[moving], u[moving])

    def beside(values: Array) -> Array:
        if factor is None:
            return _beside(linear, values)
        return factor.whiten(values.reshape(len(values), -1)).reshape(values.shape)

    left = beside(residuals / sizes)

    def fitted(shapes: Sequence[Array]) -> tuple[float, Array]:
        """Return what is left if friction has some shapes ``(N, m)``, and the sizes of each at each input."""

        def by(acting: Array) -> tuple[Array, Array, float]:
            """Return forces, their sizes and what is left, if inputs change rates by ``acting`` ``(N, m, m)``."""
            forces = np.concatenate([-acting * shape[:, None, :] for shape in shapes], axis=2)
            largest, norm = scipy.optimize.nnls(
                beside(forces / sizes[:, None]).reshape(-1, forces.shape[2]), left.ravel()
            )
            return forces, largest, float(norm)

        forces, largest, left_over = by(of_rates)
        for _ in range(2 if known else 0):
            # The linear function is one of the inputs that act, so it changes what friction does, by half at most.
            slopes = (np.linalg.lstsq(features, residuals - forces @ largest)[0][-m:] / ranges[:, None]).T
            most = 0.5 * np.abs(of_rates).mean(axis=0)
            forces, largest, left_over = by(of_rates + np.clip(slopes, -most, most))
        return left_over, largest.reshape(len(shapes), m)

    moves = directions[moving]
    left_over, largest = fitted([moves])
    if not left_over**2 < (settings.explained if factor is None else settings.explained_beside) * (left**2).sum():
        return None
    shapes = [moves, moves * np.abs(u[moving])]
    loaded, by_load = fitted(shapes)
    if grows := loaded**2 < settings.better_shape * left_over**2:
        left_over, largest = loaded, by_load
    shapes = shapes if grows else [moves]
    slow_rates = np.geomspace(settings.at_rest, settings.fast, 11).tolist()
    slowed = {slow: fitted([*shapes, moves * slowness(before, after, slow * usual)]) for slow in slow_rates}
    slow = min(slowed, key=lambda each: slowed[each][0])
    if falls := slowed[slow][0] ** 2 < settings.better_shape * left_over**2:
        largest = slowed[slow][1]
    load, excess = largest[1] if grows else np.zeros(m), largest[-1] if falls else np.zeros(m)
    still = settings.held * settings.at_rest * usual
    each_input = np.stack([largest[0], load, excess, slow * usual], axis=1)
    return DryFriction(
        tuple(each_input.ravel().tolist()),
        model,
        rates,
        signs,
        _creep(transitions, reached, effects, rates, still),
        1e-3 * ranges,
        still,
        rest=np.stack([largest[0] + excess] * 2),
        passed=np.full(m, np.inf),
        settings=settings,
        beside=factor is not None,
    )


def _beside(basis: Array, values: Array) -> Array:
    """Return what is left of values ``(N, ...)`` beside the columns of an orthonormal basis ``(N, k)``."""
    flat = values.reshape(len(values), -1)
    return (flat - basis @ (basis.T @ flat)).reshape(values.shape)


def _creep(transitions: Transitions, reached: Array, effects: Array, rates: Rows, still: Array) -> Array:
    """Return the rates of joints that stay at rest per unit of what holds them ``(m,)``, by least squares."""
    before, after = transitions.x[:, rates], transitions.x_next[:, rates]
    held = (np.abs(before) <= still) & (np.abs(after) <= still)
    force = (np.linalg.pinv(effects[:, rates]) @ (reached[:, rates] - after)[:, :, None])[:, :, 0]
    squares = np.where(held, force**2, 0.0).sum(axis=0)
    return np.asarray(np.maximum(np.where(held, force * after, 0.0).sum(axis=0) / np.maximum(squares, 1e-300), 0.0))


def _directions(transitions: Transitions, rates: Rows, settings: FrictionSettings) -> Array:
    """Return in which directions rates move ``(N, m)``, 1 or -1; 0 if a joint is nearly at rest, or turns."""
    before, after = transitions.x[:, rates], transitions.x_next[:, rates]
    still = settings.at_rest * np.sqrt((after**2).mean(axis=0))
    moves = (np.minimum(np.abs(before), np.abs(after)) > still) & (before * after > 0)
    return np.where(moves, np.sign(after), 0.0)


def _reached(model: Model, x: Array, u: Array, change: Array) -> tuple[Array, Array]:
    """Return the next states ``(..., n)`` of M, and what a unit of each input changes in them ``(..., n, m)``."""
    m = u.shape[-1]
    changes = np.concatenate([np.zeros((1, m)), np.diag(change)]).reshape(m + 1, *[1] * (u.ndim - 1), m)
    inputs = u + changes
    each = model.step(np.array(np.broadcast_to(x, (*inputs.shape[:-1], x.shape[-1]))), inputs)
    return each[0], np.moveaxis(each[1:] - each[0], 0, -1) / change
