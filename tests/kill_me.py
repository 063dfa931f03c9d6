"""A campaign in a process of its own, to be killed: ``python kill_me.py STORE BUDGET``."""

from __future__ import annotations

import sys

from conftest import make_validation
from ctxval import Campaign, searches


def main(store: str, budget: int) -> None:
    validation = make_validation()
    print("ready", flush=True)
    Campaign(validation, search=searches.GPUCB(), store=store, seed=11, name="killed").run(budget)


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]))
