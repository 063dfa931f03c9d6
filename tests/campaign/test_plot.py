from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from conftest import make_validation
from ctxval import (
    Campaign,
    Labels,
    Task,
    TaskSpace,
    Validation,
    controllers,
    distances,
    models,
    plot,
    searches,
    systems,
)
from ctxval.errors import InputError
from facts import refuses
from faulty_rig import FaultyRig
from rig_thorough import more


@pytest.fixture(scope="module")
def campaign() -> Campaign:
    labels = Labels(("angle [rad]", "rate"), ("torque [N m]",), "rad")
    return Campaign(make_validation().with_parts(labels=labels), search=searches.GPUCB(), seed=1).run(9)


def test_the_surrogate_shows_every_sample_and_the_maximum(campaign: Campaign, ax: Axes) -> None:
    axes = plot.surrogate_slice(campaign, ax=ax)
    lines = {line.get_label(): line for line in axes.lines}
    assert {"GP mean", "initial samples", "acquired samples", "worst task executed"} <= set(lines)
    assert len(lines["initial samples"].get_xdata()) == 5
    assert len(lines["acquired samples"].get_xdata()) == 4
    assert campaign.worst is not None
    assert lines["worst task executed"].get_ydata()[0] == campaign.worst.distance
    assert axes.get_xlabel() == "goal [rad]"
    assert axes.get_ylabel() == "distance [rad]"


def test_the_trajectories_are_those_of_the_worst_task(campaign: Campaign) -> None:
    figure = plot.worst_trajectories(campaign)
    assert campaign.worst is not None
    model, system = campaign.trajectories(campaign.worst)
    assert model is not None
    assert system is not None
    drawn = {line.get_label(): line.get_ydata() for line in figure.axes[0].lines}
    np.testing.assert_array_equal(drawn["system S"], system.states[:, 0])
    np.testing.assert_array_equal(drawn["model M"], model.states[:, 0])
    assert [axes.get_ylabel() for axes in figure.axes] == ["angle [rad]", "rate", "torque [N m]"]
    assert figure.axes[-1].get_xlabel() == "time [s]"


def test_of_more_dimensions_one_is_shown(ax: Axes) -> None:
    assert plot.surrogate_slice(Campaign(make_plane()).run(8, explore=True), 1, ax=ax).get_xlabel() == "y [m]"


@pytest.mark.parametrize("ending", ["png", *more("svg")])
def test_pictures_are_written(campaign: Campaign, tmp_path: Path, ending: str) -> None:
    path = plot.save(plot.worst_trajectories(campaign), tmp_path / f"a.{ending}")
    assert path.stat().st_size > 5000


def test_a_picture_that_cannot_be_written_or_drawn_is_an_input_error(campaign: Campaign, tmp_path: Path) -> None:
    with refuses(InputError, "a.png"):
        plot.save(plot.worst_trajectories(campaign), tmp_path / "none" / "a.png")
    with refuses(InputError, "a.nonsense"):
        plot.save(plot.worst_trajectories(campaign), tmp_path / "a.nonsense")
    with refuses(InputError):
        plot.worst_trajectories(Campaign(make_validation()))


def make_plane() -> Validation:
    return Validation(
        space=TaskSpace(x=(-1, 1, "m"), y=(-1, 1, "m")),
        task=lambda p: Task([p.x, p.y], horizon=5, dt=0.1),
        system=FaultyRig(systems.Simulated(models.Linear(0.9 * np.eye(2), np.eye(2))), {2: "raise"}),
        model=models.Linear(0.8 * np.eye(2), np.eye(2)),
        synthesizer=controllers.LQR([1, 1], [1, 1]),
        distance=distances.FinalState(norm=1),
    )


@pytest.fixture
def ax() -> Axes:
    return Figure().add_subplot()


def test_one_slice_of_the_surrogate_is_drawn_into_given_axes(campaign: Campaign, ax: Axes) -> None:
    assert plot.surrogate_slice(campaign, ax=ax) is ax
    assert ax.get_xlabel() == "goal [rad]"
    assert ax.get_ylabel() == "distance [rad]"
    with refuses(InputError, "axis", 0, 1):
        plot.surrogate_slice(campaign, 1, ax=ax)


def test_the_convergence_shows_each_distance_the_largest_so_far_and_what_failed(ax: Axes) -> None:
    campaign = Campaign(make_plane(), seed=1).run(7, explore=True)
    assert plot.convergence(campaign, ax=ax) is ax
    lines = {line.get_label(): line for line in ax.lines}
    so_far = lines["largest so far"].get_ydata()
    assert (np.diff(so_far) >= 0).all()
    assert campaign.worst is not None
    assert so_far[-1] == campaign.worst.distance
    assert list(lines["no distance is known"].get_xdata()) == [2]
    drawn = [*lines["initial samples"].get_xdata(), *lines["acquired samples"].get_xdata()]
    assert drawn == [trial.number for trial in campaign.completed]
    assert ax.get_ylabel() == "distance"


def test_a_campaign_draws_its_surrogate_or_its_convergence(campaign: Campaign, ax: Axes) -> None:
    assert campaign.plot(ax=ax) is ax
    assert ax.get_xlabel() == "goal [rad]"
    other = Figure().add_subplot()
    assert Campaign(make_plane(), seed=1).run(2).plot(ax=other) is other
    assert other.get_xlabel() == "trial"
    with refuses(InputError):
        Campaign(make_validation()).plot(ax=ax)


def test_new_axes_are_those_of_pyplot(campaign: Campaign, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MPLBACKEND", "agg")
    from matplotlib import pyplot

    axes = campaign.plot()
    assert pyplot.get_fignums()
    assert axes is pyplot.gca()
    pyplot.close(axes.figure)


def test_threshold_and_bound_are_drawn_and_no_band_is_below_zero(campaign: Campaign, ax: Axes) -> None:
    plot.surrogate_slice(campaign, threshold=0.5, bound=0.7, ax=ax)
    lines = {line.get_label(): line for line in ax.lines}
    assert set(lines["threshold 0.5"].get_ydata()) == {0.5}
    assert set(lines["bound on d*"].get_ydata()) == {0.7}
    assert lines["threshold 0.5"].get_linestyle() != lines["bound on d*"].get_linestyle()
    (band,) = ax.collections
    assert band.get_paths()[0].vertices[:, 1].min() >= 0
    other = Figure().add_subplot()
    campaign.plot(ax=other, threshold=0.5, bound=0.7)
    assert {"threshold 0.5", "bound on d*"} <= {line.get_label() for line in other.lines}


def test_labels_are_those_of_the_validation() -> None:
    labels = Labels(("angle [rad]", "rate [rad/s]"), ("torque [N m]",), "rad")
    named = Campaign(make_validation().with_parts(labels=labels), search=searches.Random()).run(2)
    figure = plot.worst_trajectories(named)
    assert [axes.get_ylabel() for axes in figure.axes] == ["angle [rad]", "rate [rad/s]", "torque [N m]"]
    axes = plot.convergence(named, ax=Figure().add_subplot())
    assert axes.get_ylabel() == "distance [rad]"
