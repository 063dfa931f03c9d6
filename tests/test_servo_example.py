"""The example on the recordings of a real servo."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from ctxval import Campaign, compare, searches
from ctxval.errors import InputError
from ctxval.studies.causes import find_causes
from facts import assert_names, refuses
from rig_thorough import more
from shared_data import shared_data

FOLDER = Path(__file__).parents[1] / "examples" / "servo"


@pytest.fixture(scope="module")
def servo() -> Iterator[ModuleType]:
    sys.path.insert(0, str(FOLDER))
    try:
        import servo as module

        yield module
    finally:
        sys.path.remove(str(FOLDER))
        sys.modules.pop("servo", None)


@pytest.fixture(scope="module")
def folder() -> str:
    return str(shared_data("bam_xl330"))


def test_recordings_by_others_are_no_part_of_the_repository() -> None:
    assert not list(FOLDER.parents[1].glob("examples/**/*.gz"))
    page = (FOLDER.parents[1] / "docs" / "servo.md").read_text("utf-8")
    assert all(fact in page for fact in ("Apache-2.0", "github.com/Rhoban/bam", "af22604", "arXiv 2410.08650"))


def test_a_folder_without_the_recordings_is_refused(servo: ModuleType, tmp_path: Path) -> None:
    with refuses(InputError, "lift_and_drop-100"):
        servo.experiment(str(tmp_path))


def test_recordings_are_those_that_their_contents_name(servo: ModuleType, folder: str) -> None:
    recordings = servo.Recordings(Path(folder))
    assert set(recordings.runs) == set(recordings.suite.task_names)
    assert recordings.of("sin_sin-100")[0, 0] == pytest.approx(-0.003067961575771161)


@pytest.mark.parametrize("friction", ["m1", "m3", "m4"])
def test_friction_holds_what_it_can_and_takes_energy(servo: ModuleType, friction: str) -> None:
    model, off = servo.Servo(servo.PUBLISHED[friction]), np.zeros(2)
    hanging = np.array([-servo.PUBLISHED[friction].offset, 0.0])
    held = np.array([hanging[0] + 0.01, 0.0])  # a slope that friction can hold
    assert np.array_equal(model.step(hanging, off), hanging)
    assert np.array_equal(model.step(held, off), held)
    x = np.array([[1.0, 0.0], [0.5, 3.0]])
    energy = [np.inf, np.inf]
    for _ in range(400):
        height = 1 - np.cos(x[:, 0] + servo.PUBLISHED[friction].offset)
        inertia = model.mass * model.length**2 + servo.PUBLISHED[friction].armature
        now = 0.5 * inertia * x[:, 1] ** 2 + 9.80665 * model.mass * model.length * height
        assert (now <= np.add(energy, 2e-3)).all()
        energy, x = now, model.step(x, np.zeros((2, 2)))
    assert np.abs(x[:, 1]).max() < 1e-9


def test_the_firmware_is_limited_and_counts(servo: ModuleType) -> None:
    firmware = servo.Firmware(np.array([[1.0], [0.001]]), np.ones((2, 1)), np.array([800.0, 800.0]))
    duty = firmware(0, np.array([[0.0], [0.0007]]))[:, 0]
    assert duty[0] == 1.0
    assert duty[1] == pytest.approx(800 * 0.001 * 4096 / (2 * np.pi) / (256 * 885))  # 0.0007 rad is less than a count


@pytest.mark.slow
@pytest.mark.parametrize(
    ("friction", "largest", "task"), [("m1", 0.427, "sin_sin-400"), *more(("m4", 0.522, "sin_time_square-800"))]
)
def test_distances_of_published_models_are_those_of_the_page(
    servo: ModuleType, folder: str, friction: str, largest: float, task: str
) -> None:
    validation = servo.experiment(folder, friction=friction).validation
    known = validation.distances(validation.space.grid(2))
    assert known.max() == pytest.approx(largest, abs=0.01)
    assert validation.space.task_names[int(known.argmax())] == task


@pytest.mark.thorough  # `make servo` runs it for all published models
def test_a_campaign_falsifies_m1_and_sees_only_what_it_executes(servo: ModuleType, folder: str) -> None:
    validation = servo.experiment(folder, friction="m1").validation
    revealed: list[str] = []
    given = validation.system.execute

    class Watched:
        def execute(self, controller: object, task: object) -> object:
            revealed.append(task.name)  # type: ignore[attr-defined]
            return given(controller, task)

    campaign = Campaign(validation.with_parts(system=Watched()), seed=0).run(16, 0.38)
    verdict = campaign.verdict(0.38)
    assert verdict.answer == "falsified"
    assert campaign.executions <= 4
    assert revealed == [trial.parameters["task"] for trial in campaign.trials]


@pytest.mark.slow
@pytest.mark.thorough
def test_one_recording_counts_for_all_compared_models(servo: ModuleType, folder: str) -> None:
    models = {friction: servo.experiment(folder, friction=friction).validation for friction in ("m3", "m4")}
    found = compare(models, question="worst", budget=1)
    assert found.executions == 1
    assert [(result.executions, result.shared) for result in found.candidates].count((0, 0)) == 0
    assert sum(result.executions + result.shared for result in found.candidates) == 2


@pytest.mark.slow
@pytest.mark.thorough
def test_load_friction_explains_most_of_what_the_first_model_misses(servo: ModuleType, folder: str) -> None:
    validation = servo.experiment(folder, friction="m1").validation
    campaign = Campaign(validation, search=searches.by_name("random"), seed=0).run(5)
    report = find_causes(campaign)
    assert not report.named
    assert [cause.name for cause in report.explained[0].causes] == ["load-dependent friction"]
    assert report.explained[0].share > 0.4
    assert_names(report.sentence, 5)
