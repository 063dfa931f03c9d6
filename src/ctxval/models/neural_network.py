"""A feedforward neural network learned from data."""

from __future__ import annotations

import functools
import itertools
import warnings
from collections.abc import Sequence

import numpy as np

from ctxval._util.arrays import ArrayLike, as_finite, single_threaded
from ctxval._util.checked import NonNegativeInt, PositiveInt, checked
from ctxval._util.refusals import require_extra
from ctxval.core.trajectory import Transitions
from ctxval.errors import ShapeError
from ctxval.models.scaling import IncrementModel, IncrementScaling
from ctxval.models.smooth_maps import SmoothMap, network


class FeedforwardReLU(IncrementModel):
    """A network with ReLU layers and a linear last layer that predicts the increment of the state.

    Layer i maps z to ``z @ weights[i] + biases[i]``, in the standardised units of the scaling.

    Args:
        weights: one matrix for each layer, shapes ``(n + m, h), (h, h'), ..., (h'', n)``.
        biases: one vector for each layer.
        scaling: the scaling of the state-input pair and of the increment.
        data: the transitions that the model was learned from, if any.
    """

    def __init__(
        self,
        weights: Sequence[ArrayLike],
        biases: Sequence[ArrayLike],
        scaling: IncrementScaling,
        data: Transitions | None = None,
    ) -> None:
        self.weights = [as_finite(f"weights[{i}]", value) for i, value in enumerate(weights)]
        self.biases = [as_finite(f"biases[{i}]", value) for i, value in enumerate(biases)]
        self.scaling = scaling
        self.data = data
        pair, states = len(scaling.shift_in), len(scaling.shift_out)
        widths = [pair, *[bias.size for bias in self.biases]]
        shapes = [weight.shape for weight in self.weights]
        if len(widths) < 2 or widths[-1] != states or shapes != list(itertools.pairwise(widths)):
            what = f"a network from {pair} standardised states and inputs to {states} increments must have layers"
            raise ShapeError(f"{what} that fit together, got weights {shapes} and biases {widths[1:]}.")

    @classmethod
    @checked
    def fit(
        cls,
        data: Transitions,
        hidden: Sequence[int] = (8, 8),
        *,
        seed: NonNegativeInt = 0,
        restarts: PositiveInt = 4,
        iterations: PositiveInt = 1000,
    ) -> FeedforwardReLU:
        """Train networks on recorded transitions with scikit-learn's MLPRegressor and L-BFGS.

        So many networks with these hidden layers are trained; the one with the smallest loss on the data is returned.
        """
        scaling = IncrementScaling.of(data)
        seeds = np.random.SeedSequence(seed).generate_state(restarts)
        perceptron = require_extra("sklearn.neural_network", "cases", "learned networks need").MLPRegressor
        ignored = require_extra("sklearn.exceptions", "cases", "learned networks need").ConvergenceWarning
        trained, targets = [], scaling.targets(data)
        targets = targets.ravel() if targets.shape[1] == 1 else targets  # else it warns
        with single_threaded(), warnings.catch_warnings():
            warnings.simplefilter("ignore", ignored)  # stopping at the limit of iterations is intended
            for start in seeds:
                regressor = perceptron(
                    hidden_layer_sizes=tuple(hidden),
                    solver="lbfgs",
                    alpha=1e-6,  # almost no penalty, because so few weights do not overfit thousands of transitions
                    max_iter=iterations,
                    max_fun=2 * iterations,
                    random_state=int(start),
                )
                trained.append(regressor.fit(scaling.inputs(data.x, data.u), targets))
        best = min(trained, key=lambda regressor: regressor.loss_)
        return cls(best.coefs_, best.intercepts_, scaling, data)

    @functools.cached_property
    def _map(self) -> SmoothMap:
        return network(self.weights, self.biases, "relu")
