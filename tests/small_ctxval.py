"""The command line with few draws and few closed loops, in a process of its own: ``small_ctxval.py ARGUMENTS``."""

from __future__ import annotations

import pytest

from conftest import run_few_loops, take_few_draws
from ctxval.cli import main

# Also in the processes that this one starts, which import this module under another name.
take_few_draws(pytest.MonkeyPatch().setattr)
run_few_loops(pytest.MonkeyPatch().setattr)

if __name__ == "__main__":
    main()
