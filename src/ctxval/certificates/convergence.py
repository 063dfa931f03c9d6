r"""The paper's Proposition 1 and Corollary 1 as formulas: the gap between the best distance of GP-UCB and d*.

With the information gain gamma_n of the kernel, and |P| the dimension of the task space,

    Pr(d* > best_n + r_n for some n) < eps,   r_n = C sqrt(|P| gamma_n / n).

The paper does not give C, and no trials determine it, so no verdict rests on this bound (docs/theory.md). For a Matern
kernel of smoothness nu, gamma_n is n^(e) with e = |P|(|P|+1) / (2 nu + |P|(|P|+1)), up to a logarithm; for the squared
exponential, it is (log n)^(|P|+1).
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from ctxval._util.checked import PositiveFloat, PositiveInt, checked

KernelName = Literal["matern-3/2", "matern-5/2", "squared-exponential"]


@checked
def rate(n: PositiveInt, dimension: PositiveInt, kernel: KernelName = "matern-3/2") -> float:
    """Return ``r_n / C``."""
    if kernel == "squared-exponential":
        return float(np.sqrt(dimension * np.log(max(n, np.e)) ** (dimension + 1) / n))
    double = 3.0 if kernel == "matern-3/2" else 5.0  # 2 nu
    return float(np.sqrt(dimension / n ** (double / (double + dimension * (dimension + 1)))))


@checked
def is_validated(
    best: float,
    threshold: PositiveFloat,
    constant: PositiveFloat,
    n: PositiveInt,
    dimension: PositiveInt,
    kernel: KernelName = "matern-3/2",
) -> bool:
    """Return whether Corollary 1 validates the model after n tasks of GP-UCB: ``best_n < tau - r_n``."""
    return best < threshold - constant * rate(n, dimension, kernel)
