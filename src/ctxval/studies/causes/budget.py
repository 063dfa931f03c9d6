"""What a search for causes costs. One that does not fit into its budget of thinking is smaller, and says so."""

from __future__ import annotations

from dataclasses import dataclass, replace

from ctxval._util.representation import ShortRepr
from ctxval.campaign.thinking import TimeShortage
from ctxval.errors import InputError
from ctxval.learning.effects.fit import SegmentSettings
from ctxval.learning.stage_costs import Costs, Ledger


@dataclass(frozen=True)
class CauseSettings:
    """How many causes are tried, and how much of the deviations of M they must explain."""

    named: float = 0.98  # share of the squared deviations of M in closed loop that causes must explain, to be the cause
    partial: float = 0.9  # share that M's parameters must explain for no further cause to be looked for
    little: float = 0.1  # share of the squared deviations that is not worth a sentence
    alike: float = 10.0  # differences of the criterion that do not tell causes apart
    fitted: int = 8  # explanations by one more cause that are fitted to all records
    checked: int = 4  # explanations that are tried in closed loop
    executions: int = 8  # that are explained at most
    segments: float = 1.0  # share of the segments that causes are fitted to
    failed: int = 4  # executions among them that failed
    away: float = 30.0  # ranges of the states that M predicted, beyond which a failed execution says nothing of M
    steps: int = 5  # of a failed execution
    # Prior deviations from M, and deviations of the posterior, by which an uncertain parameter of M must differ
    differs: tuple[float, float] = (0.02, 3.0)
    shares: tuple[float, ...] = (1.0, 0.5, 0.25, 0.12, 0.06)  # of a search, the largest that fits into a budget

    def part(self, share: float) -> CauseSettings:
        """Return the settings of a search that costs about so much of this one."""
        root = share**0.5
        executions, failed = max(2, round(root * self.executions)), max(1, round(root * self.failed))
        fitted, checked = max(2, round(root * self.fitted)), max(1, round(root * self.checked))
        segments = share * self.segments
        return replace(self, executions=executions, failed=failed, fitted=fitted, checked=checked, segments=segments)


@dataclass(frozen=True)
class CauseCosts(ShortRepr):
    """The seconds that stages of a search for causes take, as measured with benchmarks/simulated_robots.py."""

    costs: Costs
    settings: CauseSettings

    def evaluation(self, share: float = 1.0) -> float:
        """Return the seconds of the residuals of a model with causes after one step and after several."""
        speed, own, segments = self.costs.thinking.speed, self.costs.thinking.settings, SegmentSettings()
        rows = sum(count * steps for count, steps in zip(segments.most, segments.steps, strict=True))
        each = 2 * speed.another_step + own.row * speed.machine
        calls = sum(segments.steps) * (speed.step + 4 * own.step * speed.machine)
        return calls + share * self.settings.segments * rows * each

    def ranking(self) -> float:
        """Return the seconds of the screening of all causes, and of fits of the best ones."""
        causes = 10 * (self.costs.sizes.states + self.costs.sizes.inputs)
        return 4.5 * causes * self.evaluation(1 / 3) + 10 * self.settings.fitted * self.evaluation()

    def check(self) -> float:
        """Return the seconds of fits without each execution, and of its closed loops."""
        speed = self.costs.thinking.speed
        loops = speed.horizon * (speed.step + 24 * speed.another_step)
        return self.settings.executions * (5 * self.evaluation() + loops)

    def first(self) -> float:
        """Return the seconds of the search for one cause."""
        records = 2 * (self.settings.executions + 2) * self.evaluation()
        return records + self.ranking() + (1 + self.settings.checked) * self.check()

    def second(self) -> float:
        """Return the seconds of the search for another cause beside it."""
        return 2 * self.ranking() + 2 * self.check()

    def parameters(self, count: int) -> float:
        """Return the seconds of the most probable values of so many uncertain parameters of M."""
        rows = self.settings.executions * self.costs.sizes.horizon
        return 80 * (1 + count) * rows * self.costs.thinking.speed.another_step

    def separating(self, causes: int) -> float:
        """Return the seconds of the task that tells causes apart."""
        return 24 * (self.costs.plan(1) + causes * self.costs.run(1, 1))


def fitting_settings(ledger: Ledger, settings: CauseSettings) -> CauseSettings:
    """Return the settings of the largest search for one cause that fits into a budget.

    Raises:
        InputError: if the smallest one does not fit.
    """
    if ledger.costs is None:
        return settings
    for share in settings.shares:
        part = settings if share == 1 else settings.part(share)
        needed = CauseCosts(ledger.costs, part).first()
        if ledger.fits("causes", lambda _, needed=needed: needed):  # type: ignore[misc]
            if part is not settings:
                smaller = f"{part.executions} executions and {part.segments:.2g} of their segments"
                ledger.replaced.append(f"{smaller} in place of {settings.executions} and all of these")
            return part
    raise InputError(f"{TimeShortage(needed, ledger.costs.thinking.seconds, of='the search for causes')}.")
