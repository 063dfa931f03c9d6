"""What all commands share: errors in one sentence, exit statuses, and how things are printed."""

from __future__ import annotations

import functools
import inspect
import io
import os
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, nullcontext, redirect_stdout, suppress
from json import dumps  # code of users may replace what is in a module
from typing import Any, TypeVar

import typer
from rich.table import Table

from ctxval._util.describe import describe
from ctxval._util.progress_display import progress_shown
from ctxval._util.texts import reason_of, shortened
from ctxval.campaign.goals_of_model import GoalWarning
from ctxval.campaign.storage.disks import StoreWarning
from ctxval.certificates.bounds import as_text
from ctxval.certificates.verdict import Verdict
from ctxval.cli.commands import app
from ctxval.cli.options import described
from ctxval.cli.screen import Screen, line
from ctxval.core.experiment import UnitsWarning
from ctxval.core.preflight import DistanceWarning
from ctxval.core.trial import Trial
from ctxval.core.validation import CostWarning
from ctxval.errors import CertificateError, CtxvalError, InputError, StoreError

FALSIFIED, BAD_INPUT, CANNOT_GO_ON, INTERRUPTED, CUT_OFF = 1, 2, 3, 130, 141
_BAD = (InputError, StoreError, CertificateError)

RUN = "run"
"""Key under which a store keeps the verdict of its last run and the report that was written."""

out, notes, err = Screen(), Screen(stderr=True), Screen(stderr=True)
"""What ``--json`` silences, on stdout and on stderr, and what is always said, on stderr."""

Command = TypeVar("Command", bound=Callable[..., Any])


def command(name: str | None = None, /, *, with_json: bool = True, **words: Any) -> Callable[[Command], Command]:
    """Make a function a command of ``ctxval``, which ends with one sentence and an exit status if it fails.

    The command returns the JSON object, or the object and the exit status. With ``--json`` nothing else is printed, and
    an error is the object ``{"error": sentence}``.

    Args:
        name: the name of the command; None for that of the function.
        with_json: whether the command has the option ``--json``.
        words: what replaces the words in braces in the texts of the options.
    """

    def register(function: Command) -> Command:
        @functools.wraps(function)
        def wrapped(*, as_json: bool = False, **given: Any) -> None:
            warnings.showwarning = _show_warning
            failure, status = None, 0
            out.quiet = notes.quiet = as_json
            try:
                with _stdout_to_stderr() if as_json else nullcontext() as stdout, progress_shown(not as_json, err):
                    result = function(**given)
                    report, status = result if isinstance(result, tuple) else (result, 0)
                    if stdout is not None:
                        print(dumps(describe(report), allow_nan=False), file=stdout, flush=True)
            except CtxvalError as error:
                failure, status = str(error), BAD_INPUT if isinstance(error, _BAD) else CANNOT_GO_ON
            except (typer.Exit, typer.Abort):
                raise
            except KeyboardInterrupt:
                failure, status = _STOPPED, INTERRUPTED
            except BaseException as error:  # users' code may raise anything
                if isinstance(error.__context__, BrokenPipeError):
                    raise typer.Exit(CUT_OFF) from None  # the reader of the output has ended, as in `| head`
                # Python's own exit status here would be 1, which means that a model is falsified.
                failure, status = reason_of(error), CANNOT_GO_ON
            finally:
                out.quiet = notes.quiet = False
            if failure is not None:
                (err.say if status == INTERRUPTED else say_error)(failure)
                if as_json:
                    _print_failure(failure)
            if status:
                raise typer.Exit(status)

        title = name or function.__name__
        parameters = [*inspect.signature(function, eval_str=True).parameters.values(), _AS_JSON]
        taken = parameters if with_json else parameters[:-1]
        signature = inspect.Signature([described(each, title, words).replace(kind=each.KEYWORD_ONLY) for each in taken])
        vars(wrapped)["__signature__"] = signature
        app.command(title)(wrapped)
        return function

    return register


_AS_JSON = inspect.Parameter("as_json", inspect.Parameter.KEYWORD_ONLY, default=False, annotation=bool)
_STOPPED = "stopped. All executions are stored; run the same command to resume."


def _print_failure(sentence: str) -> None:
    try:
        print(dumps({"error": sentence}), flush=True)
    except OSError as error:
        # What is still buffered must not fail again at the exit of the interpreter, which would change the status.
        with suppress(io.UnsupportedOperation, OSError, ValueError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        if isinstance(error, BrokenPipeError):
            raise typer.Exit(CUT_OFF) from None


@contextmanager
def _stdout_to_stderr() -> Iterator[Any]:
    """Send the output of users' code and programs to stderr; yield a stream to the real standard output."""
    sys.stdout.flush()
    try:
        kept = os.dup(sys.stdout.fileno())
    except (io.UnsupportedOperation, OSError, ValueError):  # stdout has no file descriptor, as in a test
        ours = sys.stdout
        with redirect_stdout(sys.stderr):
            yield ours
        return
    number = sys.stdout.fileno()
    with os.fdopen(kept, "w", encoding=sys.stdout.encoding) as ours:
        os.dup2(sys.stderr.fileno(), number)
        try:
            with redirect_stdout(sys.stderr):
                yield ours
        finally:
            sys.stdout.flush()
            os.dup2(ours.fileno(), number)


def _show_warning(message: Warning | str, category: type[Warning], *place: Any, **_: Any) -> None:
    if issubclass(category, StoreWarning | UnitsWarning | GoalWarning | DistanceWarning | CostWarning):
        err.say(("warning:", "bold yellow"), f" {message}")
    else:
        err.say(warnings.formatwarning(message, category, *place[:2]).rstrip("\n"))


def say_error(sentence: str) -> None:
    """Print an error message."""
    err.say(("error:", "bold red"), f" {sentence}")


def worst_of(trial: Trial | None) -> dict[str, Any] | None:
    """Return the task and the distance of a trial."""
    return None if trial is None else {"task": trial.parameters, "distance": trial.distance}


def failures_of(trials: Iterable[Trial]) -> list[dict[str, Any]]:
    """Return the reasons why trials failed with the numbers of the trials, the most frequent reason first."""
    by_reason: dict[str, list[int]] = {}
    for trial in trials:
        if trial.state == "failed":
            reason = shortened(trial.failure or "no reason was stated")
            by_reason.setdefault(reason, []).append(trial.number)
    ordered = sorted(by_reason.items(), key=lambda item: -len(item[1]))
    return [{"reason": reason, "trials": numbers} for reason, numbers in ordered]


def print_failures(failures: list[dict[str, Any]]) -> None:
    """Print the most frequent reasons of failures."""
    for failure in failures[:3]:
        count = len(failure["trials"])
        which = f"trial {failure['trials'][0]}" if count == 1 else f"{count} trials"
        notes.say((f"{which} failed", "yellow"), f": {failure['reason']}")
    if len(failures) > 3:
        notes.say(f"and {len(failures) - 3} other reasons; `ctxval export` lists them.")


_COLOURS = {"validated": "green", "falsified": "red", "undecided": "yellow"}


def print_table(rows: dict[str, Any], units: str = "") -> None:
    """Print a table of names and values, of which a value may be a task with its distance."""
    table = Table(show_header=False, box=None, pad_edge=False)
    for key, value in rows.items():
        match value:
            case {"task": dict() as task, "distance": distance, **rest}:
                # All digits: the task that is typed again must be the one that was executed.
                at = ", ".join(f"{name} = {item}" for name, item in task.items())
                how = f" ({rest['method']})" if "method" in rest else ""
                text = f"{f'{distance:.4g} {units}'.rstrip()} at {at}{how}"
            case _:
                text = as_text(value) or "none"
        table.add_row(line(key.replace("_", " ")), line(text))
    out.print(table)


def print_columns(columns: Sequence[str], rows: Iterable[Sequence[str]], title: str = "", *, left: int = 1) -> None:
    """Print a table below a title; the first columns are aligned on the left, and the others on the right."""
    if title:
        out.say("")
        out.say((title, "bold"))
    table = Table(box=None, pad_edge=False)
    for place, name in enumerate(columns):
        table.add_column(line(name), justify="left" if place < left else "right")
    for row in rows:
        table.add_row(*map(line, row))
    out.print(table)


def print_other_stores(others: list[str]) -> None:
    """Name the other campaigns of the same experiment, if there are any."""
    if others:
        count = f"{len(others)} other store{'s' if len(others) > 1 else ''} of this experiment"
        sentence = f"the folder contains {count}: {', '.join(others)}."
        out.say(f"{sentence} The best result of several campaigns is wrong more often than its confidence states.")


def print_verdict(verdict: Verdict, units: str = "") -> None:
    """Print the verdict, its reason and its assumptions."""
    answer = (verdict.answer.upper(), f"bold {_COLOURS[verdict.answer]}")
    out.say(answer, f" against {f'{verdict.threshold:g} {units}'.rstrip()}: {verdict.reason}", wrap=True)
    if verdict.rests_on is not None:
        out.say(verdict.rests_on, wrap=True)
