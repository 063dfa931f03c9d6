"""What an experiment's model predicts of the distance, as numbers: the input of kinds that need more than trials."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol, runtime_checkable

from ctxval._util.arrays import Array
from ctxval.errors import CertificateError

if TYPE_CHECKING:
    from ctxval.certificates.dynamics_evidence import DynamicsEvidence
    from ctxval.certificates.sample import Sample


@runtime_checkable
class LearnedDistance(Protocol):
    """Predictions of the distance that are learned from trials and from the data that the model was made from."""

    def expected(self, points: Array, before: int) -> Array:
        """Return predicted distances ``(m,)`` at points ``(m, d)`` of the unit cube; NaN if nothing can be predicted.

        Args:
            points: points of the unit cube.
            before: a number of a trial; only trials with smaller numbers are learned from.
        """

    def dynamics(self, confidence: float) -> DynamicsEvidence | None:
        """Return what the dynamics learned from all trials say about d*; None if nothing can be learned.

        Args:
            confidence: the probability with which a bound must hold; it sets the least number of draws.

        Raises:
            CertificateError: if a part of the experiment raises an exception meanwhile.
        """

    def tasks(self, count: int, seed: int) -> Array:
        """Return independent draws from the distribution of tasks: points of the unit cube ``(count, d)``.

        They have nothing to do with the draws of any trial.
        """


def require_learned(sample: Sample, kind: str) -> LearnedDistance:
    """Return the predictions that come with a sample.

    Args:
        sample: the trials.
        kind: the name of the kind of certificate that needs them, for the message.

    Raises:
        CertificateError: if there are none.
    """
    if sample.learned is None:
        raise CertificateError(
            f"the {kind} certificate uses what the experiment's model predicts, but the experiment is not loaded: use "
            "`ctxval certify`, Campaign.verdict, or Provenance(learned=...)."
        )
    return sample.learned
