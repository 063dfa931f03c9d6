"""Which part of the tasks that keep a threshold an envelope finds within 15 executions, and what it includes falsely.

The threshold is the 0.7 quantile of the true distance over the tasks, so it is below d* and 70 % of the tasks keep it.
The true set is known at 4,000 random tasks, by executions of the true system that count as none; a noisy system is
executed 60 times at each of 1,000 tasks, and its distance is the 0.9 quantile. The method was tuned on systems of the
development lists alone (hanging-pendulum, two-tanks, docking-magnet, corner-stop, hidden-load, the
carts and pendulums with noise, and the systems with contacts of ``envelope_development.py``).

``python benchmarks/study_envelope.py --seeds 4`` runs the campaigns that are not stored yet, and writes
``docs/envelope.md``. With ``--seeds 0``, it only writes the page.
"""

from __future__ import annotations

import argparse
import time
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from ctxval import Campaign, Validation
from ctxval._util.json_lines import JsonLines
from ctxval.core.quantiles import QUANTILE
from dynamics_reporting import REPORTING as DYNAMICS
from noise_reporting import PLANTS
from strangers_reporting import REPORTING as STRANGERS
from study_auto import RESULTS

STORED = JsonLines(RESULTS / "envelope.jsonl", ("system", "seed", "rule"))
PAGE = Path(__file__).parents[1] / "docs" / "envelope.md"
RULE = 11
"""The version of the method: 1 had one margin for all tasks, 2 did not check its interpolation, 3 stated no envelope if
learned dynamics missed the distance of a test, on whichever side of the threshold, 4 executed the tests before the
model was falsified, which cost the verdict of oblique-wall, 5 learned contacts as noise, 6 asked for a regular part
only if there seemed to be noise, or a test was not explained, 7 trusted runs to places that no execution had entered,
so that only campaigns on systems with positions differ from 8, and the others have its number, 8 interpolated
with one scale for all parameters, and with errors that further tasks could only enlarge, 9 kept no executions for
the tests of noisy systems until the model was falsified, so that only campaigns that lacked tests differ from 10, and
10 interpolated what it trusts, of which smooth systems lost little."""
COMPARABLE = 3  # later versions differ in what they do if learned dynamics miss a distance, and 4 in when it tests
BUDGET, KEPT, CONFIDENCE = 15, 0.7, 0.95
TASKS, NOISY_TASKS, REPEATS = 4000, 1000, 60

SMOOTH = ("reactor", "heated-rooms", "boat-in-current", "ball-on-beam", "far-barge", "warm-bearing", "ground-effect")
CONTACTS = ("table-top", "oblique-wall", "taut-tether", "thin-pillar", "slack-cable", "loose-wrist")
NOISY = {
    "ship, noise": ("ship", "process 0.1 %"),
    "tanks, noise": ("tanks", "measurement 0.5 %"),
    "maglev, noise": ("maglev", "process 0.1 %"),
    "cart-pole, noise": ("cart-pole", "measurement 0.5 %"),
    "crane, noise": ("crane", "process 0.1 %"),
    "quadrotor, noise": ("quadrotor", "measurement 0.5 %"),
    "chain, noise": ("chain", "process 0.1 %"),
    "arm, noise": ("arm", "measurement 0.5 %"),
}
SYSTEMS = (*SMOOTH, *CONTACTS, *NOISY)


def validation_of(system: str, seed: int) -> Validation:
    """Return the validation of a system."""
    if system in NOISY:
        plant, imperfection = NOISY[system]
        return PLANTS[plant](imperfection, seed).validation
    return {**DYNAMICS, **STRANGERS}[system](seed).validation


def study(system: str, seed: int) -> dict[str, Any]:
    """Return what one campaign finds."""
    validation, noisy = validation_of(system, seed), system in NOISY
    space = validation.space
    points = space.iid(NOISY_TASKS if noisy else TASKS, np.random.default_rng(7))
    repeats = [validation.distances(points) for _ in range(REPEATS if noisy else 1)]
    distances = np.quantile(repeats, QUANTILE, axis=0)
    threshold = float(np.quantile(distances, KEPT))
    kept = distances <= threshold
    begun = time.process_time()
    campaign = Campaign(validation_of(system, seed), seed=seed)
    campaign.run(BUDGET, threshold, envelope=True, confidence=CONFIDENCE)
    envelope = campaign.envelope(threshold, CONFIDENCE)
    points, distances, kept = points[::2], distances[::2], kept[::2]  # closed loops of all would take minutes
    trusted, interpolated = envelope.trusted(points), envelope.trusted(points, interpolated=True)
    false = trusted & ~kept
    return {
        "system": system,
        "seed": seed,
        "rule": RULE,
        "dimension": space.dimension,
        "threshold": threshold,
        "answer": campaign.verdict(threshold).answer,
        "executions": campaign.executions,
        "tests": envelope.tests,
        "found": float(trusted[kept].mean()),
        "interpolated": float(interpolated[kept].mean()),
        "interpolated_false": float((interpolated & ~kept).mean()),
        "false": float(false.mean()),
        "worst_false": float((distances[false] / threshold).max(initial=0.0)),
        "in_words": sum(region.share for region in envelope.regions[:1]),
        "factor": envelope.factor,
        "raised_by": envelope.raised_by,
        "margin": envelope.margin,
        "uncovered": envelope.uncovered,
        "doubt": envelope.doubt,
        "words": envelope.words,
        "seconds": round(time.process_time() - begun, 1),
    }


TEXT = """# The envelope, measured

`make envelope` makes this page. {count} campaigns of at most {budget} executions ran with `envelope=True` on
{systems} systems that are reported and were not tuned on. (Four campaigns of an earlier version, on reactor,
heated-rooms, boat-in-current and ball-on-beam, showed that its interpolation lost much in five parameters. It was
replaced by one that was chosen on development systems, and which further tasks check since a system with short waves
was made to mislead it. Version 3 stated no envelope for the three systems with contacts, because the learned dynamics
missed the distance of a test. Since version 4, such a distance raises the factor; it withdraws the envelope only if
it exceeds the threshold and the learned dynamics have it below. Version 4 also executed the tests before the model
was falsified, which left oblique-wall undecided. Versions 3 to 5 found nothing of systems with contacts: steps that
touch something were learned as noise, and predicted runs diverged. Since version 6, the draws are learned without
such steps, and tasks whose runs come to them are not trusted; version 6 did so only if there seemed to be noise, or a
test was not explained. Version 7 was developed on cart-at-wall, gripper-on-floor, moored-boat and rail-cars;
heavy-bin, hidden-heat, hidden-load, corner-stop, hidden-post, gate-at-post and docking-magnet were to show false
volume. Version 8 does not trust runs to places that no execution entered; it differs from 7 on boat-in-current,
oblique-wall and taut-tether, which have positions. Version 7 found 97, 79 and 63 % there, version 8 found 85, 47 and
46 %. The condition is that of a validation; without it, a patch of 0.12 m made 1.05 % of a puck's tasks falsely
trusted. Version 9 interpolates better: its scales, columns, tasks at the boundary and errors were
chosen on gripper-on-floor, moored-boat, rail-cars and corner-stop, after it was seen that the interpolation had lost
most of what table-top and oblique-wall lacked. The last three contacts were added when the results of the others were
known, and before their own were: no system of the reporting lists with contacts or backlash is left out. Version 10
keeps executions for the tests of noisy systems, too, after seven campaigns of version 9 had lacked one to three tests.
Version 11, the present one, runs the closed loops of each task that it is asked about, with the same executions. It was
chosen on gripper-on-floor, moored-boat and rail-cars, of which it finds 89, 81 and 95 % in place of 67, 51 and 95 %.
Of smooth systems, whose interpolation loses little, the campaigns of versions 9 and 10 were not run again.) Of each
system, 70 % of the tasks keep the threshold. "Found" is the share of these tasks that the envelope trusts; "false" is
the share of all tasks that it trusts although their true distance is larger. True sets are known at {tasks} random
tasks, of noisy systems at {noisy_tasks} tasks by {repeats} executions each; version 11 was asked about half of them.
[How to use an envelope](how-to/envelope.md) says what it is.

**The median share found is {found:.0f} % over the systems, of which each counts once. The median of a system is at
least 80 % on {enough} of {systems} systems, of which {contacts} have contacts and {noisy} noise (the goal is 8, of
which 2 have contacts and 2 noise). In {above} of {count} campaigns, the falsely included volume is above 1 % (the
goal is at most 5 % of 200 campaigns); the largest is {largest:.1f} %. In {withdrawn} campaigns, no envelope was
stated.**

{table}

"Version" is the version of the method with which each campaign was run. "Interpolated" is the share found if nothing is
run, as by the function for planners; before version 11, this is also what was found.
"Words" is the share of the tasks in the largest box that the envelope names. "False, at most" is the largest true
distance of a falsely trusted task, divided by the threshold. Figures of systems are medians, except for the false ones,
which are the largest.

{reasons}
"""


def newest() -> list[dict[str, Any]]:
    """Return the result of each campaign by the newest version of the method, from ``COMPARABLE`` on."""
    lines = sorted(STORED.values(), key=lambda line: int(line["rule"]))
    last = {(line["system"], line["seed"]): line for line in lines if line["rule"] >= COMPARABLE}
    return [line for (system, _), line in sorted(last.items()) if system in SYSTEMS]


def is_known(system: str, seed: int) -> bool:
    """Return whether a campaign is stored, by the present rule or, of a smooth system, by those before."""
    return any((system, seed, rule) in STORED for rule in range(9 if system in SMOOTH else RULE, RULE + 1))


def write_page(page: Path = PAGE) -> None:
    """Write the page of the stored results."""
    results = newest()
    if not results:
        return
    rows = [
        "| system | parameters | campaigns | version | executions | found | false | false, at most | interpolated "
        "| words | CPU s |",
        "|---" * 11 + "|",
    ]
    medians = {}
    for system in SYSTEMS:
        lines = [line for line in results if line["system"] == system]
        if not lines:
            continue
        kind = " (contact)" if system in CONTACTS else ""
        middle = {name: float(np.median([line[name] for line in lines])) for name in ("found", "in_words", "seconds")}
        interpolated = float(np.median([line.get("interpolated", line["found"]) for line in lines]))
        medians[system] = middle["found"]
        executions = [line["executions"] for line in lines]
        worst = max(lines, key=lambda line: line["false"])
        at_most = f"{worst['worst_false']:.2f}" if worst["false"] else "-"
        rules = ", ".join(map(str, sorted({line["rule"] for line in lines})))
        cells = [
            f"{system}{kind}",
            lines[0]["dimension"],
            len(lines),
            rules,
            f"{min(executions)} to {max(executions)}" if min(executions) < max(executions) else executions[0],
            f"{100 * middle['found']:.0f} %",
        ]
        cells += [f"{100 * worst['false']:.1f} %", at_most, f"{100 * interpolated:.0f} %"]
        cells.append(f"{100 * middle['in_words']:.0f} %")
        rows.append(f"| {' | '.join(map(str, [*cells, round(middle['seconds'])]))} |")
    false = np.array([line["false"] for line in results])
    reasons = [f"* {line['system']}, seed {line['seed']}: {line['doubt']}." for line in results if line["doubt"]]
    text = TEXT.format(
        count=len(results),
        budget=BUDGET,
        systems=len({line["system"] for line in results}),
        tasks=f"{TASKS:,}",
        noisy_tasks=f"{NOISY_TASKS:,}",
        repeats=REPEATS,
        found=100 * np.median([*medians.values()]),
        above=int((false > 0.01).sum()),
        enough=sum(median >= 0.8 for median in medians.values()),
        contacts=sum(medians.get(system, 0) >= 0.8 for system in CONTACTS),
        noisy=sum(medians.get(system, 0) >= 0.8 for system in NOISY),
        largest=100 * false.max(),
        withdrawn=len(reasons),
        table="\n".join(rows),
        reasons="Why no envelope was stated:\n\n" + "\n".join(reasons) if reasons else "",
    )
    page.write_text(text.rstrip() + "\n")


def main() -> None:
    """Run the campaigns that are missing, and write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--systems", nargs="*", default=SYSTEMS)
    given = parser.parse_args()
    warnings.simplefilter("ignore")
    for seed in range(given.seeds):
        for system in given.systems:
            if not is_known(system, seed):
                result = study(system, seed)
                STORED.append(result)
                shown = {name: result[name] for name in ("executions", "found", "false", "factor", "doubt", "seconds")}
                print(system, seed, shown, flush=True)
    write_page()


if __name__ == "__main__":
    main()
