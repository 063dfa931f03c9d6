"""The independent draws that count: those whose number was chosen before they were executed."""

from __future__ import annotations

from ctxval.certificates.base import Certificate
from ctxval.certificates.bounds import drawn_from
from ctxval.certificates.sample import Sample
from ctxval.certificates.scenario import when_planned
from ctxval.errors import CertificateError


def countable_draws(sample: Sample, kind: str) -> Sample:
    """Return the independent draws whose number was chosen before they were executed.

    If the number of draws was raised after some were known, only the draws of the last decision count.

    Args:
        sample: trials of any origin.
        kind: the certificate, for messages, such as "an audit".
    """
    everything = sample.only("iid")
    if not len(everything):
        raise CertificateError(f"{kind} needs independent draws of tasks, but there is none; run certify --audit N.")
    # Draws that stop when the verdict is reached are planned as 0.
    plans = [planned for planned in everything.planned if planned != 0]
    drawn = everything.rows([row for row, planned in enumerate(everything.planned) if plans and planned == plans[-1]])
    if not len(drawn):
        raise CertificateError(
            f"the {len(everything)} independent draws ended with the verdict, so their number "
            f"depended on their distances and none counts; certify --audit N draws until there are N in all, and "
            f"counts only those after the first {len(everything)}."
        )
    return drawn


def how_drawn(sample: Sample, drawn: Sample) -> tuple[str, ...]:
    """Return, as assumptions, how the draws that count were drawn, and how many draws do not count."""
    everything = len(sample.only("iid"))
    first = (
        f"the audited tasks are independent and {drawn_from(sample.distribution)}, and "
        f"{when_planned(drawn, everything)}"
    )
    missing = everything - len(drawn)
    if not missing:
        return (first,)
    return (
        first,
        f"{missing} other independent draws do not count: the number of draws was changed, or the verdict ended them, "
        "after they were known",
    )


def not_counted(sample: Sample, drawn: Sample) -> int:
    """Return the number of independent draws that do not count."""
    return len(sample.only("iid")) - len(drawn)


def draws_left_out(certificate: Certificate) -> str:
    """Return, as the end of a sentence, how many draws do not count; empty if all count."""
    missing = certificate.details.get("not_counted")
    return f"; {missing} draws do not count, as their number was changed after they were known" if missing else ""
