"""``docs/reproduction.md``: the figures of the paper, their data and a table of its claims."""

from __future__ import annotations

import argparse
from pathlib import Path

from reproduce import FULL, QUICK, reproduce


def main() -> None:
    """Run the jobs that are not stored yet, and write the figures and the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("study", help="one figure or study, or all")
    parser.add_argument("--quick", action="store_true", help="fewer trials and coarser grids")
    parser.add_argument("--out", type=Path, help="folder of the figures; the table is written beside it")
    parser.add_argument("--results", type=Path, help="folder of the stored runs, which are not computed again")
    parser.add_argument("--workers", type=int, default=2)
    asked = parser.parse_args()
    out = asked.out or Path("reproduction" if asked.quick else "docs/reproduction")
    table = reproduce(
        asked.study,
        out,
        stored=asked.results,
        scale=QUICK if asked.quick else FULL,
        workers=asked.workers,
        on_start=lambda missing: print(f"runs: {missing}"),
        on_done=lambda job: print(job.key, flush=True),
    )
    print(f"table: {table}")


if __name__ == "__main__":
    main()
