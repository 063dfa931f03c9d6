"""Few draws and few closed loops, for what does not depend on how many there are. Processes of tests use it, too."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from ctxval.certificates import Maxima, Sample, draw_maxima
from ctxval.certificates.maxima import MaximaSettings
from ctxval.gp.hyperposterior import draw_paths
from ctxval.learning.dynamics_posterior import PosteriorSettings
from ctxval.learning.dynamics_study import LearningSettings
from ctxval.learning.hyperparameters import FAMILIES
from ctxval.learning.input_effects import InputEffectSettings
from ctxval.learning.structure import StructureSettings
from ctxval.learning.worst_case import WorstCaseSettings
from ctxval.searches.trust_region import TrustRegionSettings

drawn: dict[tuple[Any, ...], Maxima] = {}


def take_few_draws(replace: Callable[[str, Any], None], *, once: bool = False) -> None:
    """Make the draws of d* fewer, by a function that replaces an attribute.

    With ``once``, the draws of the same trials are remembered for later tests of the process.
    """

    def fewer(sample: Sample, *, draws: int = 12, paths: int = 4, **options: Any) -> Maxima:
        return draw_maxima(sample, draws=min(draws, 12), paths=4, **options)

    def remembered(sample: Sample, *, draws: int = 12, **options: Any) -> Maxima:
        trials = (sample.points.shape, sample.points.tobytes(), sample.distances.tobytes(), *sample.states)
        key = (*trials, min(draws, 12), repr(sorted(options.items())))
        if key not in drawn:
            drawn[key] = fewer(sample, draws=draws, **options)
        return drawn[key]

    for module in ("stopping", "posterior", "maxima"):
        replace(f"ctxval.certificates.{module}.draw_maxima", remembered if once else fewer)
    replace("ctxval.certificates.maxima.draw_paths", partial(draw_paths, waves=64))
    replace(
        "ctxval.certificates.maxima.MAXIMA", MaximaSettings(chains=1)
    )  # the draws are not doubled where a bound is near the threshold


def run_few_loops(replace: Callable[[str, Any], None]) -> None:
    """Make searches of the learned dynamics smaller, by a function that replaces an attribute."""
    loops = WorstCaseSettings(
        pool=48, evaluations=100, local_maxima=6, shared=8, moves=3, rounds=1, relevant=200, peaks=1, nearby=8
    )
    draws = PosteriorSettings(hyperparameters=10, learned_from=40, centres=80, pivots=40, families=FAMILIES[:1])
    replace("ctxval.learning.worst_case.WorstCaseSettings.for_dimension", lambda *_: loops)
    replace("ctxval.learning.dynamics_posterior.PosteriorSettings.for_horizon", lambda *_: draws)
    replace("ctxval.searches.trust_region.TrustRegion.settings", TrustRegionSettings(shares=(0.15,)))
    # Effects of inputs are looked for in each campaign whose model errs: half of its time.
    structure = StructureSettings(input_effects=InputEffectSettings(learned_from=40, climbed=2, evaluations=40))
    replace("ctxval.learning.dynamics_study.LearningSettings", partial(LearningSettings, structure=structure))
