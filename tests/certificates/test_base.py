from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from importlib.metadata import EntryPoint
from types import ModuleType
from typing import Any, ClassVar

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from conftest import evidence_on
from ctxval import certificates
from ctxval.certificates import (
    KINDS,
    Certificate,
    CertificateKind,
    DistanceBound,
    Sample,
    SamplingDiscarding,
    Scenario,
    require_use,
)
from ctxval.certificates.base import KindRegistry
from ctxval.errors import CertificateError, InputError, UnknownNameError
from facts import assert_names, refuses


def test_a_threshold_is_kept_only_beyond_two_errors() -> None:
    certificate = Certificate("posterior", "", 1.0, 0.95, 0.0, 9, (), error=0.1)
    assert certificate.covers(1.2)
    assert not certificate.covers(1.19)


HOSTILE = Certificate(
    "audit",
    "At most 5 % are above 0.5.",
    0.5,
    0.95,
    0.0496,
    59,
    ("the tasks are independent", "you state: fuse\r\n- replaced <b>"),
    {"largest_found": 0.123456, "not_counted": 0, "failures": {"failed": [1]}},
    doubt="trial 3 is too large",
)


def test_a_certificate_as_text_is_what_the_command_line_prints() -> None:
    assert_names(str(HOSTILE).splitlines(), 5, 0.5, 3, 0.1235, 0)


# Kind registry


confidences = st.floats(0.01, 0.999)


def sample(n: int = 9, origin: str = "acquisition") -> Sample:
    X = np.linspace(0.0, 1.0, n)[:, None]
    return Sample(X, 1.0 + np.sin(4 * X[:, 0]), [origin] * n, ["completed"] * n, learned=evidence_on(1))  # type: ignore[list-item]


# The kinds of this package


OWN = ("anytime", "audit", "auto", "dynamics", "posterior", "sampling-discarding", "scenario", "suite")
EVERYTHING = sample(30, origin="iid")
SUITE = replace(EVERYTHING, suite=EVERYTHING.points)


def certified(kind: str, confidence: float) -> Certificate:
    """Return a certificate by the default options, which a kind that has been added may refuse."""
    chosen = KINDS.find(kind).of({"discard": 2})
    try:
        if kind == "anytime":
            return chosen.certify(replace(EVERYTHING, threshold=1.5), confidence)
        return chosen.certify(SUITE if kind == "suite" else EVERYTHING, confidence)
    except CertificateError as refusal:
        if kind in OWN:
            raise
        pytest.skip(str(refusal))


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind != "posterior"])
@given(confidences, confidences)
def test_more_confidence_never_gives_a_lower_bound_or_a_smaller_volume(kind: str, one: float, other: float) -> None:
    low, high = (certified(kind, confidence) for confidence in sorted([one, other]))
    assert low.upper_bound <= high.upper_bound
    assert low.volume <= high.volume


@pytest.mark.usefixtures("few_draws")
@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_has_its_name_on_its_certificate(kind: str) -> None:
    certificate = certified(kind, 0.9)
    assert isinstance(certificate, Certificate)
    assert certificate.kind == ("dynamics" if kind == "auto" else kind)  # auto takes what decides
    if kind != "anytime":
        assert certificate.upper_bound >= np.sort(EVERYTHING.distances)[-3]
    assert certificate.assumptions


def test_what_a_kind_needs_and_is_not_given_is_asked_for() -> None:
    with refuses(CertificateError, "discarding", 1):
        SamplingDiscarding().certify(EVERYTHING, 0.9)
    with refuses(UnknownNameError, "posterior", "posteriour"):
        KINDS.find("posteriour")


def test_a_confidence_below_1_is_not_printed_as_1() -> None:
    draws = Sample(np.zeros((9, 1)), np.arange(9.0), ["iid"] * 9, ["completed"] * 9)
    certificate = Scenario().certify(draws, 0.9999999)
    assert "99.99999 % confidence," in certificate.statement


def test_the_kinds_of_this_package_are_listed_by_name() -> None:
    assert set(OWN) <= set(KINDS)
    assert list(KINDS) == sorted(KINDS)
    assert len(KINDS) == len(list(KINDS))
    assert "posteriour" not in KINDS
    assert KINDS["posterior"] is DistanceBound


def test_which_kinds_have_a_use_for_an_option_follows_from_their_fields() -> None:
    uses = {
        "tests": ("auto", "dynamics", "suite"),
        "resolution": ("auto", "posterior"),
        "volume": ("anytime", "audit", "sampling-discarding", "scenario"),
        "discard": ("sampling-discarding",),
    }
    found = {option: tuple(kind for kind in OWN if option in KINDS.find(kind).options()) for option in uses}
    assert found == uses
    with refuses(UnknownNameError, "resolution", "posterior"):
        require_use("posterior", ["resolutoin"])
    with refuses(CertificateError, "posterior", "sampling-discarding"):
        require_use("posterior", ["discard"])


# Kinds of other packages


@dataclass(frozen=True)
class Largest(CertificateKind):
    """The largest distance found, as if nothing were between the trials."""

    name: ClassVar[str] = "largest"

    factor: float = 1.0

    def certify(self, sample: Sample, confidence: float = 0.95) -> Certificate:
        return Certificate(self.name, "A guess.", self.factor * sample.best, confidence, 0.0, len(sample), ())


@pytest.fixture
def elsewhere(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """Return a module of another package, whose entry points are installed."""
    module = ModuleType("other_package")
    monkeypatch.setitem(sys.modules, "other_package", module)
    points = [
        EntryPoint(name, value, "ctxval.certificates")
        for name, value in (
            ("largest", "other_package:Largest"),
            ("broken", "other_package:Missing"),
            ("misnamed", "other_package:Largest"),
            ("number", "other_package:number"),
        )
    ]
    monkeypatch.setattr("importlib.metadata.entry_points", lambda group: points if "certificates" in group else [])
    return module


def test_a_kind_of_another_package_is_imported_when_it_is_asked_for(elsewhere: ModuleType) -> None:
    known = KindRegistry("certificate", "ctxval.certificates", method="certify")
    assert list(known) == [*KINDS.built_in, "broken", "largest", "misnamed", "number"]
    assert "largest" in known  # nothing was imported for that
    elsewhere.Largest, elsewhere.number = Largest, 3  # type: ignore[attr-defined]
    assert known["largest"] is known.find("largest") is Largest
    for name, facts in (
        ("broken", ("broken", "other_package:Missing")),
        ("misnamed", ("largest", "misnamed")),
        ("number", ("method", "certify")),
    ):
        with refuses(InputError, *facts):
            known.find(name)
    with refuses(UnknownNameError, "largest", "largst"):
        known.find("largst")


def test_a_kind_takes_its_own_options_alone() -> None:
    assert Largest.of({"factor": 2.0, "resolution": 3.0}) == Largest(2.0)
    assert Largest.of({"factor": None}) == Largest()
    assert Largest.options() == ("factor",)


def test_a_certificate_of_an_unknown_kind_rests_on_what_it_assumes() -> None:
    certificate = Largest().certify(sample())
    assert certificate.kind not in KINDS
    assert_names(CertificateKind.rests_on(certificate), "certificate")


@pytest.mark.parametrize(
    "make",
    [
        lambda: certificates.CertificateOptions("posterior"),
        lambda: certificates.CertificateOptions(DistanceBound),
        lambda: certificates.CertificateOptions(confidence="high"),
        lambda: certificates.CertificateOptions(volume=True),
        lambda: DistanceBound(resolution="fine"),
        lambda: DistanceBound(resolution="no"),
    ],
)
def test_options_of_another_type_are_refused(make: Any) -> None:
    with refuses(InputError, "got"):
        make()


def test_a_number_to_discard_is_an_integer() -> None:
    with refuses(InputError, "discard", 1.5):
        certificates.SamplingDiscarding(discard=1.5).certify(sample(30))  # type: ignore[arg-type]
