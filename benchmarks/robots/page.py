"""``docs/robots.md``: verdicts on models of real robots, from stored campaigns, and a card of each row.

``python -m robots.study`` computes what this page shows.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

import numpy as np

from ctxval.report import Card
from page_tables import DOCS, GeneratedPage, Table, reflowed, table
from robots import double_pendulum
from robots.cards import all_cards, cause, of_arm, repair, spread, worst_motions
from robots.study import (
    CAMPAIGNS,
    CAUSES,
    CERTIFIED,
    FALSE_ALARMS,
    KINDS,
    QUANTILES,
    REPEATS,
    SECONDS,
    SHARES,
    SHOWN,
    WATCHED,
)

_DECIDED = ("falsified at 0.9 d* after", "validated at 1.1 d* after")

CARDS = DOCS / "tables" / "robots-cards.json"

SOURCES = (
    ("SO-101 arm", "isaac-sim2real/sage", "4ffd262", "Apache-2.0", "output/real/so101/custom"),
    (
        "pendubot",
        "dfki-ric-underactuated-lab/double_pendulum",
        "1e8544e",
        "BSD-3-Clause",
        "leaderboard/*/real_hardware*_v2/src_data",
    ),
    ("XL330 servo", "Rhoban/bam", "af22604", "Apache-2.0", "bam/data.bak/processed"),
)
"""Of each robot: the repository with the recordings, the commit, the licence, and the folder."""

TEXT = """# Models on real robots

`make robots` computes this page. A row is a model of a real robot, and all verdicts rest on recordings that others have
published. Rows that speak against a model, or against ctxval, stay. A campaign sees one recording at a time, and the
others judge it. [All rows with their origins and the tasks that were worst](tables/robots.csv), and
[their cards as JSON](tables/robots-cards.json); `ctxval report STORE --card card.md` writes such a card of your own
campaign.

{rows}

d\\* is the largest distance of all recordings of the suite. For the arm, models were learned from five motions in
{draws} draws: numbers are medians with the smallest and the largest. A percentage is the share of the executions of
each task that a verdict is about. A dash: not asked.

## Repeat a row

Save the recordings in a folder, say FOLDER, in the form that is described below, and run in `benchmarks` the command of
the row, which is in its [card](tables/robots-cards.json) and in the [table](tables/robots.csv). Its threshold is 0.9
d\\* (of the arm: in the first draw; `--seed` makes another one). For example:

{commands}

{sources}

None of these files is a part of ctxval, and `make robots` says which folder it misses. The files of the arm and of the
pendubot were converted to NPZ, one file for each motion (`t`, `command`, `position`) or condition (`t_00`,
`position_00`, `velocity_00`, `torque_command_00`, and so on).

## An arm of six servos

An SO-101 arm follows 50 commanded motions of 34 to 205 s. The models get the commands of a motion and predict its
angles freely over its whole length. The **linear** model has one equation for each joint, with the angle and the
command of two steps. The **physical** model has proportional-derivative servos with dry friction under the weight of
the links, with masses and lengths that TheRobotStudio publishes; stiffness, damping, friction and the offset of each
joint are fitted. The tasks are the other 45 motions, with two parameters: the largest range and the largest rate of
the commands. These two were chosen after a look at the distances of one draw.

{arm}

**The largest deviation is a stop.** In `single_joint_wrist_roll`, the wrist stops at -1.03 rad while the command goes
on to -1.6 rad, and the servo's load rises to 9 N m (as published). No model that was learned from other motions knows
it: in {stopped} of {draws} draws, this motion is the worst one of the linear model. `ctxval why` sees the stop in the
recordings and names it. The physical model errs by a third of the linear one in the median motion, and no less in this
one.

{arm_causes}

## A double pendulum, ten repeats

The pendubot swings up ten times under one controller: time-varying LQR about a planned trajectory, with friction
compensation and a filter of the rates. It is written again from the facts of its repository, as a controller with
memory. At the recorded states of the undisturbed repeats, its torque at the shoulder differs from the recorded one by
{torque_error:.2f} N m in the mean, and the recorded torque is {torque:.1f} N m (RMS). The recorded reference ends
after 3.02 s, before the top, so success at the top cannot be predicted. Its times in the files are too long by a factor
of 2.5: the reference rates are the derivative of the reference angles with steps of 1 ms, and the robot follows it with
these.

The largest difference of an angle between two of ten repeats; of fewer, if a safety limit ended the others before:

{repeats}

{against}

{found}

**What ten repeats can say.** Without a law of the noise, n repeats below a threshold show, with confidence c, that a
share of $(1 - c)^{{1/n}}$ of all repeats is below it.

{quantiles}

So ten repeats support no statement about nine of ten executions with 95 % confidence; 29 repeats would. A verdict
`validated` on a suite without repeats is about the recorded executions, and says so.

{of_quantiles}

{watched}

## A servo with a pendulum

[A page of its own](servo.md) has the 16 runs of the XL330 servo, its models and its campaigns.

## Limits

- **Bounds from learned dynamics are out of reach for recordings of minutes.** After eight executions of the arm, the
  evidence of a verdict would take about 540 s, by its own estimate; the budget is 60 s. So campaigns choose tasks by
  the distances alone, and a [law of the distances](theory.md#tasks-of-a-suite-that-are-left) bounds the motions that
  are left. It rests on the two parameters of a motion, which the user has to state.
- One arm, one pendubot and one servo: nothing here is about other specimens.
- No motion of the arm was recorded twice, so it is not known how much of its distances is chance.
"""


def page() -> GeneratedPage:
    """Return the page and its table."""
    cards = list(all_cards())
    short = [0, 1, 3, 4, 5, 8, 9]
    rows = table([Card.HEAD[k] for k in short], [[each.row()[k] for k in short] for each in cards])
    whole = REPEATS[double_pendulum.UNDISTURBED, 3.0]
    text = TEXT.format(
        rows=rows,
        draws=len(of_arm("linear", SHARES[0])),
        commands=_commands(cards),
        sources=_sources(),
        arm=_arm(),
        stopped=worst_motions("linear").count("single_joint_wrist_roll"),
        arm_causes=_arm_causes(),
        torque_error=whole["torque_error"],
        torque=whole["torque"],
        repeats=_repeats(),
        against=_against(),
        found=_found(),
        quantiles=_quantiles(),
        of_quantiles=_of_quantiles(),
        watched=_watched(),
    )
    return GeneratedPage("robots.md", reflowed(text), {"robots": _whole(cards)})


def _commands(cards: Sequence[Card]) -> str:
    """Return the first command of each robot."""
    first = {each.system: each.command for each in reversed(cards)}
    return "```console\n" + "".join(f"$ {command}\n" for command in reversed(first.values())) + "```"


def _whole(cards: Sequence[Card]) -> Table:
    head = [*Card.HEAD, "command"]
    return head, [[cell.replace("\\", "") for cell in each.row()] + [each.command] for each in cards]


# Parts of the page


def _sources() -> str:
    head = ["robot", "recordings", "commit", "licence", "folder"]
    rows = [
        [robot, f"[{repository}](https://github.com/{repository})", commit, licence, f"`{folder}`"]
        for robot, repository, commit, licence, folder in SOURCES
    ]
    return table(head, rows)


def _arm() -> str:
    head = ["model", "d* [rad]", "median motion [rad]", "worst of 45 found after", *_DECIDED]
    rows, last, seconds = [], list[int](), list[float]()
    for kind in KINDS:
        whole, falsified = of_arm(kind, 1.1), of_arm(kind, 0.9)
        found = [1 + int(np.argmax(line["distances"])) for line in whole]
        columns = [line["largest"] for line in whole], [line["median"] for line in whole], found
        decided = ([len(line["tasks"]) for line in lines] for lines in (falsified, whole))
        rows.append([kind, *map(spread, columns), *map(spread, decided)])
        last.append(max(found))
        seconds.append(max(line["seconds"] for line in whole))
        assert all(max(line["distances"]) >= line["largest"] - 1e-9 for line in whole)
        assert all(line["answer"] == "falsified" for line in falsified)
        assert all(line["answer"] == "validated" for line in whole)
    fewest = min(len(line["tasks"]) for kind in KINDS for line in of_arm(kind, 1.1))
    assert max(last) < fewest
    later = " and ".join(
        f"{np.median([len(line['tasks']) for line in of_arm(kind, 1.1)[5:]]):g} ({kind})" for kind in KINDS
    )
    return (
        f"{table(head, rows)}\n\nA random order meets the worst of 45 after 23. At 1.1 d\\*, a [law of the distances]"
        "(theory.md#tasks-of-a-suite-that-are-left) over range and rate validates the models. It decides after "
        f"{fewest} executions or more, and all campaigns had found the worst motion after at most {max(last)}, so they "
        "validate no threshold below d\\*. The form of the law was chosen on the first five draws; on the others, the "
        f"medians are {later}. A campaign takes at most {max(seconds):.0f} s of CPU time."
    )


def _arm_causes() -> str:
    rows = [[about, cause(line), repair(line)] for (robot, _, about), line in CAUSES.items() if robot == "SO-101"]
    if not rows:
        return "`ctxval why` did not end within ten minutes for one joint of this arm."
    intro = (
        "`ctxval why` on single joints of the linear model (draw 0), from the four executions of eight in which the "
        "joint is worst."
    )
    return f"{intro}\n\n{table(['joint', 'cause', 'repair, on motions that were not executed'], rows)}"


def _repeats() -> str:
    head = ["condition", *(f"up to {seconds:g} s [rad]" for seconds in SECONDS)]
    rows = []
    for condition, name in double_pendulum.CONDITIONS.items():
        lines = [REPEATS[condition, seconds] for seconds in SECONDS]
        cells = (
            f"{line['largest']:.3f}" + (f" ({line['count']} repeats)" if line["count"] < 10 else "") for line in lines
        )
        rows.append([name, *cells])
    return table(head, rows)


def _against() -> str:
    repeats = {seconds: REPEATS[double_pendulum.UNDISTURBED, seconds]["largest"] for seconds in SECONDS}
    largest = {
        (model, seconds): CAMPAIGNS["double pendulum", model, f"{seconds} s", 1.1]["largest"]
        for model in double_pendulum.PUBLISHED
        for seconds in SECONDS
        if ("double pendulum", model, f"{seconds} s", 1.1) in CAMPAIGNS
    }
    of_first = " and ".join(f"{largest['1.0', s]:.2f} rad up to {s:g} s" for s in SECONDS if ("1.0", s) in largest)
    ratios = {model: value / repeats[seconds] for (model, seconds), value in largest.items() if seconds == SECONDS[-1]}
    others = " and ".join(f"{ratio:.2g} times (model {model})" for model, ratio in ratios.items() if model != "1.0")
    return (
        f"**Model 1.0 errs about as much as the robot differs from itself**: by {of_first}. The largest distance of "
        f"the other published models up to {SECONDS[-1]:g} s is {others} of the largest difference between two repeats."
    )


def _found() -> str:
    told = CAUSES.get(("double pendulum", "1.1", "1.5 s"))
    if told is None or "q2 sticks (0.304 N m). It explains 36 %" not in told["sentence"]:
        return ""
    return (
        "Model 1.1 is model 1.0 without friction and without the inertia of the rotors. `ctxval why` does not name a "
        "cause of its error. What comes nearest explains 36 % of it, a second joint that sticks with 0.304 N m; in "
        "model 1.0, this joint has 0.19 N m of dry friction. The inertia is not found."
    )


def _quantiles() -> str:
    rows = [[f"{n}", f"{100 * 0.05 ** (1 / n):.1f} %", f"{100 * (1 - 0.9**n):.1f} %"] for n in (5, 10, 20, 29, 59)]
    return table(["repeats below", "share, with 95 % confidence", "confidence that 90 % are below"], rows)


def _of_quantiles() -> str:
    models = double_pendulum.PUBLISHED
    low, high = ([QUANTILES[model, 1.5, SHOWN[0], share] for model in models] for share in SHARES)
    less = [QUANTILES[model, 1.5, SHOWN[1], SHARES[1]] for model in models]
    assert [{line["answer"] for line in lines} for lines in (high, less)] == [{"undecided"}, {"validated"}]
    falsified = [
        f"model {line['model']} is falsified after {line['executions']} executions"
        for line in low
        if line["answer"] == "falsified"
    ]
    above = [
        f"{line['above']} of {line['executions']} executions (model {line['model']})"
        for line in low
        if line["answer"] == "undecided"
    ]
    return (
        "As [repeats of a suite](how-to/suites.md#repeats), with undisturbed and perturbed runs as two tasks and ten "
        "recordings of each in turn, all three published models are undecided at 1.1 d\\* for 90 % of the executions "
        "of each task (36 recordings of each would be needed), and validated for 69 %. At 0.9 d\\*, "
        f"{' and '.join(falsified)} for 90 %, while noise may explain {' and '.join(above)} above it."
    )


def _watched() -> str:
    (line,) = WATCHED.values() or [None]
    if line is None:
        return ""
    held, perturbed = (line["alarms"][c] for c in (double_pendulum.UNDISTURBED, double_pendulum.PERTURBED))

    def said(of: dict[str, Any]) -> str:
        alarm = "no alarm" if of["alarm"] is None else f"an alarm at run {of['alarm']}"
        return f"{alarm} of {of['runs']} (evidence {of['evidence']:.2g})"

    false = ""
    if held["alarm"] is not None:
        kept = "not be" if held["evidence"] < 1000 else "also be"
        false = f" The first one is a false alarm; at the usual rate of 1 in 1,000 runs it would {kept} raised."
    return (
        f"**A watch** (`ctxval watch`) over the verdict on model {line['model']} is certified on {CERTIFIED} "
        f"undisturbed repeats up to {line['seconds']:g} s, with false alarms in at most 1 of {1 / FALSE_ALARMS:.0f} "
        f"runs. It raises {said(held)} with undisturbed repeats that were held out, and {said(perturbed)} with "
        f"perturbed ones.{false}"
    )


def main() -> None:
    """Write the page and the cards."""
    page().write()
    CARDS.write_text(json.dumps([each.to_json() for each in all_cards()], indent=1) + "\n")


if __name__ == "__main__":
    main()
