"""Campaigns that are kept whole, so that other code can be asked for the verdicts and choices that were made of them.

``python benchmarks/freeze.py`` runs the campaigns that ``benchmarks/frozen/`` lacks, cheap ones first, and writes each
as compressed JSON: how it was run, its trials with their executed trajectories, and how it ended. Nothing that a store
keeps computed is written. ``frozen_replay.py`` replays them. To replace them is to change the reference: run this with
the code whose behaviour is to be kept.
"""

from __future__ import annotations

import argparse
import functools
import itertools
import json
import lzma
import os
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

import calibrate_noise
import calibrate_outputs
import calibrate_strangers
import dynamics_truths
import strangers_truths
import study_envelope
import study_friction
from calibrate import all_of
from ctxval import Campaign, TaskSuite, Trajectory, Validation, cases, searches
from ctxval._util.arrays import single_threaded
from ctxval.certificates import KINDS, CertificateOptions
from ctxval.errors import CertificateError
from friction_systems import SYSTEMS as FRICTION
from noise_systems import IMPERFECTIONS

FROZEN = Path(__file__).with_name("frozen")
ENDING = ".json.xz"
MOST = {
    "strangers": (320, 1.0),
    "noise": (120, 0.8),
    "friction": (26, 0.15),
    "envelopes": (16, 0.25),
    "outputs": (12, 0.5),
    "paper": (160, 0.8),
}
"""Of each group, how many campaigns are kept, the cheapest, and the weight of their cost in the order of running."""
TRUSTED = 64
"""Random tasks of which it is kept whether an envelope trusts them."""


@dataclass(frozen=True)
class Recipe:
    """How one campaign is run.

    Attributes:
        system: the name of the validation in its group; see :func:`validation_of`.
        share: the threshold as a share of the largest distance that is known; None if there is none.
        steps: calls of :class:`ctxval.Campaign`, each the name of a method with its arguments.
        search, certificate: names with their options; None for the default.
        cost: CPU seconds that it may take, by which campaigns are ordered.
    """

    group: str
    system: str
    seed: int
    share: float | None
    steps: tuple[tuple[str, dict[str, Any]], ...]
    search: dict[str, Any] | None = None
    certificate: dict[str, Any] | None = None
    label: str = ""
    cost: float = field(default=7.0, compare=False)

    @property
    def name(self) -> str:
        """Its name, which is that of its file, too."""
        share = "free" if self.share is None else f"{self.share:g}"
        parts = (self.system.replace("/", ", "), str(self.seed), share, self.label)
        return f"{self.group}/{' '.join(filter(None, parts))}".replace(" %", "%")


# What is validated


def validation_of(group: str, system: str, seed: int) -> Validation:
    """Return the validation of a frozen campaign."""
    if group == "strangers":
        return {**dynamics_truths.ENTRIES, **strangers_truths.ENTRIES}[system](seed).validation
    if group == "friction":
        return FRICTION[system]().validation
    if group == "envelopes":
        return study_envelope.validation_of(system, seed)
    if group == "paper":
        return PAPER[system](seed)
    plant, imperfection = system.split("/")
    if group == "outputs":
        return calibrate_outputs.without_rates(calibrate_outputs.PLANTS[plant], imperfection, seed + 1)
    return calibrate_noise.ALL[plant](imperfection, seed + 1).validation


def _case(name: str, **options: Any) -> Callable[[int], Validation]:
    return lambda seed: cases.by_name(name, seed, **options).validation


def suite_of(validation: Validation, count: int) -> Validation:
    """Return a validation on a suite of tasks, which are spread over its box of numbers."""
    space = validation.space
    points = space.from_unit(np.random.default_rng(3).random((count, space.dimension)))
    tasks = {f"task {k}": {name: float(v) for name, v in space.describe_point(p).items()} for k, p in enumerate(points)}
    return validation.with_parts(space=TaskSuite(tasks))


class Fails:
    """A system whose executions fail in the last share of the range of the first parameter of goals."""

    def __init__(self, system: Any, above: float) -> None:
        self.system, self.above = system, above

    def execute(self, controller: Any, task: Any) -> Trajectory:
        """Run the closed loop, or fail."""
        if task.goal[0] > self.above:
            raise RuntimeError("the motor was too hot")
        return self.system.execute(controller, task)


def _failing(seed: int) -> Validation:
    validation = cases.by_name("pendulum", seed).validation
    return validation.with_parts(system=Fails(validation.system, 0.5))


PAPER: dict[str, Callable[[int], Validation]] = {
    "pendulum": _case("pendulum"),
    "pendulum-biased": _case("pendulum", variant="biased"),
    "pendulum-noisy": _case("pendulum-noisy"),
    "linear-1": _case("linear", dim=1),
    "linear-2": _case("linear", dim=2),
    "linear-5": _case("linear", dim=5),
    "dubins": _case("dubins"),
    "arm": _case("arm", model="linear"),
    "pendulum-fails": _failing,
    "pendulum-suite": lambda seed: suite_of(cases.by_name("pendulum", seed).validation, 14),
    "arm-suite": lambda seed: suite_of(cases.by_name("arm", seed, model="linear").validation, 10),
    "reactor-suite": lambda seed: suite_of(dynamics_truths.ENTRIES["reactor"](seed).validation, 20),
    "castings-physical": lambda seed: strangers_truths.ENTRIES["dull-castings"](seed).validation.with_parts(
        physical=("thickness",)
    ),
    "battery-physical": lambda seed: strangers_truths.ENTRIES["cold-battery"](seed).validation.with_parts(
        physical=("morning",)
    ),
    "shelf-physical": lambda seed: strangers_truths.ENTRIES["shelf-and-size"](seed).validation.with_parts(
        physical=("size",)
    ),
    "surface-physical": lambda seed: strangers_truths.ENTRIES["wet-surface"](seed).validation.with_parts(
        physical=("surface",)
    ),
}
"""The paper's cases, suites, and systems whose task parameters are stated to change the dynamics."""

KNOWN = {"arm": 0.17746, "arm-suite": 0.17746, "pendulum-fails": 0.4}
"""Distances that thresholds are shares of where executions of many tasks would take long, or fail."""


@functools.cache
def largest(group: str, system: str, seed: int) -> float:
    """Return the distance that thresholds of a system are shares of."""
    if group == "strangers":
        module = strangers_truths if system in strangers_truths.ENTRIES else dynamics_truths
        return float(module.TRUTHS[system, seed, module.digest(module.ENTRIES[system].make)]["distance"])
    if group == "noise":
        return float(calibrate_noise.TRUTHS[tuple(system.split("/"))]["distance"])
    if group == "outputs":
        return float(calibrate_outputs.TRUTHS[tuple(system.split("/"))]["distance"])
    if group == "friction":
        return study_friction.truth(system)
    if group == "envelopes":
        lines = study_envelope.STORED.select(system=system, seed=seed)
        return float(lines[-1]["threshold"])
    if system in KNOWN:
        return KNOWN[system]
    validation = PAPER[system](seed)
    space = validation.space
    points = space.from_unit(np.random.default_rng(7).random((1000, space.dimension)))
    distances = validation.distances(points)
    return float(distances[np.isfinite(distances)].max())


# Which campaigns


def recipes() -> list[Recipe]:
    """Return all campaigns, cheap ones first."""
    made = sorted((*_strangers(), *_noise(), *_others(), *_paper()), key=lambda one: one.cost)
    chosen = list[Recipe]()
    for group, (most, _) in MOST.items():
        for above in (False, True):  # d*, so that falsified ones are not all
            of = [one for one in made if one.group == group and ((one.share or 2.0) >= 1.0) == above]
            chosen += of[: most if group in ("paper", "envelopes") else most // 2]
    return sorted(chosen, key=lambda one: (one.cost * MOST[one.group][1], one.name))


def _run(budget: int, **arguments: Any) -> tuple[tuple[str, dict[str, Any]], ...]:
    return (("run", {"budget": budget, **arguments}),)


def _strangers() -> Iterator[Recipe]:
    times: dict[tuple[str, float], float] = {}
    for line in calibrate_strangers.STORED.values():
        times[line["entry"], line["share"]] = line["seconds"] * min(1.0, 12 / line["executions"])
    for module in (strangers_truths, dynamics_truths):
        for name, entry in module.ENTRIES.items():
            below = times.get((name, 0.95), 6.0)
            for seed, share in itertools.product(range(8 if below < 2 else 3), (0.95, 1.25)):
                if (name, seed, module.digest(entry.make)) not in module.TRUTHS or entry.family == "noise":
                    continue
                seconds = below if share < 1 else times.get((name, share), 1.5 * below + 4)
                budget = 25 if seconds < 6 else 10
                if entry.misleading and share > 1:  # it will hardly be decided
                    budget, seconds = 5, 11.0
                yield Recipe("strangers", name, seed, share, _run(budget), cost=seconds + seed)


def _noise() -> Iterator[Recipe]:
    imperfections = [one for one in IMPERFECTIONS if one not in ("delay 3", "delay 1.5")]
    lines = calibrate_noise.STORED.values()
    times = {(line["plant"], line["imperfection"], line["share"]): line["seconds"] for line in lines}
    for plant, imperfection in calibrate_noise.TRUTHS:
        misleading = plant in calibrate_noise.MISLEADING
        if not misleading and imperfection not in imperfections:
            continue
        for seed, share in itertools.product(range(2), (0.95, 1.25)):
            cost = times.get((plant, imperfection, share), 40.0) * (0.6 if share > 1 else 1.0) + 2 * seed
            yield Recipe("noise", f"{plant}/{imperfection}", seed, share, _run(12 if share < 1 else 7), cost=cost)


def _others() -> Iterator[Recipe]:
    times = {(line["system"], line["share"]): line["seconds"] for line in study_friction.STORED.values()}
    for system in FRICTION:
        for share in (0.95, 1.25):
            cost = 0.6 * times.get((system, share), 60.0)
            yield Recipe("friction", system, 0, share, _run(10 if share < 1 else 6), cost=cost)
    envelopes = {(line["system"], line["seed"]): line["seconds"] for line in study_envelope.STORED.values()}
    for (system, seed), seconds in envelopes.items():
        if seed < 2 and system in study_envelope.SYSTEMS:
            yield Recipe("envelopes", system, seed, 1.0, _run(11, envelope=True), cost=0.4 * seconds)
    for line in calibrate_outputs.STORED.select(seed=0):
        if line["seconds"] < 45:
            system = f"{line['plant']}/{line['imperfection']}"
            budget = 14 if line["share"] < 1 else 6
            yield Recipe("outputs", system, 0, line["share"], _run(budget), cost=line["seconds"])


def _paper() -> Iterator[Recipe]:
    for system, most in (("pendulum", 20), ("pendulum-biased", 12), ("linear-1", 20), ("linear-2", 12)):
        for share in (0.9, 1.05, 1.5):
            yield Recipe("paper", system, 0, share, _run(most), cost=5)
        yield Recipe("paper", system, 1, None, _run(12), cost=5)
    for seed, share in itertools.product(range(2, 16), (0.9, 1.2, 1.5)):
        yield Recipe("paper", "linear-1", seed, share, _run(15), cost=3)
        yield Recipe("paper", "linear-2", seed, share, _run(10), cost=4)
    for seed, share in ((0, 1.2), (0, 0.8), (1, 1.5)):
        yield Recipe("paper", "linear-5", seed, share, _run(14), cost=12)
        yield Recipe("paper", "dubins", seed, share, _run(12), cost=20)
        yield Recipe("paper", "arm", seed, share, _run(10), cost=30)
        yield Recipe("paper", "pendulum-noisy", seed, share, _run(12), cost=15)
    for system, most in (("pendulum", 12), ("linear-2", 16)):
        of = {"group": "paper", "system": system}
        yield Recipe(**of, seed=0, share=2.0, steps=_run(20), certificate={"kind": "posterior"}, label="posterior")
        yield Recipe(**of, seed=1, share=1.1, steps=_run(12), certificate={"kind": "posterior"}, label="posterior")
        yield Recipe(**of, seed=0, share=1.5, steps=_run(most), certificate={"kind": "dynamics"}, label="dynamics")
        untested = {"kind": "dynamics", "tests": 0, "confidence": 0.9}
        yield Recipe(**of, seed=1, share=1.2, steps=_run(most), certificate=untested, label="dynamics 0.9")
        audited = {"kind": "anytime", "volume": 0.1}
        yield Recipe(**of, seed=0, share=0.9, steps=_run(40), certificate=audited, label="anytime", cost=6)
        yield Recipe(**of, seed=1, share=1.1, steps=_run(15), certificate=audited, label="anytime", cost=6)
        for search in ("gp-ucb", "cma-es", "random", "trust-region", "auto"):
            options = {"search": {"name": search}, "label": f"explore {search}"}
            yield Recipe(**of, seed=0, share=1.2, steps=_run(14, explore=True), **options, cost=8)
        steps = (*_run(8, explore=True), ("audit", {"draws": 12}))
        scenario = {"kind": "audit", "volume": 0.3}
        yield Recipe(**of, seed=2, share=0.9, steps=steps, certificate=scenario, label="audit", cost=6)
        yield Recipe(**of, seed=2, share=1.2, steps=_run(12), certificate={"kind": "auto", "tests": 3}, label="3 tests")
    yield Recipe("paper", "pendulum", 3, 1.1, _run(12), search={"name": "gp-ucb"}, label="gp-ucb")
    for share in (0.8, 1.2):
        for system in ("pendulum-suite", "reactor-suite", "arm-suite"):
            yield Recipe("paper", system, 0, share, _run(20), cost=12)
        yield Recipe("paper", "pendulum-fails", 0, share, _run(12), cost=8)
        for system in ("castings-physical", "shelf-physical", "surface-physical", "battery-physical"):
            yield Recipe("paper", system, 0, share, _run(12), cost=20)
    for system in ("pendulum-suite", "reactor-suite"):
        steps = _run(12, envelope=True)
        yield Recipe("paper", system, 1, 0.7, steps, label="envelope")


# Running and writing


def options_of(certificate: Mapping[str, Any] | None) -> CertificateOptions | None:
    """Return the options of a certificate from its name and options."""
    if certificate is None:
        return None
    known = dict(certificate)
    further = {name: known.pop(name) for name in ("confidence", "volume") if name in known}
    return CertificateOptions(KINDS.make(known.pop("kind"), **known), **further)


def call(campaign: Campaign, step: Sequence[Any], frozen: Mapping[str, Any], **others: Any) -> None:
    """Call one step of a campaign."""
    method, arguments = step
    if method == "run":
        others |= {"threshold": frozen["threshold"], "certificate": options_of(frozen["certificate"])}
        others |= {"thinking": np.inf}  # results do not depend on the speed of the machine
    getattr(campaign, method)(**arguments, **others)


def search_of(frozen: Mapping[str, Any]) -> Any:
    """Return the search of a campaign; None for the default."""
    if frozen["search"] is None:
        return None
    options = dict(frozen["search"])
    return searches.by_name(options.pop("name"), **options)


def outcome(campaign: Campaign, frozen: Mapping[str, Any]) -> dict[str, Any]:
    """Return how a campaign ended: the verdict, or the bound if there is no threshold, and the envelope."""
    threshold, options = frozen["threshold"], options_of(frozen["certificate"])
    found: dict[str, Any] = {}
    if threshold is None:
        try:
            certificate, found["answer"] = campaign.certify(certificate=options), "certified"
        except CertificateError as error:
            certificate, found["answer"], found["reason"] = None, "refused", str(error)
    else:
        verdict = campaign.verdict(threshold, certificate=options, thinking=np.inf)
        certificate, found["answer"], found["reason"] = verdict.certificate, verdict.answer, verdict.reason
        found["next"] = None if verdict.next_task is None else dict(verdict.next_task)
        found["witness"] = None if verdict.witness is None else verdict.witness.number
    if certificate is not None:
        found |= {"kind": certificate.kind, "bound": certificate.bound, "upper": certificate.upper_bound}
        found |= {"volume": certificate.volume, "withdrawn": certificate.doubt}
    if any(arguments.get("envelope") for _, arguments in frozen["steps"]):
        envelope = campaign.envelope(threshold, thinking=np.inf)
        space = campaign.validation.space
        points = space.from_unit(np.random.default_rng(11).random((TRUSTED, space.dimension)))
        found["envelope"] = {"share": envelope.share, "factor": envelope.factor, "tests": envelope.tests}
        found["envelope"] |= {"margin": envelope.margin, "withdrawn": envelope.doubt}
        found["envelope"]["trusted"] = np.asarray(envelope.trusted(points)).astype(int).tolist()
    plain: dict[str, Any] = json.loads(json.dumps(found, default=float))
    return plain


def frozen_campaign(recipe: Recipe) -> dict[str, Any]:
    """Return a campaign that was run, in plain values."""
    started = time.process_time()
    with single_threaded(), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        threshold = None
        if recipe.share is not None:
            threshold = recipe.share * largest(recipe.group, recipe.system, recipe.seed)
        frozen = {key: value for key, value in asdict(recipe).items() if key != "cost"}
        frozen |= {"name": recipe.name, "threshold": threshold}
        validation = validation_of(recipe.group, recipe.system, recipe.seed)
        campaign, ends = Campaign(validation, search=search_of(frozen), seed=recipe.seed), []
        for step in recipe.steps:
            call(campaign, step, frozen)
            ends.append(len(campaign.trials))
        frozen |= {"ends": ends, "outcome": outcome(campaign, frozen), "draws": campaign.store.draws()}
        frozen["trials"] = [_trial(campaign, trial) for trial in campaign.trials]
    return {**frozen, "seconds": round(time.process_time() - started, 1)}


def _trial(campaign: Campaign, trial: Any) -> dict[str, Any]:
    """Return a trial in plain values, with the trajectory that was executed."""
    executed = campaign.trajectories(trial)[1]
    names = "number origin state parameters attempts executed distance failure note because"
    values = {name: getattr(trial, name) for name in names.split()} | {"note": trial.note.to_json()}
    run = None
    if executed is not None:
        run = {name: getattr(executed, name).tolist() for name in ("times", "states", "inputs")}
        run["ended"] = executed.ended
    return {**values, "point": trial.unit_point.tolist(), "run": run}


def path_of(name: str, folder: Path = FROZEN) -> Path:
    """Return the file of a campaign."""
    return folder / (name.replace(" ", "_").replace(",", "") + ENDING)


def read(path: Path) -> dict[str, Any]:
    """Return a frozen campaign."""
    frozen: dict[str, Any] = json.loads(lzma.decompress(path.read_bytes()))
    return frozen


def write(path: Path, frozen: Mapping[str, Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    whole = path.with_suffix(".part")
    plain = json.dumps(frozen, default=lambda value: value.tolist(), separators=(",", ":"))
    whole.write_bytes(lzma.compress(plain.encode(), preset=9))
    os.replace(whole, path)


def _keep(asked: tuple[Recipe, Path]) -> dict[str, Any]:
    recipe, folder = asked
    try:
        frozen = frozen_campaign(recipe)
    except Exception as error:  # one that cannot be run must not end the others
        return {"name": recipe.name, "error": f"{type(error).__name__}: {error}"}
    write(path_of(recipe.name, folder), frozen)
    ended = frozen["outcome"]
    return {"name": recipe.name, "answer": ended["answer"], "bound": ended.get("bound"), "seconds": frozen["seconds"]}


def main() -> None:
    """Run the campaigns that are missing."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=FROZEN)
    parser.add_argument("--most", type=int, default=10**6, help="how many campaigns are run at most")
    parser.add_argument("--cost", type=float, default=np.inf, help="leave out those that may take more CPU seconds")
    parser.add_argument("--groups", nargs="*")
    parser.add_argument("--only", help="a part of the name")
    parser.add_argument("--workers", type=int, default=2)
    given = parser.parse_args()
    wanted = [one for one in recipes() if one.cost <= given.cost and (not given.groups or one.group in given.groups)]
    wanted = [one for one in wanted if given.only is None or given.only in one.name]
    missing = [(one, given.out) for one in wanted if not path_of(one.name, given.out).exists()][: given.most]
    print(len(wanted), "campaigns,", len(missing), "missing", flush=True)
    for result in all_of(_keep, missing, given.workers):
        print(*result.values(), flush=True)


if __name__ == "__main__":
    main()
