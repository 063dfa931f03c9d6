import numpy as np

from ctxval.learning.local_noise import local_noise


def test_noise_that_begins_at_a_place_is_not_smoothed_away() -> None:
    rng = np.random.default_rng(0)
    pairs = rng.standard_normal((1000, 3))
    inside = pairs[:, 0] > 1.0
    innovations = np.where(inside, 1.0, 0.05) * rng.standard_normal(1000)
    innovations /= np.sqrt((innovations**2).mean())
    local = local_noise(pairs, innovations[:, None])
    assert local is not None
    relative = local(pairs)
    deep = pairs[:, 0] > 1.3
    # 21 % too small with the widest average.
    assert np.sqrt((relative[deep] ** 2).mean()) > 0.87 * innovations[deep].std()
    assert np.sqrt((relative[pairs[:, 0] < 0] ** 2).mean()) < 0.25


def test_noise_that_is_the_same_everywhere_is_not_local() -> None:
    for seed in range(5):
        rng = np.random.default_rng(seed)
        assert local_noise(rng.standard_normal((800, 4)), rng.standard_normal((800, 2))) is None


def test_no_states_have_no_noise() -> None:
    assert local_noise(np.zeros((5, 2)), np.zeros((5, 0))) is None
