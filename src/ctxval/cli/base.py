"""What all commands share: options with their texts, files that they write, errors, exit statuses, and printing."""

from __future__ import annotations

import functools
import inspect
import io
import os
import sys
import textwrap
import tomllib
import traceback
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, redirect_stdout, suppress
from dataclasses import dataclass
from json import dumps  # code of users may replace what is in a module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import typer
from rich.table import Table

from ctxval._util.checked import TimeLimit, require
from ctxval._util.cores import exits_as_exceptions
from ctxval._util.describe import describe
from ctxval._util.files import make_folder_of, require_made_by_us
from ctxval._util.progress import progress_shown
from ctxval._util.refusals import reworded
from ctxval._util.representation import counted
from ctxval._util.texts import as_text, reason_of, shortened
from ctxval.cli.commands import TEXTS, PlainCommand, Screen, app, line, number_parser
from ctxval.errors import CertificateError, CtxvalError, InputError, StoreError

if TYPE_CHECKING:  # commands that need none of them start earlier
    from ctxval.certificates.verdict import Verdict
    from ctxval.core.trial import Trial, Trials

FALSIFIED, BAD_INPUT, CANNOT_GO_ON, INTERRUPTED, CUT_OFF = 1, 2, 3, 130, 141

RUN = "run"  #: key under which a store keeps the verdict of its last run and the report that was written

ERROR, COLOURS = ("error: ", "bold red"), {"validated": "green", "falsified": "red", "undecided": "yellow"}

out, notes, err = Screen(), Screen(stderr=True), Screen(stderr=True)
"""What ``--json`` silences, on stdout and on stderr, and what is always said, on stderr."""

Command = TypeVar("Command", bound=Callable[..., Any])


def command(name: str | None = None, /, *, with_json: bool = True, **words: Any) -> Callable[[Command], Command]:
    """Make a function a command of ``ctxval``, which ends with one sentence and an exit status if it fails.

    The command returns the JSON object, or the object and the exit status. With ``--json`` nothing else is printed, and
    an error is the object ``{"error": sentence}``. A parameter that is a dataclass stands for its fields, which are
    options that several commands have. ``words`` replace the words in braces in the texts of the options.
    """

    def register(function: Command) -> Command:
        title = name or function.__name__
        groups: dict[str, tuple[Any, list[str]]] = {}
        parameters: list[inspect.Parameter] = []
        for parameter in inspect.signature(function, eval_str=True).parameters.values():
            group: Any = parameter.annotation
            options = [parameter]
            if hasattr(group, "__dataclass_fields__"):
                options = [*inspect.signature(group, eval_str=True).parameters.values()]
                groups[parameter.name] = group, [each.name for each in options]
            parameters += options
        if with_json:
            parameters += [inspect.Parameter("as_json", inspect.Parameter.KEYWORD_ONLY, default=False, annotation=bool)]

        @functools.wraps(function)
        def wrapped(*, as_json: bool = False, **given: Any) -> None:
            stated = {key for key, value in given.items() if value is not None}
            for key, (group, fields) in groups.items():
                given[key] = group(**{field: given.pop(field) for field in fields})
            _run(functools.partial(function, **given), as_json, stated)

        leading = {option: place for place, option in enumerate(TEXTS["leading"].get(title, ()))}
        parameters.sort(key=lambda each: leading.get(each.name, len(leading)))
        signature = inspect.Signature([_described(each, title, words) for each in parameters])
        vars(wrapped)["__signature__"] = signature
        app.command(title, cls=PlainCommand)(wrapped)
        return function

    return register


@functools.cache
def _names() -> dict[str, str]:
    """Return the names of parts that texts of options are completed with."""
    from ctxval.certificates import KINDS  # imported here, and also below: `ctxval status` starts without them
    from ctxval.searches import REGISTRY

    return {
        "searches": ", ".join(sorted(REGISTRY.built_in)),
        # The text itself names the kinds that most people need.
        "certificates": ", ".join(kind for kind in KINDS.built_in if kind not in ("auto", "posterior", "audit")),
        "volumes": ", ".join(kind for kind in KINDS.built_in if not KINDS.find(kind).bounds_maximum),
    }


def _described(parameter: inspect.Parameter, command: str, words: Mapping[str, Any]) -> inspect.Parameter:
    text = {**TEXTS["options"], **TEXTS.get(command, {})}[parameter.name]
    words = {"target": "CASE|FILE.toml|module:attr", **words}
    known: dict[str, Any] = {"help": text} if isinstance(text, str) else text
    if any(f"{{{name}}}" in str(known) for name in ("searches", "certificates", "volumes")):
        words |= _names()
    known = {key: value.format(**words) if isinstance(value, str) else value for key, value in known.items()}
    known |= number_parser(parameter.annotation)
    if "argument" in known:
        info: Any = typer.Argument(metavar=known.pop("argument"), **known)
    else:
        leading = TEXTS["leading"].get(command)
        panel = None if leading is None or parameter.name in leading else "Advanced"
        # Without its name, a flag would have a second option that switches it off.
        flags = known.pop("flags", [f"--{parameter.name.strip('_').replace('_', '-')}"])
        info = typer.Option(*flags, rich_help_panel=panel, **known)
    return parameter.replace(annotation=Annotated[parameter.annotation, info], kind=parameter.KEYWORD_ONLY)


_OURS = Path(__file__).parents[1]


def _run(function: Callable[[], Any], as_json: bool, stated: set[str]) -> None:
    warnings.showwarning = _show_warning
    failure, status = None, 0
    out.quiet = notes.quiet = as_json
    try:
        capture = _stdout_to_stderr() if as_json else nullcontext()
        with capture as stdout, progress_shown(not as_json, err), exits_as_exceptions():
            result = function()
            report, status = result if isinstance(result, tuple) else (result, 0)
            if stdout is not None:
                print(dumps(describe(report), allow_nan=False), file=stdout, flush=True)
    except CtxvalError as error:
        bad = isinstance(error, InputError | StoreError | CertificateError)
        failure, status = str(error), BAD_INPUT if bad else CANNOT_GO_ON
        name, must, rest = failure.partition(" must be ")
        if must and name.replace(" ", "_") in stated:  # the value of an option
            failure = f"--{name.replace('_', '-')}{must}{rest}"
    except (typer.Exit, typer.Abort):
        raise
    except KeyboardInterrupt:
        failure, status = "stopped. All executions are stored; the same command continues from them.", INTERRUPTED
    except BaseException as error:  # users' code may raise anything
        if isinstance(error.__context__, BrokenPipeError):
            raise typer.Exit(CUT_OFF) from None  # the reader of the output has ended, as in `| head`
        # Python's own exit status here would be 1, which means that a model is falsified.
        failure, status = _reason_of_others(error), CANNOT_GO_ON
        if isinstance(error, OSError) and not _in_a_folder():
            failure, status = "the current folder was deleted: change to another one.", BAD_INPUT
    finally:
        out.quiet = notes.quiet = False
    if failure is not None:
        err.say(*([] if status == INTERRUPTED else [ERROR]), failure)
        if as_json:
            try:
                print(dumps({"error": failure}), flush=True)
            except OSError as error:  # what is still buffered must not fail again at exit, and change the status
                with suppress(io.UnsupportedOperation, OSError, ValueError):
                    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
                if isinstance(error, BrokenPipeError):
                    raise typer.Exit(CUT_OFF) from None
    if status:
        raise typer.Exit(status)


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


def _reason_of_others(error: BaseException) -> str:
    """Return why users' code or the operating system ended a command."""
    if isinstance(error, OSError) and error.strerror:
        what = "the output cannot be written" if error.filename is None else f"{error.filename}"
        return f"{what}: {error.strerror}."
    places = [frame.f_code.co_filename for frame, _ in traceback.walk_tb(error.__traceback__)]
    modules = [place for place in places if not Path(place).is_relative_to(_OURS)]
    return f"{modules[-1]} ended: {reason_of(error)}" if isinstance(error, SystemExit) and modules else reason_of(error)


def _in_a_folder() -> bool:
    try:
        return bool(os.getcwd())
    except OSError:
        return False


def _show_warning(message: Warning | str, category: type[Warning], *place: Any, **_: Any) -> None:
    if category.__module__.startswith("ctxval."):
        err.say(("warning:", "bold yellow"), f" {message}")
    else:
        err.say(warnings.formatwarning(message, category, *place[:2]).rstrip("\n"))


# Values of options, and files that options name: never onto an input, and never onto the work of others


@dataclass(frozen=True)
class NewStore:
    """Where the store of an experiment is, and what it is made with if it is not there."""

    store: Path | None = None
    search: str | None = None
    seed: int | None = None


@dataclass(frozen=True)
class Parallel:
    """How executions are made: in how many processes, and for how long at most."""

    workers: int | None = None
    timeout: float | None = None


@dataclass(frozen=True)
class Allowed:
    """What may be done with the experiment of a store: whose code may run, and why it may have changed."""

    experiment: str | None = None
    trust: bool = False
    accept_change: str | None = None


def named_values(given: Sequence[str] | None, flag: str = "--option", /, **named: Any) -> dict[str, Any]:
    values = {name: value for name, value in named.items() if value is not None}
    for text in given or ():
        name, equals, value = text.partition("=")
        name = name.strip()
        if not (equals and name):
            raise InputError(f"{flag} must be NAME=VALUE, such as {flag} dim=4, got {text!r}.")
        if name in values:
            raise InputError(f"the option {name} is given twice: as {values[name]!r} and as {value!r}.")
        values[name] = parsed(value.strip())
    return values


def parsed(text: str) -> Any:
    """Return the number, Boolean, list or quoted text that a TOML file would contain, or else the text itself."""
    with suppress(tomllib.TOMLDecodeError, RecursionError):
        match tomllib.loads(f"value = {text}"):
            case {"value": str() | int() | float() | list() as value, **others} if not others and "_" not in text:
                return value
            case {"value": str() | list() as value, **others} if not others:
                return value
    return text


def require_outputs(outputs: Mapping[str, Path | None], inputs: Iterable[object], *, force: bool) -> None:
    """Check the files that a command will write, before it does anything else."""
    read = [Path(str(each)) for each in inputs if each is not None and "\0" not in str(each)]
    named: dict[Path, str] = {}
    for option, path in outputs.items():
        if path is None:
            continue
        name, has_suffix, suffix = option.partition(" .")
        if has_suffix and path.suffix.lower() != f".{suffix}":
            raise InputError(f"{name} must be a file that ends in .{suffix}, got {str(path)!r}.")
        make_folder_of(path)
        with reworded(f"{path} cannot be written", OSError, RuntimeError, ValueError):
            place, there = path.resolve(), path.exists()
            is_input = there and any(each.exists() and each.samefile(path) for each in read)
        if place in named:
            raise InputError(f"{named[place]} and {name} must be different files, and both are {path}.")
        named[place] = name
        if path.is_dir():
            raise InputError(f"{path} cannot be written: it is a folder.")
        if not force:
            if is_input or path.is_symlink():
                what = "read by this command" if is_input else "a link to another file"
                raise InputError(f"{path} is {what}: give another name, or --force to replace it.")
            require_made_by_us(path)


def require_folder(folder: Path, names: Iterable[str], mark: str, *, force: bool) -> None:
    """Check that files may be written into a folder: none of them is there, or the first one is ours."""
    first, *others = names
    there = [name for name in (first, *others) if (folder / name).exists()]
    if there and not force:
        if first not in there:
            raise InputError(f"{folder / there[0]} is there already: give another folder, or --force to replace it.")
        require_made_by_us(folder / first, mark.encode())


# Printing


def status_of(verdict: Verdict | None) -> int:
    return FALSIFIED if verdict is not None and verdict.answer == "falsified" else 0


def summary_of(trials: Trials) -> dict[str, Any]:
    """Return what became of the trials in a store."""
    failures, worst = failures_of(trials), trials.worst
    return {
        "executions": trials.executions,
        "failed": sum(len(failure["trials"]) for failure in failures),
        "failures": failures,
        "worst": None if worst is None else {"task": worst.parameters, "distance": worst.distance},
    }


def failures_of(trials: Iterable[Trial]) -> list[dict[str, Any]]:
    by_reason: dict[str, list[int]] = {}
    for trial in trials:
        if trial.state == "failed":
            by_reason.setdefault(shortened(trial.failure or "no reason was stated"), []).append(trial.number)
    ordered = sorted(by_reason.items(), key=lambda item: -len(item[1]))
    return [{"reason": reason, "trials": numbers} for reason, numbers in ordered]


def print_failures(failures: list[dict[str, Any]]) -> None:
    for failure in failures[:3]:
        count = len(failure["trials"])
        which = f"trial {failure['trials'][0]}" if count == 1 else f"{count} trials"
        notes.say((f"{which} failed", "yellow"), f": {failure['reason']}")
    if len(failures) > 3:
        notes.say(f"and {len(failures) - 3} other reasons; `ctxval export` lists them.")


def print_table(rows: dict[str, Any], units: str = "") -> None:
    """Print a table of names and values, of which a value may be a task with its distance."""
    table = Table(show_header=False, box=None, pad_edge=False)
    for key, value in rows.items():
        text = as_text(value) or "none"
        match value:
            case {"task": dict() as task, "distance": distance}:
                # All digits: the task that is typed again must be the one that was executed.
                at = ", ".join(f"{name} = {item}" for name, item in task.items())
                text = f"{f'{distance:.4g} {units}'.rstrip()} at {at}"
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
    if others:
        stores = f"{counted(len(others), 'other store')} of this experiment: {', '.join(others)}"
        why = "The best result of several campaigns is wrong more often than its confidence states."
        out.say(f"the folder contains {stores}. {why}")


def stated_seconds(thinking: float | None, usual: float | None) -> float | None:
    """Return the limit of thinking that a command states, or else the usual one; None for the default."""
    require("thinking", TimeLimit | None, thinking)
    return usual if thinking is None else thinking


def print_left_out(thinking: Mapping[str, Any] | None) -> None:
    """Print which stages did not fit into the budget of thinking, of the JSON of a result."""
    if replaced := (thinking or {}).get("replaced"):
        stages = "; ".join(replaced)
        out.say(f"for lack of time, replaced or left out: {stages}. A larger --thinking has time for more.", wrap=True)


def print_verdict(verdict: Verdict, units: str = "") -> None:
    """Print the answer with its numbers and conditions, on one screen; the report and --json have the whole reason."""
    from ctxval.certificates.sentences import summary

    out.say((verdict.answer.upper(), f"bold {COLOURS[verdict.answer]}"), summary.headline(verdict, units), wrap=True)
    print_table(summary.rows(verdict, units))
    for remark in verdict.remarks if verdict.answer == "validated" else ():
        out.say(f"Note: {remark}.", wrap=True)
    if verdict.conditions:
        out.say("It rests on")
        for condition in verdict.conditions:
            out.say(f"- {textwrap.shorten(condition, max(out.width - 2, 60), placeholder=' ...')}")
