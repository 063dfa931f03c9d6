"""The measured part of ``docs/how-to/causes.md``, from what ``study_causes.py`` has stored. Nothing is run here."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from causes_robots import DEVELOPMENT, REPORTING
from study_causes import EXECUTIONS, NOISES, ROBOTS, RULE, SERVO, STORED, faults

PAGE = Path(__file__).parents[1] / "docs" / "how-to" / "causes.md"
MARK = "<!-- written by benchmarks/causes_page.py -->\n"

HEADER = (
    "robot", "noise", "faults", "the right one first", "among three", "size within 10 %", "foreign: none of these",
)  # fmt: skip

SECTION = """
## Measured

`make causes` computes this part. Robots have one seeded fault each, which their exact model lacks, and execute
{executions} random tasks. Noise of measurements is in shares of the range of each position, twice as much of its rate;
the controllers act on it. The double pendulum, the reacher, the pusher (an arm of seven joints) and the swimmer (five)
are MuJoCo models of gymnasium. Foreign faults are in no dictionary: a torque that depends on the angle like cogging, a
spring that hardens, a force that swings with time, and a motor whose gain falls with its input. A fault is found if it
is named and first, with its joint or input, or together with others that are alike to the executions.

**Reporting robots**: {reported}

{{reporting}}

**Development robots**, on which rules and thresholds were chosen; they have all kinds of faults. {by_which_rule}

{{development}}

The rules were changed three times after results on reporting robots had been seen. The first rule saw arm, quadrotor
and a part of pusher, and let noise hide causes in stiff loops and small plays: {first} Since the second, noise is
simulated, robots of MuJoCo have the time step of their models, and a weight that is a constant force, as that of the
quadrotor is, may be named so. The swimmer, the telescope and the rotary pendulum were written down before they were
run. The second rule ran on {second} of their faults and missed {lost}: where noise made all deviations, a division by
nearly nothing excluded every cause. By the third rule, {third} Exchanged inputs let the arm fail in every task, so that
nothing was recorded, and an offset of a sensor that changes nothing but where executions begin was explained by any
cause, once by an inertia of 0.997 times that of M. Now the steps before a failure are kept, and executions that M
predicts from where they began need no cause in its dynamics.

{missed}

The quadrotor's inputs count from hovering, so M does not know the load that its friction depends on. A gain and a
saturation together come near a motor whose gain falls with its input. The faults of the pusher that are missed change
its distances by no more than noise does, about 0.005 rad. Such a cause is not named, although it is often the most
probable one.

{not_run}

{servo}
"""


def counts(records: Sequence[dict[str, Any]]) -> dict[str, int]:
    """Return what some records say together."""
    own, foreign = [each for each in records if not each["foreign"]], [each for each in records if each["foreign"]]
    first = [each for each in own if each["named"] and each["in_group"]]
    return {
        "faults": len(own),
        "first": len(first),
        "three": sum(each["rank"] is not None and each["rank"] <= 3 for each in own),
        "sized": sum(each["size_error"] <= 0.1 for each in first),
        "foreign": len(foreign),
        "none": sum(not each["named"] for each in foreign),
    }


def table(of: str, rule: int = RULE) -> str:
    """Return a table of the robots of a part."""
    records, rows = STORED.select(rule=rule, of=of), []
    for robot, noise in dict.fromkeys((each["robot"], each["noise"]) for each in records):
        n = counts([each for each in records if (each["robot"], each["noise"]) == (robot, noise)])
        noisy = f"{100 * noise:g} %" if noise else "none"
        shares = (f"{n[key]} of {n['faults']}" for key in ("first", "three"))
        sizes = f"{n['sized']} of {n['first']}"
        rows.append([robot, noisy, str(n["faults"]), *shares, sizes, f"{n['none']} of {n['foreign']}"])
    lines = [HEADER, ["---"] * len(HEADER), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def rule_of_development() -> tuple[int, str]:
    """Return the newest rule that ran on development robots, and what that means for their table."""
    if STORED.select(rule=RULE, of="development"):
        return RULE, "They were run by the present rule:"
    answers = [
        {(each["robot"], each["fault"], each["noise"]): (each["named"], each.get("causes")) for each in records}
        for records in (STORED.select(rule=RULE - 1), STORED.select(rule=RULE))
    ]
    both = set(answers[0]) & set(answers[1])
    same = sum(answers[0][key] == answers[1][key] for key in both)
    return RULE - 1, (
        f"They were run by rule {RULE - 1}; of {len(both)} faults of reporting robots that rules {RULE - 1} and {RULE} "
        f"have seen, {same} have the same answer:"
    )


def servo() -> str:
    """Return what is found on the real servo."""
    found = SERVO.select(rule=RULE)
    if not found:
        return ""
    loads = [each for each in found if each["first"] == "LoadFriction"]
    shares = " and ".join(f"{100 * each['share']:.0f} %" for each in loads)
    return (
        f"On the [real servo](../servo.md) with the published model m1, which has viscous and Coulomb friction, "
        f"friction that depends on the load is the most probable cause in {len(loads)} of {len(found)} draws of "
        f"{EXECUTIONS} recordings. It explains {shares} of the squared deviations of held-out recordings in closed "
        "loop, more than the next three causes do. It is said with its share, and not named as the cause: the largest "
        "distance of the recordings from their predictions is larger with it than from M, as it is with the published "
        "models m3 and m4, which have such a friction. The recordings are published by the Rhoban team "
        "([Rhoban/bam](https://github.com/Rhoban/bam), Apache-2.0)."
    )


def said(records: Sequence[dict[str, Any]]) -> str:
    """Return what records say together, in a sentence."""
    n = counts(records)
    return (
        f"the right cause is first in {n['first']} of {n['faults']} faults and among three in {n['three']}; of those "
        f"that are first, {n['sized']} have all sizes within 10 %. {n['none']} of {n['foreign']} foreign faults are "
        'answered "none of these".'
    )


def not_run(of_development: int) -> str:
    """Return which robots and noises are missing or incomplete; development robots were run by this rule."""
    of = {name: part for part, robots in ROBOTS.items() for name in robots}
    rules = {"reporting": RULE, "development": of_development}
    missing = [
        (name, noise, len(STORED.select(rule=rules[of[name]], robot=name, noise=noise)), len(faults(robot, of[name])))
        for name, robot in {**DEVELOPMENT, **REPORTING}.items()
        for noise in NOISES
    ]
    few = [
        f"{name} {'without noise' if not noise else 'with noise'} ({count} of {whole} faults)"
        for name, noise, count, whole in missing
        if count < whole
    ]
    return f"Not yet run, or in part: {'; '.join(few)}." if few else ""


def missed(records: Sequence[dict[str, Any]]) -> str:
    """Return which results are not as they should be."""
    kinds: dict[str, list[str]] = {"missed": [], "size": [], "named": []}
    for each in records:
        text = f"{each['robot']} {each['fault']} ({100 * each['noise']:g} %)"
        right = each["named"] and each["in_group"]
        if each["foreign"]:
            kinds["named"] += [text] if each["named"] else []
        elif not right:
            kinds["missed"].append(text)
        elif each["size_error"] > 0.1:
            kinds["size"].append(text)
    lists = [", ".join(each) or "none" for each in kinds.values()]
    return (
        f"Faults that are missed on the reporting robots: {lists[0]}. Faults with a size that is wrong by more than "
        f"10 %: {lists[1]}. Foreign faults for which a cause is named: {lists[2]}."
    )


def section() -> str:
    """Return the measured part of the page."""
    records = STORED.select(rule=RULE, of="reporting")
    first, third = (STORED.select(rule=rule, of="reporting") for rule in (1, 3))
    seen = {each["robot"] for each in first}
    second = [each for each in STORED.select(rule=2, of="reporting") if each["robot"] not in seen]
    lost = [f"{each['robot']} {each['fault']}" for each in second if not (each["named"] and each["in_group"])]
    of_development, by_which_rule = rule_of_development()
    text = SECTION.strip().format(
        second=len(second), lost=" and ".join(lost),
        executions=EXECUTIONS, reported=said(records), first=said(first), third=said(third),
        missed=missed(records), servo=servo(), not_run=not_run(of_development), by_which_rule=by_which_rule,
    )  # fmt: skip
    paragraphs = [
        textwrap.fill(part, 120, break_long_words=False, break_on_hyphens=False) for part in text.split("\n\n")
    ]
    whole = "\n\n".join(filter(None, paragraphs))
    whole = whole.replace("{reporting}", table("reporting"))
    return whole.replace("{development}", table("development", of_development))


def main() -> None:
    before = PAGE.read_text().partition(MARK)[0].rstrip()
    PAGE.write_text(f"{before}\n\n{MARK}\n{section().strip()}\n")
    print(f"{PAGE} has been written")


if __name__ == "__main__":
    main()
