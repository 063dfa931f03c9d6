from __future__ import annotations

import numpy as np
import pytest

from ctxval import Array, Campaign, Task, TaskSpace, Trajectory, Validation, controllers, distances, models, systems
from ctxval.certificates.scenario import volume_bound
from ctxval.errors import CertificateError, InputError, ShapeError
from ctxval.searches import by_name
from ctxval.studies.safety import disturbance_set, largest_residuals
from facts import assert_names, refuses
from rig_thorough import more

MODEL = models.Linear([[1.0, 0.1], [0.0, 1.0]], [[0.0], [0.1]])


def runs(count: int, seed: int) -> list[Trajectory]:
    """Return runs whose largest residual is uniform from 0 to 1 in the second state, and half of that in the first."""
    rng, made = np.random.default_rng(seed), []
    for size in rng.random(count):
        states, inputs = np.zeros((5, 2)), rng.normal(size=(4, 1))
        for t in range(4):
            sizes = size * np.array([0.5, 1.0]) * (1.0 if t == 2 else rng.random())
            states[t + 1] = MODEL.step(states[t], inputs[t]) + sizes * rng.choice([-1, 1])
        made.append(Trajectory(0.1 * np.arange(5), states, inputs))
    return made


def test_residuals_are_the_largest_of_each_run() -> None:
    found = largest_residuals(MODEL, runs(50, 0))
    assert found.shape == (50, 2)
    np.testing.assert_allclose(found[:, 0], 0.5 * found[:, 1])


@pytest.mark.slow
@pytest.mark.parametrize("discarded", [3, *more(0)])
def test_the_box_leaves_out_more_than_its_volume_as_rarely_as_stated(discarded: int) -> None:
    # r is uniform, so that the share outside of W is 1 - r.
    wrong, repeats = 0, 100
    for seed in range(repeats):
        found = disturbance_set(runs(40, seed), model=MODEL, scales=[0.5, 1.0], discarded=discarded, confidence=0.9)
        assert found.volume == volume_bound(40, discarded, 0.1)
        wrong += 1 - found.half_widths[1] > found.volume
        assert (found.half_widths <= found.largest + 1e-12).all()
    assert wrong / repeats == pytest.approx(0.1, abs=0.05)


def test_the_draws_of_a_campaign_count_and_its_other_executions_give_the_scales() -> None:
    def step(x: Array, u: Array) -> Array:
        return np.asarray(MODEL.step(x, u) + np.array([0.0, 0.02]) * np.sin(3 * x))

    validation = Validation(
        space=TaskSpace(goal=(-1.0, 1.0)),
        task=lambda p: Task([0.0, 0.0], goal=[p.goal, 0.0], horizon=15, dt=0.1),
        system=systems.Simulated(step, vectorized=True),
        model=MODEL,
        synthesizer=controllers.LQR([1.0, 0.1], [0.1]),
        distance=distances.FinalState(),
    )
    campaign = Campaign(validation, search=by_name("gp-ucb"), seed=0).run(3, explore=True, progress=False)
    with refuses(CertificateError, 0, "Campaign.audit"):
        disturbance_set(campaign)
    campaign.audit(20, progress=False)
    found = disturbance_set(campaign)
    assert found.draws == 20
    assert 0.005 < found.half_widths[1] <= 0.021
    assert_names(found.statement, "step", "W", "draws")
    assert found.to_json()["half_widths"] == found.half_widths.tolist()


def test_what_cannot_be_certified_is_refused() -> None:
    with refuses(InputError, "model"):
        disturbance_set(runs(3, 0))
    with refuses(InputError, "scales"):
        disturbance_set(runs(3, 0), model=MODEL)
    with refuses(ShapeError, "scales", 2, [1.0]):
        disturbance_set(runs(3, 0), model=MODEL, scales=[1.0])
    with refuses(CertificateError, 3, "set"):
        disturbance_set(runs(3, 0), model=MODEL, scales=[1.0, 1.0], discarded=3)
