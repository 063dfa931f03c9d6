"""The gate: checks that withdraw a bound from learned dynamics, or ask for an execution, in one table.

A bound holds only if the prior on the dynamics is right, so checks that do not believe the prior look at the evidence.
The first open check of the table withdraws the bound, and the first one with a remedy chooses the next task. A new
check is an entry of :data:`CHECKS` with a measure. The stage of a check says what it is about:

- ``learning``: whether enough is known to bound d* at all;
- ``coverage``: whether the records cover the states, inputs and tasks that predicted runs visit;
- ``tested``: whether predictions held where distances are large;
- ``tests``: whether they held at drawn tasks;
- ``explained``: whether the final law explains all executions;
- ``search``: whether the largest distance was found;
- ``support``: whether executions speak for the threshold;
- ``bound``: whether the bound exceeds the threshold, which withdraws nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from ctxval._util.arrays import Array
from ctxval.certificates.bounds import radius_of, with_units
from ctxval.certificates.evidence import Evidence
from ctxval.certificates.explained import evidence_against, least_explained, support_of
from ctxval.certificates.predictions import missing_tests
from ctxval.certificates.sample import SAME
from ctxval.certificates.sentences import withdrawals as sentences
from ctxval.core.coverage import StateInputGap
from ctxval.core.target import Quantile

Stage = Literal["learning", "coverage", "tested", "tests", "explained", "search", "support", "bound"]


@dataclass(frozen=True)
class Gap:
    """How much evidence is measured to lack: above its limit, a check is open."""

    size: float  #: compared with the limit
    values: Mapping[str, Any] = field(default_factory=dict)  #: the numbers and names of the sentence
    limit: float | None = None  #: the limit, if it depends on the evidence


@dataclass(frozen=True, eq=False)
class Remedy:
    """Executions that close a check."""

    tasks: tuple[Array, ...] = ()  #: tasks ``(m, d)`` in the order of preference, each the first that is new
    #: whether the first new task is executed, the first one again, or a task that is drawn, from all or from those
    #: whose predicted distances exceed the threshold
    kind: Literal["new", "again", "drawn", "drawn above"] = "new"


@dataclass(frozen=True, eq=False)
class Check:
    """One check of the evidence."""

    code: str  #: its name in JSON, reports and the documentation
    stage: Stage
    limit: str | float  #: the largest size of a gap that passes, or its name in :class:`CheckLimits`
    measure: Callable[[Evidence], Gap | None]  #: the gap; None if the check does not apply
    sentence: str  #: why the bound is withdrawn and what would help, with places for the values of the gap
    reason: str  #: why the limit is what it is, for the documentation
    #: what to execute, given the number of known tasks; None if no single execution closes it
    remedy: Callable[[Evidence, int], Remedy] | None = None

    def opened(self, evidence: Evidence) -> Open | None:
        """Return the gap above the limit; None if the check is passed."""
        gap = self.measure(evidence)
        if gap is None:
            return None
        stated = getattr(evidence.limits, self.limit) if isinstance(self.limit, str) else self.limit
        gap = gap if gap.limit is not None else replace(gap, limit=float(stated))
        return Open(self, gap) if gap.size > (gap.limit or 0.0) else None


@dataclass(frozen=True)
class Open:
    """A check that the evidence does not pass."""

    check: Check
    gap: Gap

    @property
    def code(self) -> str:
        """The code of the check."""
        return self.check.code

    def __str__(self) -> str:
        return self.check.sentence.format(**self.gap.values)

    def to_json(self) -> dict[str, Any]:
        """Return the code, the stage, the size of the gap and its limit."""
        return {"code": self.code, "stage": self.check.stage, "size": self.gap.size, "limit": self.gap.limit}


# Measures: learning


def _few_executions(evidence: Evidence) -> Gap:
    fewest = evidence.limits.fewest
    return Gap(fewest - evidence.executions, {"executions": evidence.executions, "fewest": fewest})


def _few_predictions(evidence: Evidence) -> Gap:
    checked, needed = len(evidence.counted()), evidence.limits.predictions
    return Gap(needed - checked, {"checked": checked, "needed": needed})


def _noisy(evidence: Evidence) -> Gap:
    return Gap(evidence.noise, {"percent": 100 * evidence.noise, "most": 100 * evidence.limits.noise})


def _noise_contradicted(evidence: Evidence) -> Gap:
    # Each prediction of a noisy system has p-values of the distance and of statistics of the trajectory. The mean of
    # p^-1/2 / 2 over them is an e-value (Vovk and Wang 2021), and so is the product: if predictions are right, it is
    # large with a small probability only.
    against = 1.0
    for prediction in [each for each in evidence.predictions if each.is_noisy][-evidence.limits.e_value_of :]:
        p = np.array([prediction.chance_of_more(prediction.distance), *prediction.p_values])
        against *= float((0.5 / np.sqrt(p)).mean())
    return Gap(against, {"against": against, "most": evidence.limits.e_value})


# Measures: coverage


def _gap(gap: StateInputGap | None, evidence: Evidence) -> Gap | None:
    # Executions cannot cover many coordinates, and parameters of M hold beyond the records.
    if gap is None or evidence.holds_beyond_records:
        return None
    coordinates, place = " and ".join(gap.coordinates), with_units(gap.place)
    return Gap(gap.size, {"coordinates": coordinates, "percent": 100 * gap.size, "place": place})


def _beyond(evidence: Evidence) -> Gap | None:
    beyond = _gap(evidence.coverage.beyond, evidence)
    if beyond is None or beyond.size > evidence.limits.diverged:
        return None
    return replace(beyond, limit=evidence.most_beyond)


def _unsampled_parameter(evidence: Evidence) -> Gap | None:
    parameter = evidence.unsampled_parameter
    if parameter is None:
        return None
    return Gap(parameter.gap, {"name": parameter.name, "percent": 100 * parameter.gap})


def _unsampled_corner(evidence: Evidence) -> Gap | None:
    corner = evidence.unsampled_corner
    return (
        None
        if corner is None or evidence.holds_beyond_records
        else Gap(corner.gap, {"place": with_units(corner.place)})
    )


def _unvisited_region(evidence: Evidence) -> Gap | None:
    region = evidence.unvisited_region
    if region is None or not region.tasks or evidence.holds_beyond_records:
        return None
    return Gap(region.size, {"within": radius_of(region.within), "place": with_units(region.place)})


# Measures: predictions that were tested


def _not_tested(evidence: Evidence) -> Gap | None:
    if evidence.negligible:
        return None  # no distance is large
    highest = evidence.target.testable(evidence.highest, evidence.maxima)
    return Gap(evidence.limits.tested * highest - evidence.best, {"highest": evidence.highest, "best": evidence.best})


def _none_held(evidence: Evidence) -> Gap | None:
    if evidence.negligible:
        return None
    size, what = evidence.target.large(evidence.bound, evidence.highest)
    large = [each for each in evidence.counted() if each.distance >= evidence.limits.matters * size]
    held = sum(each.held(evidence.raised, evidence.limits) for each in large)
    return Gap(1 - held, {"percent": 100 * evidence.limits.matters, "what": what})


def _tests_missing(evidence: Evidence) -> Gap:
    missing = missing_tests(evidence.predictions, evidence.tests, evidence.limits)
    return Gap(missing, {"missing": missing, "executions": "execution" if missing == 1 else "executions"})


# Measures: what the final law explains


def _unexplained(evidence: Evidence) -> Gap | None:
    silent = [each for each in evidence.executed if not each.quantiles]
    farthest = max(silent, key=lambda each: abs(each.distance - each.expected), default=None)
    if farthest is None or abs(farthest.distance - farthest.expected) <= evidence.negligible:
        return None
    return Gap(abs(farthest.distance - farthest.expected), vars(farthest), evidence.limits.error * evidence.bound)


def _contradicted(evidence: Evidence) -> Gap | None:
    against, least = evidence_against(evidence.executed), least_explained(evidence.executed)
    if least is None:
        return None
    values = {"against": against, "most": evidence.limits.contradicted, "trial": least.trial, "p": least.p_value}
    return Gap(against, values)


def _drift(evidence: Evidence) -> Gap | None:
    if evidence.drift is None:
        return None
    cause, p = evidence.drift
    return Gap(1 - p, {"cause": cause, "p": p}, 1 - evidence.limits.drifting)


def _unsupported(evidence: Evidence) -> Gap | None:
    if not isinstance(evidence.target, Quantile):
        return None
    level, quantile = evidence.raised if evidence.threshold is None else evidence.threshold, evidence.target.quantile
    executions = len(evidence.executed)
    ratio = support_of(evidence.executed, level, evidence.bound, quantile)
    above = sum(each.distance > level for each in evidence.executed)
    share = 100 * (1 - quantile)
    values = {"above": above, "executions": executions, "level": level, "ratio": ratio, "share": share}
    return Gap(-ratio, values, -evidence.limits.supported)


def _untested_rest(evidence: Evidence) -> Gap | None:
    rest = evidence.untested_rest
    if rest is None or rest.highest <= (evidence.raised if evidence.threshold is None else evidence.threshold):
        return None
    values = {"place": with_units(rest.place), "length": radius_of(dict.fromkeys(rest.place, rest.length))}
    return Gap(rest.size, {**values, "times": rest.times, "highest": rest.highest})


# Measures: the search


def _needle(evidence: Evidence) -> Gap | None:
    # Draws with rests have no sharp peaks that all share.
    unknown = evidence.low_dimensional or evidence.scatter > 0
    return None if unknown else Gap(evidence.peak_ratio, {"percent": 100 * evidence.peak_ratio})


def _jump(evidence: Evidence) -> Gap | None:
    share = evidence.jump / evidence.bound if evidence.jump else 0.0
    return None if evidence.low_dimensional or evidence.scatter > 0 else Gap(share, {"percent": 100 * share})


def _searches_differ(evidence: Evidence) -> Gap:
    share = max(evidence.search_shortfall - 1, evidence.disagreement)
    return Gap(share, {"percent": 100 * share})


# Measures: the bound and the threshold, which must both be known


def _above(size: float, evidence: Evidence) -> Gap | None:
    """Return the gap of a distance above the threshold; None if there is no threshold."""
    return None if evidence.threshold is None else Gap(size, limit=evidence.threshold)


def _unexplained_test(evidence: Evidence) -> Gap | None:
    return None if _failed_test(evidence) is None else _above(evidence.raised, evidence)


def _failed_test(evidence: Evidence) -> tuple[float, ...] | None:
    """Return the task of the last test that failed and that the final law does not explain; None if there is none."""
    for test in reversed(evidence.predictions):
        unknown = test.is_noisy or test.explained is None or not evidence.explains(test)
        if test.is_test and not evidence.holds(test, evidence.best) and unknown:
            return test.point
    return None


def _exceeds(evidence: Evidence) -> Gap | None:
    return _above(max(evidence.upper * evidence.search_shortfall, evidence.highest), evidence)


# Remedies


def _draws(evidence: Evidence) -> Array:
    """Return the tasks of the draws' largest distances: first that of the draw that sets the bound, then lower ones.

    With dry friction, the draw whose distance nears the threshold with the least comes first: an execution at the least
    friction at rest that nears it rules out all larger ones.
    """
    order, rank = np.argsort(evidence.maxima, kind="stable"), evidence.rank
    if evidence.friction and evidence.threshold is not None:
        near = evidence.best + evidence.limits.near * (evidence.threshold - evidence.best)
        first = int(np.searchsorted(evidence.maxima[order], near, side="right"))
        return evidence.points[[*order[first:], *order[:first][::-1]]]
    return evidence.points[[*order[rank::-1], *order[:rank:-1]]]


def _farthest(evidence: Evidence) -> Array:
    return evidence.coverage.task[None]


def _at_the_bound(evidence: Evidence, known: int) -> Remedy:
    """Return a task whose distance may exceed the threshold, or every third time one that leads beyond the records."""
    if evidence.target.share < 1 and evidence.highest > (evidence.threshold or np.inf):
        return Remedy(kind="drawn above")  # such draws prove what share of the tasks exceeds it
    exceeds = evidence.threshold is not None and evidence.upper > evidence.threshold
    # Friction is known where records are dense.
    if exceeds and known % 3 == 2 and (not evidence.friction or is_open(evidence, "coverage")):
        return Remedy((_farthest(evidence), _draws(evidence)))
    if exceeds and evidence.highest <= (evidence.threshold or 0.0) and evidence.search_shortfall <= 1:
        return Remedy((_draws(evidence), _farthest(evidence)))
    return _at_the_largest(evidence, known)


def _at_the_largest(evidence: Evidence, known: int) -> Remedy:
    return Remedy((evidence.local_maxima, _draws(evidence), _farthest(evidence)))


def _beyond_the_records(evidence: Evidence, known: int, *first: Array) -> Remedy:
    return Remedy((*first, _farthest(evidence), _draws(evidence), evidence.local_maxima))


def _at_the_parameter(evidence: Evidence, known: int) -> Remedy:
    parameter = evidence.unsampled_parameter
    return _beyond_the_records(evidence, known, *([] if parameter is None else [parameter.task[None]]))


def _at_the_corner(evidence: Evidence, known: int) -> Remedy:
    corner = evidence.unsampled_corner
    return _beyond_the_records(evidence, known, *([] if corner is None else [corner.task[None]]))


def _in_the_region(evidence: Evidence, known: int) -> Remedy:
    region = evidence.unvisited_region
    return _beyond_the_records(evidence, known, *([] if region is None else [np.array(region.tasks)]))


def _in_the_stretch(evidence: Evidence, known: int) -> Remedy:
    rest = evidence.untested_rest
    tasks = [] if rest is None or not rest.tasks else [np.array(rest.tasks)]
    return Remedy((*tasks, *in_turn(evidence, known).tasks))


def in_turn(evidence: Evidence, known: int) -> Remedy:
    """Return further tests of the predictions: where a draw is largest and far from the records, in turn.

    While no prediction held at a distance that matters to the threshold, the largest predicted distance comes first.
    """
    threshold, limits = evidence.threshold, evidence.limits
    if threshold is not None and not evidence.target.is_noisy and not evidence.negligible:
        large = (each for each in evidence.counted(threshold) if each.distance >= limits.matters * threshold)
        if not any(each.held(threshold, limits) for each in large):
            return _at_the_largest(evidence, known)
    draws, farthest = _draws(evidence), _farthest(evidence)
    return Remedy((draws, farthest) if known % 2 else (farthest, draws))


def _drawn(evidence: Evidence, known: int) -> Remedy:
    """Return a drawn task, once enough is learned for predictions of it to be tests."""
    return in_turn(evidence, known) if evidence.executions < evidence.limits.fewest else Remedy(kind="drawn")


def _past_a_failed_prediction(evidence: Evidence, known: int) -> Remedy:
    """Return further tests if an earlier one is all that raises the bound: later tests outlive it."""
    worst = evidence.failed
    if worst is None or not worst.is_test or not evidence.explains(worst):
        return in_turn(evidence, known)
    recent = all(
        each.held(evidence.bound, evidence.limits) for each in evidence.counted()[-evidence.limits.predictions :]
    )
    return Remedy(kind="drawn") if recent else in_turn(evidence, known)


def _next_to_the_failed_test(evidence: Evidence, known: int) -> Remedy:
    """Return tasks that share one parameter with the failed test, and the others with the worst task.

    A dynamics that depends on the task is large there. Parameters that M's loops do not depend on come first.
    """
    point, worst = _failed_test(evidence), np.array(evidence.worst)
    if point is None or not len(worst):
        return Remedy()
    others = [j for j in range(len(worst)) if j not in evidence.idle]
    tasks = np.tile(worst, (6, 1))[: len(worst)]
    for row, j in enumerate([*evidence.idle, *others][: len(tasks)]):
        tasks[row, j] = point[j]
    return Remedy((tasks,))


def _influential(evidence: Evidence, known: int) -> Remedy:
    return Remedy((np.array([evidence.influential]),), "again")


def _least_explained(evidence: Evidence, known: int) -> Remedy:
    least = least_explained(evidence.executed)
    assert least is not None
    task = np.array(least.point)
    times = sum(np.abs(np.array(each.point) - task).max() <= SAME for each in evidence.executed)
    return Remedy((task[None],), "again") if times < evidence.limits.repetitions else Remedy()


CHECKS = (
    Check(
        "few_executions",
        "learning",
        0,
        _few_executions,
        sentences.FEW_EXECUTIONS,
        "The data of M cover states and inputs, but they are no executions under its controllers.",
    ),
    Check(
        "not_planned",
        "learning",
        0,
        lambda evidence: Gap(evidence.unplanned, {"percent": 100 * evidence.unplanned}),
        sentences.NOT_PLANNED,
        "Nothing is known of a task for which no controller can be designed, or on which M diverges.",
    ),
    Check(
        "few_predictions",
        "learning",
        0,
        _few_predictions,
        sentences.FEW_PREDICTIONS,
        "Predictions that could have failed test the prior. One that failed raises the bound.",
    ),
    Check(
        "noisy",
        "learning",
        "noise",
        _noisy,
        sentences.NOISY,
        "Learned noise means that the next state does not follow from the recorded state and input.",
    ),
    Check(
        "noise_contradicted",
        "learning",
        "e_value",
        _noise_contradicted,
        sentences.NOISE_CONTRADICTED,
        "If the learned noise is true, this evidence exceeds its limit in at most one of 20 campaigns.",
    ),
    Check(
        "left_out",
        "learning",
        "left_out",
        lambda evidence: Gap(
            evidence.left_out, {"percent": 100 * evidence.left_out, "most": 100 * evidence.limits.left_out}
        ),
        sentences.LEFT_OUT,
        "A draw varies too little between its pivots if more of the variance is left out.",
    ),
    Check(
        "failed_test",
        "bound",
        np.inf,
        _unexplained_test,
        "",
        "Dynamics that depend on the task are largest where the task shares one parameter with the failed test.",
        _next_to_the_failed_test,
    ),
    Check(
        "executed_once",
        "explained",
        0,
        lambda evidence: None if evidence.influential is None else Gap(1),
        sentences.EXECUTED_ONCE,
        "A property of one execution, such as a wet floor, would be taken for one of its task.",
        _influential,
    ),
    Check(
        "contradicted",
        "explained",
        "contradicted",
        _contradicted,
        sentences.CONTRADICTED,
        "If the final noise is true, the evidence against it exceeds this limit in one of 100 campaigns.",
        _least_explained,
    ),
    Check(
        "exceeds",
        "bound",
        np.inf,
        _exceeds,
        "",
        "An execution where a draw exceeds the threshold falsifies, or rules the draw out.",
        _at_the_bound,
    ),
    Check(
        "unsampled_parameter",
        "coverage",
        "gap",
        _unsampled_parameter,
        sentences.UNTRIED,
        "A task parameter that hardly changes the loops of M, such as a payload, may change the system.",
        _at_the_parameter,
    ),
    Check(
        "unsampled_corner",
        "coverage",
        "corner",
        _unsampled_corner,
        sentences.UNTRIED_CORNER,
        "A post or a wall in a corner of a position concerns few tasks; four executions reach all corners.",
        _at_the_corner,
    ),
    Check(
        "unvisited_region",
        "coverage",
        "region",
        _unvisited_region,
        sentences.POCKET,
        "A post, a hole or a magnet concerns the few tasks whose runs meet it; a run sweeps a line.",
        _in_the_region,
    ),
    Check(
        "diverged",
        "coverage",
        "diverged",
        lambda evidence: _gap(evidence.coverage.beyond, evidence),
        sentences.DIVERGED,
        "Runs that leave the records by ten times their range are not predicted at all.",
        _beyond_the_records,
    ),
    Check(
        "beyond",
        "coverage",
        "beyond",
        _beyond,
        sentences.BEYOND,
        "Contacts, end stops and saturation lie beyond the records more often than between them.",
        _beyond_the_records,
    ),
    Check(
        "gap",
        "coverage",
        "gap",
        lambda evidence: _gap(evidence.coverage.marginal, evidence),
        sentences.GAP,
        "In a gap of the records, the dynamics are a guess of the prior.",
        _beyond_the_records,
    ),
    Check(
        "pair_gap",
        "coverage",
        "pair_gap",
        lambda evidence: _gap(evidence.coverage.pair, evidence),
        sentences.PAIR_GAP,
        "In a gap of the joint records of two coordinates, too.",
        _beyond_the_records,
    ),
    Check(
        "not_tested",
        "tested",
        0,
        _not_tested,
        sentences.NOT_TESTED,
        "The prediction must be tested where it matters: at a distance near the largest one.",
        _at_the_largest,
    ),
    Check(
        "none_held",
        "tested",
        0,
        _none_held,
        sentences.NONE_HELD,
        "Small distances hardly test the bound.",
        _at_the_largest,
    ),
    Check(
        "excess",
        "bound",
        np.inf,
        lambda evidence: _above(evidence.bound, evidence),
        "",
        "Half of the last excess over a prediction is added to the bound.",
        in_turn,
    ),
    Check(
        "tests_missing",
        "tests",
        0,
        _tests_missing,
        sentences.TESTS_MISSING,
        "A search looks where distances are large, so it may never see that the dynamics are other in some tasks.",
        _drawn,
    ),
    Check(
        "failed_prediction",
        "bound",
        np.inf,
        lambda evidence: _above(evidence.raised, evidence),
        "",
        "A prediction that failed leaves only thresholds credible that are far above the bound.",
        _past_a_failed_prediction,
    ),
    Check(
        "untested_rest",
        "tests",
        "rest_gap",
        _untested_rest,
        sentences.UNTESTED_REST,
        "A detent holds a joint that rests there, and no run that slides past it or leaves it fast shows that.",
        _in_the_stretch,
    ),
    Check(
        "unexplained",
        "explained",
        "error",
        _unexplained,
        sentences.UNEXPLAINED,
        "An execution that the final dynamics do not have shows that they depend on something else.",
    ),
    Check(
        "drift",
        "explained",
        "drifting",
        _drift,
        sentences.DRIFT,
        "The learned noise assumes that executions differ by nothing that changes in a regular way.",
    ),
    Check(
        "uneven_friction",
        "explained",
        "uneven",
        lambda evidence: Gap(evidence.uneven, {"times": evidence.uneven}),
        sentences.UNEVEN,
        "Friction at rest that withstood a force which moved the joint elsewhere is not the same everywhere.",
    ),
    Check(
        "needle",
        "search",
        "peak_ratio",
        _needle,
        sentences.NEEDLE,
        "If a maximum falls within a thousandth of the ranges, larger ones can be as narrow.",
    ),
    Check(
        "jump",
        "search",
        "jump",
        _jump,
        sentences.JUMP,
        "If the predicted distance jumps between nearly equal tasks, larger ones can hide between jumps.",
    ),
    Check(
        "searches_differ",
        "search",
        "agree",
        _searches_differ,
        sentences.SEARCHES_DIFFER,
        "With one or two parameters, two searches with four times as many tasks tell how sure the maximum is.",
        _at_the_largest,
    ),
    Check(
        "unsupported",
        "support",
        0,
        _unsupported,
        sentences.UNSUPPORTED,
        "Executions above the threshold must be explained by the noise better than by a share above it.",
    ),
)
"""All checks, in the order in which they withdraw the bound and choose tasks."""


def open_checks(evidence: Evidence) -> list[Open]:
    """Return the checks that the evidence does not pass, in the order of the table."""
    return [opened for check in CHECKS if (opened := check.opened(evidence)) is not None]


def remedies(evidence: Evidence, known: int) -> list[Remedy]:
    """Return what the open checks need that an execution can close, in their order, given the number of known tasks."""
    return [opened.check.remedy(evidence, known) for opened in open_checks(evidence) if opened.check.remedy]


def is_open(evidence: Evidence, *stages: Stage) -> bool:
    """Return whether a check of some stages is open."""
    return any(check.opened(evidence) is not None for check in CHECKS if check.stage in stages)


def withdrawals(evidence: Evidence) -> list[Open]:
    """Return the open checks that withdraw the bound."""
    return [opened for opened in open_checks(evidence) if opened.check.stage != "bound"]


def fewest_missing(evidence: Evidence) -> int:
    """Return the fewest executions after which nothing could withdraw or raise the bound any more, at least 1."""
    limits, checked, opened = evidence.limits, evidence.counted(), open_checks(evidence)
    holding = [last.held(evidence.bound, limits) for last in reversed(checked)]
    in_a_row = holding.index(False) if False in holding else len(holding)
    each_takes_one = sum(each.check.stage in ("coverage", "tested") for each in opened)
    counts = (int(each.gap.size) for each in opened if each.code in ("few_executions", "tests_missing"))
    return max(limits.predictions - in_a_row, each_takes_one, 1, *counts)
