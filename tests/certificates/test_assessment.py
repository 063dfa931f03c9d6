from __future__ import annotations

import json

import numpy as np
import pytest

from ctxval import Trial
from ctxval._util.version import VERSION
from ctxval.certificates import Audit, CertificateOptions, Provenance, SamplingDiscarding, Scenario, assess
from ctxval.errors import CertificateError, InputError
from facts import refuses

DRAWN = [
    Trial(k, "iid", "completed", np.array([x]), {"x": x}, 1, True, 0.5 * x)
    for k, x in enumerate(np.linspace(0, 1, 60).tolist())
]
AUDIT = CertificateOptions(Audit(), 0.9, volume=0.05)


def test_without_a_threshold_there_is_a_certificate_and_no_verdict() -> None:
    found = assess(DRAWN, AUDIT, provenance=Provenance(remarks=("S was oiled",)))
    assert found.verdict is None
    assert found.certificate is not None
    assert found.certificate.assumptions[-1] == "S was oiled"
    report = json.loads(json.dumps(found.to_json(), allow_nan=False))
    assert list(report)[:2] == ["kind", "statement"]
    assert (report["kind"], report["version"], report["expected"]) == ("audit", VERSION, None)


def test_against_a_threshold_the_verdict_comes_first() -> None:
    report = assess(DRAWN, AUDIT, 0.6).to_json()
    assert list(report)[:6] == ["verdict", "reason", "rests_on", "threshold", "next_task", "kind"]
    assert (report["verdict"], report["threshold"]) == ("validated", 0.6)
    stricter = assess(DRAWN, CertificateOptions(Audit(), 0.9), 0.6)
    assert stricter.verdict is not None
    assert stricter.verdict.answer == "undecided"


def test_a_counterexample_stands_where_the_certificate_is_refused() -> None:
    refused = assess(DRAWN, CertificateOptions(SamplingDiscarding()), 0.4)
    assert (refused.certificate, refused.kind) == (None, "sampling-discarding")
    assert refused.verdict is not None
    assert refused.verdict.answer == "falsified"
    certified = assess(DRAWN, CertificateOptions(Scenario()), 0.4)
    assert certified.certificate is not None
    assert certified.verdict is not None
    assert certified.verdict.answer == "falsified"


def test_what_is_neither_certified_nor_falsified_is_an_error() -> None:
    for threshold in (None, 0.6):
        with refuses(CertificateError, "discarding", 1):
            assess(DRAWN, CertificateOptions(SamplingDiscarding()), threshold)
    with refuses(InputError, "threshold", -1.0):
        assess(DRAWN, AUDIT, -1.0)


@pytest.mark.parametrize(("confidence", "volume"), [(0.4, 0.0), (0.9, 0.6), (0.9, -0.1), (0.9, np.nan)])
def test_options_that_no_verdict_can_have_are_refused(confidence: float, volume: float) -> None:
    with pytest.raises(InputError):
        CertificateOptions(Audit(), confidence, volume)


@pytest.mark.parametrize("confidence", [0.0, 1.0, 1e-300, np.nan])
def test_a_confidence_that_is_no_probability_is_refused(confidence: float) -> None:
    with refuses(InputError, 1, "confidence"):
        CertificateOptions(Audit(), confidence)
