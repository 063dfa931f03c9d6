"""The options of all commands that read logs, and the recordings that follow from them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import typer

from ctxval.cli.base import err, out
from ctxval.config.settings import Settings
from ctxval.core.experiment import Experiment
from ctxval.core.labels import names_of
from ctxval.data import Field, LogMapping, Recordings, read_recordings
from ctxval.errors import InputError
from ctxval.fitting.fit import STEPS as FITTED
from ctxval.replay.report import STEPS as REPLAYED

Logs = Annotated[
    list[Path],
    typer.Argument(
        metavar="LOGS...",
        help="Recordings: CSV, NPZ, MATLAB (.mat), Parquet and MCAP files, ROS bags, LeRobot data sets, or folders of "
        "such files.",
    ),
]
MappingFile = Annotated[
    Path | None,
    typer.Option(
        "--mapping", help="TOML file with the mapping of the logs, or an experiment file with the table recordings."
    ),
]
States = Annotated[
    list[str] | None,
    typer.Option(
        "--state",
        metavar="NAME=FIELD",
        help="Field of a state, such as angle=/joints.position[0] or angle=column. Repeat --state in the order of the "
        "model's states.",
    ),
]
Inputs = Annotated[
    list[str] | None,
    typer.Option("--input", metavar="NAME=FIELD", help="Field of an input. Repeat --input in the model's order."),
]
TimeField = Annotated[
    str | None,
    typer.Option(
        "--time",
        help="Column of the times, which may state a unit, such as clock_ms (default: t, time, times or timestamp).",
    ),
]
Dt = Annotated[
    float | None,
    typer.Option(
        help="Time step in seconds to which the logs are resampled; it must be that of the model (default: the mean "
        "period of the first state)."
    ),
]
Delay = Annotated[
    float | None,
    typer.Option(help="Seconds between the time at which an input is logged and the time from which it acts."),
]


Steps = Annotated[
    str | None,
    typer.Option(
        help="Numbers of steps after which errors are computed, with commas between them (default: "
        f"{','.join(map(str, REPLAYED))} for a replay, {','.join(map(str, FITTED))} for a fit)."
    ),
]
RandomSeed = Annotated[int, typer.Option(min=0, help="Seed of all random numbers.")]


@dataclass(frozen=True)
class LogOptions:
    """What the command line states of the logs; states and inputs are texts ``NAME=FIELD``."""

    mapping: Path | None
    states: Sequence[str] | None
    inputs: Sequence[str] | None
    time: str | None
    dt: float | None
    delay: float | None

    def read(
        self, logs: Sequence[Path], settings: Settings | None = None, experiment: Experiment | None = None
    ) -> Recordings:
        """Return the recordings in logs."""
        changes = {"time": self.time, "dt": self.dt, "delay": self.delay}
        given = {name: value for name, value in changes.items() if value is not None}
        states, inputs = ({}, {}) if experiment is None else _names(experiment)
        found = read_recordings(logs, self._mapping(settings), states=states, inputs=inputs, **given)
        own = [*found.states.values(), *found.inputs.values()]
        named = [*states.values(), *inputs.values()]
        same = (len(states), len(inputs)) == (len(found.states), len(found.inputs))
        if not same or set(states) & set(inputs) or any(a not in ("", b) for a, b in zip(own, named, strict=True)):
            return found
        return replace(found, states=states, inputs=inputs)

    def _mapping(self, settings: Settings | None) -> LogMapping | None:
        """Return the mapping that is given; None for that of usual names."""
        if self.states or self.inputs:
            if self.mapping is not None:
                raise InputError("--mapping cannot be combined with --state and --input.")
            if not self.states:
                raise InputError("--input needs --state: name the fields of all states too.")
            return LogMapping(_fields(self.states), _fields(self.inputs or ()))
        if self.mapping is not None:
            return LogMapping.from_toml(self.mapping)
        return None if settings is None else settings.log_mapping


def _names(experiment: Experiment) -> tuple[dict[str, str], dict[str, str]]:
    """Return the names and units of the states and inputs of an experiment, as far as they are known."""
    system = experiment.validation.system
    states, inputs = experiment.states or names_of(system, "states"), experiment.inputs or names_of(system, "inputs")
    return experiment.names(len(states), len(inputs)) if states else ({}, {})


def _fields(given: Sequence[str]) -> dict[str, Field]:
    found: dict[str, Field] = {}
    for text in given:
        name, equals, path = text.partition("=")
        name, path = (name.strip(), path.strip()) if equals else (text.strip(), text.strip())
        if not name or not path or name in found:
            raise InputError(f"each state and input must be given once, as NAME=FIELD, got {text!r}.")
        found[name] = Field(path)
    return found


def numbers(text: str) -> list[int]:
    """Return the numbers of steps in a text with commas between them."""
    parts = [part.strip() for part in text.split(",")]
    if not all(part.isdecimal() and int(part) > 0 for part in parts):
        raise InputError(f"--steps must be positive integers with commas between them, such as 1,10,50, got {text!r}.")
    return [int(part) for part in parts]


# What is printed


def print_breaks(found: Recordings) -> None:
    """Print how logs were read, and where they were split."""
    for note in found.notes:
        out.say((note, "dim"))
    for split in found.breaks[:5]:
        err.say(("split:", "yellow"), f" {split}")
    if len(found.breaks) > 5:
        err.say(f"and {len(found.breaks) - 5} other places; --json lists them.")
