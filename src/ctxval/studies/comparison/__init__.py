"""Comparison of models, controllers or distances on one system, with executions as the cost."""

from ctxval.studies.comparison.compare import compare
from ctxval.studies.comparison.result import CandidateResult, Comparison, PairResult

__all__ = ["CandidateResult", "Comparison", "PairResult", "compare"]
