"""The page as HTML. Templates escape every text; texts from elsewhere are also shortened here."""

from __future__ import annotations

import math
import secrets
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape
from markupsafe import Markup

from ctxval._util.representation import counted, line, number
from ctxval._util.texts import shortened, visible
from ctxval.campaign.by_hand import result_sentence
from ctxval.campaign.dynamics import prediction_in
from ctxval.certificates.bounds import with_error
from ctxval.core.task_suite import TaskSuite
from ctxval.core.trial import Trial
from ctxval.web.jobs import Files, interval_chart
from ctxval.web.security import MOST_UPLOAD
from ctxval.web.state import PageState


@dataclass(frozen=True)
class Problem:
    """Why a form was not accepted, with what the operator typed, which the form shows again, and the status of HTTP.

    The form is ``choose``, or the kind of the result and the number of the trial, such as ``recording-3``.
    """

    where: str
    sentence: str
    fields: Mapping[str, str]
    status: int


class Page:
    """Renders the templates of this package."""

    def __init__(self, state: PageState) -> None:
        self._state, self._served = state, state.served
        self._units = state.served.experiment.units
        self._space = state.served.campaign.validation.space
        self._templates = Environment(
            loader=PackageLoader("ctxval.web"),
            autoescape=select_autoescape(),
            undefined=StrictUndefined,
            trim_blocks=True,
            lstrip_blocks=True,
        )
        self._templates.filters |= {
            "text": text,
            "task": lambda trial: in_words(trial, self._space.units),
            "distance": lambda trial: "" if trial.distance is None else f"{trial.distance:.4g} {self._units}".rstrip(),
        }

    def campaign(
        self,
        form_token: str,
        *,
        problem: Problem | None = None,
        told: int | None = None,
        replaced: int | None = None,
        all_: bool,
    ) -> str:
        state, snapshot, space = self._state, self._state.snapshot, self._space
        certificate = state.certificate if state.verdict is None else state.verdict.certificate
        shown = snapshot.trials if all_ else snapshot.trials[-200:]  # a link shows all
        return self.render(
            "campaign.html",
            about=self._served,
            units=self._units,
            work=state,
            snapshot=snapshot,
            opened=[self._open_trial(trial) for trial in snapshot.trials.open],
            enough=self._enough(),
            shown=shown[::-1],
            parameters=list(zip(space.labels, space.low, space.high, strict=True)),
            tasks=space.task_names if isinstance(space, TaskSuite) else (),
            certificate=certificate,
            bound=None if certificate is None else with_error(certificate.upper_bound, certificate.error),
            told=None if told is None else self.ended(told),
            replaced=[trial for trial in snapshot.trials if trial.told and trial.number == replaced],
            problem=problem,
            given=lambda where, field: problem.fields.get(field, "") if problem and problem.where == where else "",
            token=form_token,
            pictures={name: Markup(drawn) for name, drawn in state.pictures.items()},
            closing=interval_chart(state.history, self._served.threshold, self._units),
            most=MOST_UPLOAD,
            submission=lambda: secrets.token_urlsafe(12),
        )

    def render(self, name: str, **values: Any) -> str:
        return self._templates.get_template(name).render(**values)

    def _open_trial(self, trial: Trial) -> dict[str, Any]:
        prepared = self._state.files.get(trial.number)
        files: Files = prepared if isinstance(prepared, dict) else {}
        # The model's trajectory has the columns that a recording must have.
        header = files.get("model.csv", b"").partition(b"\n")[0].decode("utf-8", "replace").strip()
        return {
            "number": trial.number,
            "executing": bool(trial.attempts),
            "parameters": values_of(trial.parameters, self._space.units),
            "task": self._state.snapshot.tasks.get(trial.number),
            "why": why(trial, self._units),
            "files": list(files),
            "files_error": prepared if isinstance(prepared, str) else None,
            "columns": header.split(",") if header else [],
        }

    def _enough(self) -> str | None:
        """Return why no further task is needed for the verdict; None if one may be."""
        state, budget = self._state, self._served.budget
        if not self._served.decides or state.snapshot.trials.open or state.choosing is not None:
            return None
        if state.judged == state.snapshot.ended and state.verdict is not None and state.verdict.answer != "undecided":
            return f"The verdict is reached: {state.verdict.answer}. No further execution is needed for it."
        if not state.enough:
            return None
        if state.snapshot.trials.executions >= budget:
            return f"The budget of {counted(budget, 'execution')} is spent."
        if state.verdict is not None and state.verdict.answer == "undecided":
            return "No other execution would decide the verdict; its reason says what is missing."
        return "The verdict is reached. No further execution is needed for it."

    def ended(self, number: int) -> str | None:
        """Return the result of a trial in one sentence without its full stop; None if it has none."""
        trials = self._state.snapshot.trials
        if not 0 <= number < len(trials) or trials[number].state == "open":
            return None
        differs = self._state.input_differences.get(number)
        return text(result_sentence(trials[number], self._units, inputs=differs), 1_000)


_ORIGINS = {
    "iid": "The task is an independent random draw.",
    "spread": "The task was drawn over the whole task space, to test a prediction.",
    "initial": "The task is one of the first tasks of the search, which are spread over the task space.",
    "acquisition": "The search expects to learn most about the largest distance from this task.",
    "covering": "The certificate that is to decide needs this task.",
    "manual": "A person chose this task.",
}

_SEARCHES = {
    "filling": "The task is in the largest gap between the tasks so far.",
    "improvement": "The search expects here the largest improvement over the largest distance so far.",
    "bound": "The upper confidence bound of the distance is largest at this task.",
}


def why(trial: Trial, units: str) -> list[str]:
    note = trial.note.search or {}
    sentences, expected = [_ORIGINS[trial.origin]], note.get("expected")
    if trial.origin == "acquisition" and isinstance(expected, int | float) and abs(expected) < math.inf:
        distance = f"{number(expected)} {text(units)}".rstrip()
        sentences = [f"The search expects a distance of {distance} here, the largest in the region that it examines."]
    elif trial.origin in ("acquisition", "initial"):
        sentences = [_SEARCHES.get(str(note.get("how")), _ORIGINS[trial.origin])]
    if isinstance(note.get("why"), str) and note.get("how") != "initial":
        sentences.append(f"The search does not use the prediction of the learned dynamics: {text(note['why'])}.")
    if trial.because is not None:
        sentences.append(f"Since the last execution of this task: {text(trial.because)}.")
    prediction = prediction_in(trial.note)
    if prediction is not None and math.isfinite(prediction.median):
        median, upper = (f"{number(value)} {text(units)}".rstrip() for value in (prediction.median, prediction.upper))
        sentences.append(f"Predicted distance: {median}; below {upper} with probability 0.95.")
    return sentences


def text(value: object, longest: int = 400) -> str:
    """Return a text from elsewhere: shortened, with control characters written out."""
    return visible(shortened(str(value), longest)).removesuffix(".")


def values_of(parameters: Mapping[str, Any], units: Mapping[str, str]) -> list[tuple[str, str]]:
    return [
        (line(name, 80), f"{_value(value)} {line(units.get(name, ''), 40)}".rstrip())
        for name, value in parameters.items()
    ]


def _value(value: Any) -> str:
    match value:
        case str():
            return line(value, 120)
        case [*items]:
            return f"[{', '.join(map(_value, items))}]"
    return f"{value:.6g}"


def in_words(trial: Trial, units: Mapping[str, str]) -> str:
    return ", ".join(f"{name} = {value}" for name, value in values_of(trial.parameters, units))
