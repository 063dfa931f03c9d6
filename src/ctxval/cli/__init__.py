"""The command line: a thin skin over the public interface."""

import os
import sys
import threading
import time

from ctxval.cli.commands import Screen, app

__all__ = ["app", "main"]

_GRACE = 3.0  # seconds that threads of users' modules get to end


def main() -> None:
    for number in range(3):  # a closed stream would otherwise be the first file that is opened, such as a report
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)
    for stream in (sys.stdout, sys.stderr):  # they escape the characters that their encoding does not have
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")
    if sys.stdout is None:
        advice = "send it to a file, or to /dev/null"
        Screen(stderr=True).say(f"error: the standard output is closed, so no result can be printed: {advice}.")
        sys.exit(2)
    try:
        app(prog_name="ctxval")
    except SystemExit as error:
        _end_threads(error.code if isinstance(error.code, int) else 0)
        raise


def _end_threads(status: int) -> None:
    """End this process if threads of users' modules go on, for which Python would wait without end."""
    until = time.monotonic() + _GRACE
    while running := [
        each for each in threading.enumerate() if each is not threading.main_thread() and not each.daemon
    ]:
        if time.monotonic() > until:
            names = ", ".join(each.name for each in running)
            sentence = "threads that the experiment's code has started go on, and end with this process"
            Screen(stderr=True).say(f"{sentence}: {names}.")
            sys.stdout.flush()
            os._exit(status)
        time.sleep(0.02)
