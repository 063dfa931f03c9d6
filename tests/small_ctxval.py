"""The command line with few draws and few closed loops, in a process of its own: ``small_ctxval.py ARGUMENTS``."""

from __future__ import annotations

import pkgutil
from typing import Any

from ctxval.cli import main
from small_searches import run_few_loops, take_few_draws


def replace(target: str, value: Any) -> None:
    owner, _, name = target.rpartition(".")
    setattr(pkgutil.resolve_name(owner), name, value)


# Also in the processes that this one starts, which import this module under another name.
take_few_draws(replace)
run_few_loops(replace)

if __name__ == "__main__":
    main()
