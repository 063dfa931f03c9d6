"""The methods by name: what each is given, and where it is."""

from __future__ import annotations

import importlib
import importlib.util
from dataclasses import dataclass

from peers.recorder import Maximise

VALUE = "the distance"
TRAJECTORIES = "trajectories, M, its data"


@dataclass(frozen=True)
class Method:
    """A method.

    Attributes:
        title: what the page calls it.
        given: the information that it is given.
        module, attribute: where it is in this package.
        needs: the package that it needs besides ctxval.
        resumes: whether it begins with what is known already.
    """

    title: str
    given: str
    module: str
    attribute: str
    needs: str = "ctxval"
    resumes: bool = True

    @property
    def installed(self) -> bool:
        """Return whether its package is there."""
        return importlib.util.find_spec(self.needs) is not None

    def load(self) -> Maximise:
        """Return what maximises."""
        found: Maximise = getattr(importlib.import_module(f"peers.{self.module}"), self.attribute)
        return found


METHODS: dict[str, Method] = {
    "auto": Method("ours: auto", TRAJECTORIES, "ours", "auto"),
    "auto-no-data": Method("ours: auto without data", "trajectories, M", "ours", "auto_without_data"),
    "vector": Method("ours: vector", "the error vector", "ours", "vector"),
    "scalar": Method("ours: scalar", VALUE, "ours", "scalar"),
    "gp-ucb": Method("ours: GP-UCB", VALUE, "ours", "gp_ucb"),
    "gpyopt": Method("GPyOpt", VALUE, "with_gpyopt", "gpyopt", "GPyOpt"),
    "botorch-log-ei": Method("BoTorch LogEI", VALUE, "with_botorch", "log_ei", "botorch"),
    "botorch-ucb": Method("BoTorch UCB", VALUE, "with_botorch", "ucb", "botorch"),
    "turbo": Method("TuRBO-1", VALUE, "with_botorch", "turbo", "botorch"),
    "optuna-gp": Method("Optuna GP", VALUE, "with_optuna", "optuna_gp", "optuna"),
    "egobox": Method("EGObox", VALUE, "with_egobox", "egor", "egobox"),
    "bayesian-optimization": Method("bayesian-optimization", VALUE, "with_bayes_opt", "bayesian", "bayes_opt"),
    "cma-es": Method("CMA-ES", VALUE, "ours", "cma_es", "cmaes"),
    "dual-annealing": Method("dual annealing", VALUE, "with_scipy", "annealing", resumes=False),
    "direct": Method("DIRECT", VALUE, "with_scipy", "rectangles", resumes=False),
    "verifai-bo": Method("VerifAI BO", VALUE, "with_verifai", "bayesian", "verifai", resumes=False),
    "verifai-ce": Method(
        "VerifAI cross-entropy", "the distance, a level", "with_verifai", "cross_entropy", "verifai", resumes=False
    ),
    "verifai-mab": Method(
        "VerifAI bandit", "the distance, a level", "with_verifai", "bandit", "verifai", resumes=False
    ),
    "verifai-halton": Method("VerifAI Halton", "nothing", "with_verifai", "halton", "verifai", resumes=False),
    "psy-taliro-annealing": Method(
        "PSY-TaLiRo annealing", VALUE, "with_psy_taliro", "annealing", "staliro", resumes=False
    ),
    "psy-taliro-uniform": Method(
        "PSY-TaLiRo uniform", "nothing", "with_psy_taliro", "uniform", "staliro", resumes=False
    ),
    "random": Method("random", "nothing", "ours", "random"),
}
"""Ours first, then the models of the distance, then the rest."""
