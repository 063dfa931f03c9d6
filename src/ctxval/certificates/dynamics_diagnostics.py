"""Diagnostics that withdraw the bound from learned dynamics: they do not believe the prior on the dynamics.

Each diagnostic gives a sentence, which says what is wrong and what would help; the first one withdraws the bound. The
limits were chosen on development systems. Those of the posterior bound are in
:func:`ctxval.certificates.posterior.diagnose`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from ctxval.certificates.bounds import radius_of, with_units
from ctxval.certificates.dynamics_evidence import CheckedPrediction, DynamicsEvidence
from ctxval.certificates.explained import CONTRADICTED, evidence_against, least_explained, support_of
from ctxval.certificates.prediction_tests import DRAWN
from ctxval.certificates.sentences import withdrawals as sentences
from ctxval.core.coverage import REST_GAP, StateInputGap

# Limits; docs/theory.md has the reason for each.

FEWEST = 3  # executions for a bound: the data that M was made from are no executions
_FAILING = 6  # of so many last predictions, at least half must hold; otherwise the dynamics cannot be learned
PREDICTIONS = 3  # last predictions that must have held
ACCURATE = 0.05
"""Largest difference between a distance and its prediction that held, as a share of the bound or, if a prediction
failed, of the margin that is left above the bound; see :func:`raised`."""
NOISE = 0.01  # learned variance of noise, as a share of the mean square of the residual
LEFT_OUT = 0.5  # share of the posterior variance that posterior samples leave out between their pivots
GAP = 0.25  # gap of the records in a state or an input, as a share of the range that closed loops visit
PAIR_GAP = 0.5  # the same for two of them together
CORNER = 0.05  # distance of the nearest executed task from a corner of a position in space, as a share of its ranges
POCKET = 0.125  # radius of a place that predicted runs enter and no execution has entered, as a share of the range
BEYOND = 0.02
"""Largest excess of a state or an input over its largest record, or below its smallest one, as a share of that range.
Contacts, end stops and saturation lie beyond what is recorded more often than between records. With too many
coordinates for a comparison of pairs, ``GAP`` takes its place: each extreme would take an execution of its own."""
TESTED = 0.8  # least share of the largest predicted distance that must have been executed
MATTERS = 0.3  # least distance, as a share of the bound, at which a prediction must have held
SHARP = 0.05  # share by which a large predicted distance may exceed the median of those of nearly the same tasks
JUMP = 0.01  # jump of the predicted distance between nearly equal tasks, as a share of the bound
DENSE = 2  # task parameters in which deeper searches may find the largest distance in spite of jumps
NOISY_FEWEST = 5  # executions for a bound if the system is noisy
DIVERGED = 10.0  # share of the visited range from which on predicted runs are said to diverge
NOISY_BEYOND = 0.06  # the same as BEYOND: noise leads a little beyond what a few executions have recorded
NOISY_TESTED = 0.75  # the same as TESTED, of the median posterior sample, which has the noise of all executions
TOLERATED = 0.02  # share of the bound by which a distance may exceed its prediction without being an excess
VAGUE = 2.0
"""Multiple of the largest executed distance from which the 0.95 quantile of a noisy prediction makes it no test."""
UNLIKELY = 0.01  # least predicted probability of a distance as large as the executed one
EVIDENCE = 20.0  # e-value of the last predictions of a noisy system at which they are rejected
EVIDENCE_OF = 6  # number of these predictions
SMALL = 0.1  # least predicted distance, as a share of the bound, by which the error of a drawn test is judged
USUAL = 4.0  # multiple of the median error of drawn tests up to which an error is usual
SUPPORTED = 1.0  # least likelihood ratio of the law against a share of executions above the threshold
DRIFTING = 0.005  # p-value below which the effects of executions change with their order, or with a task parameter
UNEVEN = (
    1.5  # ratio of a force that a joint withstood to one that moved it from which friction at rest differs by place
)
AGREE = 0.05  # share by which two deeper searches may differ, and by which they may exceed the usual one


# Whether predictions held


def agrees(distance: float, predicted: float, bound: float) -> bool:
    """Return whether a distance agrees with the median of its prediction, as far as it matters for a bound.

    A vague prediction that covers the distance does not suffice: hidden states make predictions vague.
    """
    return abs(distance - predicted) <= ACCURATE * bound


def held(prediction: CheckedPrediction, bound: float) -> bool:
    """Return whether an execution agrees with its prediction; with noise, whether it is not improbably large."""
    if prediction.is_noisy:
        return prediction.chance_of_more(prediction.distance - TOLERATED * bound) >= UNLIKELY
    return prediction.error <= ACCURATE * bound


def mostly_fail(holding: Sequence[bool]) -> bool:
    """Return whether predictions fail so often that the dynamics cannot be learned, by which of all of them held."""
    last = holding[-_FAILING:]
    return len(last) == _FAILING and 2 * sum(last) < _FAILING


def counted(evidence: DynamicsEvidence, bound: float) -> list[CheckedPrediction]:
    """Return the predictions that count: those that failed, and those that held where they could have failed.

    A prediction of a task like an earlier one tells nothing, nor does a later one of a run that a person imported.
    """
    return [
        prediction
        for prediction in evidence.predictions
        if not held(prediction, bound) or (prediction.new and (prediction.stored or prediction.origin != "manual"))
    ]


def tested(predictions: Sequence[CheckedPrediction], tests: int) -> list[CheckedPrediction]:
    """Return the predictions at drawn tasks among the latest that complete the tests; among all if none do."""
    stored = [prediction for prediction in predictions if prediction.stored and prediction.point]
    first = range(len(stored) - 1, -1, -1) if tests else ()
    latest = next((stored[k:] for k in first if not missing_tests(stored[k:], tests)), stored if tests else [])
    return [test for test in latest if test.origin in DRAWN]


def missing_tests(predictions: Sequence[CheckedPrediction], tests: int) -> int:
    """Return the number of executions that complete the tests; those that were predicted beforehand count.

    A noisy prediction that expects far more than what was ever executed could not have failed, and is no test.
    """
    largest = max((each.distance for each in predictions), default=0.0)
    drawn = [each for each in predictions if each.stored and each.origin in DRAWN]
    return max(tests - sum(not (each.is_noisy and each.upper > VAGUE * largest) for each in drawn), 0)


def own_error(evidence: DynamicsEvidence, prediction: CheckedPrediction, bound: float) -> float:
    """Return the largest error with which the prediction of a test at a drawn task holds.

    Most drawn tasks have small distances, where a share of the bound is a large error. So it is a share of the test's
    own distance or, if that is more, a multiple of the usual error.
    """
    errors = [each.error for each in evidence.predictions if each.stored and each.origin in DRAWN and not each.is_noisy]
    own = ACCURATE * max(prediction.median, SMALL * bound)
    return min(ACCURATE * bound, max(own, USUAL * float(np.median(errors)))) if errors else ACCURATE * bound


def holds(evidence: DynamicsEvidence, prediction: CheckedPrediction, bound: float) -> bool:
    """Return whether a prediction held; if it is one of a drawn test, also by its own distance."""
    if prediction.is_noisy or not (prediction.stored and prediction.origin in DRAWN):
        return held(prediction, bound)
    return prediction.error <= own_error(evidence, prediction, bound)


def is_explained(evidence: DynamicsEvidence, prediction: CheckedPrediction, bound: float) -> bool:
    """Return whether what is learned by now has the distance that was executed; unknown ones count as explained.

    If the dynamics depend on the task, one function of state and input cannot have the distances of all tasks. Noise
    explains none of its executions, and may be any of them.
    """
    known = prediction.explained
    if prediction.is_noisy or known is None:
        return True
    return abs(prediction.distance - known) <= own_error(evidence, prediction, bound)


def failed(evidence: DynamicsEvidence, bound: float) -> CheckedPrediction | None:
    """Return the one that failed most of the tests and of the last predictions that count; None if all of them held.

    Later tests outlive a test that failed only if it is explained by now.
    """
    drawn = [test for test in evidence.predictions if test.stored and test.origin in DRAWN]
    lasting = [test for test in drawn if evidence.tests and not is_explained(evidence, test, bound)]
    last = [*tested(evidence.predictions, evidence.tests), *lasting, *counted(evidence, bound)[-PREDICTIONS:]]
    wrong = (prediction for prediction in last if not holds(evidence, prediction, bound))
    return max(wrong, key=lambda prediction: prediction.error, default=None)


def raised(evidence: DynamicsEvidence, bound: float) -> float:
    """Return a bound that the errors of the last predictions leave credible.

    The error of a prediction that failed is a small share of the rise, so only a threshold far above the bound is kept.
    """
    worst = failed(evidence, bound)
    return bound if worst is None else bound + worst.error / ACCURATE


def jumps(evidence: DynamicsEvidence, bound: float) -> bool:
    """Return whether the distance is no smooth function of the task, so that a search may miss the largest one."""
    return evidence.peak_ratio > SHARP or evidence.jump > JUMP * bound


# Which executions would help


def fewest_executions(evidence: DynamicsEvidence) -> int:
    """Return the fewest executions for a bound."""
    return FEWEST if evidence.quantile is None else NOISY_FEWEST


def fewest_missing(evidence: DynamicsEvidence, best: float, bound: float) -> int:
    """Return the fewest executions after which nothing could withdraw or raise the bound any more, at least 1."""
    checked = counted(evidence, bound)
    in_a_row = next((k for k, last in enumerate(reversed(checked)) if not held(last, bound)), len(checked))
    each_takes_one = [*uncovered(evidence), *untested(evidence, best, bound, raised(evidence, bound))]
    tests = missing_tests(evidence.predictions, evidence.tests)
    executions = fewest_executions(evidence) - evidence.executions
    return max(executions, PREDICTIONS - in_a_row, len(each_takes_one), tests, 1)


def only_tests_missing(evidence: DynamicsEvidence, best: float, bound: float) -> bool:
    """Return whether tests are missing, and executions of other tasks would not help."""
    needed = evidence.executions >= fewest_executions(evidence) and tests_missing(evidence) is not None
    return needed and not uncovered(evidence) and not untested(evidence, best, bound)


def only_a_failed_test(evidence: DynamicsEvidence, best: float, bound: float, limit: float) -> bool:
    """Return whether an earlier test that failed is all that raises the bound above a limit: later tests outlive it."""
    worst = failed(evidence, bound)
    if worst is None or worst.origin not in DRAWN or not is_explained(evidence, worst, bound):
        return False
    recent = all(held(prediction, bound) for prediction in counted(evidence, bound)[-PREDICTIONS:])
    outlived = recent and raised(evidence, bound) > limit
    return outlived and not uncovered(evidence) and not untested(evidence, best, bound)


# Reasons to withdraw the bound


def doubt_of(evidence: DynamicsEvidence, best: float, bound: float) -> str | None:
    """Return why the bound is withdrawn, before failed predictions raise it; ``best`` is the largest distance."""
    return next(doubts(evidence, best, bound), None)


def doubts(evidence: DynamicsEvidence, best: float, bound: float) -> Iterator[str]:
    """Yield all reasons to withdraw the bound, as :func:`doubt_of` returns the first one."""
    yield from unlearned(evidence, bound)
    yield from uncovered(evidence)
    yield from untested(evidence, best, bound, raised(evidence, bound))
    if (missing := tests_missing(evidence)) is not None:
        yield missing
    yield from unexplained(evidence, bound)
    if not evidence.low_dimensional and jumps(evidence, bound):
        what = sentences.JUMP.format(percent=100 * evidence.jump / bound)
        if evidence.peak_ratio > SHARP:
            what = sentences.NEEDLE.format(percent=100 * evidence.peak_ratio)
        yield sentences.JUMPS.format(what=what)
    share = max(evidence.search_shortfall - 1, evidence.disagreement)
    if share > AGREE:
        yield sentences.SEARCHES_DIFFER.format(percent=100 * share)


def unlearned(evidence: DynamicsEvidence, bound: float) -> Iterator[str]:
    """Yield why too little is known of the dynamics."""
    fewest = fewest_executions(evidence)
    if evidence.executions < fewest:
        yield sentences.FEW_EXECUTIONS.format(executions=evidence.executions, fewest=fewest)
    if evidence.unplanned:
        yield sentences.NOT_PLANNED.format(percent=100 * evidence.unplanned)
    checked = len(counted(evidence, bound))
    if checked < PREDICTIONS:
        yield sentences.FEW_PREDICTIONS.format(checked=checked, needed=PREDICTIONS)
    if evidence.quantile is None and evidence.noise > NOISE:
        yield sentences.NOISY.format(percent=100 * evidence.noise, most=100 * NOISE)
    # Each prediction of a noisy system has p-values of the distance and of statistics of the trajectory. The mean of
    # p^-1/2 / 2 over them is an e-value (Vovk and Wang 2021), and so is the product: if predictions are right, it is
    # large with a small probability only.
    against = 1.0
    for prediction in [each for each in evidence.predictions if each.is_noisy][-EVIDENCE_OF:]:
        p = np.array([prediction.chance_of_more(prediction.distance), *prediction.p_values])
        against *= float((0.5 / np.sqrt(p)).mean())
    if against > EVIDENCE:
        yield sentences.NOISE_CONTRADICTED.format(against=against, most=EVIDENCE)
    if evidence.left_out > LEFT_OUT:
        yield sentences.LEFT_OUT.format(percent=100 * evidence.left_out, most=100 * LEFT_OUT)


def unexplained(evidence: DynamicsEvidence, bound: float) -> Iterator[str]:
    """Yield which executions the law that all of them teach does not explain, and which differ as they should not."""
    silent = [each for each in evidence.executed if not each.quantiles]
    farthest = max(silent, key=lambda each: abs(each.distance - each.expected), default=None)
    tolerated = max(ACCURATE * bound, evidence.negligible)
    if farthest is not None and abs(farthest.distance - farthest.expected) > tolerated:
        yield sentences.UNEXPLAINED.format(**vars(farthest))
    against = evidence_against(evidence.executed)
    if against > CONTRADICTED and (least := least_explained(evidence.executed)) is not None:
        yield sentences.CONTRADICTED.format(against=against, most=CONTRADICTED, trial=least.trial, p=least.p_value)
    if evidence.influential is not None:
        yield sentences.EXECUTED_ONCE
    if evidence.drift is not None and evidence.drift[1] < DRIFTING:
        yield sentences.DRIFT.format(cause=evidence.drift[0], p=evidence.drift[1])
    if evidence.uneven > UNEVEN:
        yield sentences.UNEVEN.format(times=evidence.uneven)


def untested_rest(evidence: DynamicsEvidence, threshold: float) -> str | None:
    """Return that larger friction at rest at an untested place would exceed a threshold; None if it would not."""
    rest = evidence.untested_rest
    if rest is None or rest.size <= REST_GAP or rest.highest <= threshold:
        return None
    place, length = with_units(rest.place), radius_of(dict.fromkeys(rest.place, rest.length))
    return sentences.UNTESTED_REST.format(length=length, place=place, times=rest.times, highest=rest.highest)


def unsupported(evidence: DynamicsEvidence, threshold: float, bound: float) -> str | None:
    """Return that executions of a noisy system speak against a threshold more than for it; None if they do not."""
    if evidence.quantile is None:
        return None
    ratio = support_of(evidence.executed, threshold, bound, evidence.quantile)
    if ratio >= SUPPORTED:
        return None
    above, share = sum(each.distance > threshold for each in evidence.executed), 100 * (1 - evidence.quantile)
    executions = len(evidence.executed)
    return sentences.UNSUPPORTED.format(above=above, executions=executions, level=threshold, ratio=ratio, share=share)


def uncovered(evidence: DynamicsEvidence) -> list[str]:
    """Return what the records and executions do not cover."""

    def at(gap: StateInputGap) -> str:
        coordinates, place = " and ".join(gap.coordinates), with_units(gap.place)
        return sentences.GAP_AT.format(coordinates=coordinates, percent=100 * gap.size, place=place)

    coverage, pair, missing = evidence.coverage, evidence.coverage.pair, []
    if coverage.beyond.size > most_beyond(evidence):
        far = coverage.beyond.size > DIVERGED
        missing.append(sentences.DIVERGED if far else sentences.BEYOND.format(gap=at(coverage.beyond)))
    if coverage.marginal.size > GAP:
        missing.append(sentences.GAP.format(gap=at(coverage.marginal)))
    if pair is not None and pair.size > PAIR_GAP:
        missing.append(sentences.PAIR_GAP.format(gap=at(pair)))
    others = unsampled_parameter(evidence), unsampled_corner(evidence), unentered_pocket(evidence)
    return [*missing, *filter(None, others)]


def most_beyond(evidence: DynamicsEvidence) -> float:
    """Return by how much closed loops may leave the records, as a share of the visited range."""
    return GAP if evidence.coverage.pair is None else BEYOND if evidence.quantile is None else NOISY_BEYOND


def unsampled_parameter(evidence: DynamicsEvidence) -> str | None:
    """Return that values of a parameter which the loops of M do not depend on were not tried; None if they were."""
    untried = evidence.unsampled_parameter
    if untried is None or untried.gap <= GAP:
        return None
    return sentences.UNTRIED.format(name=untried.name, percent=100 * untried.gap)


def unsampled_corner(evidence: DynamicsEvidence) -> str | None:
    """Return that a corner of a position in space was not tried; None if all were."""
    corner = evidence.unsampled_corner
    if corner is None or corner.gap <= CORNER:
        return None
    return sentences.UNTRIED_CORNER.format(place=with_units(corner.place))


def unentered_pocket(evidence: DynamicsEvidence) -> str | None:
    """Return that no execution has entered a place in space that predicted runs enter; None if it is small."""
    pocket = evidence.unvisited_region
    if pocket is None or not pocket.tasks or pocket.size <= POCKET:
        return None
    return sentences.POCKET.format(within=radius_of(pocket.within), place=with_units(pocket.place))


def untested(evidence: DynamicsEvidence, best: float, bound: float, allowed: float | None = None) -> list[str]:
    """Return why predictions are not tested at large distances; errors may be those of a bound ``allowed``."""
    if evidence.negligible:
        return []  # no distance is large
    least, reasons = TESTED * evidence.highest, []
    if evidence.quantile is not None:
        least = NOISY_TESTED * min(evidence.highest, float(np.median(evidence.maxima)))
    if best < least:
        reasons.append(sentences.NOT_TESTED.format(highest=evidence.highest, best=best))
    # Most executions of a noisy task are far below the bound on a quantile, however well it is known.
    size, what = (bound, "bound") if evidence.quantile is None else (evidence.highest, "largest predicted distance")
    large = [prediction for prediction in counted(evidence, bound) if prediction.distance >= MATTERS * size]
    if not any(held(prediction, bound if allowed is None else allowed) for prediction in large):
        reasons.append(sentences.NONE_HELD.format(percent=100 * MATTERS, what=what))
    return reasons


def tests_missing(evidence: DynamicsEvidence) -> str | None:
    """Return that predictions must be tested at drawn tasks; None if they were."""
    missing = missing_tests(evidence.predictions, evidence.tests)
    if not missing:
        return None
    executions = "execution" if missing == 1 else "executions"
    return sentences.TESTS_MISSING.format(missing=missing, executions=executions)
