"""``ctxval remeasure``: recompute the distances of stored executions."""

from __future__ import annotations

from typing import Any

from ctxval.cli.base import command, out, print_table, worst_of
from ctxval.cli.commands import app
from ctxval.cli.options import AsJson, StoreArgument
from ctxval.cli.trust import AcceptChange, Named, Trust, open_store
from ctxval.storage.store import Store


@app.command()
@command
def remeasure(
    store: StoreArgument,
    experiment: Named = None,
    trust: Trust = False,
    accept_change: AcceptChange = None,
    as_json: AsJson = False,
) -> Any:
    """Recompute the distances of all stored executions, after you changed the distance function.

    Nothing is executed. If an experiment file defines the distance, name the file with --experiment. The history of the
    store keeps the earlier values.
    """
    known = Store.existing(store)
    before = {trial.number: trial.distance for trial in known.trials()}
    opened = open_store(known, store, experiment, trust, accept_change, remeasure=True)
    trials = opened.campaign.trials
    changed = [trial.number for trial in trials if trial.distance != before.get(trial.number)]
    report: dict[str, Any] = {
        "measured": sum(trial.state == "completed" for trial in trials),
        "changed": changed,
        "unmeasured": [trial.number for trial in opened.campaign.unmeasured],
        "worst": worst_of(opened.campaign.worst),
        "store": str(store),
    }
    if not as_json:
        if changed:
            count = f"{len(changed)} of {report['measured']}"
            out.say(f"{count} distances have changed. The history of the store keeps the earlier values.")
        else:
            file = "If an experiment file defines the distance, name the file with --experiment."
            out.say(f"no distance has changed. {file}")
        if report["unmeasured"]:
            out.say(f"trials without a distance: {', '.join(map(str, report['unmeasured']))}.")
        if report["worst"] is not None:
            print_table({"largest distance": report["worst"]})
    return report
