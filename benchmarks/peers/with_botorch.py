"""BoTorch: log expected improvement, an upper confidence bound, and trust regions (TuRBO-1)."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
import torch
from botorch.acquisition import AcquisitionFunction, LogExpectedImprovement, UpperConfidenceBound
from botorch.exceptions import ModelFittingError
from botorch.fit import fit_gpytorch_mll
from botorch.generation import MaxPosteriorSampling
from botorch.models import SingleTaskGP
from botorch.optim import optimize_acqf
from gpytorch.constraints import Interval
from gpytorch.kernels import MaternKernel, ScaleKernel
from gpytorch.likelihoods import GaussianLikelihood
from gpytorch.mlls import ExactMarginalLogLikelihood
from torch import Tensor
from torch.quasirandom import SobolEngine

from ctxval._util.arrays import Array
from peers.recorder import Suggest, Suggesting

INITIAL = 5
BETA = 2.0
"""Of the upper confidence bound, as in our GP-UCB."""
RESTARTS, RAW_SAMPLES = 10, 512
"""Of maximising the acquisition function, as in BoTorch's own examples."""

torch.set_num_threads(1)


def sobol(count: int, dimension: int, seed: int) -> Array:
    """Return the first design, shape ``(count, dimension)``."""
    return np.asarray(SobolEngine(dimension, scramble=True, seed=seed).draw(count, dtype=torch.double).numpy())


def tensors(points: Array, values: Array) -> tuple[Tensor, Tensor]:
    """Return points and values as BoTorch takes them."""
    return torch.tensor(points, dtype=torch.double), torch.tensor(values[:, None], dtype=torch.double)


def fitted(model: SingleTaskGP) -> SingleTaskGP:
    """Return a model of standardised values with its most likely hyperparameters, or its first ones if that fails."""
    # It fails where points crowd, as all do at the maximum of a function of one variable.
    with suppress(ModelFittingError):
        fit_gpytorch_mll(ExactMarginalLogLikelihood(model.likelihood, model))
    return model.eval()


def log_ei_acquisition(X: Tensor, Y: Tensor) -> AcquisitionFunction:
    """Return the default acquisition of BoTorch, on its default model."""
    return LogExpectedImprovement(fitted(SingleTaskGP(X, Y)), best_f=Y.max())


def ucb_acquisition(X: Tensor, Y: Tensor) -> AcquisitionFunction:
    """Return the upper confidence bound with a Matern 3/2 kernel, one length-scale for each dimension."""
    kernel = ScaleKernel(MaternKernel(nu=1.5, ard_num_dims=X.shape[1]))
    return UpperConfidenceBound(fitted(SingleTaskGP(X, Y, covar_module=kernel)), beta=BETA)


def start(acquisition: Callable[[Tensor, Tensor], AcquisitionFunction], dimension: int, seed: int) -> Suggest:
    """Return the suggestions that maximise an acquisition function, after some Sobol points."""
    torch.manual_seed(seed)
    first = sobol(INITIAL, dimension, seed)
    cube = torch.stack([torch.zeros(dimension), torch.ones(dimension)]).double()

    def suggest(points: Array, values: Array) -> Array:
        if len(points) < INITIAL:
            return np.asarray(first[len(points)])
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            chosen = acquisition(*tensors(points, values))
            candidate, _ = optimize_acqf(chosen, cube, q=1, num_restarts=RESTARTS, raw_samples=RAW_SAMPLES)
        return np.asarray(candidate[0].numpy())

    return suggest


log_ei = Suggesting(lambda dimension, seed: start(log_ei_acquisition, dimension, seed))
ucb = Suggesting(lambda dimension, seed: start(ucb_acquisition, dimension, seed))


# TuRBO-1 (Eriksson et al., Scalable Global Optimization via Local Bayesian Optimization, 2019), batches of one.


@dataclass
class Region:
    """Where a trust region stands: its length and how often it has succeeded or failed in a row.

    Attributes:
        first: number of the value that it began with.
    """

    first: int = 0
    length: float = 0.8
    successes: int = 0
    failures: int = 0
    best: float = -np.inf


def region_after(values: Array, dimension: int) -> Region:
    """Return the trust region that the values, in order, lead to; the paper's thresholds."""
    region, initial = Region(), 2 * dimension
    for i, value in enumerate(values):
        better = value > region.best + 1e-3 * abs(region.best)
        region.best = max(region.best, float(value))
        if i < region.first + initial:
            continue
        region.successes, region.failures = (region.successes + 1, 0) if better else (0, region.failures + 1)
        if region.successes == 3:
            region.length, region.successes = min(2 * region.length, 1.6), 0
        elif region.failures == max(4, dimension):
            region.length, region.failures = region.length / 2, 0
        if region.length < 0.5**7:
            region = Region(first=i + 1)
    return region


def local_model(X: Tensor, Y: Tensor) -> SingleTaskGP:
    """Return the paper's model: Matern 5/2 with bounded length-scales."""
    dimension = X.shape[1]
    matern = MaternKernel(nu=2.5, ard_num_dims=dimension, lengthscale_constraint=Interval(0.005, 4.0))
    likelihood = GaussianLikelihood(noise_constraint=Interval(1e-8, 1e-3))
    return fitted(SingleTaskGP(X, Y, covar_module=ScaleKernel(matern), likelihood=likelihood))


def sampled(model: SingleTaskGP, X: Tensor, Y: Tensor, length: float, dimension: int) -> Tensor:
    """Return the best point of one posterior sample inside the region, whose sides follow the length-scales."""
    scales = model.covar_module.base_kernel.lengthscale.detach().reshape(-1)
    weights = scales / torch.prod(scales ** (1 / dimension))
    centre = X[Y.argmax()]
    low, high = (centre - weights * length / 2).clamp(0, 1), (centre + weights * length / 2).clamp(0, 1)
    count = min(100 * dimension, 5000)
    drawn = low + (high - low) * torch.rand(count, dimension, dtype=torch.double)
    moved = torch.rand(count, dimension) <= min(20 / dimension, 1.0)
    moved[torch.arange(count), torch.randint(dimension, (count,))] = True
    with torch.no_grad():
        return MaxPosteriorSampling(model, replacement=False)(torch.where(moved, drawn, centre), num_samples=1)[0]


def start_turbo(dimension: int, seed: int) -> Suggest:
    """Return the suggestions of one trust region, which restarts where it has become too small."""
    torch.manual_seed(seed)

    def suggest(points: Array, values: Array) -> Array:
        region = region_after(values, dimension)
        own = len(points) - region.first
        if own < 2 * dimension:
            return np.asarray(sobol(2 * dimension, dimension, 1000 * seed + region.first)[own])
        X, Y = tensors(points[region.first :], values[region.first :])
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return np.asarray(sampled(local_model(X, Y), X, Y, region.length, dimension).numpy())

    return suggest


turbo = Suggesting(start_turbo)
