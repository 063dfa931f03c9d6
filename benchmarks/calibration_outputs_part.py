"""The part of ``docs/calibration.md`` on verdicts from outputs. Nothing is run here."""

from __future__ import annotations

from calibrate_outputs import BUDGET, RULE, STORED, table_text
from calibration_verdicts_part import validated_share

TEXT = """## Outputs in place of states

{plants} of the plants of the section before, with positions and angles recorded and no rates: the states of the models
are estimated from these outputs ([how](theory.md#dynamics-bound)), and the controllers are the same state feedbacks
behind a Kalman filter. The estimates were not tuned on these plants. Campaigns run until they are decided, with at most
{budget} executions. {count} campaigns are stored.

**At 0.95 d*, {false} of {below} campaigns were validated falsely (the 95 % interval is {low:.1f} to {high:.1f} %).**

{table}
"""


def from_outputs() -> str:
    """Return the part; without campaigns it is empty."""
    results = STORED.select(rule=RULE)
    below = [line["answer"] for line in results if line["share"] == 0.95]
    if not below:
        return ""
    return TEXT.format(
        plants=len({line["plant"] for line in results}),
        budget=BUDGET,
        count=len(results),
        **validated_share(below),
        table=table_text(),
    )
