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
from ctxval.data import Field, LogMapping, Recordings, read_recordings
from ctxval.errors import InputError

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
    str | None, typer.Option("--time", help="Column of the times (default: t, time, times or timestamp).")
]
Dt = Annotated[
    float | None,
    typer.Option(
        help="Time step in seconds to which the logs are resampled; it must be that of the model (default: the median "
        "period of the first state)."
    ),
]
Delay = Annotated[
    float | None,
    typer.Option(help="Seconds between the time at which an input is logged and the time from which it acts."),
]


@dataclass(frozen=True)
class LogOptions:
    """What the command line states of the logs.

    Attributes:
        mapping: the file of a mapping.
        states, inputs: texts ``NAME=FIELD``.
        time: the column of the times.
        dt, delay: seconds.
    """

    mapping: Path | None
    states: Sequence[str] | None
    inputs: Sequence[str] | None
    time: str | None
    dt: float | None
    delay: float | None

    def read(
        self, logs: Sequence[Path], settings: Settings | None = None, experiment: Experiment | None = None
    ) -> Recordings:
        """Return the recordings in logs.

        Args:
            logs: the files and folders.
            settings: settings whose mapping is used if the command line states none.
            experiment: an experiment that names the states and inputs, if the logs do not.

        Raises:
            InputError: if the options contradict each other, or the logs cannot be read.
        """
        changes = {"time": self.time, "dt": self.dt, "delay": self.delay}
        given = {name: value for name, value in changes.items() if value is not None}
        found = read_recordings(logs, self._mapping(settings), **given)
        named = experiment is not None and (experiment.states or experiment.inputs)
        if not named or experiment is None or any((found.states | found.inputs).values()):
            return found
        states, inputs = experiment.names(len(found.states), len(found.inputs))
        return found if set(states) & set(inputs) else replace(found, states=states, inputs=inputs)

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


def _fields(given: Sequence[str]) -> dict[str, Field]:
    found: dict[str, Field] = {}
    for text in given:
        name, equals, path = text.partition("=")
        name, path = (name.strip(), path.strip()) if equals else (text.strip(), text.strip())
        if not name or not path or name in found:
            raise InputError(f"each state and input must be given once, as NAME=FIELD, got {text!r}.")
        found[name] = Field(path)
    return found


def print_breaks(found: Recordings) -> None:
    """Print how logs were read, and where they were split."""
    for note in found.notes:
        out.say((note, "dim"))
    for one in found.breaks[:_BREAKS]:
        err.say(("split:", "yellow"), f" {one}")
    if len(found.breaks) > _BREAKS:
        err.say(f"and {len(found.breaks) - _BREAKS} other places; --json lists them.")


_BREAKS = 5
"""Largest number of splits that are printed."""
