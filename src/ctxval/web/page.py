"""The page as HTML. Templates escape every text; texts from elsewhere are also shortened here."""

from __future__ import annotations

import secrets
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape

from ctxval._util.representation import counted
from ctxval.campaign.telling import result_sentence
from ctxval.core.trial import Trial
from ctxval.web.desk import Snapshot
from ctxval.web.jobs import Files
from ctxval.web.security import MOST_UPLOAD
from ctxval.web.state import PageState
from ctxval.web.words import in_words, text, values_of, why

_SHOWN = 200
"""Number of the latest trials in the table; a link shows all."""

_COLUMNS = "model.csv"
"""The file whose header names the columns that a recording must have."""


@dataclass(frozen=True)
class Problem:
    """Why a form was not accepted.

    Attributes:
        where: the form: ``choose``, or the kind of the result and the number of the trial, such as ``recording-3``.
        sentence: the reason.
        fields: what the operator typed, which the form shows again.
        status: the status of HTTP.
    """

    where: str
    sentence: str
    fields: Mapping[str, str] = field(default_factory=dict)
    status: int = 422


@dataclass(frozen=True, eq=False)
class OpenView:
    """An open trial as the page shows it.

    Attributes:
        number: the number of the trial.
        executing: whether a program executes it, so that no result of it can be recorded.
        values: the task parameters with their units.
        start: the initial state, with names and units.
        duration: the length of the execution in words.
        why: why the task was chosen, in sentences.
        files: the names of the files; empty if they are not ready.
        files_error: why there are no files; None if there is no reason.
        columns: the columns of a recording; empty if they are not known yet.
    """

    number: int
    executing: bool
    values: list[tuple[str, str]]
    start: list[tuple[str, str]]
    duration: str
    why: list[str]
    files: tuple[str, ...]
    files_error: str | None
    columns: tuple[str, ...]


class Page:
    """Renders the templates of this package.

    Args:
        state: what the page shows.
    """

    def __init__(self, state: PageState) -> None:
        self._state = state
        self._templates = Environment(
            loader=PackageLoader("ctxval.web"),
            autoescape=select_autoescape(),
            undefined=StrictUndefined,
            trim_blocks=True,
            lstrip_blocks=True,
        )
        self._templates.filters["text"] = text

    def campaign(
        self,
        form_token: str,
        *,
        problem: Problem | None = None,
        told: int | None = None,
        replaced: int | None = None,
        all_: bool,
    ) -> str:
        """Return the page of the campaign, with the forms of a trial whose result is to be replaced."""
        state = self._state
        snapshot, background, description = state.snapshot, state.background, state.description
        opened = [self._open_view(trial, snapshot) for trial in snapshot.waiting]
        shown = snapshot.trials if all_ else snapshot.trials[-_SHOWN:]
        return self._render(
            "campaign.html",
            about=description,
            work=background,
            snapshot=snapshot,
            opened=opened,
            enough=self._enough(),
            rows=[self._row(trial) for trial in reversed(shown)],
            left_out=len(snapshot.trials) - len(shown),
            again=[(trial.number, in_words(trial, description.space.units)) for trial in shown if trial.executed],
            parameters=self._parameters(),
            worst=None if snapshot.worst is None else self._row(snapshot.worst),
            news=self._news(),
            told=None if told is None else self.ended(told),
            replaced=[self._row(trial) for trial in snapshot.trials if trial.told and trial.number == replaced],
            problem=problem,
            given=_given(problem),
            token=form_token,
            version=state.version,
            pictures={name: f"{zlib.crc32(image):08x}" for name, image in background.pictures.images.items()},
            most=MOST_UPLOAD,
            submission=lambda: secrets.token_urlsafe(12),
        )

    def enter(self, sentence: str | None = None) -> str:
        """Return the page that asks for the token; the sentence says why the last one was not accepted."""
        return self._render("enter.html", sentence=sentence)

    def message(self, title: str, sentence: str, *, forward: bool = False) -> str:
        """Return a page with one sentence, and a link to the campaign; ``forward`` follows the link at once."""
        return self._render("message.html", title=title, sentence=sentence, forward=forward)

    def _render(self, name: str, **values: Any) -> str:
        return self._templates.get_template(name).render(**values)

    def _open_view(self, trial: Trial, snapshot: Snapshot) -> OpenView:
        task = snapshot.tasks.get(trial.number)
        found = self._state.background.files.get(trial.number)
        files: Files = found if isinstance(found, dict) else {}
        return OpenView(
            trial.number,
            bool(trial.attempts),
            values_of(trial.parameters, self._state.description.space.units),
            [] if task is None else [(text(name, 80), f"{value:.6g}") for name, value in task.start],
            "" if task is None else f"{task.horizon} steps of {task.dt:g} s, {task.horizon * task.dt:g} s in total",
            why(trial, self._state.description.units),
            tuple(files),
            text(found, 1_000) if isinstance(found, str) else None,
            _header(files),
        )

    def _row(self, trial: Trial) -> dict[str, Any]:
        units = self._state.description.units
        return {
            "number": trial.number,
            "task": in_words(trial, self._state.description.space.units),
            "origin": trial.origin,
            "state": trial.state,
            "told": trial.told,
            "distance": "" if trial.distance is None else f"{trial.distance:.4g} {units}".rstrip(),
            "remark": "" if trial.failure is None else text(trial.failure),
        }

    def _parameters(self) -> list[tuple[int, str, str, str]]:
        """Return the place, the label and the bounds of each task parameter."""
        space = self._state.description.space
        bounds = zip(space.labels, space.low.tolist(), space.high.tolist(), strict=True)
        return [
            (place, text(label, 80), f"{low:.6g}", f"{high:.6g}") for place, (label, low, high) in enumerate(bounds)
        ]

    def _news(self) -> str:
        """Return what is new, for a screen reader."""
        background = self._state.background
        if self._state.description.live:
            return background.outcome or ""
        if background.choosing is not None:
            return "A task is being chosen."
        if background.choice_error is not None:
            return "No task was chosen."
        if background.chosen is not None:
            return f"Trial {background.chosen} is open."
        return self._enough() or ""

    def _enough(self) -> str | None:
        """Return why no further task is needed for the verdict; None if one may be."""
        state, snapshot = self._state, self._state.snapshot
        work, about = state.background, state.description
        if not about.decides or snapshot.waiting or work.choosing is not None:
            return None
        judged = work.judgement if work.judged == snapshot.ended else None
        if judged is not None and judged.answer != "undecided":
            return f"The verdict is reached: {judged.answer}. No further execution is needed for it."
        if not work.enough:
            return None
        if snapshot.executions >= about.budget:
            return f"The budget of {counted(about.budget, 'execution')} is spent."
        return "The verdict is reached. No further execution is needed for it."

    def ended(self, number: int) -> str | None:
        """Return the result of a trial in one sentence without its full stop; None if it has none."""
        trials = self._state.snapshot.trials
        if not 0 <= number < len(trials) or trials[number].state == "open":
            return None
        return text(result_sentence(trials[number], self._state.description.units), 1_000)


def _given(problem: Problem | None) -> Callable[[str, str], str]:
    """Return a function of a form and a field that returns what the operator typed there."""

    def given(where: str, field: str) -> str:
        return problem.fields.get(field, "") if problem is not None and problem.where == where else ""

    return given


def _header(files: Files) -> tuple[str, ...]:
    """Return the names of the columns of the model's trajectory, which are those of a recording."""
    first = files.get(_COLUMNS, b"").partition(b"\n")[0].decode("utf-8", "replace").strip()
    return tuple(text(name, 80) for name in first.split(",")) if first else ()
