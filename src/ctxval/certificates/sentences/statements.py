"""What certificates state and assume, in sentences."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from ctxval._util.representation import counted
from ctxval._util.texts import enumerated
from ctxval.certificates.bounds import (
    at_most,
    except_for,
    late,
    of_tasks,
    percent,
    rubbing,
    state_of,
    with_error,
    with_units,
)
from ctxval.certificates.evidence import Evidence
from ctxval.certificates.sample import Sample, listed
from ctxval.core.target import Quantile, Share

if TYPE_CHECKING:
    from ctxval.certificates.envelope import Envelope

ONE_CAMPAIGN = (
    "this campaign was fixed beforehand and not chosen among several: the best of several is wrong more often than "
    "stated"
)
"""The assumption that all certificates share."""

UNSEEN = (
    "M was not learned from these tasks, nor chosen after seeing them: a model that is retrained on them needs a new "
    "store and fresh draws"
)
"""The assumption that all bounds from independent draws share."""

NO_BOUND = "nothing is said of how large the distance is in the volume left out: this is no bound on d*"

ABOUT_DRAWS = (
    UNSEEN,
    "each task has one distance: the system is deterministic",
    "nothing is assumed of how the distance depends on the task",
    NO_BOUND,
)
"""Assumptions and limits of the statements by independent draws among trials of any origin."""

ANY_ORDER = "how the tasks were chosen and when the campaign stopped does not matter"


EXECUTED_AGAIN = (
    "an execution of a task again gives the distance that was recorded: its noise is not bounded, and what one "
    "execution shows is all that is known of its task"
)
"""The assumption of a statement about executed tasks alone."""

LAW_OF_DISTANCES = (
    "the logarithm of the distance is normal, with one variance, about a linear function of the logarithms of positive "
    "task parameters and of the others as they are"
)
"""The assumption of a bound on the tasks of a suite that were not executed."""

INDEPENDENT_REPEATS = "executions of one task are independent, and later ones are like those that were recorded"
"""The assumption of a statement about repeated tasks."""


def suite_statement(upper: float, confidence: float, tasks: int, left: int) -> str:
    """Return the bound on a suite of which some tasks are left."""
    return (
        f"With {percent(confidence)} probability under a law of the distances, all {tasks} tasks of the suite stay at "
        f"or below {at_most(upper)}; {left} of them were not executed."
    )


# Independent draws


def share_above(sample: Sample, volume: float, confidence: float, limit: str, draws: int, remark: str = "") -> str:
    """Return the statement that at most a share of the tasks exceeds a limit, by independent draws."""
    return (
        f"With {percent(confidence)} confidence, at most {at_most(100 * volume, 3)} % {of_tasks(sample.distribution)} "
        f"have a distance above {limit}{remark} ({counted(draws, 'independent draw')})."
    )


def how_drawn(sample: Sample, drawn: Sample, tasks: str = "the audited tasks") -> tuple[str, ...]:
    """Return, as assumptions, how the draws that count were drawn, and how many draws do not count."""
    known, planned = len(sample.only("iid")), drawn.planned[-1]
    when = "their number was chosen before they were executed"
    if planned is None:
        when += " (the store does not know when)"
    elif planned > known:
        when = f"their number did not depend on their distances, although {planned} were planned and {known} are known"
    others = (
        f"{known - len(drawn)} other independent draws do not count: the number of draws was changed, or the verdict "
        "ended them, after they were known"
    )
    first = f"{tasks} are independent and {distributed(sample)}, and {when}"
    return (first,) if known == len(drawn) else (first, others)


def distributed(sample: Sample) -> str:
    """Return how independent draws are distributed, as the end of a clause "the tasks are independent and ..."."""
    if sample.distribution is None:
        return "uniform over the task space"
    return f"follow the stated distribution of tasks ({sample.distribution})"


def violations(sample: Sample) -> str:
    """Return a clause that draws without a distance count as violations, with their numbers."""
    numbers = [*sample.numbers_of("failed"), *sample.numbers_of("unmeasured")]
    return (
        f"{sample.failed} of {len(sample)} executions of independent draws have no distance and count as violations, "
        f"larger than any distance ({listed(numbers)})"
    )


# The posterior of the distance


def posterior_statement(upper: float, error: float, confidence: float, *, stochastic: bool) -> str:
    """Return the bound on d* from a Gaussian process of the distance."""
    what, bound = "the largest expected distance" if stochastic else "d*", with_error(upper, error)
    remark = " (plus or minus one standard error of the random draws that it is computed from)" if "±" in bound else ""
    given = "under a Gaussian process of the distance, given the trials"
    return f"With {percent(confidence)} probability {given}, {what} is at most {bound}{remark}."


def posterior_assumptions(sample: Sample, used: int, resolution: float, *, stochastic: bool) -> tuple[str, ...]:
    """Return what the posterior bound assumes; the process is conditioned on so many of the trials."""
    what, noise = "distance, or its logarithm,", "each task has one distance: the system is deterministic"
    if stochastic:
        what, noise = "expected distance", "executions of one task differ by independent normal noise of one size"
    left_out = (
        f"the process is conditioned on {used} of the {len(sample)} trials, the largest distances, the latest and "
        "well-spread ones, because all would take too long; the others would hardly raise the bound",
    )
    return (
        f"the {what} is a draw from a Gaussian process: a constant mean, a Matern kernel of smoothness 3/2 or 5/2, one "
        "length-scale for each parameter, all of them unknown and integrated over",
        f"it is as rough in one part of the task space as in another, as far as {resolution:g} of its diagonal from "
        "the trials: a peak in a gap between them, of which no trial shows a trace, is not covered; audit for that",
        noise,
        ANY_ORDER,
        *(left_out if used < len(sample) else ()),
    )


def both_outcomes(sample: Sample, *, stochastic: bool) -> str | None:
    """Return why a bound is withdrawn if a failed task later succeeded for no stated reason; None if none did."""
    first = next((success for success in sample.made_good if success.because is None), None)
    if first is None:
        return None
    what = "the system is not deterministic there"
    if stochastic:
        what = "a failure has no distance, so that nothing is known of the expected one there"
    return (
        f"trial {first.trial} failed and trial {first.by} executed the same task with success, for no stated reason: "
        f"{what}, and the bound is withdrawn; if the cause was removed in between, execute the task once more and say "
        f'so: ctxval ask STORE --again {first.trial} --because "what was changed"'
    )


def two_distances(sample: Sample, rows: tuple[int, int]) -> str:
    """Return that two executions of one task, which are rows of a sample, have different distances."""
    (first, second), (before, after) = ([of[row] for row in rows] for of in (sample.numbers, sample.distances))
    return (
        f"trials {first} and {second} executed one task, and their distances are {before:g} and {after:g}: the system "
        "is not deterministic"
    )


# Learned dynamics

IRREGULAR = (
    "the dynamics are smooth except at states like those of the recorded contacts: a quadratic function of one or two "
    "states, or of all states and inputs, tells them apart, and there is no other contact that no execution has met"
)
"""What an envelope assumes if it is learned without some recorded steps."""


def dynamics_statement(upper: float, error: float, confidence: float, evidence: Evidence) -> str:
    """Return the bound on d*, or on a quantile over executions of the worst task or over the tasks, from dynamics."""
    law = "a Gaussian process of the residual dynamics"
    law = "the posterior of M's uncertain parameters" if evidence.is_parametric else law
    shown = f"{upper:.6g}" if evidence.negligible else with_error(upper, error)
    bound, what = f"With {percent(confidence)} probability under {law}", f"d* is at most {shown}"
    match evidence.target:
        case Quantile(quantile=quantile):
            which = f"the {quantile:g} quantile of the distance"
            return f"{bound} with noise, {which} is at most {with_error(upper, error)} in every task."
        case Share(share=share):
            what = f"the distances of {100 * share:.4g} % of the tasks are at most {shown}"
    return f"If {SMALL_ERRORS}, {what}." if evidence.negligible else f"{bound}, {what}."


SMALL_ERRORS = "M errs nowhere by more than its largest error in a recorded step"
"""The assumption if the errors of M are negligible in all executions."""

_PARAMETRIC = (
    "in every task, also in states that no execution entered, the system is M with other values of its uncertain "
    "parameters, and differs from it in a step as in the recorded steps"
)


def in_words(parameters: Mapping[str, Sequence[float]]) -> str:
    """Return the median of each parameter with its 5 % and 95 % quantiles."""
    return ", ".join(f"{name} {median:.4g} [{low:.4g}, {high:.4g}]" for name, (median, low, high) in parameters.items())


_WITHOUT_DATA = (
    "the data that M was made from contradict the executions and are left out: M was learned on another system, or the "
    "system has changed since",
)


def dynamics_assumptions(evidence: Evidence) -> tuple[str, ...]:
    """Return what the bound from learned dynamics assumes."""
    coordinates = len(evidence.coverage.resolution)
    prior = (
        "the residual x' - M(x, u) is a draw from a Gaussian process: a Matern kernel of smoothness 3/2 or 5/2 that "
        "may grow with the inputs, plus a linear function"
    )
    if evidence.without_model:
        prior = (
            "a smooth function and a linear model explain the records far better than one and M, so the system is "
            "learned without M: its difference from the linear model that fits best is a draw from a Gaussian process, "
            "a Matern kernel of smoothness 3/2, 5/2 or 9/2 that may grow with the inputs, plus a linear function"
        )
    joint = "what happens only at a combination of three or more coordinates that was never visited is not covered"
    if evidence.coverage.pair is None:
        joint = (
            f"with {coordinates} coordinates of state and input, the records cover each one alone and not all "
            "combinations: what happens only at a combination that was never visited, such as a contact in a corner, "
            "is not covered"
        )
    steps = "the last record" if not evidence.lags else f"the last {evidence.lags + 1} records"
    state = f"{'' if evidence.estimated else 'the '}{state_of(evidence.estimated)}"
    complete = f"{state} is complete: the next state depends on it and on the input alone"
    if evidence.lags or evidence.target.is_noisy:
        complete = f"the next record depends on {steps} and inputs alone, up to noise"
    but = except_for(evidence.physical)
    alike = f"the system is deterministic, and its dynamics do not change with time or with the task{but}"
    if evidence.target.is_noisy:
        alike = (
            "noise is independent from step to step, like that of the records, and the dynamics do not change with "
            f"time or with the task{but}"
        )
    acting, friction = late(evidence.acting), rubbing(evidence.friction)
    searched = (
        f"the search of {evidence.evaluations} closed loops on the learned dynamics found the largest distance of each "
        "posterior sample"
    )
    if evidence.target.share < 1:
        searched = (
            f"the shares of tasks follow from {evidence.evaluations} closed loops of randomly drawn tasks, which "
            "exaggerate each posterior sample's distance with a probability of 99 %"
        )
    if evidence.is_parametric:
        return complete, alike, f"{_PARAMETRIC} ({in_words(evidence.parameters)})", searched, ANY_ORDER
    if evidence.negligible:
        gaps = with_units(evidence.coverage.resolution)
        beside = f"the largest gaps of the records of states and inputs, where this is not known, are {gaps}"
        return complete, alike, SMALL_ERRORS, beside, joint, ANY_ORDER
    return (
        complete,
        *([f"inputs act alike in every task: {acting.removeprefix('acting ')}"] if acting else []),
        *([f"{friction} is the same everywhere and after any time at rest"] if friction else []),
        alike,
        f"{prior}; its hyperparameters are unknown and integrated over",
        *(_WITHOUT_DATA if evidence.without_data else ()),
        "in gaps of the records, the residual is like what was seen beside them; the largest gaps of states and inputs "
        f"are {with_units(evidence.coverage.resolution)}",
        joint,
        searched,
        ANY_ORDER,
    )


def condition_on_dynamics(details: Mapping[str, Any]) -> str:
    """Return the condition under which the confidence of a bound from learned dynamics holds."""
    if details["parameters"]:
        return " of M's uncertain parameters, if the system is M with other values of them, and errors as recorded"
    physical = details["physical"]
    state, acting = state_of(details["estimated"]), late(details["acting"])
    acting = f" ({acting})" if acting else ""
    friction = f"{rubbing(details['friction'])} and " if details["friction"] else ""
    lags = f" of the last {details['lags'] + 1} steps" if details["lags"] else ""
    recorded = [f"{state.replace('state', 'states', 1)} and inputs{lags}{acting}"]
    if details["quantile"] is not None:
        return (
            f" with noise, if what M misses is {friction}a smooth function of "
            f"{enumerated([*recorded, *physical], 10)}, the same in every task and over time, and noise is independent "
            "from step to step and like that of the records"
        )
    if not lags:
        recorded = [state, f"input{acting}"] if physical else [f"{state} and input{acting}"]
    missed = "the system" if details["without_model"] else "what M misses"
    return (
        f", if {missed} is {friction}one smooth function of {enumerated([*recorded, *physical], 10)}, the same in "
        "every task and over time"
    )


def conditions_on_dynamics(details: Mapping[str, Any]) -> list[str]:
    """Return what a validation by learned dynamics rests on."""
    again, lags, estimated = details["differing"], details["lags"], details["estimated"]
    changing = f"changing neither with time nor with the task{except_for(details['physical'])}"
    steps = f"the last {lags + 1} records and inputs" if lags else "the last record and input"
    complete = f"{steps} determining the next record"
    if details["quantile"] is not None:
        complete += " up to noise"
        alike = (
            "noise being independent from step to step and like that of the records, and the system's dynamics "
            f"{changing}"
        )
    else:
        if not lags:
            complete = f"{'' if estimated else 'the '}{state_of(estimated)} being complete"
        noise = "" if again is None else f" (trials {again[0]} and {again[1]} of one task differ a little)"
        alike = f"the system being deterministic{noise}, and its dynamics {changing}"
    acting, friction = late(details["acting"]), rubbing(details["friction"])
    if details["parameters"]:
        values = in_words(details["parameters"])
        return [complete, alike, f"M having the right uncertain parameters ({values}), also where no execution was"]
    return [
        complete,
        *([f"the inputs {acting} in every task, as in the executions"] if acting else []),
        *([f"{friction} being the same everywhere and after any time at rest"] if friction else []),
        alike,
        "its dynamics in the gaps of the records being like those beside the gaps (at most "
        f"{with_units(details['resolution'])} wide in single coordinates, wider in several at once)",
    ]


def whole_suite_statement(trusted: int, tasks: int, threshold: float, units: str) -> str:
    """Return what the envelope of a suite says whose tasks were all executed."""
    limit = f"{at_most(threshold)} {units}".rstrip()
    return f"All {tasks} tasks of the suite were executed, and d stays below {limit} on {trusted or 'none'} of them."


def envelope_statement(envelope: Envelope) -> str:
    """Return what an envelope says, why it is not larger, and what nothing has checked."""
    limit = f"{at_most(envelope.threshold)} {envelope.units}".rstrip()
    size = f"{100 * envelope.share:.2g} % of the tasks" if envelope.tasks is None else f"{len(envelope.tasks)} tasks"
    tasks = f"all tasks of a set of {size}" if envelope.share else "no task that can be named"
    sentences = [
        f"With {percent(envelope.confidence)} confidence, {envelope.target.of_distance} stays below {limit} on {tasks}."
    ]
    or_irregular = " or come to contacts" if envelope.irregular else ""
    if envelope.uncovered >= 0.005:
        sentences.append(
            f"Another {100 * envelope.uncovered:.2g} % of the tasks are predicted to stay below it, but their runs "
            f"leave what was recorded{or_irregular}, so they are not trusted, however accurate the model is there."
        )
    if envelope.irregular:
        steps = "1 recorded step is" if envelope.irregular == 1 else f"{envelope.irregular} recorded steps are"
        sentences.append(
            f"{steps} not explained by a smooth function of state and input, as at a contact; tasks whose predicted "
            "runs come near such states are not trusted."
        )
    if envelope.share and envelope.tasks is None and not envelope.checks:
        sentences.append(
            f"Boxes, pictures and saved functions are interpolated between {envelope.evaluated} tasks whose closed "
            "loops were run, and no further task checks this, because the planner designs one task at a time."
        )
    return " ".join(sentences)
