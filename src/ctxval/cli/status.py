"""``ctxval status`` and ``ctxval export``: what the file of a store holds. No code of an experiment is loaded."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

from ctxval._util.files import MADE_BY
from ctxval._util.representation import counted
from ctxval.campaign.storage.recovery import export, recover
from ctxval.campaign.storage.store import Store
from ctxval.cli import base
from ctxval.cli.base import command, out, print_table
from ctxval.core.trial import Trials
from ctxval.errors import StoreAccessError


@command()
def status(store: Path, set_aside: int | None = None) -> Any:
    opened = Store.existing(store)
    if set_aside is not None:
        from ctxval.campaign.storage import setting_aside  # imported here: `ctxval status` starts faster without it

        out.say(f"{setting_aside.set_aside(opened, set_aside)}. The history of the store keeps what it held.")
    with opened.snapshot():
        description, trials, changes = opened.description(), Trials(opened.trials()), opened.history()
        thresholds = [asdict(stated) for stated in opened.thresholds() or ()]
        kept = opened.computed(base.RUN)
    verdict = None
    match kept:
        case {"verdict": {"verdict": str(answer), "threshold": float(threshold), "reason": str(reason)}}:
            verdict = f"{answer} against {threshold:g}: {reason}"
    search = description.get("search")
    search = search.get("type") if isinstance(search, dict) else None
    without = {"unmeasured": trials.in_state("unmeasured").numbers, "open": trials.open.numbers}
    report: dict[str, Any] = {
        "case": description.get("name"),
        "search": search,
        "seed": description.get("seed"),
        **base.summary_of(trials),
        **without,
        "verdict": verdict,
        "thresholds": thresholds,
        "changes": [asdict(change) for change in changes],
        "store": str(store),
    }
    rows = ("case", "search", "seed", "executions", "failed", *without, "worst", "verdict", "store")
    print_table({key: report[key] for key in rows})
    for stated in thresholds:
        known = counted(stated["distances"], "known distance")
        out.say(f"{stated['at'][:19]} threshold {stated['threshold']:g}: stated after {known}")
    for change in report["changes"]:
        out.say(f"{change['at'][:19]} {change['what']}: {change['why']}")
    base.print_failures(report["failures"])
    return report


@command("export")
def export_store(store: Path, out_: Path | None = None, force: bool = False) -> Any:
    content = recover(store)
    if content.damaged and not content.trials and not content.trajectories:
        raise StoreAccessError(f"nothing can be read from {store}: it is not a store, or it is damaged completely.")
    target = store.with_suffix(".export") if out_ is None else out_
    base.require_folder(target, ("trials.json", "trials.csv", "trajectories"), MADE_BY, force=force)
    export(content, target)
    for sentence in content.damaged[:20]:
        out.say(("cannot be read", "yellow"), f": {sentence}")
    if len(content.damaged) > 20:
        out.say(f"and {len(content.damaged) - 20} others; trials.json lists them.")
    counts = {"trials": len(content.trials), "trajectories": len(content.trajectories)}
    out.say(f"{counts['trials']} trials and {counts['trajectories']} trajectories in {target}")
    return {**counts, "damaged": content.damaged, "folder": str(target)}
