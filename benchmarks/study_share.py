"""Verdicts on 99 % of the tasks, with a running robot in the family of M's parameters and outside, and a smooth case.

``python benchmarks/study_share.py --seeds 3`` runs what ``results/task_share.jsonl`` does not have yet, and writes
``docs/how-to/share.md``. The threshold is a share of the 0.99 quantile of the distance over 20,000 random tasks; the
robot is the HalfCheetah of ``study_parameters.py``. Needs the extra ``mujoco``.
"""

from __future__ import annotations

import argparse
import time
import warnings
from pathlib import Path

import numpy as np

from ctxval import Campaign, Validation
from ctxval.cli.config.settings import load_experiment
from json_lines import JsonLines
from page_tables import GeneratedPage, reflowed, table
from study_parameters import cheetah

RESULTS = Path(__file__).parent / "results" / "task_share.jsonl"
SHARE, FACTORS, BUDGET, TASKS = 0.99, (0.95, 1.25), 30, 20_000
CASES = {
    "cheetah inside": "HalfCheetah, S in the family of M's parameters",
    "cheetah armature": "HalfCheetah, S with another armature",
    "cheetah slope": "HalfCheetah, S on a slope",
    "dubins": "Dubins car (11 task parameters, smooth)",
}
STORED = JsonLines(RESULTS, ("case", "factor", "seed"))
TEXT = """# 99 % of the tasks

At contacts, 0.1 % of change in a parameter may lead to other motion, so the largest distance over all tasks is no
stable number. `ctxval run` and `ctxval check` say so before the first execution if closed loops of M are not smooth.
The distance that 99 % of the tasks stay below is stable:

```text
ctxval run cheetah.toml --threshold 0.3 --share 0.99
```

In Python: `campaign.run(30, 0.3, share=0.99)`, then `campaign.verdict(0.3, share=0.99)`. In a file: `share = 0.99` in
the table `[certificate]`.

- **validated**: with 95 % probability under what executions teach of the dynamics, at most 1 % of the tasks exceed the
  threshold, and predictions at 8 independent draws held. The verdict also says what these draws show alone.
- **falsified**: executions at tasks drawn where larger distances are predicted prove that more than 1 % exceed it,
  [whatever the system is](../theory.md#shares-of-the-tasks). One excess decides nothing.

Noisy systems, suites and envelopes have no share.

## Measured

`make share` makes this page. q is the true 0.99 quantile of 20,000 random tasks; validations at 0.95 q are false.
Campaigns had at most 30 executions; the bound is the median of validations.

{table}
"""


def validation_of(case: str) -> Validation:
    """Return the validation of a case."""
    name, _, what = case.partition(" ")
    return cheetah(what) if name == "cheetah" else load_experiment(name).validation


def truth_of(case: str, results: JsonLines = STORED) -> np.ndarray:
    """Return the largest distances of random tasks, in descending order, and store them."""
    if (case, 0.0, -1) not in results:
        validation = validation_of(case)
        distances = validation.distances(validation.space.iid(TASKS, np.random.default_rng(99)))
        largest = np.sort(distances)[::-1][: TASKS // 20]
        results.append({"case": case, "factor": 0.0, "seed": -1, "largest": [float(f"{d:.7g}") for d in largest]})
    return np.array(results[case, 0.0, -1]["largest"])


def run(case: str, factor: float, seed: int, results: JsonLines = STORED) -> None:
    """Run a campaign and store how it ended."""
    largest = truth_of(case, results)
    quantile = float(largest[round((1 - SHARE) * TASKS)])
    campaign, begun = Campaign(validation_of(case), seed=seed), time.process_time()
    threshold = factor * quantile
    campaign.run(BUDGET, threshold=threshold, share=SHARE)
    verdict = campaign.verdict(threshold, share=SHARE)
    bound = None if verdict.certificate is None else verdict.certificate.upper_bound / quantile
    record = {
        "case": case, "factor": factor, "seed": seed, "answer": verdict.answer, "executions": campaign.executions,
        "bound": bound, "cpu": (time.process_time() - begun) / campaign.executions,
        "above": float((largest > threshold).sum() / TASKS), "reason": verdict.reason,
    }  # fmt: skip
    results.append(record)
    print(record, flush=True)


def page(results: JsonLines = STORED) -> GeneratedPage:
    """Return the page of the stored campaigns."""
    rows = []
    for case, name in CASES.items():
        cells, validated, cpu = [name], list[float](), list[float]()
        for factor in FACTORS:
            campaigns = results.select(case=case, factor=factor)
            answers = [each["answer"] for each in campaigns]
            counts = "/".join(str(answers.count(answer)) for answer in ("validated", "falsified", "undecided"))
            executions = f"{np.median([each['executions'] for each in campaigns]):g}" if campaigns else "-"
            cells += [counts if campaigns else "not run", executions]
            cpu += [each["cpu"] for each in campaigns]
            validated = [each["bound"] for each in campaigns if each["answer"] == "validated"]
        cells += [f"{np.median(validated):.2f}" if validated else "-", f"{np.median(cpu):.1f}" if cpu else "-"]
        rows.append(cells)
    answers_of = [f"{factor:g} q: validated/falsified/undecided" for factor in FACTORS]
    header = ("system", answers_of[0], "executions", answers_of[1], "executions", "bound / q", "CPU s an execution")
    return GeneratedPage("how-to/share.md", reflowed(TEXT.replace("{table}", table(header, rows))))


def main() -> None:
    """Run the missing campaigns, and write the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--cases", nargs="*", default=list(CASES))
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    for case in options.cases:
        for seed in range(options.seeds):
            for factor in FACTORS:
                if (case, factor, seed) not in STORED:
                    run(case, factor, seed)
    page().write()


if __name__ == "__main__":
    main()
