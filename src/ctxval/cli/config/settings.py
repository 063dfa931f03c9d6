"""Settings: the content of an experiment file with the options of the command line, as a store keeps them."""

from __future__ import annotations

import os
import re
import shlex
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, Field, ValidationError, ValidationInfo, field_validator, model_validator
from pydantic_core import PydanticCustomError

from ctxval import Campaign, Experiment, Store, TaskSpace, TaskSuite, Validation, searches
from ctxval._util.checked import require_known
from ctxval._util.files import read_toml
from ctxval.campaign.interval_search import is_decisive
from ctxval.certificates import KINDS, RESOLUTION, CertificateOptions, require_use
from ctxval.certificates.options import CONFIDENCE, LEAST_CONFIDENCE, MOST_VOLUME, WITHIN
from ctxval.certificates.prediction_tests import TESTS
from ctxval.cli.config import parts
from ctxval.cli.config.parts import argument, part, require_types
from ctxval.cli.config.references import reference, require_function
from ctxval.cli.config.trust import allow
from ctxval.core.labels import Labels, labels_of
from ctxval.core.quantiles import QUANTILE
from ctxval.data import LogMapping
from ctxval.data.recorded_system import Recorded
from ctxval.distances import UnsafeMargin
from ctxval.errors import CertificateError, InputError, UnknownNameError
from ctxval.models import Refined, read_refined
from ctxval.studies.aspect1 import TASKS

Part = dict[str, Any]  #: a table with a type, which may be ``module:attr``, and its arguments


class CertificateTable(BaseModel, extra="allow"):
    """The table ``[certificate]``, chosen before a campaign; a kind from another package has its own options in it."""

    kind: str = "auto"
    volume: float = Field(default=0.0, ge=0, le=MOST_VOLUME, strict=True)  #: of the tasks above the threshold
    tests: int = Field(default=TESTS, ge=0, strict=True)  #: executions at drawn tasks, predicted beforehand
    #: the share of the executions of each task that the verdict is about, if they differ by noise
    quantile: float = Field(default=QUANTILE, ge=0.5, lt=1, strict=True)
    share: float = Field(default=1.0, ge=0.5, le=1, strict=True)  #: of the tasks that the verdict is about
    #: the largest distance between a task and its nearest trial, in diagonals of the task space
    resolution: float = Field(default=RESOLUTION, gt=0, allow_inf_nan=False, strict=True)
    discard: int | None = Field(default=None, ge=0)  #: the largest distances, for ``sampling-discarding``

    @model_validator(mode="after")
    def _used(self) -> CertificateTable:
        if self.kind not in KINDS.built_in:
            return self  # it is checked when it is used: reading imports nothing, and a store must stay readable
        fields, extra = type(self).model_fields, self.model_extra or {}
        changed = {name for name, field in fields.items() if name != "kind" and getattr(self, name) != field.default}
        try:
            require_known("setting", extra, {*fields, *KINDS[self.kind].options()})
            require_use(self.kind, sorted({*changed, *extra}))
            require_types(f"certificate {self.kind!r}", KINDS[self.kind], extra)
        except (CertificateError, InputError) as error:
            raise PydanticCustomError("use", str(error)) from error
        return self

    def options(
        self, confidence: float, *, kind: str | None = None, stated: Mapping[str, Any] | None = None
    ) -> CertificateOptions:
        given, chosen = dict(stated or {}), KINDS.find(kind or self.kind)
        require_use(chosen.name, given)
        if kind in (None, self.kind):
            planned, given = self.model_dump(), {**(self.model_extra or {}), **given}
        else:  # only those settings of the file hold that are not about one kind
            planned = self.model_dump(include={"volume", *KINDS["auto"].options()})
        merged = {**planned, **require_types(f"certificate {chosen.name!r}", chosen, given)}
        return CertificateOptions(chosen.of(merged), confidence, merged["volume"])


class SearchTable(BaseModel, extra="allow"):
    """The table ``[search]``: the type of a search, and its options."""

    type: str = searches.DEFAULT

    @model_validator(mode="before")
    @classmethod
    def _typed(cls, given: Any) -> Any:
        if isinstance(given, dict) and "name" in given:
            raise PydanticCustomError("use", f"[search] has a type in place of a name: type = {given['name']!r}.")
        return given

    def build(self, folder: Path | None = None) -> searches.Search:
        options = {key: argument(value, folder) for key, value in (self.model_extra or {}).items()}
        options = require_types(f"search {self.type!r}", searches.REGISTRY.find(self.type), options)
        return searches.by_name(self.type, **options)


class Aspect1Table(BaseModel, extra="forbid"):
    """The table ``[aspect1]``, which ``ctxval check --aspect1`` reads; a campaign does not use it."""

    distance: Part | None = None  #: how far a trajectory is from completing its task; None to derive it
    threshold: float | None = Field(default=None, gt=0, allow_inf_nan=False, strict=True)  #: in the goal's units
    tasks: int = Field(default=TASKS, ge=2)


class SpecTable(BaseModel, extra="allow"):
    """The table ``[spec]``: what a closed loop shall do, with the arguments of the specification as other entries."""

    type: str = "ReachAvoid"
    #: the robustness of M that shall suffice for a task to be safe; None to find it
    margin: float | None = Field(default=None, gt=0, allow_inf_nan=False, strict=True)

    def on(self, experiment: Experiment) -> Experiment:
        """Return an experiment that judges the specification in place of its distance; the threshold is the margin."""
        from ctxval.studies.safety import judged_by  # imported here, because few files have a specification

        return judged_by(experiment, UnsafeMargin({"type": self.type, **(self.model_extra or {})}, margin=self.margin))


RECORDED = {
    "type": "recorded"
}  #: the task function or the synthesizer of a file whose recorded system gives its tasks or inputs
_WHOLE = ("space", "task", "system", "model", "synthesizer")


class ExperimentSettings(BaseModel, extra="forbid"):
    """The content of an experiment file, overridden by the options of the command line."""

    experiment: str | None = None  #: names the experiment; otherwise ``name`` to ``units`` describe it completely
    options: dict[str, Any] = Field(default_factory=dict)
    name: str | None = None
    space: dict[str, list[Any]] | None = None
    suite: dict[str, dict[str, float | str]] | None = None  #: tasks by name, in the place of the space
    #: see :func:`~ctxval.cli.config.parts.with_distribution`; a named experiment may have one too
    distribution: dict[str, dict[str, Any]] | None = None
    task: Part | None = None
    system: Part | None = None
    model: Part | None = None
    synthesizer: Part | None = None
    distance: Part | None = None
    states: dict[str, str] = Field(default_factory=dict)
    inputs: dict[str, str] = Field(default_factory=dict)
    units: str | None = None
    budget: int | None = Field(default=None, ge=1, strict=True)
    threshold: float | None = Field(default=None, gt=0, allow_inf_nan=False, strict=True)
    longest: int | None = Field(default=None, ge=1, strict=True)
    start_tolerance: float | None = Field(default=None, ge=0, allow_inf_nan=False)
    physical: list[str] | None = None  #: the task parameters that change the dynamics, also of a named experiment
    #: the indices of M's states that are recorded, or ``{ref = "module:attr"}``, a function of them
    outputs: dict[str, str] | list[int] | None = None
    explore: bool | None = None  #: as the options of ``ctxval run``, so that a store knows the command that made it
    within: float = Field(default=WITHIN, gt=0, allow_inf_nan=False, strict=True)
    thinking: float | None = Field(default=None, gt=0)  #: seconds for one choice, verdict included
    confidence: float = Field(default=CONFIDENCE, ge=LEAST_CONFIDENCE, lt=1, strict=True)
    certificate: CertificateTable = Field(default_factory=CertificateTable)
    seed: int = Field(default=0, ge=0, strict=True)
    store: Path | None = None
    search: SearchTable = Field(default_factory=SearchTable)
    aspect1: Aspect1Table = Field(default_factory=Aspect1Table)
    spec: SpecTable | None = None
    judge: Literal["distance", "spec"] = "distance"  #: ``ctxval safe`` judges the specification
    refined: Path | None = None  #: the file of a model by `ctxval refine`, which replaces the given model
    recordings: dict[str, Any] | None = None
    folder: Path | None = None  #: that of modules and files, as of the experiment file; None for the current one
    file: str | None = None  #: the name of the experiment file, for the commands that reports state

    @field_validator("task", "system", "model", "synthesizer", "distance", "outputs", mode="before")
    @classmethod
    def _tables(cls, given: Any, field: ValidationInfo) -> Any:
        if not isinstance(given, str):
            return given
        key = "ref" if field.field_name == "outputs" or (field.field_name == "task" and ":" in given) else "type"
        form = f'{field.field_name} = {{ {key} = "{given}" }}'
        raise PydanticCustomError("use", f"{field.field_name} must be a table, as in {form}, got {given!r}.")

    def load(self) -> Experiment:
        if self.experiment is None:
            experiment = self._described()
        else:
            for name in (*_WHOLE, "suite", "distance", "name", "outputs"):
                if getattr(self, name) is not None:
                    why = f"remove one of them, because a named experiment has its own {name}"
                    raise InputError(f"the file has both 'experiment' and {name!r}: {why}.")
            if "seed" in self.options:
                where = "write it at the top of the file, or give --seed"
                raise InputError(f"[options] must not contain the seed: {where}.")
            experiment = parts.named_experiment(self.experiment, self.seed, self.options, self.folder)
        validation = experiment.validation
        stated = {name: getattr(self, name) for name in ("longest", "physical", "start_tolerance")}
        changed = {name: value for name, value in stated.items() if value is not None}
        if self.refined is not None:  # a model that was learned from executions of the given one
            path = (self.folder or Path()) / self.refined
            refined = read_refined(path, validation.model)
            if refined.data is None:
                raise InputError(f"{path} lacks the recorded steps that the model was learned from.")
            changed["model"] = Refined(refined, refined.data, validation.model)
            experiment = replace(experiment, truth=None)
        if self.distribution is not None:
            changed["space"] = parts.with_distribution(validation.space, self.distribution, self.folder)
        if changed:
            experiment = replace(experiment, validation=validation.with_parts(**changed))
        if self.judge == "distance":
            return experiment
        if self.spec is None:
            raise InputError("a specification is needed: the experiment file has no table [spec].")
        if self.threshold not in (None, self.spec.margin):
            raise InputError(f"if a specification is judged, its margin is the threshold, got {self.threshold:g}.")
        return self.spec.on(experiment)

    def _described(self) -> Experiment:
        if self.space is not None and self.suite is not None:
            raise InputError("the file has both [space] and [suite]: tasks fill a box, or they are a list.")
        needed = _WHOLE if self.suite is None and self.task != RECORDED else _WHOLE[1:]
        if missing := ", ".join(name for name in needed if getattr(self, name) is None):
            how = "name an experiment, as in experiment = 'pendulum', or describe one"
            raise InputError(f"the file must {how}: it has no {missing}.")
        if self.options:
            named = "a named experiment (experiment = ...)"
            raise InputError(f"[options] is only for {named}; this file describes its own.")
        system: Any = part("system", self.system or {}, self.folder)
        if RECORDED in (self.task, self.synthesizer) and not isinstance(system, Recorded):
            raise InputError(f"tasks and inputs of the type {RECORDED['type']!r} need a system of the type Recorded.")
        box = {name: tuple(bounds) for name, bounds in (self.space or {}).items()}
        repeats = system.repeats if isinstance(system, Recorded) else 1
        tasks: Any = system.names if self.suite is None and self.space is None else self.suite
        space = TaskSpace(**box) if tasks is None else TaskSuite(tasks, None, repeats)
        outputs: Any = self.outputs
        if isinstance(self.outputs, dict):
            require_known("entry of outputs", self.outputs, ["ref"])
            outputs = require_function("outputs", reference(self.outputs.get("ref", ""), self.folder), "x -> y")
        default: Part = {"type": "FinalState"}
        if self.spec is not None:  # d_a, of the states that the specification looks at
            default = {"type": "MaximumDeviation", "components": (self.spec.model_extra or {}).get("components")}
        task = (
            system.task if self.task == RECORDED else parts.task_function(self.task or {}, space, system, self.folder)
        )
        tables = {"model": self.model, "synthesizer": self.synthesizer, "distance": self.distance or default}
        names = {"states": self.states, "inputs": self.inputs}
        made = {
            kind: system if table == RECORDED else part(kind, table or {}, self.folder, names)
            for kind, table in tables.items()
        }
        labels = Labels(labels_of(self.states), labels_of(self.inputs), self.units or "")
        validation = Validation(space=space, task=task, system=system, labels=labels, outputs=outputs, **made)
        if isinstance(task, parts.TaskTable):
            validation.require_goal(task(space.parameters(space.low)))
        return Experiment(self.name or "experiment", validation)

    def campaign(
        self, experiment: Experiment, store: Store | Path, *, accept_change: str | None = None, remeasure: bool = False
    ) -> Campaign:
        """Return a campaign, with these settings in its store; later commands may build the experiment from them."""
        campaign = Campaign(
            experiment.validation,
            search=self.search.build(self.folder),
            store=store,
            seed=self.seed,
            name=experiment.name,
            accept_change=accept_change,
            remeasure=remeasure,
        )
        plain = self.model_dump(mode="json", exclude={"store", "aspect1"})
        plain["folder"] = str(self.folder or Path().resolve())  # in which modules and files were found now
        campaign.store.keep_settings(plain)
        allow(plain)
        return campaign

    def certified_as(self, stated: dict[str, Any]) -> ExperimentSettings:
        """Return these settings with options of the certificate from the command line, which override the file."""
        given = {name: value for name, value in stated.items() if value is not None}
        try:
            table = CertificateTable.model_validate({**self.certificate.model_dump(), **given})
        except ValidationError as error:
            raise InputError(sentence_of("", error)) from error
        return self.model_copy(update={"certificate": table})

    @property
    def certificate_options(self) -> CertificateOptions:
        return self.certificate.options(self.confidence)

    @property
    def explores(self) -> bool:
        """Whether the search alone chooses the tasks, and spends the budget."""
        if self.explore is not None:
            return self.explore
        # By default if a search other than `auto` or a certificate that ends no campaign is named.
        return self.search.type != searches.DEFAULT or not is_decisive(self.certificate_options)

    @property
    def log_mapping(self) -> LogMapping | None:
        return None if self.recordings is None else LogMapping.from_table(self.recordings)

    def store_path(self, name: str) -> Path:
        """Return the path of the store: the given one, or a file in ``runs/`` named after experiment and search."""
        if self.store is not None:
            return self.store
        options = [f"{key}-{value}" for key, value in self.options.items()]
        # A name may have any characters, but the store must be in the folder.
        names = re.sub(r"[/\\\x00-\x1f\x7f]", "-", "-".join([name, *options, self.search.type]))
        return Path("runs") / f"{names}-seed{self.seed}.sqlite"


def read_settings(target: str, overrides: dict[str, Any]) -> ExperimentSettings:
    """Return the settings of a case, an experiment file or ``module:attr``."""
    is_file = target.endswith(".toml")
    if not is_file and ":" not in target and Path(target).suffix:
        raise InputError(not_an_experiment(target))
    if is_file and not os.path.lexists(target):
        example = f"`ctxval init {shlex.quote(target)}` writes an example"
        raise InputError(f"there is no experiment file {target}; {example}.")
    content: dict[str, Any] = read_toml(target) if is_file else {"experiment": target}
    for key in sorted({"folder", "file"} & content.keys()):
        where = "modules and files are read from the folder of this file"
        raise InputError(f"{target}: no setting is called {key!r}; {where}.")
    given = {key: value for key, value in overrides.items() if value is not None}
    options, search = content.get("options", {}), content.get("search", {})
    for key, table in (("options", options), ("search", search)):
        if not isinstance(table, dict):
            raise InputError(f"[{key}] must be a table, got {table!r}.")
    options = {**options, **given.pop("options", {})}
    named = given.pop("search", None)
    if named is not None and named != search.get("type", searches.DEFAULT):
        search = {"type": named}  # the options in the file were those of another search
    whole = {**content, **given, "options": options, "search": search}
    if is_file:
        whole |= {"folder": Path(target).parent.resolve(), "file": Path(target).name}
    elif ":" in target:
        whole["folder"] = Path().resolve()
    try:
        return ExperimentSettings.model_validate(whole)
    except ValidationError as error:
        field = str(next(iter(error.errors()[0]["loc"]), ""))
        raise InputError(sentence_of("" if given.get(field) is not None else f"{target}: ", error)) from error


def load_experiment(target: str | Path, *, seed: int | None = None, **options: Any) -> Experiment:
    """Return the experiment of a TOML file, of a case, or of a reference ``module:attr``, as ``ctxval run`` loads it.

    A reference in the file runs the code of its module, which must be in the folder of the file or installed.

    Args:
        target: the path of the file, or the name or reference.
        seed: the seed of a case, or of the function that makes the experiment (default: that of the file, or 0).
        options: options of a case, or of that function.
    """
    return read_settings(str(target), {"seed": seed, "options": options or None}).load()


def not_an_experiment(target: str, *others: str) -> str:
    """Return the sentence that another file is no experiment, with what else it may be."""
    kinds = ", ".join(("neither a case", "an experiment file (.toml)", *others))
    attribute = f" (here {Path(target).stem}:NAME)" if Path(target).suffix == ".py" else ""
    return f"{target} is {kinds} nor a reference module:attr{attribute}."


def sentence_of(source: str, error: ValidationError) -> str:
    """Return what is wrong with a setting, in one sentence that names it, after the text of its source."""
    first = error.errors()[0]
    if first["type"] == "use":
        return f"{source}{first['msg']}"
    if first["type"] == "extra_forbidden":
        return f"{source}{UnknownNameError.among('setting', str(first['loc'][-1]), ExperimentSettings.model_fields)}"
    name, value = ".".join(map(str, first["loc"])), first["input"]
    shown = repr(value[:100]) if isinstance(value, str) else str(value)[:100]
    match first:
        case {"type": "greater_than_equal", "ctx": {"ge": bound}}:
            why = " must be a positive integer" if bound == 1 else f" must be at least {bound}"
        case {"type": "greater_than", "ctx": {"gt": 0}}:
            why = " must be a positive number"
        case _:
            why = f": {first['msg'].lower()}".replace(": input should", " must", 1)
    return f"{source}{name}{why}, got {shown}."
