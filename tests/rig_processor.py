"""A campaign on the processor that the environment names: ``python rig_processor.py SEARCH BUDGET STORE ...``.

``OPENBLAS_CORETYPE`` chooses the kernels of linear algebra as another processor would.
"""

from __future__ import annotations

import sys

import threadpoolctl

import small_ctxval  # noqa: F401  # few draws and closed loops
from conftest import make_validation
from ctxval import Campaign, searches


def kernels() -> str:
    """Return for which processors the linear algebra of this process is."""
    return ", ".join(sorted({str(info.get("architecture")) for info in threadpoolctl.threadpool_info()}))


if __name__ == "__main__":
    search, budget, *stores = sys.argv[1:]
    for store in stores:
        campaign = Campaign(make_validation(), search=searches.by_name(search), store=store, seed=1, name="processors")
        campaign.run(int(budget), explore=True)
    print(kernels())
