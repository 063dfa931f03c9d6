"""``ctxval safe``: in which tasks the system satisfies the specification of an experiment file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ctxval._util.checked import PositiveFloat, PositiveInt, require
from ctxval._util.representation import task_text
from ctxval._util.texts import enumerated
from ctxval.campaign.storage.store import Store
from ctxval.cli.base import FALSIFIED, command, failures_of, notes, out, print_failures, print_table
from ctxval.cli.config.settings import Settings, read_settings
from ctxval.cli.config.stored_settings import budget_of
from ctxval.errors import CtxvalError, InputError
from ctxval.specs import ReachAvoid
from ctxval.studies.safety import DrawnTasks, SafetyReport, assess, draw_tasks, require_safe_tasks
from ctxval.studies.safety.draws import require_box


@command()
def safe(
    target: str,
    margin: float | None = None,
    budget: int | None = None,
    confidence: float | None = None,
    audit: int | None = None,
    seed: int | None = None,
    store: Path | None = None,
    workers: int | None = None,
    timeout: float | None = None,
    accept_change: str | None = None,
) -> Any:
    require("margin", PositiveFloat | None, margin)
    require("audit", PositiveInt | None, audit)
    given = read_settings(target, {"budget": budget, "confidence": confidence, "seed": seed})
    if given.spec is None:
        raise InputError(f"{target} has no table [spec] with sets to avoid or to reach.")
    table = given.spec if margin is None else given.spec.model_copy(update={"margin": margin})
    asked: dict[str, Any] = {"spec": table, "judge": "spec", "threshold": table.margin, "explore": False}
    if given.certificate.kind == "auto":  # a Gaussian process of a distance with kinks would be no evidence
        asked["certificate"] = given.certificate.model_copy(update={"kind": "dynamics"})
    settings = given.model_copy(update=asked)
    experiment = settings.load()
    usual = settings.store_path(experiment.name)
    # It is not the store of a campaign of the experiment's own distance.
    path = usual.with_name(f"{usual.stem}.safe{usual.suffix}") if store is None else store
    if audit is not None:
        require_box(experiment.validation)
    share = require_safe_tasks(experiment.validation)
    campaign = settings.campaign(
        experiment, path, accept_change=accept_change, remeasure=_has_another_margin(path, settings)
    )
    total, certificate = budget_of(experiment, settings), settings.certificate_options
    units, wanted = experiment.units, f"{100 * share:.0f} % of the drawn tasks satisfy the specification on the model"
    if table.margin is not None:
        wanted += f" with the margin {table.margin:g} {units}".rstrip()
    out.say((experiment.name, "bold"), f": {wanted}", wrap=True)
    certificate.kind.require_usable(certificate.confidence, total)
    campaign.run(total, table.margin, certificate=certificate, explore=False, workers=workers, timeout=timeout)
    report, drawn = assess(campaign, certificate), None
    if audit is not None:
        least = report.d_b if report.d_b_bound is None else report.d_b_bound
        beside = path.with_name(f"{path.stem}.draws-above-{least:.6g}{path.suffix}")
        drawn = draw_tasks(campaign, least, audit, store=beside, confidence=certificate.confidence)
    _print(report, drawn)
    failures = failures_of(campaign.failed)
    print_failures(failures)
    out.say(f"store: {path}")
    summary = {**report.to_dict(), "drawn": drawn and vars(drawn), "budget": total, "failures": failures}
    return {**summary, "store": str(path)}, FALSIFIED if report.answer == "falsified" else 0


def _has_another_margin(path: Path, settings: Settings) -> bool:
    """Return whether a store was made for another margin, so that its distances are computed again."""
    if not path.exists() or not path.stat().st_size:
        return False
    try:
        kept = Store.existing(path).settings().get("spec")
    except CtxvalError:  # the campaign says it
        return False
    known, wanted = kept.get("margin") if isinstance(kept, dict) else None, settings.spec and settings.spec.margin
    if not isinstance(kept, dict) or known == wanted:
        return False
    notes.say(f"{path} was made for another margin: the distances of its executions are computed again.")
    return True


def _print(report: SafetyReport, drawn: DrawnTasks | None) -> None:
    units = report.units

    def of(value: float | None, before: str = "") -> str:
        return "unknown" if value is None else f"{before}{value:.4g} {units}".rstrip()

    if report.answer is not None and report.margin is not None:
        colour = {"validated": "green", "falsified": "red", "undecided": "yellow"}[report.answer]
        out.say((report.answer.upper(), f"bold {colour}"), f": margin {of(report.margin)}")
    out.say(report.statement[0].upper() + report.statement[1:], wrap=True)
    executed, predicted = "largest executed", "predicted to be at most"
    certified = "not certified" if report.d_b_bound is None else f"certified at most {of(report.d_b_bound)}"
    rows = {
        "largest deviation": f"{executed} {of(report.d_a)}, {predicted} {of(report.d_a_bound)}",
        "largest margin of an unsafe task": f"{executed} {of(report.d_b)}, {certified}",
    }
    if report.share_by_deviation is not None:
        rows["safe if no deviation is larger"] = f"{100 * report.share_by_deviation:.1f} %, which is not certified"
    if report.tightened is not None:
        if report.tightened.avoid:
            rows["avoid on the model"] = enumerated([repr(part) for part in report.tightened.avoid], 6)
        if report.tightened.reach is not None:
            rows["reach on the model"] = repr(report.tightened.reach)
    elif report.d_b_bound is not None and isinstance(report.spec, ReachAvoid):
        rows["sets on the model"] = "nothing is left of a set that grows or shrinks by the bound"
    if drawn is not None:
        rows["independent draws"] = (
            f"{drawn.unsafe} of {drawn.draws} tasks with a margin above {of(drawn.margin)} are unsafe: at most "
            f"{100 * drawn.share:.3g} % of them, with {100 * drawn.confidence:g} % confidence"
        )
    rows["between recorded times"] = f"the system moves by up to {of(report.between)}, which is not seen"
    rows["executions"] = str(report.executions)
    print_table(rows)
    for task in report.counterexamples[:5]:
        where = task_text(task.parameters)
        out.say(f"unsafe: {where}: {of(task.on_model)} on the model, {of(task.on_system)} on the system", wrap=True)
    if len(report.counterexamples) > 5:
        out.say(f"and {len(report.counterexamples) - 5} other unsafe tasks.")
