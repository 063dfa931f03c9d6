"""CPU time until a verdict, beside the code in which two engines learned the dynamics, as ratios of one run.

The demo is the whole command, from importing to the report; the others are campaigns with their verdict. Answers and
numbers of executions are printed too: a ratio of different verdicts tells nothing. The earlier code has no tests at
drawn tasks, so each figure is measured without them, and with the eight of the default. The last figure is the time of
an execution until decided over that of a suggestion of the search.
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
import sys
import tempfile
import time
import warnings
from typing import Any

import landed
from ctxval import Campaign, Validation, cases, certificates, searches
from landed import Ratio, add_store_option, report

EARLIER = "6387a59"
BUDGET, REPEATS, TESTS = 20, 3, 8
# The case, its options, and 1.1 times the largest distance that is known of seed 0.
CASES: dict[str, tuple[str, dict[str, Any], float, float]] = {
    "linear 10-D": ("linear", {"dim": 5}, 1.1 * 6.1352, 4.0),
    "Dubins 11-D": ("dubins", {}, 1.1 * 0.32654, 4.0),
    "arm": ("arm", {"model": "linear"}, 1.1 * 0.17746, 4.0),
    "quadrotor, iLQR with limits": ("quadrotor", {}, 0.35, 3.0),
}
SUGGESTED = ("linear 10-D", "Dubins 11-D", "arm")
"""Cases of which an execution until decided is compared with a suggestion."""
MOST_SUGGESTIONS = 6.0


def demo(tests: int) -> tuple[float, str]:
    """Return CPU seconds of the demo, from the start of this process, and its last lines."""
    from ctxval.cli import main as command_line

    sys.argv = ["ctxval", "run", "pendulum"]
    sys.argv += ["--tests", str(tests)] if hasattr(Campaign, "certify") else ["--until-decided"]
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder), contextlib.suppress(SystemExit):
        command_line()
    return time.process_time(), ""


def validation_of(name: str) -> Validation:
    case, options, *_ = CASES[name]
    if case == "quadrotor":
        from bench_designs import LIMITS, quadrotor

        return quadrotor(LIMITS)
    return cases.by_name(case, 0, **options).validation


def campaign(name: str, tests: int) -> tuple[float, str]:
    """Return CPU seconds of a campaign with its verdict, and the answer with the number of executions."""
    threshold, validation = CASES[name][2], validation_of(name)
    started = time.process_time()
    running = Campaign(validation, seed=0)
    if hasattr(running, "run_until_decided"):  # the earlier code
        running.run_until_decided(threshold, BUDGET)
        answer = running.verdict(threshold).answer
    else:
        options = certificates.CertificateOptions(certificates.Automatic(tests=tests))
        running.run(BUDGET, threshold, certificate=options)
        answer = running.verdict(threshold, certificate=options).answer
    return time.process_time() - started, f"{answer} after {running.executions}"


def suggestions(name: str) -> tuple[float, float]:
    """Return CPU seconds of an execution until decided, and of a suggestion of the search."""
    seconds, text = campaign(name, TESTS)
    executions = int(text.split()[-1])
    exploring = Campaign(validation_of(name), search=searches.by_name("auto"), seed=0)
    started = time.process_time()
    exploring.run(executions, explore=True)
    return seconds / executions, (time.process_time() - started) / executions


def main() -> None:
    """Print all ratios, or report the figures of one case."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tests", type=int, default=TESTS, help="tests at drawn tasks of the present code")
    parser.add_argument("--only", nargs="*", help="measure these cases alone")
    parser.add_argument("--case", choices=["demo", *CASES], help="report the seconds of one case")
    add_store_option(parser)
    options = parser.parse_args()
    if options.case is not None:
        warnings.simplefilter("ignore")
        report(demo(options.tests) if options.case == "demo" else campaign(options.case, options.tests))
        return
    wanted = [("demo", 5.0), *((name, case[3]) for name, case in CASES.items())]
    wanted = [pair for pair in wanted if not options.only or pair[0] in options.only]
    for (name, least), tests in itertools.product(wanted, (0, TESTS)):
        arguments = ("--case", name, "--tests", str(tests))
        repeats = 1 if name.startswith("quadrotor") else REPEATS
        earlier, now = landed.beside_landed(__file__, *arguments, repeats=repeats, revision=EARLIER)
        if name != "demo":
            print(f"{name}: {earlier[0][1]} before, {now[0][1]} now")
        seconds = [[one[0] for one in figures] for figures in (earlier, now)]
        figure = f"until the verdict, {name}" + (f", {tests} tests on top" if tests else "")
        Ratio("bench_verdicts", figure, *seconds, least=None if tests else least).tell(options.store)
    for name in SUGGESTED:
        if options.only and name not in options.only:
            continue
        decided, suggested = suggestions(name)
        figure = f"an execution until decided over a suggestion, {name}"
        Ratio("bench_verdicts", figure, [decided], [suggested], most=MOST_SUGGESTIONS).tell(options.store)


if __name__ == "__main__":
    main()
