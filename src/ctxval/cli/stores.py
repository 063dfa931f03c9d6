"""``ctxval status``, ``ctxval export`` and ``ctxval remeasure``: the trials in a store."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

from ctxval._util.files import MADE_BY
from ctxval._util.representation import counted
from ctxval.campaign.storage.recovery import export, recover
from ctxval.campaign.storage.store import Store
from ctxval.cli.base import RUN, command, failures_of, out, print_failures, print_table, worst_of
from ctxval.cli.config.stored_settings import open_store
from ctxval.cli.options import Allowed, require_folder
from ctxval.errors import StoreAccessError


@command()
def status(store: Path) -> Any:
    opened = Store.existing(store)
    with opened.snapshot():
        description, trials, changes = opened.description(), opened.trials(), opened.history()
        thresholds = [asdict(stated) for stated in opened.thresholds() or ()]
        kept = opened.computed(RUN)
    verdict = None
    match kept:
        case {"verdict": {"verdict": str(answer), "threshold": float(threshold), "reason": str(reason)}}:
            verdict = f"{answer} against {threshold:g}: {reason}"
    search = description.get("search")
    measured = [trial for trial in trials if trial.distance is not None]
    report: dict[str, Any] = {
        "case": description.get("name"),
        "search": search.get("type") if isinstance(search, dict) else None,
        "seed": description.get("seed"),
        "executions": sum(trial.executed for trial in trials),
        "failed": sum(trial.state == "failed" for trial in trials),
        "failures": failures_of(trials),
        "unmeasured": [trial.number for trial in trials if trial.state == "unmeasured"],
        "open": [trial.number for trial in trials if trial.state == "open"],
        "worst": worst_of(max(measured, key=lambda trial: trial.distance or 0, default=None)),
        "verdict": verdict,
        "thresholds": thresholds,
        "changes": [asdict(change) for change in changes],
        "store": str(store),
    }
    print_table({key: value for key, value in report.items() if key not in ("failures", "thresholds", "changes")})
    for stated in thresholds:
        known = counted(stated["distances"], "known distance")
        out.say(f"{stated['at'][:19]} threshold {stated['threshold']:g}: stated after {known}")
    for change in report["changes"]:
        out.say(f"{change['at'][:19]} {change['what']}: {change['why']}")
    print_failures(report["failures"])
    return report


@command("export")
def export_store(store: Path, out_: Path | None = None, force: bool = False) -> Any:
    content = recover(store)
    if content.damaged and not content.trials and not content.trajectories:
        raise StoreAccessError(f"nothing can be read from {store}: it is not a store, or it is damaged completely.")
    target = store.with_suffix(".export") if out_ is None else out_
    require_folder(target, ("trials.json", "trials.csv", "trajectories"), MADE_BY, force=force)
    export(content, target)
    for sentence in content.damaged[:20]:
        out.say(("cannot be read", "yellow"), f": {sentence}")
    if len(content.damaged) > 20:
        out.say(f"and {len(content.damaged) - 20} others; trials.json lists them.")
    counts = {"trials": len(content.trials), "trajectories": len(content.trajectories)}
    out.say(f"{counts['trials']} trials and {counts['trajectories']} trajectories in {target}")
    return {**counts, "damaged": content.damaged, "folder": str(target)}


@command()
def remeasure(store: Path, allowed: Allowed) -> Any:
    before = {trial.number: trial.distance for trial in Store.existing(store).trials()}
    campaign = open_store(store, allowed, remeasure=True).campaign
    trials = campaign.trials
    report: dict[str, Any] = {
        "measured": sum(trial.state == "completed" for trial in trials),
        "changed": [trial.number for trial in trials if trial.distance != before.get(trial.number)],
        "unmeasured": [trial.number for trial in campaign.unmeasured],
        "worst": worst_of(campaign.worst),
        "store": str(store),
    }
    if report["changed"]:
        count = f"{len(report['changed'])} of {report['measured']}"
        out.say(f"{count} distances have changed. The history of the store keeps the earlier values.")
    else:
        file = "If an experiment file defines the distance, name the file with --experiment."
        out.say(f"no distance has changed. {file}")
    if report["unmeasured"]:
        out.say(f"trials without a distance: {', '.join(map(str, report['unmeasured']))}.")
    if report["worst"] is not None:
        print_table({"largest distance": report["worst"]})
    return report
