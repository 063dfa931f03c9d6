"""A first model with the causes of its error in it, whose sizes are fitted to all executions."""

from __future__ import annotations

import functools
from dataclasses import dataclass, field

from ctxval._util.arrays import single_threaded
from ctxval._util.representation import ShortRepr
from ctxval.campaign.campaign import Campaign
from ctxval.core.model import Model
from ctxval.errors import InputError
from ctxval.studies.causes import CauseReport, Repaired, find_causes
from ctxval.studies.causes.evidence import Records as Executions
from ctxval.studies.causes.evidence import explained
from ctxval.studies.refinement.held_out import Records, held_out
from ctxval.studies.refinement.methods import Learned, Method


@dataclass(frozen=True, eq=False)
class CauseRepair(ShortRepr, Method):
    """The first model with the causes that executions of its campaign name, with sizes fitted to all executions.

    Attributes:
        campaign: that of the first model.
    """

    campaign: Campaign
    name: str = field(default="causes", init=False)
    makes = Repaired

    @functools.cached_property
    def report(self) -> CauseReport:
        """The causes.

        Raises:
            InputError: if no cause is named, or if a model cannot have it.
        """
        found = find_causes(self.campaign)
        if found.repaired is None:
            raise InputError(f"no cause is known that a model could have. {found.sentence}")
        if not found.repaired.complete:
            raise InputError(
                f"a step of a model depends on state and input alone, so it cannot have this cause. {found.sentence}"
            )
        return found

    def learn(self, model: Model, records: Records) -> Learned:
        """Return the model with its causes."""
        if self.campaign.validation.outputs is not None:
            raise InputError("the method 'causes' needs recorded states of M, and only outputs are recorded.")
        best = self.report.explained[0].explanation

        def repaired(some: Records) -> Repaired:
            if not some.executed:
                raise InputError("the method 'causes' needs executions with trajectories.")
            with single_threaded():
                return explained(Executions(model, some.executed), best.candidates, best.sizes).repaired

        learned = repaired(records)
        note = " and ".join(cause.text(self.report.plant) for cause in learned.causes)
        return Learned(learned, held_out(repaired, model, records), (note,))
