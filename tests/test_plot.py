from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from conftest import make_validation
from ctxval import Campaign, TaskSpace, Validation, controllers, distances, models, plot, systems
from ctxval.errors import InputError


@pytest.fixture(scope="module")
def campaign() -> Campaign:
    return Campaign(make_validation(), seed=1).run(9)


def test_the_surrogate_shows_every_sample_the_truth_and_the_maximum(campaign: Campaign) -> None:
    grid = campaign.validation.space.grid(101)
    curve = plot.Curve(grid[:, 0], campaign.validation.distances(grid))
    axes = plot.surrogate(campaign, truth=curve, units="rad").axes[0]
    lines = {line.get_label(): line for line in axes.lines}
    assert {"GP mean", "true distance", "initial samples", "acquired samples", "worst task executed"} <= set(lines)
    assert len(lines["initial samples"].get_xdata()) == 5
    assert len(lines["acquired samples"].get_xdata()) == 4
    np.testing.assert_array_equal(lines["true distance"].get_ydata(), curve.values)
    assert campaign.worst is not None
    assert lines["worst task executed"].get_ydata()[0] == campaign.worst.distance
    assert axes.get_xlabel() == "goal [rad]"
    assert axes.get_ylabel() == "distance [rad]"


def test_the_trajectories_are_those_of_the_worst_task(campaign: Campaign) -> None:
    figure = plot.worst_trajectories(campaign, states=("angle [rad]",), inputs=("torque [N m]",))
    assert campaign.worst is not None
    model, system = campaign.trajectories(campaign.worst)
    assert model is not None
    assert system is not None
    drawn = {line.get_label(): line.get_ydata() for line in figure.axes[0].lines}
    np.testing.assert_array_equal(drawn["system S"], system.states[:, 0])
    np.testing.assert_array_equal(drawn["model M"], model.states[:, 0])
    assert [axes.get_ylabel() for axes in figure.axes] == ["angle [rad]", "state 1", "torque [N m]"]
    assert figure.axes[-1].get_xlabel() == "time [s]"


def test_more_dimensions_are_shown_as_slices() -> None:
    from ctxval import Task

    plane = Validation(
        space=TaskSpace(x=(-1, 1, "m"), y=(-1, 1, "m")),
        task=lambda p: Task([p.x, p.y], horizon=5, dt=0.1),
        system=systems.Simulated(models.Linear(0.9 * np.eye(2), np.eye(2))),
        model=models.Linear(0.8 * np.eye(2), np.eye(2)),
        synthesizer=controllers.LQR([1, 1], [1, 1]),
        distance=distances.FinalState(norm=1),
    )
    figure = plot.surrogate(Campaign(plane).run(8))
    assert [axes.get_xlabel() for axes in figure.axes] == ["x [m]", "y [m]"]


@pytest.mark.parametrize("ending", ["png", "svg"])
def test_pictures_are_written(campaign: Campaign, tmp_path: Path, ending: str) -> None:
    path = plot.save(plot.surrogate(campaign), tmp_path / f"a.{ending}")
    assert path.stat().st_size > 5000


def test_a_picture_that_cannot_be_written_or_drawn_is_an_input_error(campaign: Campaign, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be written"):
        plot.save(plot.surrogate(campaign), tmp_path / "none" / "a.png")
    with pytest.raises(InputError, match="cannot be written"):
        plot.save(plot.surrogate(campaign), tmp_path / "a.nonsense")
    with pytest.raises(InputError, match="nothing to draw"):
        plot.worst_trajectories(Campaign(make_validation()))
