"""What all commands share: errors in one sentence, exit statuses, and how things are printed."""

from __future__ import annotations

import functools
import importlib
import io
import os
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, nullcontext, redirect_stdout, suppress
from json import dumps  # code of users may replace what is in a module
from typing import Any

import typer
from rich.table import Table

from ctxval._util.describe import describe
from ctxval._util.progress_display import progress_shown
from ctxval._util.texts import reason_of, shortened
from ctxval.campaign.goals_of_model import GoalWarning
from ctxval.certificates.bounds import as_text
from ctxval.certificates.verdict import Verdict
from ctxval.cli.screen import Screen, line
from ctxval.core.experiment import UnitsWarning
from ctxval.core.preflight import CostWarning, DistanceWarning
from ctxval.core.trial import Trial
from ctxval.errors import CertificateError, CtxvalError, InputError, StoreError
from ctxval.storage.disks import StoreWarning

FALSIFIED, BAD_INPUT, CANNOT_GO_ON, INTERRUPTED, CUT_OFF = 1, 2, 3, 130, 141
_BAD = (InputError, StoreError, CertificateError)

RUN = "run"
"""Key under which a store keeps the verdict of its last run and the report that was written."""

out = Screen()
err = Screen(stderr=True)


def command(function: Callable[..., Any]) -> Callable[..., Any]:
    """Let a command print its result as JSON, and turn its errors into one sentence and an exit status.

    The command returns the JSON object, or the object and the exit status. With ``--json``, an error is the object
    ``{"error": sentence}``.
    """

    @functools.wraps(function)
    def wrapped(*args: Any, **kwargs: Any) -> Any:
        warnings.showwarning = _show_warning
        as_json = bool(kwargs.get("as_json"))
        try:
            with _stdout_to_stderr() if as_json else nullcontext() as stdout, progress_shown(not as_json, err):
                result = function(*args, **kwargs)
                report, status = result if isinstance(result, tuple) else (result, 0)
                if stdout is not None:
                    print(dumps(describe(report), allow_nan=False), file=stdout, flush=True)
                if status:
                    raise typer.Exit(status)
                return
        except CtxvalError as error:
            say_error(str(error))
            _print_failure(str(error), as_json)
            raise typer.Exit(BAD_INPUT if isinstance(error, _BAD) else CANNOT_GO_ON) from None
        except (typer.Exit, typer.Abort):
            raise
        except KeyboardInterrupt:
            err.say(_STOPPED)
            _print_failure(_STOPPED, as_json)
            raise typer.Exit(INTERRUPTED) from None
        except BaseException as error:  # users' code may raise anything
            if isinstance(error.__context__, BrokenPipeError):
                raise typer.Exit(CUT_OFF) from None  # the reader of the output has ended, as in `| head`
            # Python's own exit status here would be 1, which means that a model is falsified.
            say_error(reason_of(error))
            _print_failure(reason_of(error), as_json)
            raise typer.Exit(CANNOT_GO_ON) from None

    return wrapped


def _print_failure(sentence: str, as_json: bool) -> None:
    if not as_json:
        return
    try:
        print(dumps({"error": sentence}), flush=True)
    except OSError as error:
        # What is still buffered must not fail again at the exit of the interpreter, which would change the status.
        with suppress(io.UnsupportedOperation, OSError, ValueError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        if isinstance(error, BrokenPipeError):
            raise typer.Exit(CUT_OFF) from None


_STOPPED = "stopped. All executions are stored; run the same command to resume."


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


@contextmanager
def worker_options(workers: int | None, dask: str | None, timeout: float | None) -> Iterator[dict[str, Any]]:
    """Yield the arguments of :meth:`ctxval.Campaign.run` for local processes or for the workers of a Dask scheduler."""
    if dask is None:
        yield {"workers": workers, "timeout": timeout}
        return
    try:
        distributed: Any = importlib.import_module("distributed")
    except ImportError as error:
        raise InputError("--dask needs dask.distributed: pip install 'ctxval[dask]'.") from error
    try:
        client = distributed.Client(dask, timeout=10)
    except (OSError, ValueError, TypeError) as error:
        raise InputError(f"there is no Dask scheduler at {dask}: {type(error).__name__}: {error}.") from error
    with client:
        threads = sum(client.nthreads().values())
        if not threads:
            raise InputError(f"the Dask scheduler at {dask} has no workers.")
        yield {"workers": workers or threads, "executor": client.get_executor(pure=False), "timeout": timeout}


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
        err.say((f"{which} failed", "yellow"), f": {failure['reason']}")
    if len(failures) > 3:
        err.say(f"and {len(failures) - 3} other reasons; `ctxval export` lists them.")


_COLOURS = {"validated": "green", "falsified": "red", "undecided": "yellow"}


def print_table(rows: dict[str, Any], units: str = "") -> None:
    """Print a table of names and values."""
    table = Table(show_header=False, box=None, pad_edge=False)
    for key, value in rows.items():
        table.add_row(line(key.replace("_", " ")), line(_text(value, units)))
    out.print(table)


def print_columns(
    left: Sequence[str], right: Sequence[str], rows: Iterable[Sequence[str]], title: str | None = None
) -> None:
    """Print a table with columns that are aligned on the left, then those on the right, below a title."""
    if title is not None:
        out.say("")
        out.say((title, "bold"))
    table = Table(*map(line, left), box=None, pad_edge=False)
    for name in right:
        table.add_column(line(name), justify="right")
    for row in rows:
        table.add_row(*map(line, row))
    out.print(table)


def _text(value: Any, units: str) -> str:
    match value:
        case list():
            return ", ".join(_text(item, units) for item in value) or "none"
        case {"task": dict() as task, "distance": distance, **rest}:
            # All digits: the task that is typed again must be the one that was executed.
            at = ", ".join(f"{name} = {item}" for name, item in task.items())
            how = f" ({rest['method']})" if "method" in rest else ""
            return f"{f'{distance:.4g} {units}'.rstrip()} at {at}{how}"
        case dict():
            return ", ".join(f"{name} {_text(item, '')}" for name, item in value.items())
        case _:
            return as_text(value)


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
