"""What verdicts say, in sentences with units, tasks and numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

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
from ctxval.certificates.dynamics_evidence import PushedDistances, Tolerance
from ctxval.certificates.sample import executions_of
from ctxval.certificates.sentences.statements import condition_on_dynamics, conditions_on_dynamics
from ctxval.core.space import TaskSpace
from ctxval.core.trial import Trial

if TYPE_CHECKING:
    from ctxval.certificates.base import Certificate
    from ctxval.certificates.forecast import Forecast

# Falsified


def falsified(
    worst: Trial, trials: Sequence[Trial], tau: float, quantities: Quantities, bets: Bets | None = None
) -> str:
    """Return which executed task exceeds a threshold, and how often an execution of the same task reproduced it."""
    distance, limit = distinguishable(worst.least, tau)
    if worst.distance is None:
        return (
            f"trial {worst.number} failed ({quoted(worst.failure or '')}), but its distance is at least "
            f"{quantities.of(distance)} by the steps before the failure, which exceeds {quantities.of(limit)}, in the "
            f"task {quantities.task(worst)}; if a fault caused this that is mended by now, execute the task again and "
            f'say what it was (`ctxval run` with --again-failed "...", or `ctxval ask STORE --again {worst.number} '
            '--because "..."` if people execute it).'
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
            f"{100 * bets.quantile:g} % of the executions of each task stay below it (e-value {bets.wealth:.3g})"
        )
    return (
        f"trial {worst.number} has the distance {quantities.of(distance)}, which exceeds {quantities.of(limit)}, "
        f"in the task {quantities.task(worst).removeprefix('task ')}{reproduced}{noise}."  # of a suite: its name
    )


def noise_may_explain(bets: Bets, tau: float, quantities: Quantities) -> str:
    """Return that executions exceed a threshold, and that noise may be the cause."""
    exceed = "exceeds" if bets.above == 1 else "exceed"
    return (
        f"{bets.above} of {counted(bets.executions, 'execution')} {exceed} {quantities.of(f'{tau:.6g}')}, which noise "
        f"may explain (e-value {bets.wealth:.3g} against the threshold)"
    )


def falsified_beside(executed: Sequence[tuple[str, Trial]], tau: float, quantities: Quantities) -> str:
    """Return, as a sentence after a space, which trials of other stores exceed a threshold; empty if there are none."""
    if not executed:
        return ""
    first = "Another store of this experiment falsifies"
    if len(executed) > 1:
        first = f"{len(executed)} other stores of this experiment falsify"
    trials = (
        f"trial {trial.number} of {quoted(name)} has the distance "
        f"{quantities.of(distinguishable(trial.distance or 0.0, tau)[0])}, at {quantities.task(trial)}"
        for name, trial in executed[:3]
    )
    return f" {first} {quantities.of(f'{tau:.6g}')}: {'; '.join(trials)}{'; ...' if len(executed) > 3 else ''}."


# Validated


def validated(certificate: Certificate, tau: float, quantities: Quantities) -> str:
    """Return what is validated in one sentence: which tasks stay below the threshold, by which bound, if what holds."""
    upper, limit = _bound_and_limit(certificate, tau, quantities)
    kind, details, level = certificate.kind, certificate.details, percent(certificate.confidence)
    if kind == "suite":
        return (
            f"all {details['tasks']} tasks of the suite were executed, and no distance exceeds {limit}: the largest is "
            f"{upper}."
        )
    tests, quantile = details.get("tests"), details.get("quantile")
    untested = "" if tests is None or tests["drawn"] else "no prediction was tested at drawn tasks (tests = 0); "
    if certificate.volume:
        return (
            f"{untested}with {level} confidence, at most {at_most(100 * certificate.volume, 3)} % "
            f"{of_tasks(certificate.distribution)}{quantities.ranges} exceed {limit}: the {kind} bound is "
            f"{upper}, from {counted(certificate.trials, 'independent draw')}."
        )
    which = "" if quantile is None else f" in at least {100 * quantile:g} % of its executions"
    condition = "confidence, if its assumptions hold"
    if kind == "dynamics":
        condition = f"probability under a Gaussian process{condition_on_dynamics(details)}"
    elif kind == "posterior":
        what = "expected distance" if details.get("stochastic") else "distance"
        condition = f"probability under a Gaussian process, if the {what} is as smooth between the trials as at them"
        resolution = details.get("resolution")
        if resolution is not None and resolution["diagonals"] != RESOLUTION:
            diagonals = f"{resolution['diagonals']:g} diagonals; usual: {RESOLUTION:g}"
            condition += f"{_gaps(resolution, quantities)} ({diagonals})"
    return (
        f"{untested}every task{quantities.ranges} stays at or below {limit}{which}: the {kind} bound is {upper}, with "
        f"{level} {condition}."
    )


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


def rests_on(
    conditions: Sequence[str],
    certificate: Certificate,
    tau: float,
    quantities: Quantities,
    remarks: Sequence[str],
    alone: Sequence[str],
) -> str:
    """Return the evidence of a validation, what it rests on, and what independent draws say without any of it."""
    parts = list(conditions)
    made_good = certificate.details.get("failures", {}).get("made_good", [])
    if made_good:
        numbers = ", ".join(str(failure["trial"]) for failure in made_good)
        parts.append(f"your word that what made trial {numbers} fail is removed for good")
    parts += [*(f"your word that {remark}" for remark in remarks), *alone]
    trials = evidence(certificate, tau, quantities)
    return f"{trials}It rests on {'; on '.join(parts)}.{_without_assumptions(certificate, tau, quantities)}"


def evidence(certificate: Certificate, tau: float, quantities: Quantities) -> str:
    """Return what speaks for a bound on d*: executions, tests of predictions, and what the bound survives."""
    if certificate.volume or certificate.kind == "suite":
        return ""
    details = certificate.details
    best, tests, left = details.get("best"), details.get("tests"), details.get("not_executed")
    largest = "" if best is None else f", the largest distance {quantities.of(f'{best:.4g}')}"
    tested = ""
    if tests is not None and tests["drawn"]:
        tested = f"; {tests['drawn']} of them at tasks drawn over the whole task space"
        if tests["largest_error"] is not None:
            within = at_most(100 * tests["largest_error"] / tau, 2)
            tested += f", where the predictions made beforehand erred by at most {within} % of the threshold"
    missing = f"; {left} of the {details['tasks']} tasks were not executed" if left else ""
    survives = ""
    if (known := tolerances(certificate, tau)) is not None:
        everywhere, away = known
        survives = (
            f" The bound would survive a further error of M of {_push(everywhere)} at every step, or of {_push(away)} "
            f"where no record is near; its largest recorded error is {_rate(everywhere.state, everywhere.residual)}."
        )
    executions = counted(certificate.trials, "execution")
    least = _not_entered(details.get("pocket")) + _not_tried(details.get("empty_box"), quantities.space)
    return f"{executions}{largest}{tested}{missing}.{survives}{least} "


def tolerances(certificate: Certificate, tau: float) -> tuple[Tolerance, Tolerance] | None:
    """Return the smallest pushes, everywhere and away from all records, that bring a task above a threshold."""
    pushed = certificate.details.get("pushed")
    if pushed is None:
        return None
    distances = PushedDistances.from_json(pushed)
    return distances.tolerance(tau), distances.tolerance(tau, away=True)


def _push(tolerance: Tolerance) -> str:
    if np.isfinite(tolerance.push):
        return _rate(tolerance.state, tolerance.push)
    return "more than 8 times the largest residual"


def _rate(label: str, value: float) -> str:
    name, unit = parted(label)
    return f"{f'{two_digits(value)} {unit}'.rstrip()} in {name}"


def _not_entered(pocket: Mapping[str, Any] | None) -> str:
    """Return, as a sentence after a space, the largest region of two states that loops enter and no execution has."""
    if pocket is None:
        return ""
    return (
        f" The least tested place is {with_units(pocket['place'])}: predicted runs lead there, and no execution came "
        f"within {radius_of(pocket['within'])}."
    )


def _not_tried(empty: Mapping[str, Any] | None, space: TaskSpace | None) -> str:
    """Return, as a sentence after a space, the largest box of two task parameters without an execution."""
    if empty is None or space is None:
        return ""
    box, low, high = EmptyBox(**empty), space.low, space.high
    ends = zip(box.parameters, box.low, box.high, strict=True)
    sides = ((*parted(space.labels[j]), *(low[j] + np.array(side) * (high[j] - low[j])).tolist()) for j, *side in ends)
    both = " and ".join(f"{name} {first:.3g} to {last:.3g} {unit}".rstrip() for name, unit, first, last in sides)
    share = 100 * box.share
    return f" No execution had {both} together ({share:.0f} % of the task space, the largest box of two parameters)."


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
                once = (
                    "the noise being normal and alike everywhere (it is the expected distance that "
                    "is bounded: single executions may exceed it)"
                )
            return [f"the distance being as smooth between the trials as at them{where}", once]
        case "suite":
            return ["an execution of a task again giving the distance that was recorded"]
        case "audit" | "anytime" | "scenario" | "sampling-discarding" | "region":
            draws = (
                "tasks that were drawn independently, and from which M was not learned (how large the distance is in "
                f"the {at_most(100 * certificate.volume, 3)} % that are left out is not known)"
            )
            fixed = ["a prediction that was fixed before these tasks were drawn"]
            return [draws, *(fixed if certificate.kind == "region" else [])]
    return ["what its certificate assumes"]


def looked(known: int, smaller: Sequence[float], largest: float, quantities: Quantities) -> str:
    """Return that a threshold was stated after distances were known, and which smaller ones before it do not hold."""
    known_ones = "1 distance was" if known == 1 else f"{known} distances were"
    parts = [f"the threshold was stated after {known_ones} known"] if known else []
    falsified_ones = [each for each in smaller if each < largest]
    for group, how in ((falsified_ones, "falsified"), (smaller[len(falsified_ones) :], "left undecided")):
        if group:
            limits = enumerated((quantities.of(f"{each:.6g}") for each in group), 5)
            word, were, are = ("threshold", "was", "is") if len(group) == 1 else ("thresholds", "were", "are")
            parts.append(f"the smaller {word} {limits}, which {were} stated before, {are} {how}")
    return "".join(f"; {part}" for part in parts)


def not_selected(known: int, others: int, falsifying: Sequence[str]) -> list[str]:
    """Return that neither a threshold nor a campaign was selected, by what was known and by other stores."""
    distances = "distance that was" if known == 1 else "distances that were"
    fitted = f"the threshold not being chosen to suit the {known} {distances} known when it was stated"
    sentences, alone = [fitted] if known else [], "this campaign not being chosen among several"
    if not others:
        return [*sentences, alone]
    lie = "store of this experiment lies" if others == 1 else "stores of this experiment lie"
    which = "none of them falsifies the threshold" if others > 1 else "it does not falsify the threshold"
    if falsifying:
        verb = "falsifies" if len(falsifying) == 1 else "falsify"
        count = "it falsifies" if others == 1 else f"{len(falsifying)} of them {verb}"
        which = f"{count} the threshold ({enumerated(map(quoted, falsifying), 5)})"
    return [*sentences, f"{alone} ({others} other {lie} beside it, and {which})"]


def _without_assumptions(certificate: Certificate, tau: float, quantities: Quantities) -> str:
    tests = certificate.details.get("tests", {})
    if tests.get("share_missed") is None:
        return ""
    draws = [f"{counted(tests['spread'], 'test')} drawn as a Latin hypercube"] if tests["spread"] else []
    draws += [counted(tests["independent"], "independent draw")] if tests["independent"] else []
    return (
        f" By these tests alone, whatever the dynamics are: at most {at_most(100 * tests['share_missed'], 2)} % "
        f"{of_tasks(certificate.distribution)} exceed {quantities.of(f'{tau:.6g}')} "
        f"({' and '.join(draws)}, {percent(certificate.confidence)})."
    )


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
        why = f"no distance above {limit} was executed, but d* may be up to {upper}"
        if (quantile := certificate.details.get("quantile")) is not None:
            share = f"{100 * quantile:g} % of the executions of a task"
            why = f"{share} may have distances of up to {upper}, and the threshold is {limit}"
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
    outside, missing = "", details.get("not_counted")
    if "share_kept" in details:
        outside = (
            f" ({at_most(100 * details['volume_of_draws'], 3)} % because of the number of draws, and the rest because "
            "the prediction plus its margin exceeds the threshold there)"
        )
    left = f"; {missing} draws do not count, as their number was changed after they were known" if missing else ""
    return f"{outside}{left}"


def outlook(forecast: Forecast, horizon: int) -> str:
    """Return how many more executions are expected, and what they would decide, without a full stop."""
    many = f"about {forecast.executions}" if forecast.executions is not None else f"more than {horizon}"
    plural = "execution is" if forecast.executions == 1 else "executions are"
    if forecast.fewest:
        share = f"{100 * forecast.validated:.0f} % of the posterior samples of the dynamics stay below the threshold"
        return f"at least {forecast.executions} more {plural} needed to validate it, and {share}"
    shares = {"validated": forecast.validated, "falsified": forecast.falsified}
    answer = max(shares, key=lambda name: shares[name])
    outcome = f" ({answer} in {100 * shares[answer]:.0f} % of the simulated futures)" if shares[answer] else ""
    return f"{many} more {plural} expected to decide{outcome}"
