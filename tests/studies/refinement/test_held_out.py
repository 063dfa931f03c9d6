"""What is held out, and the measured residual by regions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ctxval import Trajectory, Transitions, models
from ctxval.errors import InputError
from ctxval.studies.refinement import HeldOut, Records, held_out, measure_residual
from facts import assert_names, refuses

TRUE = models.Linear([[1.0, 0.1], [0.0, 0.8]], [[0.0], [0.1]])
FIRST = models.Linear([[1.0, 0.1], [0.0, 1.0]], [[0.0], [0.1]])


def executions(count: int, horizon: int = 30) -> list[Trajectory]:
    found = []
    for seed in range(count):
        rng = np.random.default_rng(seed)
        states, inputs = [rng.normal(size=2)], rng.normal(size=(horizon, 1))
        for u in inputs:
            states.append(TRUE.step(states[-1], u))
        found.append(Trajectory(0.1 * np.arange(horizon + 1), np.array(states), inputs))
    return found


@pytest.mark.parametrize("count", [1, 2, 7, 25])
def test_every_execution_is_held_out_once(count: int) -> None:
    records = Records.of(FIRST, executions(count))
    folds = records.folds()
    assert len(folds) == (2 if count == 1 else min(count, 10))
    held = Transitions.joined([one.transitions for _, one in folds])
    assert len(held) == len(records.transitions)
    for known, one in folds:
        assert len(known.transitions) + len(one.transitions) == len(records.transitions)
        assert not {x.tobytes() for x in known.transitions.x} & {x.tobytes() for x in one.transitions.x}


def test_the_data_of_the_model_are_never_held_out_beside_executions() -> None:
    data = executions(1)[0].transitions()
    own = models.Linear(FIRST.A, FIRST.B, data=data)
    records = Records.of(own, executions(3))
    assert (records.sources == -1).sum() == len(data)
    assert all(known.own is not None and held.own is None for known, held in records.folds())
    assert len(Records.of(own, []).folds()) == 2


def test_nothing_to_learn_from_is_refused() -> None:
    with refuses(InputError):
        Records.of(FIRST, [])


def test_errors_are_those_of_models_that_did_not_see_the_execution() -> None:
    records = Records.of(FIRST, executions(4))
    found = held_out(lambda some: models.Linear.fit(some.transitions), FIRST, records)
    assert found.rms.max() < 1e-12
    expected = 0.2 * np.sqrt((records.transitions.x[:, 1] ** 2).mean())
    assert found.rms_before[1] == pytest.approx(expected)
    assert found.better[1]


def test_a_fit_that_memorises_is_no_better_on_what_is_held_out() -> None:
    def memory(some: Records) -> models.Model:
        known = {x.tobytes(): after for x, after in zip(some.transitions.x, some.transitions.x_next, strict=True)}
        return models.Function(lambda x, u: known.get(x.tobytes(), FIRST.step(x, u)))

    found = held_out(memory, FIRST, Records.of(FIRST, executions(3)))
    np.testing.assert_allclose(found.errors, found.before, atol=1e-12)


def test_a_model_that_cannot_be_learned_or_diverges_counts_as_the_first_one() -> None:
    def refused(some: Records) -> models.Model:
        raise InputError("too few")

    records = Records.of(FIRST, executions(2))
    for learn in (refused, lambda some: models.Function(lambda x, u: x * np.nan, vectorized=True)):
        found = held_out(learn, FIRST, records)
        np.testing.assert_array_equal(found.errors, found.before)


def test_errors_that_add_up_choose_corrections() -> None:
    """Of noisy records, the error of one step is hardly smaller with the true model; that of ten steps is."""
    rng, noisy = np.random.default_rng(0), list[Trajectory]()
    for run in executions(3):
        noisy.append(replace(run, states=run.states + 0.3 * rng.normal(size=run.states.shape)))
    true = models.Linear.fit(Records.of(FIRST, executions(3)).transitions)
    found = held_out(lambda some: true, FIRST, Records.of(FIRST, noisy))
    assert found.rms[1] > 0.8 * found.rms_before[1]
    assert found.left < 0.7
    assert len(found.later) == sum(run.horizon - 9 for run in noisy)
    short = [Trajectory(run.times[:6], run.states[:6], run.inputs[:5]) for run in executions(3)]
    of_short = held_out(lambda some: true, FIRST, Records.of(FIRST, short))
    assert (len(of_short.later), of_short.left) == (0, pytest.approx(0, abs=1e-9))


def errors_by_speed(count: int = 2000) -> HeldOut:
    """Errors that are ten times as large if the second coordinate is above 1."""
    rng = np.random.default_rng(0)
    pairs = rng.uniform(-2, 2, (count, 3))
    errors = 0.01 * rng.normal(size=(count, 2)) * np.where(pairs[:, 1:2] > 1, 10, 1)
    return HeldOut(pairs, errors, errors, rng.normal(size=(count, 2)), errors, errors)


def test_regions_separate_large_residuals_from_small_ones() -> None:
    found = measure_residual(errors_by_speed(), {"a": "m", "b": "m/s"}, {"c": "N"})
    first, last = found.regions[0], found.regions[-1]
    assert last.low[1] == pytest.approx(1, abs=0.1)
    assert first.quantile.max() == pytest.approx(0.0196, rel=0.15)
    assert last.quantile.max() == pytest.approx(0.196, rel=0.15)
    assert sum(one.steps for one in found.regions) == found.whole.steps == 2000
    assert "b > 0.984" in found.text
    assert "b [m/s]: 95 %" in found.text
    assert_names(found.range_text, -2, 2, "m", "b")


def test_the_largest_residual_of_a_region_is_measured_in_it() -> None:
    given = errors_by_speed()
    for one in measure_residual(given, {"a": "", "b": ""}, {"c": ""}).regions:
        inside = ((given.pairs > one.low) & (given.pairs <= one.high)).all(axis=1)
        assert inside.sum() == one.steps
        np.testing.assert_array_equal(np.abs(given.errors[inside]).max(axis=0), one.largest)


def test_what_is_new_to_the_model_is_separate_from_what_was_left_out_in_turn() -> None:
    # Models that lack one of a few executions err; the model that has them all does not.
    given = errors_by_speed(400)
    new = np.arange(400) >= 300
    given = replace(given, errors=np.where(new[:, None], 1e-4, 0.5) * np.sign(given.errors), new=new)
    found = measure_residual(given, {"a": "", "b": ""}, {"c": ""})
    assert found.left_out is not None
    assert (found.whole.steps, found.left_out.steps) == (100, 300)
    assert found.whole.largest.max() == pytest.approx(1e-4)
    assert found.left_out.largest.max() == pytest.approx(0.5)
    assert sum(one.steps for one in found.regions) == 100
    assert_names(found.text, "new")
    np.testing.assert_allclose(given.rms, 1e-4)


def test_residuals_of_zero_have_one_region() -> None:
    given = errors_by_speed()
    zero = replace(given, errors=0 * given.errors)
    found = measure_residual(zero, {"a": "", "b": ""}, {"c": ""})
    assert len(found.regions) == 1
    assert "everywhere" in found.text
    plain = found.to_json()
    assert plain["guaranteed"] is False
    assert plain["regions"][0]["range"]["a"] == [None, None]
