"""The measured part of ``docs/how-to/causes.md``, from what ``study_causes.py`` has stored. Nothing is run here."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from study_causes import EXECUTIONS, NOISES, ROBOTS, RULE, SERVO, STORED, faults

PAGE = Path(__file__).parents[1] / "docs" / "how-to" / "causes.md"
MARK = "<!-- written by benchmarks/causes_page.py -->\n"

HEADER = (
    "robot", "noise", "faults", "the right one first", "among three", "size within 10 %", "foreign: none of these",
)  # fmt: skip

SECTION = """
## Measured

`make causes` computes this part and prints its tables. Robots with one seeded fault each, which their exact model
lacks, execute {executions} random tasks, mostly with measurement noise of 0.1 % of the ranges, which acts on the
controllers. Foreign faults are in no dictionary. A fault is found if it is named first, at its joint or input, or
within a group that the executions do not distinguish.

| robots | the right one first | among three | size within 10 % | foreign faults answered "none of these" |
| --- | --- | --- | --- | --- |
| reporting | {reporting} |
| development | {development} |

The rules were changed three times after results on reporting robots had been seen, and by the first rule the right
cause was first in {first}. Development robots were run by rule {development_rule} of {rule}. Missed: {missed}.
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


def rule_of_development() -> int:
    """Return the newest rule that ran on development robots."""
    return RULE if STORED.select(rule=RULE, of="development") else RULE - 1


def servo() -> str:
    """Return what is found on the real servo."""
    found = SERVO.select(rule=RULE)
    if not found:
        return ""
    loads = [each for each in found if each["first"] == "LoadFriction"]
    shares = " and ".join(f"{100 * each['share']:.0f} %" for each in loads)
    return (
        "On a [real servo](../servo.md) with the published model m1, load-dependent friction is the most probable "
        f"cause in {len(loads)} of {len(found)} draws of {EXECUTIONS} recordings, and explains {shares} of the squared "
        "deviations of held-out recordings. It is not named, because the largest distance does not fall with it."
    )


def cells(records: Sequence[dict[str, Any]]) -> str:
    """Return the last cells of a row: counts of the answers of some records."""
    n = counts(records)
    shares = (f"{n[key]} of {n['faults']}" for key in ("first", "three"))
    return " | ".join([*shares, f"{n['sized']} of {n['first']}", f"{n['none']} of {n['foreign']}"])


def not_run(of_development: int) -> str:
    """Return how many faults were not run with each noise; development robots were run by this rule."""
    rules, missing = {"reporting": RULE, "development": of_development}, []
    for noise in NOISES:
        cases = [(name, of, len(faults(robot, of))) for of, robots in ROBOTS.items() for name, robot in robots.items()]
        run = sum(len(STORED.select(rule=rules[of], robot=name, noise=noise)) for name, of, _ in cases)
        whole = sum(count for *_, count in cases)
        if run < whole:
            missing.append(f"{whole - run} of {whole} faults {'with' if noise else 'without'} noise")
    return f"Not yet run: {', '.join(missing)}." if missing else ""


def missed(records: Sequence[dict[str, Any]]) -> str:
    """Return the faults of reporting robots that were missed."""
    lost = [each for each in records if not each["foreign"] and not (each["named"] and each["in_group"])]
    return ", ".join(dict.fromkeys(f"{each['robot']} {each['fault']}" for each in lost)) or "none"


def section() -> str:
    """Return the measured part of the page."""
    development, first = rule_of_development(), counts(STORED.select(rule=1, of="reporting"))
    records = STORED.select(rule=RULE, of="reporting")
    text = SECTION.strip().format(
        executions=EXECUTIONS, reporting=cells(records), rule=RULE, development_rule=development,
        development=cells(STORED.select(rule=development, of="development")),
        first=f"{first['first']} of {first['faults']} faults", missed=missed(records), servo=servo(),
        not_run=not_run(development),
    )  # fmt: skip
    return "\n\n".join(
        part if part.startswith("|") else textwrap.fill(part, 120, break_long_words=False, break_on_hyphens=False)
        for part in text.split("\n\n")
    )


def main() -> None:
    before = PAGE.read_text().partition(MARK)[0].rstrip()
    PAGE.write_text(f"{before}\n\n{MARK}\n{section().strip()}\n")
    print(table("reporting"), table("development", rule_of_development()), f"{PAGE} has been written", sep="\n\n")


if __name__ == "__main__":
    main()
