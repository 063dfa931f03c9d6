"""What a threshold is about: which distances raise a bound, and how it is stored."""

from __future__ import annotations

import numpy as np
import pytest

from ctxval.core.target import Largest, Quantile, Share, Target


@pytest.mark.parametrize("target", [Largest(), Quantile(0.8), Quantile(0.9, 0.99), Share(0.99)])
def test_a_target_is_stored_by_its_quantile_and_its_share(target: Target) -> None:
    assert Target.from_json(target.to_json()) == target
    assert target.to_json().get("share", 1.0) == target.share
    assert target.volume == pytest.approx(1 - target.share)


def test_options_ask_for_the_largest_distance_or_for_that_of_a_share_until_noise_is_known() -> None:
    assert Target.asked(0.8, 1.0) == Largest(0.8)
    assert Target.asked(0.8, 0.95) == Share(0.95, 0.8)
    assert Largest(0.8).with_noise() == Quantile(0.8)
    assert Share(0.95, 0.8).with_noise() == Quantile(0.8, 0.95)


def test_an_execution_contradicts_a_bound_on_the_largest_distance_alone() -> None:
    assert [target.raised(1.0, 1.2) for target in (Largest(), Quantile(), Share(0.9))] == [1.2, 1.0, 1.0]
    assert [target.reached(1.2, lambda: 0.7) for target in (Largest(), Quantile(), Share(0.9))] == [1.2, 1.2, 0.7]


def test_executions_of_a_noisy_system_are_judged_by_the_mean_and_not_by_the_bound() -> None:
    maxima = np.array([1.0, 2.0, 6.0])
    assert Largest().testable(3.0, maxima) == 3.0
    assert Quantile().testable(3.0, maxima) == 2.0
    assert [target.large(5.0, 3.0)[0] for target in (Largest(), Quantile(), Share(0.9))] == [5.0, 3.0, 5.0]
