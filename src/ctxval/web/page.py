"""The page as HTML. Templates escape every text; texts from elsewhere are also shortened here."""

from __future__ import annotations

import secrets
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape

from ctxval._util.representation import counted
from ctxval.campaign.telling import result_sentence
from ctxval.certificates import Certificate
from ctxval.certificates.bounds import with_error
from ctxval.core.trial import Trial
from ctxval.web.jobs import Files
from ctxval.web.security import MOST_UPLOAD
from ctxval.web.state import PageState
from ctxval.web.words import in_words, text, values_of, why


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


class Page:
    """Renders the templates of this package."""

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
        state, snapshot, description = self._state, self._state.snapshot, self._state.description
        certificate = state.certificate if state.verdict is None else state.verdict.certificate
        images = {name: data for name, data in state.pictures.items() if isinstance(data, bytes)}
        space = description.space
        shown = snapshot.trials if all_ else snapshot.trials[-200:]  # a link shows all
        return self._render(
            "campaign.html",
            about=description,
            work=state,
            snapshot=snapshot,
            opened=[self._open_trial(trial) for trial in snapshot.waiting],
            enough=self._enough(),
            rows=[self._row(trial) for trial in reversed(shown)],
            left_out=len(snapshot.trials) - len(shown),
            again=[(trial.number, in_words(trial, space.units)) for trial in shown if trial.executed],
            parameters=[
                (place, text(label, 80), f"{low:.6g}", f"{high:.6g}")
                for place, (label, low, high) in enumerate(zip(space.labels, space.low, space.high, strict=True))
            ],
            worst=None if snapshot.worst is None else self._row(snapshot.worst),
            certificate=certificate,
            bound=None if certificate is None else self._bound(certificate),
            news=self._news(),
            told=None if told is None else self.ended(told),
            replaced=[self._row(trial) for trial in snapshot.trials if trial.told and trial.number == replaced],
            problem=problem,
            given=lambda where, field: problem.fields.get(field, "") if problem and problem.where == where else "",
            token=form_token,
            pictures={name: f"{zlib.crc32(data):08x}" for name, data in images.items()},
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

    def _open_trial(self, trial: Trial) -> dict[str, Any]:
        """Return what the page shows of an open trial; a program executes it if it has attempts."""
        state, task = self._state, self._state.snapshot.tasks.get(trial.number)
        found = state.files.get(trial.number)
        files: Files = found if isinstance(found, dict) else {}
        # The model's trajectory has the columns that a recording must have.
        header = files.get("model.csv", b"").partition(b"\n")[0].decode("utf-8", "replace").strip()
        return {
            "number": trial.number,
            "executing": bool(trial.attempts),
            "parameters": values_of(trial.parameters, state.description.space.units),
            "start": [] if task is None else [(text(name, 80), f"{value:.6g}") for name, value in task.start],
            "task": task,
            "why": why(trial, state.description.units),
            "files": list(files),
            "files_error": text(found, 1_000) if isinstance(found, str) else None,
            "columns": [text(name, 80) for name in header.split(",")] if header else [],
        }

    def _bound(self, certificate: Certificate) -> str:
        units = self._state.description.units
        bound = f"{with_error(certificate.upper_bound, certificate.error)} {units}".rstrip()
        return f"{bound}, with confidence {certificate.confidence:g}"

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

    def _news(self) -> str:
        """Return what is new, for a screen reader."""
        state = self._state
        if state.description.live:
            return state.outcome or ""
        if state.choosing is not None:
            return "A task is being chosen."
        if state.choice_error is not None:
            return "No task was chosen."
        if state.chosen is not None:
            return f"Trial {state.chosen} is open."
        return self._enough() or ""

    def _enough(self) -> str | None:
        """Return why no further task is needed for the verdict; None if one may be."""
        state, about = self._state, self._state.description
        if not about.decides or state.snapshot.waiting or state.choosing is not None:
            return None
        if state.judged == state.snapshot.ended and state.verdict is not None and state.verdict.answer != "undecided":
            return f"The verdict is reached: {state.verdict.answer}. No further execution is needed for it."
        if not state.enough:
            return None
        if state.snapshot.executions >= about.budget:
            return f"The budget of {counted(about.budget, 'execution')} is spent."
        return "The verdict is reached. No further execution is needed for it."

    def ended(self, number: int) -> str | None:
        """Return the result of a trial in one sentence without its full stop; None if it has none."""
        trials = self._state.snapshot.trials
        if not 0 <= number < len(trials) or trials[number].state == "open":
            return None
        return text(result_sentence(trials[number], self._state.description.units), 1_000)
