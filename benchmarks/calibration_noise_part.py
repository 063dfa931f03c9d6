"""The part of ``docs/calibration.md`` on verdicts under noise. Nothing is run here."""

from __future__ import annotations

from calibrate_noise import BUDGET, HALVES, QUANTILE, RULE, STORED, table
from calibration_verdicts_part import validated_share

TEXT = """## Noise

{plants} plants have noise, encoders, late commands or slow actuators, in the shares of their ranges and in the steps
that the table names ([noise](explanation/noise.md)). They were never tuned on. A threshold is a share of the largest
{quantile:g} quantile of the distance, d_q*. Campaigns run with the default certificate, eight tests and at most
{budget} executions until they are decided. {count} campaigns are stored.

**At 0.95 d_q*, {false} of {below} campaigns were validated falsely (the 95 % interval is {low:.1f} to {high:.1f} %).**

{reported}
{developed}{misleading}"""

DEVELOPED = """
On plants on which rules were chosen:

{table}
"""

MISLEADING = """
On carts that break an assumption, which were looked at during development:

{table}
"""


def under_noise() -> str:
    """Return the part; without campaigns it is empty."""
    stored = STORED.select(rule=RULE)
    results = [line for line in stored if line["plant"] in HALVES["reporting"]]
    if not results:
        return ""
    below = [line["answer"] for line in results if line["share"] == 0.95]

    def of(half: str, text: str) -> str:
        return text.format(table=table(half)) if any(line["plant"] in HALVES[half] for line in stored) else ""

    return TEXT.format(
        plants=len(HALVES["reporting"]),
        quantile=QUANTILE,
        budget=BUDGET,
        count=len(results),
        **validated_share(below),
        reported=table("reporting"),
        developed=of("development", DEVELOPED),
        misleading=of("misleading", MISLEADING),
    )
