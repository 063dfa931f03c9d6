"""``ctxval start``: from logs to a first statement, a mapping, a model and an experiment file to edit."""

from __future__ import annotations

import json
import shlex
from pathlib import Path
from string import Template
from typing import Any

import numpy as np

from ctxval._util.files import write_text
from ctxval.cli.base import command, out, print_columns, require_outputs
from ctxval.cli.recordings import Logs, error_cells, print_breaks
from ctxval.data import Field, LogMapping, Observer
from ctxval.models import write_model
from ctxval.report.replay_page import write_replay_page
from ctxval.studies.survey import Survey, survey


@command()
def start(logs: list[Path], reading: Logs, out_: Path = Path("start"), force: bool = False, seed: int = 0) -> Any:
    files = {name: out_ / name for name in ("mapping.toml", "model.npz", "experiment.toml", "report.html")}
    require_outputs({f"--out {name}": path for name, path in files.items()}, [*logs, reading.mapping], force=force)
    stated = reading.stated()
    result = survey(logs, stated, dt=reading.dt, seed=seed)
    _print(result)
    write_text(files["mapping.toml"], mapping_text(result.mapping, result.recordings.dt))
    write_model(files["model.npz"], result.best.model)
    write_replay_page(result.replay, files["report.html"], name=f"the {result.best.kind} model")
    if result.recordings.inputs:
        write_text(files["experiment.toml"], experiment_text(result))
    else:
        del files["experiment.toml"]
    out.say("")
    out.say(f"{', '.join(files)} in {out_}")
    if result.recordings.inputs:
        where = shlex.quote(str(files["experiment.toml"]))
        out.say(f"next: edit {where}, and then ctxval check {where}")
    return {**result.to_json(), "files": [str(path) for path in files.values()]}


def _print(result: Survey) -> None:
    recordings = result.recordings
    steps = f"{recordings.steps} steps of {recordings.dt:g} s"
    out.say(f"{len(result.sources)} logs, {len(recordings.runs)} recordings, {steps}")
    rows = [
        (
            field.path,
            field.role or "-",
            f"{field.period:.3g} s" if field.period else "-",
            f"{field.low:.4g} to {f'{field.high:.4g} {field.unit}'.rstrip()}" if field.records else "-",
            field.remark,
        )
        for field in result.fields[:24]
    ]
    print_columns(["field", "taken as", "every", "values", "remark"], rows, "fields of the logs", left=2)
    if len(result.fields) > 24:
        out.say(f"and {len(result.fields) - 24} other fields; --json lists them.")
    for guess in result.guesses:
        out.say(("guessed: ", "yellow"), guess, wrap=True)
    print_breaks(recordings)
    errors = [(model.kind, *error_cells(each)) for model in result.fit.fitted for each in model.errors]
    print_columns(["model", "state", "steps", "rms error", "of the change"], errors, "error on others", left=2)
    out.say("")
    for sentence in result.replay.insights:
        out.say(("- ", "bold"), sentence, wrap=True)
    out.say((f"{result.statement[:1].upper()}{result.statement[1:]}.", "bold"), wrap=True)


def mapping_text(mapping: LogMapping, dt: float) -> str:
    usual = vars(Field("x"))

    def text_of(field: Field) -> str:
        changed = {name: value for name, value in vars(field).items() if value != usual[name] and value != ""}
        if set(changed) == {"path"}:
            return json.dumps(field.path)
        return f"{{ {', '.join(f'{name} = {json.dumps(value)}' for name, value in changed.items())} }}"

    lines = [f"dt = {dt!r}  # time step of the model, seconds"]
    for name in ("time", "time_unit", "delay", "longest_gap", "lags", "valid"):
        if value := getattr(mapping, name):
            lines.append(f"{name} = {json.dumps(value)}")
    for kind in ("states", "inputs"):
        fields = getattr(mapping, kind).items()
        lines += ["", f"[{kind}]", *(f"{json.dumps(name)} = {text_of(field)}" for name, field in fields)]
    if isinstance(mapping.observer, Observer):
        named = ", ".join(f"{json.dumps(name)} = {json.dumps(unit)}" for name, unit in mapping.observer.states.items())
        lines += ["", "[observer]", f"function = {json.dumps(mapping.observer.reference)}", f"states = {{ {named} }}"]
    return "\n".join(lines) + "\n"


def experiment_text(result: Survey) -> str:
    """Return an experiment file to edit: goals within the recorded range of the first state, and LQR on the model."""
    recordings = result.recordings
    states, inputs = recordings.states, recordings.inputs
    x = np.concatenate([run.trajectory.states for run in recordings.runs])
    u = np.concatenate([run.trajectory.inputs for run in recordings.runs])
    first, unit = next(iter(states.items()))

    def numbers(values: Any) -> list[float]:
        return [float(f"{value:.3g}") for value in values]

    values = {
        "unit": unit,
        "goals": numbers(np.quantile(x[:, 0], [0.05, 0.95])) + ([unit] if unit else []),
        "start": numbers(np.median([run.trajectory.states[0] for run in recordings.runs], axis=0)),
        "goal": ["goal", *[0.0] * (len(states) - 1)],
        "horizon": min(max(result.reach[1], 10), 200),
        "dt": recordings.dt,
        "Q": numbers(1 / np.maximum(x.var(axis=0), 1e-12)),
        "R": numbers(1 / np.maximum(u.var(axis=0), 1e-12)),
    }
    texts = {name: json.dumps(value) for name, value in values.items()}
    for kind, units in (("state", states), ("input", inputs)):
        rows = [f"{json.dumps(name)} = {json.dumps(unit)}" for name, unit in units.items()]
        texts |= {f"{kind}s": ", ".join(units), f"{kind}_units": ", ".join(rows), f"{kind}_rows": "\n".join(rows)}
    template = (Path(__file__).parent / "example" / "start.toml.txt").read_text("utf-8")
    return Template(template).substitute(texts, first=first)
