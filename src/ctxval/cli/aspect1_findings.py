"""What ``ctxval check --aspect1`` says of the tasks and the controllers on the model."""

from __future__ import annotations

from collections.abc import Iterator

from ctxval.aspect1 import Aspect1Report
from ctxval.certificates.bounds import of_tasks
from ctxval.config.check import Checked, convergence, task_text
from ctxval.core.soundness import SATURATED


def aspect1_findings(report: Aspect1Report) -> list[Checked]:
    """Return what simulations of M show of its tasks and controllers, as sentences."""
    unconverged = convergence(report.not_converged, report.designs)
    return [_completion(report), *_flips(report), *_saturated(report), unconverged]


def _completion(report: Aspect1Report) -> Checked:
    count, worst = len(report.simulated), report.worst
    at = task_text(worst.parameters)
    if report.failed:
        told = f"M has no closed loop in {len(report.failed)} of {count} tasks, for example at {at}"
        return Checked("tasks on the model", "failed", f"{told}: {worst.reason}")
    ends = f"the worst of {count} tasks is {at}, with an error of {_number(report, worst.error)}"
    if report.threshold is None:
        return Checked("tasks on the model", "noted", f"{ends}; give a threshold to judge it")
    if report.exceeding:
        many = f"M does not complete {report.exceeding} of {count} tasks within {_number(report, report.threshold)}"
        return Checked("tasks on the model", "failed", f"{many}: {ends}")
    bound = None if report.verdict is None else report.verdict.bound
    held = f"; the error over all tasks is at most {_number(report, bound)}" if bound is not None else ""
    tasks = "of all tasks" if report.distribution is None else of_tasks(report.distribution)
    share = f"; with confidence 0.95 it does not complete at most {100 * (report.share or 0):.3g} % {tasks}"
    return Checked("tasks on the model", "ok", f"M completes all of them: {ends}{share}{held}")


def _number(report: Aspect1Report, value: float | None) -> str:
    return f"{value:.4g} {report.units}".rstrip()


def _flips(report: Aspect1Report) -> Iterator[Checked]:
    found = report.flips
    if found is None or report.flipped is None:
        return
    differ = f"by {100 * found.largest:.3g} % of the range of the inputs"
    if not found.flipped:
        text = f"the inputs on M of {found.pairs} pairs of neighbouring tasks differ by at most {differ[3:]}"
        yield Checked("neighbouring tasks", "ok", text)
        return
    between = " and ".join(map(task_text, report.flipped))
    yield Checked(
        "neighbouring tasks",
        "noted",
        f"{found.flipped} of {found.pairs} pairs of neighbouring tasks have controllers that differ abruptly, such as "
        f"{between}, whose inputs on M differ {differ}",
    )


def _saturated(report: Aspect1Report) -> Iterator[Checked]:
    if report.saturation is None:
        return
    at_limit = dict(zip(report.inputs, report.saturation.shares.tolist(), strict=True))
    named = [f"{name} in {100 * share:.3g} %" for name, share in at_limit.items() if share >= SATURATED]
    how = "" if report.saturation.known else "; the synthesizer states no limits, so repeated extreme values count"
    if named:
        yield Checked("limits of the inputs", "noted", f"at a limit: {', '.join(named)} of the steps on M{how}")
    else:
        yield Checked("limits of the inputs", "ok", "the inputs stay off their limits on M")
