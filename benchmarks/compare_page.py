"""``docs/comparison.md``: how many executions comparisons need, and how often their decisions are false.

``python benchmarks/study_compare.py`` computes what this page shows.
"""

from __future__ import annotations

import numpy as np

from page_tables import GeneratedPage, reflowed, table
from reproduce.jobs import AUTO, measured_with
from study_compare import BUDGETS, CONFIDENCE, PAPER, PLAIN, STORED

TEXT = """# Comparisons: executions and false decisions

`make compare-study` computes these tables, and `ctxval compare` is the command. All decisions of one comparison hold
together with confidence {confidence}. The truths come from dense grids. {measured}

## The paper's arm: network, Gaussian process, linear model

The paper compares three models of its arm by d*, and by the distance at which the system ends from its target, with
{paper} executions for each model: {separate} in three separate campaigns. The question `worst` has the paper's
distance, and `mean` the final distance of the system from its target. Each seed draws other data for the models.

{arm}

## Two controllers on carts

Each seed draws the drag of a cart and the weights of two LQRs. A decision is false if the other candidate has the
smaller true value. No largest possible distance is stated, so decisions on expected distances are asymptotic. The
last column counts confidence intervals without the true difference. One controller is usually better in most tasks,
so false decisions are rarer than these.

{carts}

## Skewed differences

Without a largest possible distance, decisions on expected distances are exact only if the corrected differences are
symmetric about their mean. Here independent draws have the mean 0, so every decision on the sign is false; at most 5
% should be. State `--largest-possible` if no distance can exceed a known number: the decisions are then valid for
every distribution.

{skewed}
"""

_NAMES = {"worst": "worst", "mean": "mean", "plain": "mean, without predictions"}
_ARM = ["question", "seed", "executions", f"share of {3 * PAPER}", "pairs decided", "false", "ranking", "truths [mm]"]
_CARTS = ["question", "comparisons", "budget", "decided", "false", "executions: median, largest"]


def page() -> GeneratedPage:
    """Return the whole page."""
    text = TEXT.format(
        confidence=CONFIDENCE,
        measured=measured_with(STORED.values(), AUTO),
        paper=PAPER,
        separate=3 * PAPER,
        arm=table(_ARM, [row for question in ("worst", "mean") for row in _arm_rows(question)]),
        carts=table([*_CARTS, "intervals without the truth"], [row for one in _NAMES for row in _cart_rows(one)]),
        skewed=table(["distribution of the differences", "draws", "repetitions", "false"], _skewed_rows()),
    )
    return GeneratedPage("comparison.md", reflowed(text))


def _arm_rows(question: str) -> list[tuple[str, ...]]:
    rows = []
    for one in STORED.select(case="arm", question=question):
        truths = ", ".join(f"{name} {1000 * value:.1f}" for name, value in one["truths"].items())
        share = f"{100 * one['executions'] / (3 * PAPER):.0f} %"
        decided = f"{one['decided']} of {one['pairs']}"
        rows.append(
            (
                question,
                str(one["seed"]),
                str(one["executions"]),
                share,
                decided,
                str(one["false"]),
                one["ranking"].replace("<", "&lt;"),
                truths,
            )
        )
    return rows


def _cart_rows(question: str) -> list[tuple[str, ...]]:
    found = STORED.select(case="cart", question=question)
    if not found:
        return []
    decided = [one for one in found if one["decided"]]
    spent = [one["executions"] for one in decided] or [0]
    false, missed = sum(one["false"] for one in found), sum(bool(one.get("missed")) for one in found)
    return [
        (
            _NAMES[question],
            str(len(found)),
            str(BUDGETS.get(("cart", question), 2 * PLAIN)),
            str(len(decided)),
            _share(false, len(found)),
            f"{np.median(spent):.0f}, {max(spent)}",
            _share(missed, len(found)) if "missed" in found[0] else "-",
        )
    ]


def _skewed_rows() -> list[tuple[str, ...]]:
    return [
        (
            one["question"],
            f"at most {one['draws']}",
            str(one["repetitions"]),
            _share(one["false"], one["repetitions"]),
        )
        for one in STORED.select(case="skewed")
    ]


def _share(count: int, whole: int) -> str:
    return f"{count} ({100 * count / whole:.1f} %)"


if __name__ == "__main__":
    page().write()
