"""Settings: the content of an experiment file with the options of the command line, as a store keeps them."""

from __future__ import annotations

import re
import shlex
import tomllib
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from ctxval.campaign.campaign import Campaign
from ctxval.campaign.interval_search import is_decisive
from ctxval.campaign.storage.store import Store
from ctxval.certificates import CertificateOptions
from ctxval.certificates.options import CONFIDENCE, LEAST_CONFIDENCE, WITHIN
from ctxval.cli.config.parts import named_experiment, part, space_of, task_function, with_distribution
from ctxval.cli.config.signatures import code_named, signed
from ctxval.cli.config.tables import Aspect1Table, CertificateTable, SearchTable
from ctxval.core.experiment import Experiment
from ctxval.core.labels import Labels, labels_of
from ctxval.core.model import Model, as_model
from ctxval.core.validation import Validation
from ctxval.data import LogMapping
from ctxval.errors import InputError, UnknownNameError
from ctxval.models import REGISTRY, Refined, read_model, read_refined
from ctxval.models.mujoco import is_sysid_result
from ctxval.searches import DEFAULT as DEFAULT_SEARCH
from ctxval.studies.aspect1 import Aspect1Report
from ctxval.studies.aspect1 import check as check_aspect1

Part = str | dict[str, Any]
"""``module:attr``, or a table with a type and its arguments."""

_WHOLE = ("space", "task", "system", "model", "synthesizer")


class Settings(BaseModel):
    """The content of an experiment file, overridden by the options of the command line.

    Either ``experiment`` names the experiment, or ``name`` to ``units`` describe it completely.

    Attributes:
        distribution: the distribution of a task parameter by its name, such as ``{type = "normal", mean = 0.0,
            deviation = 0.3}`` or ``{ref = "module:attr"}``; all others are uniform. Or ``sampler``, the reference of a
            function that draws whole tasks. A named experiment may have one too.
            longest: the largest horizon.
        explore, within: as the options of ``ctxval run``, so that a store knows the command that made it.
            refined: the file of a model that `ctxval refine` has learned from executions; it replaces the given model.
        folder: the folder of modules and files, which is that of the experiment file; None for the current folder.
    """

    model_config = ConfigDict(extra="forbid")

    experiment: str | None = None
    options: dict[str, Any] = Field(default_factory=dict)
    name: str | None = None
    space: dict[str, list[Any]] | None = None
    distribution: dict[str, dict[str, Any]] | None = None
    task: Part | None = None
    system: Part | None = None
    model: Part | None = None
    synthesizer: Part | None = None
    distance: Part | None = None
    states: dict[str, str] = Field(default_factory=dict)
    inputs: dict[str, str] = Field(default_factory=dict)
    units: str | None = None
    budget: int | None = Field(default=None, ge=1)
    threshold: float | None = Field(default=None, gt=0, allow_inf_nan=False, strict=True)
    longest: int | None = Field(default=None, ge=1, strict=True)
    explore: bool | None = None
    within: float = Field(default=WITHIN, gt=0, allow_inf_nan=False, strict=True)
    confidence: float = Field(default=CONFIDENCE, ge=LEAST_CONFIDENCE, lt=1, strict=True)
    certificate: CertificateTable = Field(default_factory=CertificateTable)
    seed: int = Field(default=0, ge=0)
    store: Path | None = None
    search: SearchTable = Field(default_factory=SearchTable)
    aspect1: Aspect1Table = Field(default_factory=Aspect1Table)
    refined: Path | None = None
    recordings: dict[str, Any] | None = None
    folder: Path | None = None

    def load(self) -> Experiment:
        """Return the experiment."""
        made = self._described() if self.experiment is None else self._named(self.experiment)
        validation = given = made.validation
        if self.refined is not None:  # a model that was learned from executions of the given one
            path = (self.folder or Path()) / self.refined
            refined = read_refined(path, given.model)
            if refined.data is None:
                raise InputError(f"{path} lacks the recorded steps that the model was learned from.")
            validation = validation.with_model(Refined(refined, refined.data, given.model))
            made = replace(made, truth=None)
        if self.longest is not None:
            validation = validation.with_longest(self.longest)
        if self.distribution is not None:
            space = with_distribution(validation.space, self.distribution, self.folder)
            validation = validation.with_space(space)
        return made if validation is given else replace(made, validation=validation)

    def _named(self, experiment: str) -> Experiment:
        given = [name for name in (*_WHOLE, "distance", "name") if getattr(self, name) is not None]
        if given:
            raise InputError(
                f"the file has both 'experiment' and {given[0]!r}: remove one of them, because a named experiment has "
                f"its own {given[0]}."
            )
        if "seed" in self.options:
            raise InputError("[options] must not contain the seed: write it at the top of the file, or give --seed.")
        return named_experiment(experiment, self.seed, self.options, self.folder)

    def _described(self) -> Experiment:
        missing = [name for name in _WHOLE if getattr(self, name) is None]
        if missing:
            raise InputError(
                "the file must name an experiment, as in experiment = 'pendulum', or describe one: "
                f"it has no {', '.join(missing)}."
            )
        if self.options:
            raise InputError(
                "[options] is only for a named experiment (experiment = ...); this file describes its own."
            )
        space, system = space_of(self.space or {}), part("system", self.system or {}, self.folder)
        validation = Validation(
            space=space,
            task=task_function(self.task or {}, space, system, self.folder),
            system=system,
            model=part("model", self.model or {}, self.folder),
            synthesizer=part("synthesizer", self.synthesizer or {}, self.folder),
            distance=part("distance", self.distance or "FinalState", self.folder),
            labels=Labels(labels_of(self.states), labels_of(self.inputs), self.units or ""),
        )
        return Experiment(self.name or "experiment", validation)

    def campaign(
        self,
        experiment: Experiment,
        store: Store | Path,
        *,
        accept_change: str | None = None,
        remeasure: bool = False,
    ) -> Campaign:
        """Return a campaign, and write these settings into its store, signed by this user.

        The signature lets later commands run the code that the settings name without asking.
        """
        search = self.search.build(self.folder)
        campaign = Campaign(
            experiment.validation,
            search=search,
            store=store,
            seed=self.seed,
            name=experiment.name,
            accept_change=accept_change,
            remeasure=remeasure,
        )
        plain = self.model_dump(mode="json", exclude={"store", "aspect1"})
        if self.folder is None and code_named(plain):
            plain["folder"] = str(Path().resolve())  # the folder in which its code was found now
        campaign.store.keep_settings(signed(plain, campaign.store.settings()))
        return campaign

    def certified_as(self, stated: dict[str, Any]) -> Settings:
        """Return these settings with options of the certificate from the command line, which override the file."""
        given = {name: value for name, value in stated.items() if value is not None}
        try:
            table = CertificateTable.model_validate({**self.certificate.model_dump(), **given})
        except ValidationError as error:
            raise InputError(sentence_of("certificate", error)) from error
        return self.model_copy(update={"certificate": table})

    @property
    def certificate_options(self) -> CertificateOptions:
        """The kind, the options and the confidence of the certificate for the verdict."""
        return self.certificate.options(self.confidence)

    @property
    def explores(self) -> bool:
        """Whether the search alone chooses the tasks, and spends the budget.

        Unless that is stated, it does if a search other than ``auto`` or a certificate that ends no campaign is named.
        """
        if self.explore is not None:
            return self.explore
        return self.search.name != DEFAULT_SEARCH or not is_decisive(self.certificate_options)

    def aspect1_of(self, experiment: Experiment, tasks: int | None, threshold: float | None) -> Aspect1Report:
        """Return whether the model of an experiment completes its tasks; S is never executed."""
        table = self.aspect1
        return check_aspect1(
            experiment.validation,
            threshold=table.threshold if threshold is None else threshold,
            distance=None if table.distance is None else part("distance", table.distance, self.folder),
            tasks=table.tasks if tasks is None else tasks,
            seed=self.seed,
        )

    @property
    def log_mapping(self) -> LogMapping | None:
        """The mapping of logs; None if there is none."""
        return None if self.recordings is None else LogMapping.from_table(self.recordings)

    def store_path(self, name: str) -> Path:
        """Return the path of the store: the given one, or a file in ``runs/`` named after experiment and search."""
        if self.store is not None:
            return self.store
        options = [f"{key}-{value}" for key, value in self.options.items()]
        # A name may have any characters, but the store must be in the folder.
        names = re.sub(r"[/\\\x00-\x1f\x7f]", "-", "-".join([name, *options, self.search.name]))
        return Path("runs") / f"{names}-seed{self.seed}.sqlite"


def read_settings(target: str, overrides: dict[str, Any]) -> Settings:
    """Return the settings of a case, an experiment file or ``module:attr``."""
    is_file = target.endswith(".toml")
    if not is_file and ":" not in target and Path(target).suffix:
        raise InputError(not_an_experiment(target))
    content = _read_toml(Path(target)) if is_file else {"experiment": target}
    if "folder" in content:
        raise InputError(
            f"{target}: no setting is called 'folder'; modules and files are read from the folder of this file."
        )
    if "experiment" not in content and not any(key in content for key in _WHOLE):
        raise InputError(
            f"{target} has no experiment: name one, as in experiment = 'pendulum' or 'module:attr', or describe one."
        )
    given = {key: value for key, value in overrides.items() if value is not None}
    options = {**_table(content, "options"), **given.pop("options", {})}
    search = _table(content, "search")
    named = given.pop("search", None)
    if named is not None and named != search.get("name", DEFAULT_SEARCH):
        search = {"name": named}  # the options in the file were those of another search
    whole = {**content, **given, "options": options, "search": search}
    if is_file or ":" in target:
        whole["folder"] = (Path(target).parent if is_file else Path()).resolve()
    try:
        return Settings.model_validate(whole)
    except ValidationError as error:
        option = error.errors()[0]["loc"][:1]
        source = "the command line" if option and overrides.get(str(option[0])) is not None else target
        raise InputError(sentence_of(source, error)) from error


def not_an_experiment(target: str, *others: str) -> str:
    """Return the sentence that another file is no experiment, with what else it may be."""
    said = ", ".join(("neither a case", "an experiment file (.toml)", *others))
    attribute = f" (here {Path(target).stem}:NAME)" if Path(target).suffix == ".py" else ""
    return f"{target} is {said} nor a reference module:attr{attribute}."


def _table(content: dict[str, Any], key: str) -> dict[str, Any]:
    table = content.get(key, {})
    if not isinstance(table, dict):
        raise InputError(f"[{key}] must be a table, got {table!r}.")
    return table


def _read_toml(path: Path) -> dict[str, Any]:
    try:
        with path.open("rb") as file:
            return tomllib.load(file)
    except FileNotFoundError:
        name = shlex.quote(str(path))
        raise InputError(f"there is no experiment file {path}; `ctxval init {name}` writes an example.") from None
    except OSError as error:
        raise InputError(f"the experiment file {path} cannot be read: {error.strerror}.") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise InputError(f"{path} is not valid TOML: {error}.") from error


def sentence_of(target: str, error: ValidationError) -> str:
    """Return what is wrong with a setting, in one sentence that names it."""
    first = error.errors()[0]
    where = ".".join(str(part) for part in first["loc"])
    if first["type"] == "use":
        return f"{target}: {first['msg']}"
    if first["type"] == "extra_forbidden":
        return f"{target}: {UnknownNameError.among('setting', str(first['loc'][-1]), Settings.model_fields)}"
    value = first["input"]
    shown = repr(value[:100]) if isinstance(value, str) else str(value)[:100]
    return f"{target}: {where}: {first['msg'].lower()}, got {shown}."


def named_model(text: str, options: Mapping[str, Any], dt: float | None = None) -> Model:
    """Return a model from a file, an experiment, ``module:attr`` or a name of the registry."""
    path = Path(text)
    if path.suffix in (".toml", ".npz"):
        if options:
            of = "of" if path.suffix == ".toml" else "in"
            raise InputError(f"the model {of} {text} takes no options, got {', '.join(options)}.")
        return read_model(path) if path.suffix == ".npz" else read_settings(text, {}).load().validation.model
    table: dict[str, Any] = {"type": text}
    if path.suffix == ".onnx":
        table = {"type": "Onnx", "source": text}
    elif path.suffix == ".xml" or is_sysid_result(path):
        table = {"type": "MuJoCo", "mjcf": text, "dt": dt}
    elif ":" not in text and text not in REGISTRY.built_in and text not in REGISTRY.installed:
        raise InputError(
            f"a model must be a file that ends in .onnx, .npz, .xml or .toml, a result of mujoco.sysid, module:attr, "
            f"or one of {', '.join(REGISTRY.built_in)}, got {text!r}."
        )
    return as_model(part("model", {**table, **options}))
