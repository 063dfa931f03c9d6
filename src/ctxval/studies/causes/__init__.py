"""Why a model fails: the effects that it lacks, with their sizes in physical units."""

from ctxval.learning import effects
from ctxval.learning.effects import *  # noqa: F403
from ctxval.studies.causes.find import find_causes
from ctxval.studies.causes.report import CauseReport

__all__ = ["CauseReport", "find_causes"]
__all__ += effects.__all__
