import numpy as np
import pytest

from ctxval import models
from ctxval.studies.causes.cause import plant_of
from ctxval.studies.causes.signals import Delay, Lag


@pytest.mark.parametrize(("dt", "late", "slow"), [(0.02, "60 ms", "40 ms"), (5.0, "15 s", "10 s")])
def test_slow_plants_are_late_by_seconds(dt: float, late: str, slow: str) -> None:
    x, u = np.linspace(-1, 1, 20)[:, None], np.ones((20, 1))
    plant = plant_of(models.Linear([[0.9]], [[0.1]]), dt, {"T": "degC"}, {"heat": "W"}, x, u)
    assert f"arrive {late} late" in Delay((3.0,)).text(plant)
    assert Lag((2.0,)).text(plant).endswith(f"of {slow}")
