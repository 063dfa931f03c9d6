r"""The paper's Proposition 1 and Corollary 1 as formulas: the gap between the best distance of GP-UCB and d*.

With the information gain gamma_n of the kernel, and |P| the dimension of the task space,

    Pr(d* > best_n + r_n for some n) < eps,   r_n = C sqrt(|P| gamma_n / n).

The paper prints "for all n", from which its corollary would not follow; its proof gives "for some n". It does not give
C, and no trials determine C, so no verdict rests on this bound.

For a Matern kernel of smoothness nu, gamma_n = O(n^(e) log n) with e = |P|(|P|+1) / (2 nu + |P|(|P|+1)); without the
logarithm, nu = 3/2 gives the printed r_n = C sqrt(|P| / n^(3 / (3 + |P|(|P|+1)))). For the squared exponential,
gamma_n = O((log n)^(|P|+1)).
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
    """Return whether Corollary 1 validates the model: ``best_n < tau - r_n``.

    n tasks were chosen by the acquisition function. The largest distance found, tau and the constant C have one unit.
    """
    return best < threshold - constant * rate(n, dimension, kernel)
