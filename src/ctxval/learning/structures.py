"""How much history the next record depends on: the structure of noisy dynamics, chosen by evidence."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ctxval._util.arrays import Array, Mask
from ctxval.core.model import Model
from ctxval.learning.dynamics_posterior import DynamicsPosterior
from ctxval.learning.histories import History, Record, Structure
from ctxval.learning.innovations import FilterFit, InnovationsFit, LaggedFit, fit_filter, fit_lagged

STRUCTURES = (
    Structure(0), Structure(1), Structure(2), Structure(3), Structure(0, 3.0), Structure(0, 30.0), Structure(2, 30.0)
)  # fmt: skip
EXACT = 1e-3  # share of noise below which records with lags determine the next one
NOISY = 0.01  # share of noise from which executions of one task differ
_BETTER, _GOOD = 0.1, 0.02  # share of the error without a history, and of the residual, that a history leaves
_UNEXPLAINED = 0.05  # share of the residual that nothing predicts if there is noise


@dataclass(frozen=True, eq=False)
class ChosenStructure:
    """A structure, learned from some executions, with the hyperparameters of the fit whose records are the state."""

    structure: Structure
    theta: Array


def fit_structures(
    model: Model, records: Sequence[Record], pairs: Array, live: Mask, chosen: ChosenStructure | None = None
) -> tuple[InnovationsFit, ChosenStructure]:
    """Return the posterior of the most probable structure, or of a structure that was chosen before.

    Fewer lags are preferred: the fewest that determine the next record, or else those with the largest evidence.
    Measurement noise is considered if no lags determine it.
    """

    def lagged(structure: Structure, theta: Array | None) -> LaggedFit:
        history = History(model, structure, np.eye(len(live)))
        return fit_lagged(history, records, pairs, theta, live)

    def filtered(structure: Structure, plain: InnovationsFit) -> FilterFit:
        middle = plain.scaled.shift[: len(live)], plain.scaled.shift[len(live) : pairs.shape[1]]
        scales = np.maximum(plain.noise, 1e-9 * plain.scaled.scale[: len(live)])
        return fit_filter(History.of(model, structure, scales, middle), records, pairs, plain)

    if chosen is not None:
        plain = lagged(Structure(0 if chosen.structure.ratio else chosen.structure.lags), chosen.theta)
        return (filtered(chosen.structure, plain) if chosen.structure.ratio else plain), chosen
    longest = max(1, len(records))
    fits: list[InnovationsFit] = [
        lagged(structure, None) for structure in STRUCTURES if not structure.ratio and structure.lags <= longest
    ]
    of_states = fits[0]
    least = min(fit.share for fit in fits)
    exact = [fit for fit in fits if fit.share <= max(10 * least, 1e-6)] if least <= EXACT else []
    best = min(exact, key=lambda fit: fit.history.structure.lags) if exact else max(fits, key=_preference)
    if best.share > NOISY:
        for structure in STRUCTURES:
            if structure.ratio and structure.lags <= longest:
                with contextlib.suppress(np.linalg.LinAlgError):
                    fits.append(filtered(structure, of_states))
        best = max(fits, key=_preference)
    structure = best.history.structure
    return best, ChosenStructure(structure, (of_states if structure.ratio else best).theta)


def predicted_by_history(
    posterior: DynamicsPosterior, records: Sequence[Record], pairs: Array, without_history: Array
) -> bool:
    """Return whether a history predicts the last record far better than state and input do, or neither predicts it.

    The last record is left out. ``without_history`` has the predictions ``(H, n)`` of its states without a history,
    learned from the other records.
    """
    last, sizes, live = records[-1], posterior.data.sizes, posterior.data.learned

    def share(errors: Array) -> float:
        return float(((errors[:, live] / sizes[live]) ** 2).mean(axis=0).max())

    without = share(last.states[1:] - without_history)
    if without < EXACT:
        return False
    shares = []
    for lags in (1, 2, 3):
        history = History(posterior.model, Structure(lags), np.eye(len(live)))
        fit = fit_lagged(history, records[:-1], pairs, None, live, usual=True)
        with_history = share(history.along([last], fit.residual)[2])
        if with_history < min(_BETTER * without, _GOOD):
            return True
        shares += [with_history, fit.share]
    return min(without, *shares) > _UNEXPLAINED  # noise


def _preference(fit: InnovationsFit) -> float:
    structure = fit.history.structure
    return fit.evidence - 3 * structure.lags - (3 if structure.ratio else 0)
