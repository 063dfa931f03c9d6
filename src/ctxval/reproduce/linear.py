"""The figure of the linear systems: executions until within 5 % against the dimension of the task space."""

from __future__ import annotations

from ctxval.reproduce.jobs import Results
from ctxval.reproduce.study import TECHNIQUES, Claim, ExecutionsWithin, Place, Scale, agreement, counted, spread


class LinearComplexity(ExecutionsWithin):
    """The paper's Fig. 8: the effect of the dimension of the task space."""

    name = "linear"
    title = "Linear systems: executions until within 5 %"
    case = "linear"
    axes = "dimension of the task space", "executions until within 5 % of d*, median"
    column = "dimension"
    places = tuple(Place(2.0 * states, (("dim", states),), 5.0) for states in range(1, 11))
    dodge = 0.25

    def budget(self, search: str, scale: Scale) -> int:
        return 100 if search == "gp-ucb" else scale.of(20_000)

    def claims(self, results: Results, scale: Scale) -> list[Claim]:
        medians = {
            search: [spread(row)[0] for row in self.executions(results, scale, search)[[0, 4, -1]]]
            for search in TECHNIQUES
        }
        texts = [
            f"{TECHNIQUES[search][0]}: " + ", ".join(counted(value, self.budget(search, scale)) for value in row)
            for search, row in medians.items()
        ]
        ucb, sc = medians["gp-ucb"], medians["random"]
        # The largest dimension is 10 times the smallest one, so a growth up to this ratio is at most linear.
        return [
            Claim(
                "growth with the dimension is modest for CuSTOM, drastic for SC and SD (within 5 %)",
                f"executions in 2-D, 10-D, 20-D: {'; '.join(texts)}",
                agreement(ucb[2] / ucb[0] <= 10 and sc[2] / sc[0] > 10 * ucb[2] / ucb[0], sc[2] > ucb[2]),
            )
        ]
