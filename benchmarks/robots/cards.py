"""The cards of models on real robots, from stored campaigns."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from ctxval.report import Card, CardVerdict
from json_lines import JsonLines
from robots import double_pendulum
from robots.study import CAMPAIGNS, CAUSES, KINDS, QUANTILES, RESULTS, SECONDS, SHARES, SHOWN

SERVO = JsonLines(RESULTS / "servo.jsonl", ("model", "share", "seed"))
SERVO_CAUSES = JsonLines(RESULTS / "causes_servo.jsonl", ("rule", "seed"))
SERVO_REFINED = JsonLines(RESULTS / "servo_refined.jsonl", ("model", "half"))

OF_ARM = "recordings: SAGE, Apache-2.0"
OF_PENDULUM = "recordings: DFKI, BSD-3-Clause"
OF_SERVO = "model and recordings: Rhoban, Apache-2.0"
LARGEST = "largest deviation of {}"


def all_cards() -> Iterable[Card]:
    """Return the cards of all rows."""
    for kind in KINDS:
        yield _card_of_arm(kind)
    for seconds in SECONDS:
        for model in (*double_pendulum.PUBLISHED, *double_pendulum.LEARNED):
            if ("double pendulum", model, f"{seconds} s", SHARES[0]) in CAMPAIGNS:
                yield _card_of_pendulum(model, seconds)
    for model in double_pendulum.PUBLISHED:
        yield _card_of_repeats(model)
    for model in ("m1", "m3", "m4"):
        yield _card_of_servo(model)


def of_arm(kind: str, share: float) -> list[dict[str, Any]]:
    return CAMPAIGNS.select(robot="SO-101", model=kind, share=share)


def worst_motions(kind: str) -> list[str]:
    return [line["tasks"][int(np.argmax(line["distances"]))] for line in of_arm(kind, 1.1)]


def spread(values: Sequence[float], digits: int = 3) -> str:
    """Return the median with the smallest and the largest of values, if these differ."""
    median, low, high = (f"{each:.{digits}g}" for each in (np.median(values), min(values), max(values)))
    return median if low == high else f"{median} ({low} to {high})"


def _answers(lines: Sequence[dict[str, Any]]) -> str:
    answers = [line["answer"] for line in lines]
    each = [f"{answers.count(answer)} {answer}" for answer in dict.fromkeys(answers)]
    return answers[0] if len(answers) == 1 else ", ".join(each)


def _verdicts(of_share: dict[float, list[dict[str, Any]]], largest: float) -> tuple[CardVerdict, ...]:
    verdicts = []
    for share, lines in of_share.items():
        counts = [len(line["tasks"]) for line in lines]
        executions = counts[0] if len(counts) == 1 else f"{spread(counts)} executions"
        verdicts.append(CardVerdict(share * largest, _answers(lines), executions))
    return tuple(verdicts)


def _card_of_arm(kind: str) -> Card:
    lines = {share: of_arm(kind, share) for share in SHARES}
    largest = float(np.median([line["largest"] for line in lines[1.1]]))
    worst, of_first = worst_motions(kind), SHARES[0] * CAMPAIGNS["SO-101", kind, "draw 0", SHARES[0]]["largest"]
    told = CAUSES.get(("SO-101", "linear", "wrist roll")) if kind == "linear" else None
    return Card(
        "SO-101 arm",
        f"{kind}, learned from five motions",
        f"model: ctxval; {OF_ARM}" if kind == "linear" else f"masses: TheRobotStudio; {OF_ARM}",
        LARGEST.format("five joints"),
        "rad",
        largest,
        largest,
        _verdicts(lines, largest),
        spread([len(line["tasks"]) for line in lines[1.1]]),
        max(set(worst), key=worst.count),
        cause(told),
        repair(told),
        f"ctxval run robots.so101:experiment --option folder=FOLDER --option model={kind} --threshold {of_first:.3g}",
    )


def _card_of_pendulum(model: str, seconds: float) -> Card:
    lines = {share: [CAMPAIGNS["double pendulum", model, f"{seconds} s", share]] for share in SHARES}
    (line,) = lines[1.1]
    told = CAUSES.get(("double pendulum", model, f"{seconds} s"))
    published = model in double_pendulum.PUBLISHED
    return Card(
        "pendubot, TVLQR",
        f"model {model}" if published else f"{model}, learned from five perturbed runs",
        "model and " + OF_PENDULUM if published else f"model: ctxval; {OF_PENDULUM}",
        LARGEST.format(f"both angles up to {seconds:g} s"),
        "rad",
        line["largest"],
        line["largest"],
        _verdicts(lines, line["largest"]),
        len(line["tasks"]),
        line["tasks"][int(np.argmax(line["distances"]))],
        cause(told),
        repair(told),
        f"ctxval run robots.double_pendulum:experiment --option folder=FOLDER --option model={model} "
        f"--option seconds={seconds} --threshold {SHARES[0] * line['largest']:.3g}",
    )


def _card_of_repeats(model: str) -> Card:
    lines = [QUANTILES[model, 1.5, quantile, share] for quantile in SHOWN for share in SHARES]
    largest = lines[0]["largest"]
    return Card(
        "pendubot, TVLQR: undisturbed and perturbed, ten repeats each",
        f"model {model}",
        "model and " + OF_PENDULUM,
        LARGEST.format("both angles up to 1.5 s"),
        "rad",
        largest,
        largest,
        tuple(
            CardVerdict(line["share"] * largest, f"{100 * line['quantile']:g} %: {line['answer']}", line["executions"])
            for line in lines
        ),
        20,
        "",
        command=f"ctxval run robots.double_pendulum:experiment --option folder=FOLDER --option model={model} "
        f"--option seconds=1.5 --option repeats=true --threshold {SHARES[1] * largest:.3g}",
    )


def _card_of_servo(model: str) -> Card:
    lines = {share: SERVO.select(model=model, share=share) for share in SHARES}
    largest = max(max(line["distances"]) for line in lines[1.1])
    worst = max(lines[1.1], key=lambda line: max(line["distances"]))
    told = SERVO_CAUSES.get((1, 0)) if model == "m1" else None
    refined = [line for line in SERVO_REFINED.select(model=model) if line["after"]]
    repaired = [(max(line["before"].values()), max(line["after"].values())) for line in refined]
    return Card(
        "XL330 servo, pendulum",
        f"friction model {model}",
        OF_SERVO,
        LARGEST.format("the angle over 6 s"),
        "rad",
        largest,
        largest,
        _verdicts(lines, largest),
        spread([len(line["tasks"]) for line in lines[1.1]]),
        worst["tasks"][int(np.argmax(worst["distances"]))],
        cause(told),
        "; ".join(f"refined with 8 runs: {before:.2f} to {after:.2f} rad on 8 others" for before, after in repaired)
        or (
            "no model: a run that it learned from stays above the threshold"
            if SERVO_REFINED.select(model=model)
            else ""
        ),
        "env -C ../examples/servo ctxval run servo:experiment --option folder=FOLDER "
        f"--option friction={model} --threshold {SHARES[0] * largest:.3g}",
    )


def cause(told: dict[str, Any] | None) -> str:
    """Return the cause that ``ctxval why`` names, or else what the recordings show and what comes nearest."""
    if told is None:
        return ""
    first, *rest = str(told["sentence"]).split(". ")
    if first.startswith("The recordings show: "):
        return f"{first[21].upper()}{first[22:]}; in all, {rest[1][0].lower()}{rest[1][1:]}"
    nearest = rest[0] if rest else ""
    return first if told["named"] or not nearest else f"none named; {nearest[0].lower()}{nearest[1:]}"


def repair(told: dict[str, Any] | None) -> str:
    if told is None:
        return ""
    if "after" not in told:
        seen = str(told["sentence"]).startswith("The recordings show: ")
        return f"none, because {'what is seen is not all' if seen else 'no cause is named'}"
    return f"{told['before']:.3g} to {told['after']:.3g} rad on {told['of']} others, nearer in {told['nearer']}"
