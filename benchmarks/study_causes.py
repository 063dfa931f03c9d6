"""Seeded faults on robots: does ``find_causes`` name the right one, with the right size, from five executions?

``python benchmarks/study_causes.py development`` runs what is not stored yet, and prints each result.
"""

from __future__ import annotations

import argparse
import time
import warnings
from typing import Any

import numpy as np

from calibrate import RESULTS
from causes_robots import DEVELOPMENT, REPORTING
from causes_systems import Fault, Robot, faults_of, foreign_of
from ctxval import Campaign, searches
from ctxval.errors import InputError
from ctxval.learning import effects
from ctxval.learning.effects import Effect
from ctxval.studies.causes import find_causes
from json_lines import JsonLines

RULE = 5
"""The number of the rule by which causes are found and named, and of the way in which faults are simulated.

1: the first one. 2: noise is simulated in closed loops; robots of MuJoCo have the time step of their models; 98 %
instead of 95 %. 3: deviations that are less than noise no longer exclude a cause, and residuals are compared over more
steps. 4: the steps before a failure count; executions that M predicts from where they began need no cause.
5: if no cause counts, the one that explains most is said, although the largest distance does not fall.
"""
ROBOTS = {"development": DEVELOPMENT, "reporting": REPORTING}
COUNTS = {"development": 20, "reporting": 10}
"""Seeded faults of a robot, beside 4 foreign ones; of development robots, all kinds that they can have."""
EXECUTIONS, NOISES = 5, (0.0, 1e-3)
STORED = JsonLines(RESULTS / "causes.jsonl", ("rule", "robot", "fault", "noise"))
SERVO = JsonLines(RESULTS / "causes_servo.jsonl", ("rule", "seed"))
SEEDS = 2
_RATIOS = ("input gain", "sensor scale", "time step", "gravity", "mass")


def faults(robot: Robot, of: str) -> list[Fault]:
    """Return the faults of a robot, with those that are foreign."""
    return [*faults_of(robot, COUNTS[of]), *foreign_of(robot)]


def is_right(robot: Robot, fault: Fault, cause: Effect) -> bool:
    """Return whether a cause is the fault, at its place."""
    place, compiled = fault.place, getattr(robot.model, "compiled", None)
    joints = robot.joints if compiled is None else compiled.nq
    attributes = {"viscous friction": "damping", "Coulomb friction": "frictionloss", "armature": "armature"}
    if isinstance(cause, effects.JointAttribute):
        return attributes.get(fault.kind) == cause.attribute and cause.joint.dof == place
    weight = robot.constant_weight(place) if fault.kind == "gravity" else None
    if weight is not None and isinstance(cause, effects.Bias):  # this is the same
        return cause.joint.rate == joints + place and cause.joint.input is None
    if cause.name != fault.kind:
        return False
    if isinstance(cause, effects.BodyMass):
        return cause.body == place
    if isinstance(cause, effects.SensorOffset):
        return cause.state == place
    if isinstance(cause, effects.SensorScale):
        return cause.states[0] == place
    if isinstance(cause, effects.Gravity):  # that of the whole robot
        return {joints + j for j in robot.weights} <= {joint.rate for joint in cause.joints}
    if hasattr(cause, "joint"):
        driven = cause.joint.input is None or robot.driven[cause.joint.input] == place
        return bool(cause.joint.rate == joints + place and driven)
    return getattr(cause, "input", place) == place


def size_error(robot: Robot, fault: Fault, cause: Effect) -> float | None:
    """Return the largest relative error of a size; of ratios, that of their difference from 1."""
    weight = robot.constant_weight(fault.place) if fault.kind == "gravity" else None
    if weight is not None and isinstance(cause, effects.Bias):
        return abs(cause.sizes[0] / (weight * (fault.sizes[0] - 1)) - 1)
    if not fault.sizes:
        return 0.0
    shift = 1.0 if fault.kind in _RATIOS else 0.0
    found, true = np.array(cause.sizes) - shift, np.array(fault.sizes) - shift
    return float(np.max(np.abs(found - true) / np.abs(true)))


def measured(robot: Robot, fault: Fault, noise: float) -> dict[str, Any]:
    """Return what is stored of a fault."""
    validation = robot.experiment(fault, noise, 0).validation
    campaign = Campaign(validation, search=searches.by_name("random"), seed=0).run(EXECUTIONS)
    started = time.process_time()
    known = {"place": fault.place, "sizes": list(fault.sizes), "foreign": fault.foreign}
    try:
        report = find_causes(campaign, thinking=np.inf)
    except InputError as error:  # the robot fell in all tasks, so nothing is recorded
        failed = {"named": False, "rank": None, "in_group": False, "size_error": None, "sentence": str(error)}
        return {**known, "executions": len(campaign.completed), **failed, "seconds": 0.0}
    listed = [each.causes for each in report.explained]
    listed += [each.repaired.effects for each in report.ranked]
    distinct = list(dict.fromkeys(tuple(cause.with_sizes(()) for cause in each) for each in listed))
    places = [k for k, each in enumerate(distinct) if any(is_right(robot, fault, cause) for cause in each)]
    right = [cause for each in report.explained for cause in each.causes if is_right(robot, fault, cause)]
    return {
        **known,
        "executions": len(campaign.completed),
        "named": report.named,
        "causes": [[type(cause).__name__, list(cause.sizes)] for cause in report.causes],
        "alike": len(report.explained),
        "rank": places[0] + 1 if places else None,
        "in_group": bool(right),
        "size_error": size_error(robot, fault, right[0]) if right else None,
        "share": report.explained[0].share if report.explained else None,
        "structure": report.explained[0].structure if report.explained else None,
        "uncertainty": report.explained[0].uncertainty if report.explained else None,
        "uncertain_structure": report.explained[0].uncertain_structure if report.explained else None,
        "before": report.before,
        "after": report.after,
        "sentence": report.sentence,
        "seconds": round(time.process_time() - started, 1),
    }


def on_servo(seed: int) -> dict[str, Any]:
    """Return what is found in five recordings of the real servo with the model m1."""
    from study_servo import validation

    campaign = Campaign(validation("m1"), search=searches.by_name("random"), seed=seed).run(EXECUTIONS)
    report = find_causes(campaign, thinking=np.inf)
    first = report.explained[0] if report.explained else None
    return {
        "rule": RULE,
        "seed": seed,
        "first": type(report.ranked[0].repaired.effects[0]).__name__,
        "sizes": list(report.ranked[0].repaired.effects[0].sizes),
        "named": report.named,
        "share": first.share if first else 0.0,
        "sentence": report.sentence,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("robots", choices=("development", "reporting", "servo"))
    parser.add_argument("--only", nargs="*", help="names of robots")
    parser.add_argument("--faults", nargs="*", help="kinds of faults")
    parser.add_argument("--noise", nargs="*", type=float, default=NOISES, help="in shares of ranges")
    arguments = parser.parse_args()
    if arguments.robots == "servo":
        from study_servo import require_recordings

        require_recordings()
        for seed in range(SEEDS):
            if (RULE, seed) not in SERVO:
                SERVO.append(on_servo(seed))
                print(SERVO[RULE, seed], flush=True)
        return
    robots = ROBOTS[arguments.robots]
    warnings.simplefilter("ignore")  # that a fault keeps the robot from its goal
    for noise in arguments.noise:
        for name, robot in robots.items():
            if arguments.only and name not in arguments.only:
                continue
            for fault in faults(robot, arguments.robots):
                if (RULE, name, fault.kind, noise) in STORED or fault.kind not in (arguments.faults or [fault.kind]):
                    continue
                key = {"rule": RULE, "robot": name, "of": arguments.robots, "fault": fault.kind, "noise": noise}
                STORED.append({**key, **measured(robot, fault, noise)})
                known = STORED[RULE, name, fault.kind, noise]
                verdict = "right" if known["rank"] == 1 and known["named"] else ""
                print(name, fault.kind, fault.sizes, noise, verdict, known["rank"], known["size_error"], flush=True)
                print("    ", known["seconds"], known.get("structure"), known["sentence"], flush=True)


if __name__ == "__main__":
    main()
