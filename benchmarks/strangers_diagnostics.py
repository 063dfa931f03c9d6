"""Which diagnostics withdrew a bound from learned dynamics, at each step of a campaign at which it was judged.

A diagnostic has caught something if the bound was below the threshold: without the diagnostics, the threshold would
have been validated. It has caught it alone if no other one withdrew the bound. Nothing more is computed than campaigns
compute anyway.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from ctxval import Campaign
from ctxval.certificates import Evidence
from ctxval.certificates.checks import CHECKS, withdrawals
from ctxval.core.trial import Trials

CONFIDENCE = 0.95
FAILED = "a prediction that failed"
"""It withdraws no bound, but raises it."""
NAMES = {
    "few_executions": "fewest executions",
    "not_planned": "tasks without a plan",
    "few_predictions": "fewest predictions",
    "noisy": "noise",
    "noise_contradicted": "evidence against the noise",
    "left_out": "variance left out",
    "beyond": "beyond the records",
    "diverged": "beyond the records",
    "pair_gap": "joint gap",
    "unsampled_parameter": "untried parameter",
    "unsampled_corner": "untried corner",
    "unvisited_region": "unentered place",
    "not_tested": "largest distance untested",
    "none_held": "no large prediction that held",
    "tests_missing": "tests missing",
    "needle": "jumps",
    "jump": "jumps",
    "searches_differ": "deeper searches",
}
"""Names of checks in stored results, by their codes, where they differ."""


def stopping(evidence: Evidence, best: float, threshold: float) -> list[str] | None:
    """Return the names of the checks that stop a validation; None if the bound exceeds the threshold anyway."""
    judged = replace(evidence, best=best, confidence=CONFIDENCE, threshold=threshold)
    if max(judged.bound, best) > threshold:
        return None
    names = [NAMES.get(opened.code, opened.code) for opened in withdrawals(judged)]
    return [*names, FAILED] if judged.raised > threshold else names


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
            def judged(trials: Sequence[Any], *args: Any, **options: Any) -> Evidence | None:
                evidence: Evidence | None = judge(trials, *args, **options)
                if evidence is not None and not options.get("pending"):
                    by = stopping(evidence, Trials(trials).largest, self.threshold)
                    if by is not None:
                        steps[self.campaign.executions] = by
                return evidence

            return judged

        for name in ("screening", "evidence", "kept_evidence"):
            setattr(dynamics, name, watched(getattr(dynamics, name)))
        try:
            self.campaign.run(budget, self.threshold, thinking=float("inf"))
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
    withdrawing = (check.code for check in CHECKS if check.stage != "bound")
    known = dict.fromkeys([*(NAMES.get(code, code) for code in withdrawing), FAILED])
    order = sorted(known, key=lambda name: (-campaigns[name], -alone[name], -spoke[name]))
    return [[name, str(spoke[name]), str(alone[name]), str(campaigns[name])] for name in order]
