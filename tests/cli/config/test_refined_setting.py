"""The setting ``refined``: the file of a model that replaces the model of an experiment."""

from __future__ import annotations

from pathlib import Path

from ctxval import Transitions, cases, models
from ctxval.cli.config.settings import read_settings
from ctxval.errors import InputError
from facts import refuses


def test_a_refined_model_replaces_that_of_a_named_experiment(tmp_path: Path) -> None:
    given = cases.by_name("pendulum").validation.model
    assert isinstance(given, models.Linear)
    assert isinstance(given.data, Transitions)
    models.write_model(tmp_path / "better.npz", models.Linear(0.9 * given.A, given.B, data=given.data))
    (tmp_path / "my.toml").write_text('experiment = "pendulum"\nrefined = "better.npz"\n')
    made = read_settings(str(tmp_path / "my.toml"), {}).load()
    model = made.validation.model
    assert isinstance(model, models.Refined)
    assert isinstance(model.before, models.Linear)
    assert (model.model.A == 0.9 * given.A).all()  # type: ignore[attr-defined]
    assert made.truth is None


def test_a_file_without_recorded_steps_is_refused(tmp_path: Path) -> None:
    models.write_model(tmp_path / "m.npz", models.Linear([[1.0, 0.0], [0.0, 1.0]], [[0.0], [1.0]]))
    (tmp_path / "my.toml").write_text('experiment = "pendulum"\nrefined = "m.npz"\n')
    with refuses(InputError, "m.npz"):
        read_settings(str(tmp_path / "my.toml"), {}).load()
