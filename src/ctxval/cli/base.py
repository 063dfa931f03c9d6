"""What all commands share: errors in one sentence, exit statuses, and how things are printed."""

from __future__ import annotations

import functools
import importlib
import io
import json
import os
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, redirect_stdout
from dataclasses import asdict
from typing import Annotated, Any

import typer
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from ctxval._util.describe import describe
from ctxval._util.texts import reason_of, shortened
from ctxval.campaign.campaign import Campaign
from ctxval.certificates.bounds import as_text
from ctxval.certificates.verdict import Verdict
from ctxval.cli.screen import Commands, Screen, line
from ctxval.core.trial import Trial
from ctxval.errors import CertificateError, CtxvalError, InputError, StoreError
from ctxval.storage.disks import StoreWarning

FALSIFIED, BAD_INPUT, CANNOT_GO_ON, INTERRUPTED, CUT_OFF = 1, 2, 3, 130, 141
_BAD = (InputError, StoreError, CertificateError)

app = typer.Typer(
    name="ctxval",
    cls=Commands,
    help="Decide whether a learned model of a robot can be trusted for the control tasks it is meant for.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)
out = Screen()
err = Screen(stderr=True)

AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON object and nothing else.")]


def command(function: Callable[..., Any]) -> Callable[..., Any]:
    """Turn ctxval's errors into one sentence and an exit status; what a command returns is its JSON."""

    @functools.wraps(function)
    def wrapped(*args: Any, **kwargs: Any) -> Any:
        warnings.showwarning = _show_warning
        try:
            with _stdout_to_stderr() if kwargs.get("as_json") else _as_it_is() as stdout:
                return _answered(function(*args, **kwargs), stdout if kwargs.get("as_json") else None)
        except CtxvalError as error:
            say_error(str(error))
            raise typer.Exit(BAD_INPUT if isinstance(error, _BAD) else CANNOT_GO_ON) from None
        except (typer.Exit, typer.Abort):
            raise
        except KeyboardInterrupt:
            err.say("stopped; what was executed is stored, run the same command to go on.")
            raise typer.Exit(INTERRUPTED) from None
        except BaseException as error:  # users' code may raise anything
            if isinstance(error.__context__, BrokenPipeError):
                raise typer.Exit(CUT_OFF) from None  # the reader of our output has gone, as in `| head`
            # Python's own exit status here would be 1, which says that a model is falsified.
            say_error(reason_of(error))
            raise typer.Exit(CANNOT_GO_ON) from None

    return wrapped


def _answered(answer: Any, stdout: Any) -> None:
    """Print a command's JSON where that was asked for, and leave with its exit status."""
    report, status = answer if isinstance(answer, tuple) else (answer, 0)
    if stdout is not None:
        print(json.dumps(describe(report), allow_nan=False), file=stdout, flush=True)
    if status:
        raise typer.Exit(status)


@contextmanager
def _as_it_is() -> Iterator[None]:
    yield None


@contextmanager
def _stdout_to_stderr() -> Iterator[Any]:
    """Send what users' code and programs print to stderr; yield what is the standard output for us."""
    sys.stdout.flush()
    try:
        kept = os.dup(sys.stdout.fileno())
    except (io.UnsupportedOperation, OSError, ValueError):  # no file of its own, as in a test
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


RESOLUTION_HELP = (
    "How far from every trial a task may be for a validation, in diagonals of the task space; 0.125 if not given. "
    "What is larger is more often wrong: of campaigns with a threshold just below d*, 1 of 74 said validated at 0.125, "
    "8 of 75 at 0.25, and of those on narrow peaks in 2-D 11 of 48."
)
Workers = Annotated[int | None, typer.Option(help="Executions at a time, each in a process of its own.")]
Dask = Annotated[str | None, typer.Option(metavar="ADDRESS", help="Of a Dask scheduler whose workers execute.")]
Timeout = Annotated[float | None, typer.Option(help="Seconds after which an execution has failed.")]


@contextmanager
def worker_options(workers: int | None, dask: str | None, timeout: float | None) -> Iterator[dict[str, Any]]:
    """Yield the options of a campaign's run that say who executes: processes, or the workers of a Dask scheduler.

    Raises:
        InputError: there is no such scheduler, or it has no workers.
    """
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
    if issubclass(category, StoreWarning):
        err.say(("warning:", "bold yellow"), f" {message}")
    else:
        err.say(warnings.formatwarning(message, category, *place[:2]).rstrip("\n"))


def say_error(sentence: str) -> None:
    """Print what is wrong."""
    err.say(("error:", "bold red"), f" {sentence}")


@contextmanager
def progress(campaign: Campaign, total: int, *, show: bool) -> Iterator[Callable[[Trial], None]]:
    """Show how many executions have ended, of how many."""
    columns = (
        TextColumn("executions"),
        BarColumn(bar_width=30),
        MofNCompleteColumn(),
        TextColumn("largest distance {task.fields[best]}  {task.fields[pace]}"),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=err, disable=not show) as display:
        line = display.add_task("", total=total, completed=campaign.executions, best="-", pace="")

        def on_trial(trial: Trial) -> None:
            best = "-" if campaign.worst is None else f"{campaign.worst.distance:.4g}"
            display.update(line, completed=campaign.executions, best=best, pace=_pace(trial))

        yield on_trial


def _pace(trial: Trial) -> str:
    return "" if trial.seconds is None else f"{trial.seconds:.2g} s/execution"


def certificate_of(verdict: Verdict | None) -> dict[str, Any]:
    """Return what stands behind a verdict, and what is expected of further executions."""
    if verdict is None:
        return {"certificate": None, "expected": None}
    return {
        "certificate": None if verdict.certificate is None else verdict.certificate.to_json(),
        "expected": None if verdict.expected is None else asdict(verdict.expected),
    }


def worst_of(trial: Trial | None) -> dict[str, Any] | None:
    """Return a trial's task and distance."""
    return None if trial is None else {"task": trial.parameters, "distance": trial.distance}


def failures_of(trials: Iterable[Trial]) -> list[dict[str, Any]]:
    """Return why trials failed, the most frequent reason first, and which ones."""
    by_reason: dict[str, list[int]] = {}
    for trial in trials:
        if trial.state == "failed":
            reason = shortened(trial.failure or "for no stated reason")
            by_reason.setdefault(reason, []).append(trial.number)
    ordered = sorted(by_reason.items(), key=lambda item: -len(item[1]))
    return [{"reason": reason, "trials": numbers} for reason, numbers in ordered]


def print_failures(failures: list[dict[str, Any]]) -> None:
    """Print the most frequent reasons."""
    for failure in failures[:_REASONS]:
        count = len(failure["trials"])
        which = f"trial {failure['trials'][0]}" if count == 1 else f"{count} trials"
        err.say((f"{which} failed", "yellow"), f": {failure['reason']}")
    if len(failures) > _REASONS:
        err.say(f"and {len(failures) - _REASONS} other reasons; ctxval export has them.")


_REASONS = 3
"""Reasons of failures that are printed."""


def print_table(rows: dict[str, Any], units: str = "") -> None:
    """Print names and values."""
    table = Table(show_header=False, box=None, pad_edge=False)
    for key, value in rows.items():
        table.add_row(line(key.replace("_", " ")), line(_text(value, units)))
    out.print(table)


def _text(value: Any, units: str) -> str:
    match value:
        case list():
            return ", ".join(_text(item, units) for item in value)
        case {"task": dict() as task, "distance": distance, **rest}:
            at = ", ".join(f"{name} = {_text(item, '')}" for name, item in task.items())
            how = f" ({rest['method']})" if "method" in rest else ""
            return f"{distance:.4g} {units} at {at}{how}"
        case dict():
            return ", ".join(f"{name} {_text(item, '')}" for name, item in value.items())
        case _:
            return as_text(value)


def print_other_stores(others: list[str]) -> None:
    """Name the other campaigns of the same experiment, if there are any."""
    if others:
        count = f"{len(others)} other store{'s' if len(others) > 1 else ''} of this experiment beside this one"
        out.say(f"{count}: {', '.join(others)}. The best of several campaigns is wrong more often than stated.")


def print_verdict(verdict: Verdict) -> None:
    """Print the answer and its reason."""
    out.say((verdict.answer, "bold"), f" against {verdict.threshold:g}: {verdict.reason}", wrap=True)
    if verdict.rests_on is not None:
        out.say(verdict.rests_on, wrap=True)
