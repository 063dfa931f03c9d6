"""``ctxval remeasure``: distances anew for what was executed."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from ctxval.cli.base import AsJson, app, command, out, worst_of
from ctxval.cli.trust import AcceptChange, Named, Trust, open_store
from ctxval.storage.store import Store


@app.command()
@command
def remeasure(
    store: Annotated[Path, typer.Argument(metavar="STORE", help="File of a campaign's trials.")],
    experiment: Named = None,
    trust: Trust = False,
    accept_change: AcceptChange = None,
    as_json: AsJson = False,
) -> Any:
    """Compute the distance of every stored execution again, after the distance was changed or mended.

    Nothing is executed. If the distance stands in an experiment file, name the file with --experiment. The values that
    were stored before stay in the store's history.
    """
    known = Store.existing(store)
    before = {trial.number: trial.distance for trial in known.trials()}
    opened = open_store(known, store, experiment, trust, accept_change, remeasure=True)
    trials = opened.campaign.trials
    changed = [trial.number for trial in trials if trial.distance != before.get(trial.number)]
    report = {
        "measured": sum(trial.state == "completed" for trial in trials),
        "changed": changed,
        "unmeasured": [trial.number for trial in opened.campaign.unmeasured],
        "worst": worst_of(opened.campaign.worst),
        "store": str(store),
    }
    if not as_json:
        _print(report)
    return report


def _print(report: dict[str, Any]) -> None:
    changed, waiting = len(report["changed"]), report["unmeasured"]
    if changed:
        out.say(f"{changed} of {report['measured']} distances have changed; the store's history has those of before.")
    else:
        out.say("no distance has changed; if the distance stands in an experiment file, name it with --experiment.")
    if waiting:
        out.say(f"without a distance: trials {', '.join(map(str, waiting))}.")
    if report["worst"] is not None:
        task = ", ".join(f"{name} = {value}" for name, value in report["worst"]["task"].items())
        out.say(f"the largest distance is {report['worst']['distance']:.4g} at {task}.")
