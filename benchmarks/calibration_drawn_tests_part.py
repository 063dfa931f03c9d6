"""The part of ``docs/calibration.md`` on the rules of verdicts on strangers: what was tried on the development half."""

from __future__ import annotations

from typing import Any

import study_drawn_tests
import study_ranked_coverage
import study_tolerances
from calibration_verdicts_part import table
from strangers_diagnostics import caught

DRAWN = """### Tests at drawn tasks

Eight tests are drawn by each design alone, without a campaign, 200 times for each of two seeds of each system of the
development half whose dynamics are other in some tasks or places. The numbers are the percentages of these sets of
tests of which at least one test meets what is other, and of which one would fail for it. `hypercube` is the design of
campaigns (`make drawn-tests`).

{power}

Campaigns on these systems run with thresholds of 0.95 d*, so that each validation would be false. {count} of 350 are
stored, and {false} of them {were} validated.

{campaigns}"""

DIAGNOSTICS = """### What each diagnostic caught

At {steps} steps of {campaigns} campaigns with a threshold below d*, the bound from learned dynamics was below the
threshold, and diagnostics alone stopped a validation. A diagnostic caught a step alone if no other one spoke. (The
campaigns are those of both halves and of `make drawn-tests` of which it is stored what spoke. Whether other systems
need a diagnostic that caught nothing here is not known.)

{table}"""

TOLERANCES = """### Is a validation that survives little more often false?

The tolerance of a validation is the smallest push that would bring some task above the threshold. A verdict could be
called fragile if it is less than the largest residual. True validations are those of regular systems at 1.25 d*, with
the tolerances that they have at other thresholds; false ones are those of misleading systems at 0.95 d* without tests
at drawn tasks.

{table}

So such a word would be given to true validations, and not to the false ones: on a regular system, M errs smoothly and
largely, and the posterior has learned it. It is therefore not given; the verdict states both numbers."""

RANKED = """### Coverage tasks ranked by pushes

While records leave gaps, campaigns execute the task whose closed loop leads farthest from the records. Instead, the 16
farthest tasks were ranked by how much a push of the largest residual, where no record is near, changes their distance
on the posterior mean. Campaigns on the development half, with both rules:

{table}

{conclusion}"""


def of_rules(results: list[dict[str, Any]]) -> str:
    """Return the part, without what nothing is stored of; ``results`` are campaigns with thresholds below d*."""
    return "\n\n".join(part for part in (_drawn(), _diagnostics(results), _tolerances(), _ranked()) if part)


def _drawn() -> str:
    campaigns = study_drawn_tests.STORED.select(what="campaign")
    if not study_drawn_tests.STORED.select(what="power"):
        return ""
    false = sum(line["answer"] == "validated" for line in campaigns)
    header = ["system", "campaigns", "validated", "falsified", "undecided", "median executions"]
    return DRAWN.format(
        power=table(["system", *study_drawn_tests.DESIGNS], study_drawn_tests.power_table()),
        count=len(campaigns),
        false=false,
        were="was" if false == 1 else "were",
        campaigns=table(header, study_drawn_tests.campaigns_table()),
    )


def _diagnostics(results: list[dict[str, Any]]) -> str:
    known = [line for line in [*results, *study_drawn_tests.STORED.select(what="campaign")] if "stopped" in line]
    if not known:
        return ""
    steps = sum(len(by) > 0 for line in known for _, by in line["stopped"])
    header = ["diagnostic", "steps at which it spoke", "steps at which it alone spoke", "campaigns with such a step"]
    return DIAGNOSTICS.format(steps=steps, campaigns=len(known), table=table(header, caught(known)))


def _tolerances() -> str:
    if not len(study_tolerances.STORED):
        return ""
    header = ["tau / d*", "push", "less than the largest residual", "median tolerance / largest residual"]
    return TOLERANCES.format(table=table(header, study_tolerances.rows()))


def _ranked() -> str:
    if not len(study_ranked_coverage.STORED):
        return ""
    header = ["tau / d*", "ranked by", "campaigns", "validated", "falsified", "undecided", "executions"]
    return RANKED.format(table=table(header, study_ranked_coverage.rows()), conclusion=study_ranked_coverage.CONCLUSION)
