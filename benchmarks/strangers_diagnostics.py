"""Which diagnostics withdrew a bound from learned dynamics, at each step of a campaign at which it was judged.

A diagnostic has caught something if the bound was below the threshold: without the diagnostics, the threshold would
have been validated. It has caught it alone if no other one withdrew the bound. Nothing more is computed than campaigns
compute anyway.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from ctxval import Campaign
from ctxval.certificates import DynamicsEvidence
from ctxval.certificates.dynamics import bound_of
from ctxval.certificates.dynamics_diagnostics import doubts, raised
from ctxval.core.trial import Trials

CONFIDENCE = 0.95
FAILED = "a prediction that failed"
"""It withdraws no bound, but raises it."""
NAMES = {
    "executed trajectories, and the bound needs": "fewest executions",
    "no controller can be designed": "tasks without a plan",
    "were predicted from earlier ones": "fewest predictions",
    "noise is learned": "noise",
    "contradict the learned noise": "evidence against the noise",
    "understate the predictive uncertainty": "variance left out",
    "leave the recorded range of": "beyond the records",
    "predicted runs diverge": "beyond the records",
    "enter a gap in the records": "gap",
    "enter a gap in the joint records": "joint gap",
    "hardly changes the closed loops": "untried parameter",
    "has a task near the corner": "untried corner",
    "where predicted runs lead, and a post": "unentered place",
    "is not tested where it matters": "largest distance untested",
    "small distances hardly test it": "no large prediction that held",
    "must be predicted beforehand": "tests missing",
    "if a task changes by a thousandth": "jumps",
    "searches of the learned dynamics find": "deeper searches",
}
"""Names of the diagnostics, by a phrase of the sentence of each."""


def name_of(sentence: str) -> str:
    """Return the name of the diagnostic that gives a sentence.

    Raises:
        ValueError: if none or several do.
    """
    names = [name for phrase, name in NAMES.items() if phrase in sentence]
    if len(names) != 1:
        raise ValueError(f"one diagnostic gives each sentence, but {names} give: {sentence}")
    return names[0]


def stopping(evidence: DynamicsEvidence, best: float, threshold: float) -> list[str] | None:
    """Return the names of the diagnostics that stop a validation; None if the bound exceeds the threshold anyway."""
    bound = bound_of(evidence, best, CONFIDENCE)
    if max(bound, best) > threshold:
        return None
    names = [name_of(sentence) for sentence in doubts(evidence, best, bound)]
    return [*names, FAILED] if raised(evidence, bound) > threshold else names


@dataclass(frozen=True)
class JudgedRun:
    """Runs a campaign and writes down what stopped a validation, whenever the bound was below the threshold."""

    campaign: Campaign
    threshold: float

    def run(self, budget: int) -> list[list[Any]]:
        """Return, for each such step, the number of executions and the names of what stopped it; empty if nothing did.

        Of several bounds after one execution, the last one counts: it has the most draws.
        """
        dynamics, steps = self.campaign.recorder.dynamics, dict[int, list[str]]()

        def watched(judge: Any) -> Any:
            def judged(trials: Sequence[Any], *args: Any, **options: Any) -> DynamicsEvidence | None:
                evidence: DynamicsEvidence | None = judge(trials, *args, **options)
                if evidence is not None and not options.get("pending"):
                    by = stopping(evidence, Trials(trials).largest, self.threshold)
                    if by is not None:
                        steps[self.campaign.executions] = by
                return evidence

            return judged

        for name in ("screening", "evidence", "kept_evidence"):
            setattr(dynamics, name, watched(getattr(dynamics, name)))
        try:
            self.campaign.run(budget, self.threshold)
        finally:
            for name in ("screening", "evidence", "kept_evidence"):
                delattr(dynamics, name)
        return [[executions, by] for executions, by in sorted(steps.items())]


def caught(results: Sequence[dict[str, Any]]) -> list[list[str]]:
    """Return the rows of a table: what each diagnostic stopped, in stored campaigns with thresholds below d*.

    These are the steps at which it spoke, those at which it alone did, and the campaigns that have such a step.
    """
    spoke, alone, campaigns = Counter[str](), Counter[str](), defaultdict[str, int](int)
    for line in results:
        single = [by[0] for _, by in line["stopped"] if len(by) == 1]
        spoke.update(name for _, by in line["stopped"] for name in by)
        alone.update(single)
        for name in set(single):
            campaigns[name] += 1
    known = dict.fromkeys([*NAMES.values(), FAILED])
    order = sorted(known, key=lambda name: (-campaigns[name], -alone[name], -spoke[name]))
    return [[name, str(spoke[name]), str(alone[name]), str(campaigns[name])] for name in order]
