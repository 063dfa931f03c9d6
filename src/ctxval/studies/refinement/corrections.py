"""Corrections of a model that are learned from records: the mean of the residual dynamics, exact or averaged."""

from __future__ import annotations

import numpy as np

from ctxval._util.arrays import Array, single_threaded
from ctxval.core.model import Model
from ctxval.learning import DynamicsPosterior, PosteriorSettings, learn_posterior
from ctxval.learning.histories import History, Record, Structure
from ctxval.learning.innovations import fit_lagged
from ctxval.learning.residual_data import NEGLIGIBLE
from ctxval.models import Correction
from ctxval.models.scaling import standard_deviations
from ctxval.studies.refinement.held_out import Records


def exact_correction(model: Model, records: Records, centres: int) -> Correction | None:
    """Return the mean of Gaussian processes of the residual, conditioned on transitions that represent the others.

    Returns None if M explains the records.
    """
    # Matern 5/2 that does not grow with the inputs.
    settings = PosteriorSettings(hyperparameters=1, centres=centres, families=((2.5, 0.0),), of_steps=False)
    posterior = learn_posterior(model, records.transitions, records.sources, settings=settings)
    return None if posterior is None else correction_of(posterior)


def correction_of(posterior: DynamicsPosterior) -> Correction:
    """Return a learned residual as a correction, with the box of the records that it was learned from."""
    # At least 24 centres are kept, if they predict the others with a relative error of 0.005: design on the model is
    # then faster.
    data, mean = posterior.data, posterior.with_few_centres(24, 0.005)
    (centres,), values = mean.centres, np.exp(mean.thetas[0])
    scales, constant, slope = values[:-2], values[-2], values[-1]
    weights = np.zeros((len(centres), len(data.units)))
    weights[:, data.learned] = mean.weights[0]
    weights *= data.units
    linear = np.concatenate([slope * centres.T @ weights, constant * weights.sum(axis=0, keepdims=True)])
    limit = posterior.limit * data.units
    return _correction(data.shift, data.scale, data.pairs, centres, scales, weights, linear, limit)


def averaged_correction(model: Model, records: Records) -> Correction | None:
    """Return the mean of a Gaussian process of low rank, conditioned on all transitions, which averages their noise.

    Returns None if M explains the records, or if their numbers are too large.
    """
    runs = [Record(run.states, run.inputs, run.states[0]) for run in records.executed]
    if records.own is not None:
        of_model = records.own[:: max(1, len(records.own) // 50_000)]  # of more, only a part is averaged
        runs += [
            Record(np.stack([x, after]), u[None], x)
            for x, u, after in zip(of_model.x, of_model.u, of_model.x_next, strict=True)
        ]
    data = records.transitions
    k = data.x.shape[1] + data.u.shape[1]
    try:
        with single_threaded(), np.errstate(all="ignore"):
            sizes = np.sqrt(((data.x_next - model.step(data.x, data.u)) ** 2).mean(axis=0))
            live = sizes > NEGLIGIBLE * standard_deviations(data.x_next - data.x)
            if not live.any():
                return None
            history = History(model, Structure(), np.eye(len(live)))
            fit = fit_lagged(history, runs, np.zeros((0, k)), None, live, products=False)
    except (np.linalg.LinAlgError, ValueError):  # numbers that are not finite
        return None
    scaled, features, function = fit.scaled, fit.features, fit.features.function(fit.weights)
    linear = features.linear * np.roll(function.linear[: k + 1], -1, axis=0)  # the constant is the last row
    limit = 5.0 * np.abs(scaled.E).max(axis=0)
    scales = np.exp(features.theta[1:])
    return _correction(scaled.shift, scaled.scale, scaled.Z, features.centres, scales, function.matern, linear, limit)


def _correction(
    shift: Array, scale: Array, pairs: Array, centres: Array, scales: Array, weights: Array, linear: Array, limit: Array
) -> Correction:
    low, high = pairs.min(axis=0), pairs.max(axis=0)
    # A coordinate that the residual does not depend on fades the correction within one more range of the records.
    fade = np.minimum(scales, np.maximum(high - low, 1.0))
    return Correction(shift, scale, centres, scales, weights, linear, low, high, fade, limit)
