"""``docs/comparison.md``: how many executions comparisons need, and how often their decisions are false.

``python benchmarks/study_compare.py`` computes what this page shows.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ctxval.paper.reproduce.jobs import AUTO, measured_with
from study_compare import BUDGETS, CONFIDENCE, PAPER, PLAIN, STORED

PAGE = Path(__file__).parents[1] / "docs" / "comparison.md"

INTRODUCTION = f"""\
# Comparisons: executions and false decisions

`make compare-study` computes these tables, and `ctxval compare` is the command. All decisions of one comparison hold
together with confidence {CONFIDENCE}. The truths come from dense grids, which a real system would not have.
{measured_with(STORED.values(), AUTO)}

## The paper's arm: network, Gaussian process, linear model

The paper compares three models of its robotic arm by d*, and by the distance at which the system ends from its target.
It executes {PAPER} tasks for each model, so three separate campaigns take {3 * PAPER}. A comparison may take half of
that. Here the first question is `worst` with the paper's distance, and the second one is `mean` with the final distance
of the system from its target. Each seed draws other data for the models.
"""

SKEWED = """
## Skewed differences

Without a largest possible distance, the decisions on expected distances are exact only if the corrected differences of
the two candidates are symmetric about their mean, and asymptotic otherwise. If the differences are skewed, decisions
are false more often than stated. The table is for independent draws with the mean 0, so every decision on the sign is
false; at most 5 % should be. State `--largest-possible` if a number is known that no distance can exceed: the
decisions are then valid for every distribution.
"""

CART = """
## Two controllers on carts

Each seed draws the drag of a cart and the weights of two LQRs. A decision is false if the other candidate has the
smaller true value. No largest possible distance is stated, so the decisions on expected distances are the asymptotic
ones. The last column counts the confidence intervals that do not contain the true difference at the end. Here one
controller is usually better in most tasks, so false decisions are rarer than intervals without the truth.
"""

_NAMES = {"worst": "worst", "mean": "mean", "plain": "mean, without predictions"}


def page() -> str:
    """Return the whole page."""
    arm = [row for question in ("worst", "mean") for row in _arm_rows(question)]
    carts = [row for question in _NAMES for row in _cart_rows(question)]
    share = f"share of {3 * PAPER}"
    heads = ("question", "seed", "executions", share, "pairs decided", "false", "ranking", "truths [mm]")
    cart_heads = (
        "question",
        "comparisons",
        "budget",
        "decided",
        "false",
        "executions: median, largest",
        "intervals without the truth",
    )
    skewed_heads = ("distribution of the differences", "draws", "repetitions", "false")
    measured = [INTRODUCTION, _table(heads, arm), CART, _table(cart_heads, carts)]
    return "\n".join([*measured, SKEWED, _table(skewed_heads, _skewed_rows()), ""])


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


def _table(headers: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    return "\n".join(f"| {' | '.join(cells)} |" for cells in (headers, ["---"] * len(headers), *rows))


if __name__ == "__main__":
    PAGE.write_text(page())
