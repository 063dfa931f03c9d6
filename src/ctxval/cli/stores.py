"""``ctxval status`` and ``ctxval export``: the trials in a store."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

from ctxval._util.files import MADE_BY
from ctxval.cli.base import RUN, command, failures_of, out, print_failures, print_table, worst_of
from ctxval.cli.commands import app
from ctxval.cli.options import AsJson, StoreArgument
from ctxval.cli.outputs import Force, require_folder
from ctxval.errors import StoreAccessError
from ctxval.storage.recovery import export, recover
from ctxval.storage.store import Store


@app.command()
@command
def status(store: StoreArgument, as_json: AsJson = False) -> Any:
    """Summarise the trials in a store. Nothing is executed."""
    opened = Store.existing(store)
    with opened.snapshot():
        description, trials, changes = opened.description(), opened.trials(), opened.history()
        kept = opened.computed(RUN)
    verdict = None
    match kept:
        case {"verdict": {"verdict": str(answer), "threshold": float(threshold), "reason": str(reason)}}:
            verdict = f"{answer} against {threshold:g}: {reason}"
    search = description.get("search")
    report: dict[str, Any] = {
        "case": description.get("name"),
        "search": search.get("type") if isinstance(search, dict) else None,
        "seed": description.get("seed"),
        "executions": sum(trial.executed for trial in trials),
        "failed": sum(trial.state == "failed" for trial in trials),
        "failures": failures_of(trials),
        "unmeasured": [trial.number for trial in trials if trial.state == "unmeasured"],
        "open": [trial.number for trial in trials if trial.state == "open"],
        "worst": worst_of(
            max((t for t in trials if t.distance is not None), key=lambda t: t.distance or 0, default=None)
        ),
        "verdict": verdict,
        "changes": [asdict(change) for change in changes],
        "store": str(store),
    }
    if not as_json:
        print_table({key: value for key, value in report.items() if key not in ("failures", "changes")})
        for change in report["changes"]:
            out.say(f"{change['at'][:19]} {change['what']}: {change['why']}")
        print_failures(report["failures"])
    return report


@app.command("export")
@command
def export_store(
    store: Annotated[
        Path, typer.Argument(metavar="STORE", help="Store of a campaign (a .sqlite file). It may be damaged.")
    ],
    folder: Annotated[
        Path | None, typer.Option("--out", help="Output folder (default: a folder next to the store).")
    ] = None,
    force: Force = False,
    as_json: AsJson = False,
) -> Any:
    """Write the trials of a store as CSV and JSON.

    If the store is damaged, everything that can be read is written.
    """
    found = recover(store)
    if found.damaged and not found.trials and not found.trajectories:
        raise StoreAccessError(f"nothing can be read from {store}: it is not a store, or it is damaged completely.")
    target = store.with_suffix(".export") if folder is None else folder
    require_folder(target, ("trials.json", "trials.csv", "trajectories"), MADE_BY, force=force)
    export(found, target)
    report = {
        "trials": len(found.trials),
        "trajectories": len(found.trajectories),
        "damaged": found.damaged,
        "folder": str(target),
    }
    if not as_json:
        for sentence in found.damaged[:20]:
            out.say(("cannot be read", "yellow"), f": {sentence}")
        if len(found.damaged) > 20:
            out.say(f"and {len(found.damaged) - 20} others; trials.json lists them.")
        out.say(f"{len(found.trials)} trials and {len(found.trajectories)} trajectories in {target}")
    return report
