"""Verdicts and causes for the robots of ``simulated_robots.py``, against the truth by brute force.

``python benchmarks/study_simulated_robots.py --seeds 2`` runs what ``results/simulated_robots.jsonl`` does not have
yet, and writes ``docs/simulated-robots.md``. Each threshold is a share of d*, or of the distance that 99 % of the tasks
stay below if the check before the first execution finds that closed loops of M are not smooth. d* is the largest
distance of random tasks and of 900 near the largest ones. A cell of more than ``--limit`` seconds of CPU time is stored
as "not ended"; ``--again`` runs those again. Needs the extras ``mujoco``, ``pybullet`` and ``onnx``.
"""

from __future__ import annotations

import argparse
import signal
import time
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from ctxval import Campaign, Validation, searches
from ctxval.campaign.dynamics import SensitivityWarning
from ctxval.learning.closed_loops import LoopPlanner
from ctxval.learning.sensitivity import found_sensitivity
from ctxval.learning.stage_costs import Speed, Thinking, ThinkingSettings
from ctxval.studies.causes import find_causes
from json_lines import JsonLines
from page_tables import GeneratedPage, reflowed, table
from simulated_robots import ROBOTS, MissingFileError, Table

STORED = JsonLines(
    Path(__file__).parent / "results" / "simulated_robots.jsonl", ("robot", "system", "question", "seed")
)
SHARE, FACTORS, BUDGET, EXECUTIONS, STAR = 0.99, (0.95, 1.25), 25, 6, r"d\*"
TEXT = """# Robots in simulators

`make simulated-robots` makes this page from stored campaigns. M is a simulator with a few uncertain parameters, S the
same simulator with other ones (*inside* the family), or with something that no parameter of M is. The largest distance
d\\* is the target. Where the check before the first execution finds that closed loops of M are not smooth, as with most
contacts, it is q, the distance that [99 % of the tasks](how-to/share.md) stay below. Both are known by brute force,
with {tasks}. Validations at 0.95 are false, falsifications at 1.25, too. Campaigns had at most {budget} executions.

{summary}

## Verdicts

Answers have their numbers of executions in brackets, one for each seed; a bound is a multiple of d\\* or of q.

{table}

## Causes

`ctxval why` after {executions} random executions. True changes are factors; friction in joints is in N m, a slope in
m/s^2 and a latency in steps.

{causes}

## Robots

{robots}

Rules of the source were changed after results on {tuned}; the others report.
"""


class NotEnded(BaseException):
    """A cell took too long; users' parts and the package catch no such exception."""


@contextmanager
def at_most(seconds: float) -> Iterator[None]:
    """Raise :class:`NotEnded` after so many seconds of CPU time, which other processes on a machine do not change."""

    def end(*_: object) -> None:
        raise NotEnded

    signal.signal(signal.SIGPROF, end)
    signal.setitimer(signal.ITIMER_PROF, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)


def refined(validation: Validation, points: np.ndarray, values: np.ndarray) -> float:
    """Return d* by random tasks and by tasks near the largest ones."""
    rng, space = np.random.default_rng(99), validation.space
    for near in (0.1, 0.04, 0.02):
        moves = near * rng.normal(size=(12, 25, space.dimension))
        more = np.clip(points[np.argsort(-values)[:12], None] + moves, 0, 1).reshape(-1, space.dimension)
        of_more = np.nan_to_num(validation.distances(space.from_unit(more)))
        points, values = np.concatenate([points, more]), np.concatenate([values, of_more])
    return float(values.max())


def truth_of(robot: str, system: str, results: JsonLines = STORED) -> Mapping[str, Any]:
    """Return what is true of a robot with a system: the target, and a share of random tasks above each threshold."""
    key = (robot, system, "truth", -1)
    if key not in results:
        validation, count, begun = ROBOTS[robot].make(ROBOTS[robot].systems[system]), ROBOTS[robot].tasks, time.time()
        points = np.random.default_rng(99).random((count, validation.space.dimension))
        values = np.nan_to_num(validation.distances(validation.space.from_unit(points)))
        quantile = float(np.quantile(values, SHARE, method="higher"))
        speed = Speed.measured(validation, points[:16], ThinkingSettings())
        assert speed is not None, "no task can be planned"
        planner = LoopPlanner(validation)
        sensitivity = found_sensitivity(planner, Thinking(np.inf, np.inf, speed), FACTORS[1] * quantile)
        smooth = sensitivity is None
        target = refined(validation, points, values) if smooth else quantile
        record = {
            "largest": float(values.max()), "quantile": quantile, "share": 1.0 if smooth else SHARE, "target": target,
            "spike": None if sensitivity is None else sensitivity.largest,
            "above": [float((values > factor * target).mean()) for factor in FACTORS], "seconds": time.time() - begun,
        }  # fmt: skip
        results.append(dict(zip(results.key, key, strict=True)) | record)
    return results[key]


def judged(robot: str, system: str, factor: float, seed: int, limit: float) -> dict[str, Any]:
    """Return how a campaign ended."""
    truth, begun = truth_of(robot, system), time.process_time()
    threshold, share = factor * truth["target"], truth["share"]
    campaign = Campaign(ROBOTS[robot].make(ROBOTS[robot].systems[system]), seed=seed)
    answer, bound, reason, values = "not ended", None, "", {}
    try:
        with at_most(limit):
            campaign.run(BUDGET, threshold=threshold, share=share)
            verdict = campaign.verdict(threshold, share=share)
            answer, reason = verdict.answer, verdict.reason
            if verdict.certificate is not None:
                bound = verdict.certificate.upper_bound / truth["target"]
                values = verdict.certificate.details.get("parameters") or {}
    except NotEnded:
        pass
    count = campaign.executions
    best = max((trial.distance or 0.0 for trial in campaign.trials), default=0.0)
    return {
        "answer": answer, "share": share, "executions": count, "best": best / truth["target"], "bound": bound,
        "cpu": (time.process_time() - begun) / max(count, 1), "parameters": values, "reason": reason[:600],
    }  # fmt: skip


def explained(robot: str, system: str, seed: int, limit: float) -> dict[str, Any]:
    """Return the causes that are found after a few random executions."""
    changes, begun = ROBOTS[robot].systems[system], time.process_time()
    campaign = Campaign(ROBOTS[robot].make(changes), search=searches.by_name("random"), seed=seed)
    try:
        with at_most(limit):
            report = find_causes(campaign.run(EXECUTIONS), most=len(changes) or 2, thinking=np.inf)
    except NotEnded:
        return {"answer": "not ended", "causes": [], "cpu": time.process_time() - begun}
    first = report.explained[0] if report.explained else None
    named = [] if first is None else [[each.sentence(report.plant), list(each.sizes)] for each in first.causes]
    answer = "none" if first is None else "named" if report.named else "nearest"
    share = 0.0 if first is None else first.share
    cpu = time.process_time() - begun
    return {"answer": answer, "causes": named, "share": share, "sentence": report.sentence[:600], "cpu": cpu}


def cells(robots: list[str], seeds: int) -> Iterator[tuple[str, str, float | str, int]]:
    """Return the cells in the order of their worth."""
    for seed in range(seeds):
        for outside in (False, True):
            for robot in robots:
                for system in ROBOTS[robot].outside if outside else ("inside",):
                    for question in (*FACTORS, "why") if outside and not seed else FACTORS:
                        yield robot, system, question, seed


def main() -> None:
    """Run the missing cells, and write the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--robots", nargs="*", default=list(ROBOTS))
    parser.add_argument("--limit", type=float, default=400.0)
    parser.add_argument("--questions", nargs="*", default=[*map(str, FACTORS), "why"])
    parser.add_argument("--again", action="store_true", help="run cells again that did not end")
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    warnings.simplefilter("ignore", SensitivityWarning)
    for robot, system, question, seed in cells(options.robots, options.seeds):
        known = STORED.get((robot, system, question, seed))
        again = known is None or (options.again and known["answer"] == "not ended")
        if not again or str(question) not in options.questions:
            continue
        try:
            ended = (
                explained(robot, system, seed, options.limit)
                if isinstance(question, str)
                else judged(robot, system, question, seed, options.limit)
            )
        except MissingFileError as reason:
            print(f"{robot} is skipped: {reason}")
            continue
        STORED.append({"robot": robot, "system": system, "question": question, "seed": seed} | ended)
        print(robot, system, question, seed, ended, flush=True)
    page().write()


# The page


def page(results: JsonLines = STORED) -> GeneratedPage:
    """Return the page of the stored campaigns."""
    rows, causes = [], []
    for robot, about in ROBOTS.items():
        for system, changes in about.systems.items():
            truths = results.select(robot=robot, system=system, question="truth")
            target = "not run"
            if truths:
                target = f"{STAR if truths[0]['share'] == 1 else 'q'} = {truths[0]['target']:.3g}"
            cells, bounds, cpu = [robot, system, target], list[str](), list[float]()
            for factor in FACTORS:
                campaigns = results.select(robot=robot, system=system, question=factor)
                cells.append(", ".join(f"{each['answer']} ({each['executions']})" for each in campaigns) or "not run")
                cpu += [each["cpu"] for each in campaigns]
                bounds += [f"{each['bound']:.2f}" for each in campaigns if each["answer"] == "validated"]
            rows.append([*cells, ", ".join(bounds) or "-", f"{np.median(cpu):.1f}" if cpu else "-"])
            for each in results.select(robot=robot, system=system, question="why"):
                found = "; ".join(sentence for sentence, _ in each["causes"]) or "-"
                share = f"{100 * each.get('share', 0.0):.3g} %"
                causes.append([robot, _changes(changes), each["answer"], found, share, f"{each['cpu']:.0f}"])
    campaigns = [each for factor in FACTORS for each in results.select(question=factor)]
    counts = [about.tasks for about in ROBOTS.values()]
    text = TEXT.format(
        tasks=f"{min(counts):,} to {max(counts):,} random tasks", budget=BUDGET,
        executions=EXECUTIONS, summary=_summary(campaigns),
        table=table(("robot", "S", "target", *(f"at {factor:g}" for factor in FACTORS), "bound", "CPU s"), rows),
        causes=table(("robot", "true changes", "answer", "found", "explained", "CPU s"), causes),
        robots="\n".join(f"- `{robot}`: {about.title}" for robot, about in ROBOTS.items()),
        tuned=", ".join(f"`{robot}`" for robot, about in ROBOTS.items() if about.tuned),
    )  # fmt: skip
    return GeneratedPage("simulated-robots.md", reflowed(text))


def _summary(campaigns: list[Mapping[str, Any]]) -> str:
    rows = []
    for name, tuned in (("changed after results on them", True), ("others", False)):
        mine = [each for each in campaigns if ROBOTS[each["robot"]].tuned == tuned]
        below, above = ([each for each in mine if each["question"] == factor] for factor in FACTORS)
        if not mine:
            continue
        false = [each for each in below if each["answer"] == "validated"]
        # Of a largest distance, it is an executed fact that brute force did not find.
        false += [each for each in above if each["answer"] == "falsified" and each["share"] < 1]
        decided = [each for each in above if each["answer"] in ("validated", "falsified") and each["executions"] <= 20]
        counts = f"{len(false)} of {len(mine)}", f"{len(decided)} of {len(above)}"
        executions = f"{np.median([each['executions'] for each in above]):g}" if above else "-"
        open_ones = sum(each["answer"] == "not ended" for each in mine)
        slowest = f"{max(each['cpu'] for each in mine):.0f}"
        rows.append([name, *counts, executions, str(open_ones), slowest])
    header = ("rules", "false", "decided at 1.25 within 20", "median executions there", "not ended", "most CPU s")
    return table(header, rows)


def _changes(changes: Table) -> str:
    return ", ".join(f"{name} {value:g}" for name, value in changes.items()) or "another engine"


if __name__ == "__main__":
    main()
