from __future__ import annotations

from pathlib import Path

from ctxval.cli.config.settings import ExperimentSettings
from ctxval.distances import MaximumDeviation, UnsafeMargin
from ctxval.errors import InputError
from facts import refuses

SPEC = {"avoid": {"type": "Ball", "center": [1.0], "radius": 0.2}, "components": ["angle"]}


def test_a_named_experiment_may_be_judged_by_a_specification() -> None:
    settings = ExperimentSettings.model_validate(
        {"experiment": "pendulum", "spec": {**SPEC, "margin": 0.1}, "judge": "spec", "threshold": 0.1}
    )
    experiment = settings.load()
    assert isinstance(experiment.validation.distance, UnsafeMargin)
    assert (experiment.threshold, experiment.units, experiment.truth) == (0.1, "rad", None)
    assert experiment.validation.distance.spec.components == (0,)
    assert not isinstance(settings.model_copy(update={"judge": "distance"}).load().validation.distance, UnsafeMargin)


def test_a_specification_that_is_missing_is_asked_for() -> None:
    with refuses(InputError, "experiment"):
        ExperimentSettings.model_validate({"experiment": "pendulum", "judge": "spec"}).load()


def test_the_margin_is_the_threshold() -> None:
    settings = ExperimentSettings.model_validate(
        {"experiment": "pendulum", "spec": SPEC, "judge": "spec", "threshold": 0.5}
    )
    with refuses(InputError, 0.5, "threshold"):
        settings.load()


def test_with_a_specification_the_default_distance_is_the_deviation_of_its_states(tmp_path: Path) -> None:
    described = {
        "space": {"goal": [0.0, 1.0]},
        "task": {"initial_state": [0.0, 0.0], "goal": ["goal", 0.0], "horizon": 5, "dt": 0.1},
        "system": {
            "type": "Manual",
            "states": {"angle": "rad", "rate": "rad/s"},
            "inputs": {"torque": "N m"},
            "dt": 0.1,
        },
        "model": {"type": "Linear", "A": [[1.0, 0.1], [0.0, 1.0]], "B": [[0.0], [0.1]]},
        "synthesizer": {"type": "LQR", "Q": [1.0, 1.0], "R": [1.0]},
        "states": {"angle": "rad", "rate": "rad/s"},
    }
    distance = ExperimentSettings.model_validate({**described, "spec": SPEC}).load().validation.distance
    assert isinstance(distance, MaximumDeviation)
    assert distance.components == (0,)
