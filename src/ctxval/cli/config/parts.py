"""The parts of an experiment, made from tables that name a part of a registry, or code of users as ``module:attr``."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, get_type_hints

from ctxval import Experiment, Parameters, TaskSpace, Transitions, cases, controllers, distances, models, systems
from ctxval._util.checked import require, require_known
from ctxval._util.files import Archive, read_bytes
from ctxval._util.refusals import reworded
from ctxval._util.registry import Declaration, Registry, construct, declaration_of
from ctxval.cli.config.references import accepts, is_function, reference, require_function, require_part
from ctxval.core.model import Model
from ctxval.core.task import COMMAND, Task
from ctxval.core.task_distribution import Normal
from ctxval.core.validation import Validation
from ctxval.data import LogMapping, read_recordings
from ctxval.errors import InputError
from ctxval.models.saved import stored_transitions

_REGISTRIES = (systems.REGISTRY, models.REGISTRY, controllers.REGISTRY, distances.REGISTRY)
REGISTRIES: dict[str, Registry[Any]] = {registry.kind: registry for registry in _REGISTRIES}
"""Where the parts that an experiment file describes are found, by the name of their table."""


Names = Mapping[str, Mapping[str, str]]  #: the ``states`` and the ``inputs`` of an experiment file, with units


def part(kind: str, given: Mapping[str, Any], folder: Path | None = None, names: Names | None = None) -> Any:
    """Return a system, model, synthesizer or distance; ``names`` are looked for in recorded data of a model."""
    registry = REGISTRIES[kind]
    table = dict(given) if isinstance(given, Mapping) else {}
    name = table.pop("type", None)
    if not isinstance(name, str):
        example = f'type = "{given if isinstance(given, str) else registry.built_in[0]}"'
        raise InputError(f"the {kind} must be a table with a type, such as {{ {example} }}, got {given!r}.")
    what = f"the {kind} {name}"
    if ":" in name:
        arguments = {key: argument(value, folder) for key, value in table.items()}
        named = reference(name, folder)
        # A model or a distance may be a function itself, rather than a function that makes one.
        count = {"model": 2, "distance": 3}.get(registry.kind)
        makes = inspect.isfunction(named) and (bool(arguments) or count is None or not accepts(named, count))
        if isinstance(named, type) or (makes and not arguments and not accepts(named, 0)):
            require_part(registry, what, named)  # raises an error with the reason
        if isinstance(named, type) or makes:
            named = _built(registry.kind, what, named, arguments, folder, names)
        elif arguments:
            raise InputError(f"{what} is an object already, so it takes no arguments, got {', '.join(arguments)}.")
        return require_part(registry, what, named)
    build = registry.find(name)
    declared = declaration_of(build) or Declaration(name)
    placed = dict(table)
    if folder is not None and declared.folder is not None:
        placed[declared.folder] = str(folder / str(table.get(declared.folder, "")))
    for key in declared.files if folder is not None else ():
        file = table.get(key)
        if isinstance(file, str) and "<" not in file:  # "<" begins a MuJoCo model that is given as text
            placed[key] = str(Path(folder or "") / file)
    arguments = {
        key: part(declared.parts[key], value, folder)
        if key in declared.parts and not (isinstance(value, Mapping) and "ref" in value)
        else argument(value, folder)
        for key, value in placed.items()
    }
    for key, value in arguments.items():
        if key in declared.functions and isinstance(table[key], Mapping) and not isinstance(value, Model):
            require_function(f"{key} of {what}", value, declared.functions[key])
    return registry.require_made(name, _built(kind, what, build, arguments, folder, names))


def _built(
    kind: str, what: str, build: Any, arguments: dict[str, Any], folder: Path | None, names: Names | None
) -> Any:
    if kind == "model" and "data" in arguments and (hasattr(build, "fit") or declaration_of(build) is not None):
        # A part that cannot be learned here, such as a network, keeps the data, so that searches begin with them.
        data = recorded(arguments["data"], folder, names)
        build, arguments = getattr(build, "fit", build), {**arguments, "data": data}
    return construct(what, build, arguments)


def argument(value: Any, folder: Path | None = None) -> Any:
    """Return an argument unchanged, or the object that ``{ref = "module:attr"}`` names."""
    match value:
        case {"ref": text, **others} if not others:
            named = reference(str(text), folder)
            if inspect.ismodule(named) or (inspect.isroutine(named) and not inspect.isfunction(named)):
                raise InputError(f"{text} must be an object, a class or a function written in Python, got {named!r}.")
            return named
        case {}:
            return {key: argument(item, folder) for key, item in value.items()}
    return value


def recorded(data: Any, folder: Path | None = None, names: Names | None = None) -> Transitions:
    """Return the transitions in ``logs``, read by a mapping if one is given; NPZ files may have x, u and x_next."""
    described = dict(data) if isinstance(data, Mapping) else {}
    paths = described.pop("logs", None)
    if not paths or type(paths) is not list or {*map(type, paths)} != {str}:
        example = 'logs = ["run1.csv", "folder"]'
        raise InputError(f"data must be a table with a list of files, such as {{ {example} }}, got {data!r}.")
    mapping = LogMapping.from_table(described) if described else None
    parts, logs = list[Transitions](), dict[str, list[Path]]()
    for path in (Path(folder or "", path) for path in paths):
        stored = None
        if mapping is None and path.suffix == ".npz":
            with reworded(f"{path} cannot be read as recorded data", InputError):
                stored = stored_transitions(Archive(read_bytes(path)))
        if stored is not None:
            parts.append(stored)
        else:  # arrays in NPZ files have other names than columns
            logs.setdefault("" if mapping is not None else path.suffix, []).append(path)
    read = (read_recordings(each, mapping, **(names or {})) for each in logs.values())
    return Transitions.joined([*parts, *(recordings.transitions()[0] for recordings in read)])


@dataclass(frozen=True)
class TaskTable:
    """A task function without code: every component is a number, or a task parameter by name."""

    initial_state: list[float | str]
    goal: list[float | str] | None
    horizon: int
    dt: float
    environment: dict[str, list[float | str]] = field(default_factory=dict)

    def __call__(self, p: Parameters) -> Task:
        start = [_component(entry, p) for entry in self.initial_state]
        goal = None if self.goal is None else [_component(entry, p) for entry in self.goal]
        around = {name: [_component(entry, p) for entry in entries] for name, entries in self.environment.items()}
        return Task(start, goal=goal, horizon=self.horizon, dt=self.dt, environment=around)

    def describe(self) -> dict[str, Any]:
        known = {name: getattr(self, name) for name in ("initial_state", "goal", "horizon", "dt")}
        return known | ({"environment": self.environment} if self.environment else {})


def _component(entry: float | str, p: Parameters) -> Any:
    if not isinstance(entry, str):
        return entry
    name, _, index = entry.removeprefix("-").partition("[")
    value = p[name.strip()]
    if index:
        value = value[..., int(index.removesuffix("]"))]
    return -value if entry.startswith("-") else value


def task_function(given: Mapping[str, Any], space: TaskSpace, system: Any, folder: Path | None = None) -> Any:
    """Return the map p -> task of an experiment file, from the reference of a function or from components."""
    if set(given) == {"ref"}:
        return require_function(f"the task {given['ref']}", reference(str(given["ref"]), folder), "p -> Task")
    require_known("entry of [task]", given, (*TaskTable.__dataclass_fields__, COMMAND))
    table = {"goal": None, "dt": getattr(system, "dt", None), **given}
    missing = [key for key in ("initial_state", "horizon", "dt") if table.get(key) is None]
    if missing:
        raise InputError(f"[task] needs {', '.join(missing)}.")
    around = dict(require("environment of [task]", Mapping, table.get("environment", {})))
    if COMMAND in table:
        around[COMMAND] = table.pop(COMMAND)
    of_environment = {f"environment {name!r}": entries for name, entries in around.items()}
    for name, entries in {"initial_state": table["initial_state"], "goal": table["goal"], **of_environment}.items():
        plain = type(entries) is list and entries and {*map(type, entries)} <= {int, float, str}
        if not plain and (name, entries) != ("goal", None):
            raise InputError(f"{name} of [task] must be a list of numbers and of names of parameters, got {entries!r}.")
    task = TaskTable(**{**table, "environment": around})
    with reworded("[task] cannot be used"):
        task(space.parameters(space.low))
    return task


def require_types(what: str, function: Any, options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options, with lists converted to tuples."""
    target = getattr(function, "__init__") if isinstance(function, type) else function  # noqa: B009
    hints: dict[str, Any] = {}
    with suppress(NameError, TypeError):
        hints = get_type_hints(target, include_extras=True)
    given = {name: tuple(value) if isinstance(value, list) else value for name, value in options.items()}
    with reworded(what, InputError):
        return {name: require(name, hints.get(name, Any), value) for name, value in given.items()}


def with_distribution(
    space: TaskSpace, tables: Mapping[str, Mapping[str, Any]], folder: Path | None = None
) -> TaskSpace:
    """Return a task space with a distribution of tasks: ``sampler`` alone, or one of each parameter."""
    # The former is the reference of a function (rng, n) -> tasks (n, d), and the latter normal, uniform, or one of a
    # frozen distribution of scipy.stats.
    if set(tables) == {"sampler"} and set(tables["sampler"]) == {"ref"} and "sampler" not in space.names:
        return space.sampled(argument(tables["sampler"], folder))
    for name in tables:
        space.columns(name)  # which refuses names that are not in the space
    stated: dict[str, Any] = {}
    for name, table in tables.items():
        if set(table) == {"ref"}:
            stated[name] = argument(table, folder)
            continue
        given = dict(table)
        kind = given.pop("type", None)
        if kind == "uniform":
            continue
        require_known(f"distribution of {name}", [str(kind)], ("normal", "uniform"))
        if given.keys() <= {"mean", "deviation"} and len(given) < 2:
            raise InputError(f"the normal distribution of {name} needs a mean and a deviation, got {given!r}.")
        stated[name] = construct(f"the distribution of {name}", Normal, given)
    return space.distributed(**stated) if stated else space


def named_experiment(text: str, seed: int, options: dict[str, Any], folder: Path | None = None) -> Experiment:
    """Return the experiment of a case, or of a reference, which runs the code of its module."""
    if ":" not in text:
        if options:
            options = require_types(f"case {text!r}", cases.REGISTRY.find(text), options)
        return cases.by_name(text, seed, **options)
    experiment = reference(text, folder)
    if is_function(experiment) and not isinstance(experiment, Validation | Experiment):
        seeds = (seed,) if accepts(experiment, 1, **options) else ()
        if not accepts(experiment, len(seeds), **options):
            given = f"{' ' if options else ''}{', '.join(options)}; it takes {inspect.signature(experiment)}"
            raise InputError(f"{text} must be callable with a seed and its options{given}.")
        experiment = construct(text, experiment, options, *seeds)
    if isinstance(experiment, Validation):
        return Experiment(text.partition(":")[2], experiment)
    if not isinstance(experiment, Experiment):
        kinds = "an Experiment or a Validation, or a function that makes one, of a seed if it needs one"
        raise InputError(f"{text} must be {kinds}, got {type(experiment).__name__}.")
    return experiment
