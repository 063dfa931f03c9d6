"""What verdicts say, in sentences with units, tasks and numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from ctxval._util.representation import counted
from ctxval._util.texts import enumerated, parted, quoted
from ctxval.certificates.bets import Bets
from ctxval.certificates.bounds import (
    NO_UNITS,
    Quantities,
    at_most,
    distinguishable,
    of_tasks,
    percent,
    radius_of,
    two_digits,
    with_error,
    with_units,
)
from ctxval.certificates.covering import RESOLUTION, EmptyBox
from ctxval.certificates.sample import executions_of
from ctxval.certificates.sentences.statements import (
    INDEPENDENT_REPEATS,
    SMALL_ERRORS,
    condition_on_dynamics,
    conditions_on_dynamics,
)
from ctxval.certificates.sentences.withdrawals import REFINED
from ctxval.certificates.task_share import ShareBets
from ctxval.core.learned_numbers import PushedDistances, Tolerance
from ctxval.core.space import TaskSpace
from ctxval.core.trial import Trial, Trials

if TYPE_CHECKING:
    from ctxval.certificates.base import Certificate
    from ctxval.certificates.provenance import Provenance

# Falsified


def falsified(
    worst: Trial,
    trials: Sequence[Trial],
    tau: float,
    quantities: Quantities,
    bets: Bets | ShareBets | None,
    confidence: float,
) -> str:
    """Return which executed task exceeds a threshold, and how often an execution of the same task reproduced it."""
    if isinstance(bets, ShareBets):
        return _share_falsified(worst, tau, quantities, bets, confidence)
    if worst.ended_alone is not None:
        what = f"S ended after {worst.ended_alone:.3g} s ({quoted(worst.failure or '')}) and M did not"
        where = quantities.task(worst).removeprefix("task ")
        return f"in trial {worst.number}, {what}, in the task {where}: this exceeds every threshold."
    distance, limit = distinguishable(worst.least, tau)
    if worst.distance is None:
        return (
            f"trial {worst.number} failed ({quoted(worst.failure or '')}), but its distance is at least "
            f"{quantities.of(distance)} by the steps before the failure, which exceeds {quantities.of(limit)}, in the "
            f"task {quantities.task(worst)}; if the cause was a fault that has been repaired, execute the task again "
            'and state the repair (`ctxval run` with --again-failed "...", or '
            f'`ctxval ask STORE --again {worst.number} --because "..."` if people execute it).'
        )
    again = [(trial.distance or 0.0) > tau for trial in executions_of(worst, trials) if trial is not worst]
    reproduced = ", executed once" if not again else ""
    if any(again):
        times = {1: "once", 2: "twice"}.get(sum(again), f"{sum(again)} times")
        reproduced = f", reproduced {times}"
    if not all(again):
        reproduced += f" ({len(again) - sum(again)} of {len(again)} repetitions of the task did not exceed it)"
    noise = ""
    if bets is not None:
        noise = (
            f"; {bets.above} of {counted(bets.executions, 'execution')} exceed it, too many for noise if "
            f"{100 * bets.quantile:g} % of the executions of each task stay below it (e-value {bets.wealth:.3g}, "
            f"where {_needed(confidence)})"
        )
    return (
        f"trial {worst.number} has the distance {quantities.of(distance)}, which exceeds {quantities.of(limit)}, "
        f"in the task {quantities.task(worst).removeprefix('task ')}{reproduced}{noise}."  # of a suite: its name
    )


def _share_falsified(worst: Trial, tau: float, quantities: Quantities, bets: ShareBets, confidence: float) -> str:
    """Return which share of the tasks exceeds a threshold, as executions alone show, and the largest of them."""
    return (
        f"with {percent(confidence)} confidence, more than {100 * bets.least:.3g} % of the tasks exceed "
        f"{quantities.of(f'{tau:.6g}')}, and at most {100 * (1 - bets.share):.3g} % may: {bets.above} of "
        f"{counted(bets.executions, 'execution')} at drawn tasks exceed it (e-value {bets.wealth:.3g}, where "
        f"{_needed(confidence)}). This rests on no model, only on the threshold being fixed before they were drawn; "
        f"the largest distance is {quantities.of(f'{worst.least:.4g}')} in trial {worst.number}, in the task "
        f"{quantities.task(worst).removeprefix('task ')}."
    )


def _needed(confidence: float) -> str:
    """Return which e-value rules noise out as the cause (Ville 1939)."""
    return f"{1 / (1 - confidence):.3g} is needed"


def noise_may_explain(bets: Bets, tau: float, quantities: Quantities, confidence: float) -> str:
    """Return that executions exceed a threshold, and that noise may be the cause."""
    exceed = "exceeds" if bets.above == 1 else "exceed"
    return (
        f"{bets.above} of {counted(bets.executions, 'execution')} {exceed} {quantities.of(f'{tau:.6g}')}, which noise "
        f"may explain (e-value {bets.wealth:.3g} against the threshold, where {_needed(confidence)})"
    )


def caution(known: Provenance, tau: float) -> str:
    """Return what speaks against any answer, each as a sentence after a space; empty if nothing does."""
    quantities, caution = known.quantities, ""
    limit = quantities.of(f"{tau:.6g}")
    above = [(other.path.name, other.worst) for other in known.beside if other.worst and other.falsifies(tau)]
    if above:
        first = "Another store of this experiment falsifies"
        if len(above) > 1:
            first = f"{len(above)} other stores of this experiment falsify"
        trials = (
            f"trial {trial.number} of {quoted(name)} has the distance "
            f"{quantities.of(distinguishable(trial.distance or 0.0, tau)[0])}, at {quantities.task(trial)}"
            for name, trial in above[:3]
        )
        caution = f" {first} {limit}: {'; '.join(trials)}{'; ...' if len(above) > 3 else ''}."
    if known.start is not None and known.start[0] > tau:
        caution += f" The start of an execution was off by {known.start[1]}; the threshold is {limit}."
    return caution


# Validated


def validated(certificate: Certificate, tau: float, quantities: Quantities) -> str:
    """Return what is validated in one sentence: which tasks stay below the threshold, by which bound, if what holds."""
    upper, limit = _bound_and_limit(certificate, tau, quantities)
    kind, details, level = certificate.kind, certificate.details, percent(certificate.confidence)
    if kind == "suite" and "repeats" in details:
        return (
            f"with {level} confidence, each of {counted(details['tasks'], 'task')} of the suite stays at or below "
            f"{limit}{certificate.target.often}: the bound is {upper}, from at least "
            f"{counted(details['repeats'], 'execution')} of each."
        )
    if kind == "suite" and details.get("not_executed"):
        return (
            f"every task of the suite of {details['tasks']} stays at or below {limit}: the bound is {upper}, with "
            f"{level} probability under a law of the distances over the task parameters."
        )
    if kind == "suite":
        return (
            f"all {details['tasks']} tasks of the suite were executed, and no distance exceeds {limit}: the largest is "
            f"{upper}."
        )
    tests = details.get("tests")
    untested = "" if tests is None or tests["drawn"] else "no prediction was tested at drawn tasks (tests = 0); "
    if certificate.volume and kind != "dynamics":
        return (
            f"{untested}with {level} confidence, at most {at_most(100 * certificate.volume, 3)} % "
            f"{of_tasks(certificate.distribution)}{quantities.ranges} exceed {limit}: the {kind} bound is "
            f"{upper}, from {counted(certificate.trials, 'independent draw')}."
        )
    condition = "confidence, if its assumptions hold"
    if kind == "dynamics":
        law = "the posterior" if details["parameters"] else "a Gaussian process"
        condition = f"probability under {law}{condition_on_dynamics(details)}"
    elif kind == "posterior":
        what = "expected distance" if details.get("stochastic") else "distance"
        condition = f"probability under a Gaussian process, if the {what} is as smooth between the trials as at them"
        resolution = details.get("resolution")
        if resolution is not None and resolution["diagonals"] != RESOLUTION:
            diagonals = f"{resolution['diagonals']:g} diagonals; usual: {RESOLUTION:g}"
            condition += f"{_gaps(resolution, quantities)} ({diagonals})"
    given = f"if {SMALL_ERRORS}" if details.get("negligible") else f"with {level} {condition}"
    keeps = f"every task{quantities.ranges} stays at or below {limit}{certificate.target.often}"
    if certificate.volume:
        share = f"{100 * (1 - certificate.volume):.4g} % {of_tasks(certificate.distribution)}"
        keeps = f"at least {share}{quantities.ranges} stay at or below {limit}"
    return f"{untested}{keeps}: the {kind} bound is {upper}, {given}."


def _bound_and_limit(certificate: Certificate, tau: float, quantities: Quantities) -> tuple[str, str]:
    upper, limit = with_error(certificate.upper_bound, certificate.error), f"{tau:.6g}"
    if "±" not in upper:
        upper, limit = distinguishable(certificate.upper_bound, tau)
    return quantities.of(upper), quantities.of(limit)


def _gaps(resolution: Mapping[str, float], quantities: Quantities) -> str:
    """Return how large the gaps between trials may be, in the units of the tasks and as a share of the task space."""
    share = 100 * resolution["of_the_space"]
    if resolution["of_each_range"] >= 1:
        return ", also in whole regions without a trial"
    volume = f"{share:.0f}" if share >= 10 else f"{share:.2g}"
    return f", in gaps of up to {quantities.lengths(resolution['of_each_range'])}, {volume} % of the task space"


# What a validation rests on


def all_conditions(
    conditions: Sequence[str], certificate: Certificate, tau: float, known: Provenance, trials: Sequence[Trial]
) -> tuple[str, ...]:
    """Return the conditions of a kind of certificate, and those of the campaign, each as an end of "It rests on"."""
    details, parts = certificate.details, list(conditions)
    made_good = details.get("failures", {}).get("made_good", [])
    if made_good:
        numbers = ", ".join(str(failure["trial"]) for failure in made_good)
        parts.append(f"your statement that the cause of the failure of trial {numbers} was removed permanently")
    parts += [f"your statement that {remark}" for remark in known.remarks if remark != REFINED]
    return (*parts, *_not_selected(known, known.known_before(tau, trials), tau))


def rests_on(conditions: Sequence[str], certificate: Certificate, tau: float, known: Provenance) -> str:
    """Return the evidence of a validation, what it rests on, and what independent draws say without any of it."""
    tests = certificate.details.get("tests", {})
    text = f"{_evidence(certificate, tau, known.quantities)}It rests on {'; on '.join(conditions)}."
    alone = (
        f"Without these assumptions, the tests alone show with {percent(certificate.confidence)} confidence only that"
    )
    limit = known.quantities.of(f"{tau:.6g}")
    if (missed := certificate.details.get("missed_by_tests")) is not None:
        left = counted(certificate.details["not_executed"], "task")
        return f"{text} {alone} at most {missed} of the {left} that were not executed exceed {limit}."
    if tests.get("share_missed") is None:
        return text
    what = f"of the {certificate.target.drawn} {of_tasks(certificate.distribution)}".removeprefix("of the tasks ")
    draws = [f"{counted(tests['spread'], 'test')} drawn as a Latin hypercube"] if tests["spread"] else []
    draws += [counted(tests["independent"], "independent draw")] if tests["independent"] else []
    return (
        f"{text} {alone} at most {at_most(100 * tests['share_missed'], 2)} % {what} exceed {limit} "
        f"({' and '.join(draws)})."
    )


def _evidence(certificate: Certificate, tau: float, quantities: Quantities) -> str:
    """Return what speaks for a bound on d*: executions, tests of predictions, and what the bound survives."""
    details, text = certificate.details, str(counted(certificate.trials, "execution"))
    is_whole = certificate.kind == "suite" and not details.get("not_executed")
    if (certificate.volume and certificate.kind != "dynamics") or is_whole:
        return ""
    best, tests, left = details.get("best"), details.get("tests"), details.get("not_executed")
    if best is not None:
        text += f", the largest distance {quantities.of(f'{best:.4g}')}"
    if tests is not None and tests["drawn"]:
        text += f"; {tests['drawn']} of them at tasks drawn over the whole task space"
        if tests["largest_error"] is not None:
            within = at_most(100 * tests["largest_error"] / tau, 2)
            text += f", where the predictions made beforehand erred by at most {within} % of the threshold"
    if (supported_share := details.get("share_supported")) is not None:
        text += (
            f"; without the learned noise, they support only that {100 * supported_share:.2g} % of such executions "
            f"stay at or below the threshold, with {percent(certificate.confidence)} confidence"
        )
    if left:
        text += f"; {left} of the {details['tasks']} tasks were not executed"
    text += "."
    if (pushes := tolerances(certificate, tau)) is not None:
        everywhere, away = pushes
        beside = " beside dry friction" if details.get("friction") else ""
        text += (
            " No tried task exceeds the threshold under a further error of M, beyond what was learned, of up to "
            f"{push_in_words(everywhere)} at every step, or of {push_in_words(away)} where no record is near; the "
            f"largest error of M{beside} in the records, which was learned, is "
            f"{_rate(everywhere.state, everywhere.residual)}."
        )
    if (pocket := details.get("unvisited_region")) is not None:
        text += (
            f" The least tested place is {with_units(pocket['place'])}: predicted runs lead there, and no execution "
            f"came within {radius_of(pocket['within'])}."
        )
    if (empty := details.get("empty_box")) is not None and quantities.space is not None:
        text += f" {_not_tried(EmptyBox(**empty), quantities.space)}"
    return f"{text} "


def tolerances(certificate: Certificate, tau: float) -> tuple[Tolerance, Tolerance] | None:
    """Return the smallest pushes, everywhere and away from all records, that bring a task above a threshold."""
    pushed = certificate.details.get("pushed")
    if pushed is None:
        return None
    distances = PushedDistances.from_json(pushed)
    return distances.tolerance(tau), distances.tolerance(tau, away=True)


def push_in_words(tolerance: Tolerance) -> str:
    """Return the size of a push with its state and unit."""
    finite = np.isfinite(tolerance.push)
    return _rate(tolerance.state, tolerance.push) if finite else "more than 8 times the largest residual"


def _rate(label: str, value: float) -> str:
    name, unit = parted(label)
    return f"{f'{two_digits(value)} {unit}'.rstrip()} in {name}"


def _not_tried(box: EmptyBox, space: TaskSpace) -> str:
    sides = []
    for j, *side in zip(box.parameters, box.low, box.high, strict=True):
        name, unit = parted(space.labels[j])
        first, last = space.low[j] + np.array(side) * (space.high[j] - space.low[j])
        sides.append(f"{name} {first:.3g} to {last:.3g} {unit}".rstrip())
    share = f"{100 * box.share:.0f} % of the task space"
    return f"No execution had {' and '.join(sides)} together ({share}, the largest box of two parameters)."


def conditions(certificate: Certificate, space: TaskSpace | None) -> list[str]:
    """Return what a validation by a built-in kind rests on: each entry completes a sentence "It rests on ..."."""
    details = certificate.details
    match certificate.kind:
        case "dynamics":
            return conditions_on_dynamics(details)
        case "posterior":
            resolution, quantities = details.get("resolution"), Quantities(space=space)
            where = "" if resolution is None else f"{_gaps(resolution, quantities)} (a peak inside one may be missed)"
            once = "each task having one distance, however often it is executed"
            if details.get("stochastic"):
                bounded = "it is the expected distance that is bounded: single executions may exceed it"
                once = f"the noise being normal and alike everywhere ({bounded})"
            return [f"the distance being as smooth between the trials as at them{where}", once]
        case "suite":
            if "repeats" in details:
                return [INDEPENDENT_REPEATS]
            if details.get("not_executed"):
                return [
                    "the logarithm of the distance being normal about a linear function of the logarithms of positive "
                    "task parameters and of the others as they are",
                    "no task that was not executed meeting what no execution has met, such as a stop",
                ]
            return ["an execution of a task again giving the distance that was recorded"]
        case "audit" | "anytime" | "scenario" | "sampling-discarding":
            return [
                "tasks that were drawn independently, and from which M was not learned (how large the distance is in "
                f"the {at_most(100 * certificate.volume, 3)} % that are left out is not known)"
            ]
    return ["what its certificate assumes"]


def looked(
    known: Provenance, certificate: Certificate, tau: float, trials: Sequence[Trial], volume: float
) -> list[str]:
    """Return that a threshold was stated after distances were known, and which smaller ones before it do not hold."""
    count = known.known_before(tau, trials)
    known_ones = "1 distance was" if count == 1 else f"{count} distances were"
    parts = [f"the threshold was stated after {known_ones} known"] if count else []
    stated = [each.threshold for each in known.thresholds or ()]
    before = stated[: stated.index(tau)] if tau in stated else stated
    smaller = sorted(each for each in before if each < tau and not certificate.covers(each, volume))
    largest = Trials(trials).largest
    falsified_ones = [each for each in smaller if each < largest]
    for group, how in ((falsified_ones, "falsified"), (smaller[len(falsified_ones) :], "left undecided")):
        if group:
            limits = enumerated((known.quantities.of(f"{each:.6g}") for each in group), 5)
            word, were, are = ("threshold", "was", "is") if len(group) == 1 else ("thresholds", "were", "are")
            parts.append(f"the smaller {word} {limits}, which {were} stated before, {are} {how}")
    return parts


def _not_selected(known: Provenance, count: int, tau: float) -> list[str]:
    """Return that neither a threshold nor a campaign was selected, by what was known and by other stores."""
    distances = "distance that was" if count == 1 else "distances that were"
    fitted = f"the threshold not being chosen to suit the {count} {distances} known when it was stated"
    sentences, alone = [fitted] if count else [], "this campaign not being chosen among several"
    others = len(known.beside)
    if not others:
        return [*sentences, alone]
    lie = "store of this experiment lies" if others == 1 else "stores of this experiment lie"
    if all(other.worst is None for other in known.beside):
        return [*sentences, f"{alone} ({others} other {lie} beside it)"]
    which = "none of them falsifies the threshold" if others > 1 else "it does not falsify the threshold"
    falsifying = [quoted(other.path.name) for other in known.beside if other.falsifies(tau)]
    if falsifying:
        verb = "falsifies" if len(falsifying) == 1 else "falsify"
        them = "it falsifies" if others == 1 else f"{len(falsifying)} of them {verb}"
        which = f"{them} the threshold ({enumerated(falsifying, 5)})"
    return [*sentences, f"{alone} ({others} other {lie} beside it, and {which})"]


# Undecided


def undecided(certificate: Certificate, tau: float, volume: float, quantities: Quantities) -> str:
    """Return why a certificate does not validate a threshold that a share of the tasks may exceed."""
    suspicion, suspect = "", certificate.details.get("suspect")
    if suspect is not None:
        suspicion = (
            f" The dynamics seem to depend on {suspect[0]}: with it, executions are predicted from the others "
            f'{suspect[1]:.2g} times as well. State it as physical = ["{suspect[0]}"].'
        )
    if certificate.doubt is not None:
        support = supported(certificate, tau, quantities)
        return f"{f'{support}; but ' if support else ''}{certificate.doubt}.{suspicion}"
    upper, limit = _bound_and_limit(certificate, tau, quantities)
    if certificate.upper_bound > tau:
        why = certificate.target.exceeding(upper, limit)
        if certificate.volume:
            share = f"{100 * certificate.volume:.4g} % {of_tasks(certificate.distribution)}"
            why = f"{share} may have distances up to {upper} and more, and the threshold is {limit}"
        why += f"{_shortfall(certificate)}."
    elif not certificate.covers(tau, certificate.volume):
        why = (
            f"the {certificate.kind} bound is {upper}, and {limit} is too near to it for the random draws that it is "
            "computed from; more executions tighten it."
        )
    else:
        why = (
            f"the {certificate.kind} bound of {counted(certificate.trials, 'trial')} leaves out "
            f"{at_most(100 * certificate.volume, 3)} % {of_tasks(certificate.distribution)}, more than the "
            f"{100 * volume:.3g} % that are acceptable{_shortfall(certificate)}; it is no bound on d*."
        )
    return f"{why}{suspicion}"


def supported(certificate: Certificate, tau: float, quantities: Quantities = NO_UNITS) -> str:
    """Return what speaks for a threshold although a bound from dynamics is withdrawn; empty if nothing does."""
    if certificate.kind != "dynamics":
        return ""
    details = certificate.details
    largest, predictions = details["largest_draw"], details["predictions"]
    if largest is None or largest > tau or not predictions["held"]:
        return ""
    return (
        f"supported by the model: no posterior sample of the dynamics exceeds "
        f"{quantities.of(f'{tau:.6g}')} in a search of {details['evaluations']} closed loops; "
        f"{predictions['held']} of the last {predictions['last_ones']} predictions held"
    )


def _shortfall(certificate: Certificate) -> str:
    details = certificate.details
    if details.get("raised_from") is not None:
        worst = next(checked for checked in details["checked"] if checked["trial"] == details["raised_by_trial"])
        return (
            f": trial {worst['trial']} came out at {worst['distance']:.4g} where {worst['median']:.4g} was predicted, "
            f"which raises the bound from {details['raised_from']:.4g} until 3 predictions in a row hold. If "
            "predictions go on failing, a state that is not recorded, a jump such as a contact or dry friction, noise, "
            "or dynamics that depend on the task are the likely cause: record more states, state the task parameters "
            "that change the dynamics (physical = [...]), or use --kind posterior or an audit"
        )
    missing = details.get("not_counted")
    return f"; {missing} draws do not count, as their number was changed after they were known" if missing else ""
