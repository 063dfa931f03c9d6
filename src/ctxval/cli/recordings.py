"""``ctxval replay`` and ``ctxval fit``: recordings of the system, and models learned from them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ctxval._util.files import read_toml
from ctxval._util.representation import counted, task_text
from ctxval._util.texts import shortened
from ctxval.cli import base
from ctxval.cli.base import command, named_values, notes, out, print_columns, require_outputs
from ctxval.cli.config.parts import part
from ctxval.cli.config.references import reference, require_function
from ctxval.cli.config.settings import ExperimentSettings, read_settings
from ctxval.core.experiment import Experiment
from ctxval.core.labels import names_of
from ctxval.core.model import Model, as_model
from ctxval.data import Field, LogMapping, Observer, Recordings, read_recordings
from ctxval.errors import InputError
from ctxval.models import REGISTRY, read_model
from ctxval.models.mujoco import is_sysid_result
from ctxval.studies.fitting import FitReport, FittedModel, FittedParameter, fit
from ctxval.studies.fitting.fit import HOLD_OUT, KINDS
from ctxval.studies.fitting.fit import STEPS as FITTED
from ctxval.studies.fitting.model_file import BESIDE, SUFFIXES, require_onnx, require_suffix, write_model_file
from ctxval.studies.replay import PredictedTask, ReplayReport
from ctxval.studies.replay import replay as compared
from ctxval.studies.replay.report import STEPS as REPLAYED
from ctxval.studies.replay.report import RecordedData


@dataclass(frozen=True)
class Logs:
    """How logs are read: with the mapping of a file, or with that of fields on the command line."""

    mapping: Path | None = None
    state: list[str] | None = None
    input_: list[str] | None = None
    time: str | None = None
    dt: float | None = None
    delay: float | None = None

    def stated(self) -> LogMapping | None:
        """Return the mapping of the file or of the fields on the command line; None if none is stated."""
        if self.state or self.input_:
            if self.mapping is not None:
                raise InputError("--mapping cannot be combined with --state and --input.")
            if not self.state:
                raise InputError("--input needs --state: name the fields of all states too.")
            fields: tuple[dict[str, Field], dict[str, Field]] = {}, {}
            for kind, given in zip(fields, (self.state, self.input_ or ()), strict=True):
                for text in given:
                    name, equals, path = map(str.strip, text.partition("="))
                    if not name or (equals and not path) or name in kind:
                        wanted = "each state and input must be given once, as NAME=FIELD"
                        raise InputError(f"{wanted}, got {text!r}.")
                    kind[name] = Field(path if equals else name)
            return replace(LogMapping(*fields), **self.changes)
        if self.mapping is None:
            return None
        mapping = replace(LogMapping.from_toml(self.mapping), **self.changes)
        return _with_observer(mapping, self.mapping.parent)

    @property
    def changes(self) -> dict[str, Any]:
        """What replaces the values of any mapping."""
        stated = {"time": self.time, "dt": self.dt, "delay": self.delay}
        return {name: value for name, value in stated.items() if value is not None}

    def read(
        self, logs: Sequence[Path], settings: ExperimentSettings | None = None, experiment: Experiment | None = None
    ) -> Recordings:
        """Return the recordings in files and folders, with the names and units of the experiment if they fit."""
        mapping = self.stated()
        if mapping is None and settings is not None and settings.log_mapping is not None:
            mapping = _with_observer(settings.log_mapping, settings.folder)
        states, inputs = dict[str, str](), dict[str, str]()
        if experiment is not None:
            system = experiment.validation.system
            known = {kind: getattr(experiment, kind) or names_of(system, kind) for kind in ("states", "inputs")}
            states, inputs = experiment.names(*map(len, known.values())) if known["states"] else ({}, {})
        recordings = read_recordings(logs, mapping, states=states, inputs=inputs, **self.changes)
        same = (len(states), len(inputs)) == (len(recordings.states), len(recordings.inputs))
        known_units = [*states.values(), *inputs.values()]
        units = [*recordings.states.values(), *recordings.inputs.values()]
        agree = same and all(unit in ("", known) for unit, known in zip(units, known_units, strict=True))
        return replace(recordings, states=states, inputs=inputs) if agree and not states.keys() & inputs else recordings


def _with_observer(mapping: LogMapping, folder: Path | None) -> LogMapping:
    """Return a mapping that the user has named, with the function of its observer, which is imported."""
    observer = mapping.observer
    if not isinstance(observer, Observer) or observer.function is not None:
        return mapping
    what = f"the observer {observer.reference}"
    function = require_function(what, reference(observer.reference, folder), "(y, u, dt) -> x")
    return replace(mapping, observer=replace(observer, function=function))


@dataclass(frozen=True)
class StepFunction:
    """The user's step function whose parameters are estimated, and their bounds."""

    step: str | None = None
    parameter: list[str] | None = None
    vectorized: bool = False

    @property
    def bounds(self) -> dict[str, Any]:
        return named_values(self.parameter, "--parameter")

    def load(self) -> Any:
        if self.step is None:
            return None
        return require_function(f"--step {self.step}", reference(self.step), "(x, u, theta) -> x_next")


_STEPS: dict[str, Any] = {"replayed": ",".join(map(str, REPLAYED)), "fitted": ",".join(map(str, FITTED))}


@command(**_STEPS)
def replay(
    logs: list[Path],
    reading: Logs,
    model: str | None = None,
    option: list[str] | None = None,
    experiment: str | None = None,
    steps: str | None = None,
    executions: int = 10,
    seed: int = 0,
) -> Any:
    settings = None if experiment is None else read_settings(experiment, {})
    loaded = None if settings is None else settings.load()
    recordings = reading.read(logs, settings, loaded)
    if model is not None:
        chosen = named_model(model, named_values(option), recordings.dt)
    elif loaded is not None:
        chosen = loaded.validation.model
    else:
        raise InputError("a model is needed: give --model, or --experiment for the model of an experiment.")
    wanted = REPLAYED if steps is None else numbers(steps)
    validation = None if loaded is None else loaded.validation.with_parts(model=chosen)
    report = compared(chosen, recordings, steps=wanted, validation=validation, executions=executions, seed=seed)
    units = "" if loaded is None else loaded.units
    _print_replay(report, units)
    return report.to_json()


def _print_replay(report: ReplayReport, units: str) -> None:
    data = report.data
    out.say(
        f"{counted(data.recordings, 'recording')}, {data.steps} steps of {data.dt:g} s ({data.steps * data.dt:.4g} s)"
    )
    out.say(f"states: {', '.join(data.states)}; inputs: {', '.join(data.inputs) or 'none'}")
    print_breaks(report.data)
    errors = sorted(report.errors, key=lambda error: list(data.states).index(error.state))
    rows = [(*error_cells(each), f"{each.lowest:.3g} to {each.highest:.3g}", f"{each.upper:.3g}") for each in errors]
    columns = ["state", "steps", "rms error", "of the change", "of recordings", "95 % below"]
    print_columns(columns, rows, "error of the prediction")
    if report.residuals:
        residuals = []
        for each in report.residuals:
            rms, rest = (f"{value:.3g} {each.unit}".rstrip() for value in (each.rms, each.rest))
            shares = (f"{100 * share:.0f} %" for share in (each.explained, each.linear, each.history))
            residuals.append((each.state, rms, *shares, rest))
        columns = ["state", "rms", "explained by (x, u)", "affine part", "explained by the step before", "rest"]
        print_columns(columns, residuals, "one-step residual on held-out recordings")
    if report.tasks is not None:
        _print_tasks("largest predicted distances, which no execution has tested", report.tasks.worst, units)
        upper = f"{report.tasks.upper:.4g} {units}".rstrip()
        median = f"{report.tasks.median:.4g}"
        out.say(f"largest distance over all tasks: {median}, at most {upper} in 95 % of the posterior samples")
        _print_tasks("executions that would tell most of the largest distance", report.tasks.executions, units)
    out.say("")
    for sentence in report.insights:
        out.say(("- ", "bold"), sentence, wrap=True)


def print_errors(models: Sequence[FittedModel], title: str, states: Sequence[str] = ()) -> None:
    """Print the errors of models; those of each in the order of the states, if it is given."""
    rows = []
    for model in models:
        errors = sorted(model.errors, key=lambda error: states.index(error.state) if states else 0)
        rows += [(model.kind, *error_cells(each)) for each in errors]
    print_columns(("model", "state", "steps", "rms error", "of the change"), rows, title, left=2)


def error_cells(error: Any) -> tuple[str, ...]:
    """Return the state, the number of steps, the error, and its share of the recorded change."""
    rms = f"{error.rms:.3g} {error.unit}".rstrip()
    return error.state, str(error.steps), rms, f"{100 * error.relative:.3g} %"


def _print_tasks(title: str, tasks: Sequence[PredictedTask], units: str) -> None:
    columns = ["task", f"distance [{units}]" if units else "distance", "90 % between"]
    rows = [[task_text(each.parameters), f"{each.median:.4g}", f"{each.low:.4g} and {each.high:.4g}"] for each in tasks]
    if any(each.resolved is not None for each in tasks):
        columns.append("resolved")
        for row, each in zip(rows, tasks, strict=True):
            row.append(f"{100 * (each.resolved or 0):.0f} %")
    print_columns(columns, rows, title)


@command("fit", kinds=", ".join(KINDS), **_STEPS)
def fit_models(
    logs: list[Path],
    reading: Logs,
    function: StepFunction,
    kind: str | None = None,
    given: str | None = None,
    hold_out: float = HOLD_OUT,
    steps: str | None = None,
    out_: Path | None = None,
    force: bool = False,
    seed: int = 0,
) -> Any:
    kinds: Any = kind.split(",") if kind else (["parameters"] if function.step is not None else list(KINDS[:3]))
    if (function.step is None) != (not function.parameter):
        raise InputError("--step and --parameter must be given together.")
    bounds = function.bounds
    require_model_file(out_, [*logs, reading.mapping, given], force=force)
    recordings = reading.read(logs)
    report = fit(
        recordings,
        [name.strip() for name in kinds],
        step=function.load(),
        bounds=bounds,
        vectorized=function.vectorized,
        given=None if given is None else named_model(given, {}, recordings.dt),
        hold_out=hold_out,
        steps=FITTED if steps is None else numbers(steps),
        seed=seed,
    )
    print_breaks(recordings)
    _print_fit(report)
    if not report.fitted:
        return {**report.to_json(), "files": []}, base.CANNOT_GO_ON
    written, learned = list[str](), [model for model in report.fitted if model.kind != "given"]
    best = (learned or report.fitted)[0]
    if out_ is not None:
        holds = [model for model in learned if isinstance(model.model, SUFFIXES[out_.suffix])]
        if not holds:
            tried = f"no model that was learned ({', '.join(model.kind for model in report.fitted)})"
            raise InputError(f"{tried} can be written to a file that ends in {out_.suffix}.")
        best = holds[0]
        written = write_model_file(out_, best.model, function.step)
        out.say(f"the {best.kind} model is in {' and '.join(written)}")
    if best.useless is not None:
        notes.say(("not good: ", "bold red"), f"{best.useless}.", wrap=True)
    return {**report.to_json(), "files": written}, 0 if best.useless is None else base.FALSIFIED


def require_model_file(path: Path | None, inputs: Iterable[object], *, force: bool) -> None:
    """Check that the file of a model and those beside it can be written, before anything is learned or executed."""
    if path is not None:
        require_suffix(path)
        if path.suffix == ".onnx":
            require_onnx()
        beside = {f"FILE{suffix}": path.with_suffix(suffix) for suffix in BESIDE}
        require_outputs({"--out": path, **beside}, inputs, force=force)


def print_parameters(parameters: Sequence[FittedParameter]) -> None:
    for each in parameters:
        note = f"; {each.note}" if each.note else ""
        between = f"between {each.low:.6g} and {each.high:.6g} with confidence 0.95{note}"
        out.say((each.name, "bold"), f" = {each.value:.6g}, {between}")


def _print_fit(report: FitReport) -> None:
    held, learned = report.held_out, report.learned_from
    errors_on = f"errors on {held.steps} steps of {len(held.runs)} others"
    out.say(f"learned from {learned.steps} steps of {len(learned.runs)} recordings; {errors_on}")
    if report.fitted:
        print_errors(report.fitted, "error on held-out recordings", list(held.states))
    for model in report.fitted:
        print_parameters(model.parameters)
        for note in model.notes:
            out.say((f"{model.kind}: ", "bold"), note, wrap=True)
    for failure in report.failed:
        notes.say((f"{failure.kind}: ", "yellow"), shortened(failure.reason))


def numbers(text: str) -> list[int]:
    parts = [part.strip() for part in text.split(",")]
    if not all(part.isdecimal() and int(part) > 0 for part in parts):
        raise InputError(f"--steps must be positive integers with commas between them, such as 1,10,50, got {text!r}.")
    return [int(part) for part in parts]


def print_breaks(recordings: Recordings | RecordedData) -> None:
    for note in recordings.notes:
        out.say((note, "dim"))
    for split in recordings.breaks[:5]:
        notes.say(("split:", "yellow"), f" {split}")
    if len(recordings.breaks) > 5:
        notes.say(f"and {len(recordings.breaks) - 5} other places; --json lists them.")


def named_model(text: str, options: Mapping[str, Any], dt: float | None = None) -> Model:
    """Return a model from a file, an experiment, ``module:attr`` or a name of the registry."""
    path = Path(text)
    if path.suffix in (".toml", ".npz"):
        if options:
            of = "of" if path.suffix == ".toml" else "in"
            raise InputError(f"the model {of} {text} takes no options, got {', '.join(options)}.")
        if path.suffix == ".npz":
            return read_model(path)
        content = read_toml(path) if path.is_file() else {}
        if set(content) == {"model"}:  # as `ctxval fit` writes it
            return as_model(part("model", content["model"], path.parent))
        return read_settings(text, {}).load().validation.model
    table: dict[str, Any] = {"type": text}
    if path.suffix == ".onnx":
        table = {"type": "Onnx", "source": text}
    elif path.suffix == ".xml" or is_sysid_result(path):
        table = {"type": "MuJoCo", "mjcf": text, "dt": dt}
    elif ":" not in text and text not in REGISTRY.built_in and text not in REGISTRY.installed:
        files = "a file that ends in .onnx, .npz, .xml or .toml, a result of mujoco.sysid"
        known = f"module:attr, or one of {', '.join(REGISTRY.built_in)}"
        raise InputError(f"a model must be {files}, {known}, got {text!r}.")
    return as_model(part("model", {**table, **options}))
