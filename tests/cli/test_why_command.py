"""``ctxval why``, as users call it."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from ctxval import Campaign
from ctxval.campaign.storage.store import Store
from facts import assert_names
from rig_cli import Invoke, calling, report

MODULE = '''
"""A carriage whose motor has an offset."""

import numpy as np

from ctxval import Experiment, Task, TaskSpace, Validation, controllers, distances, models, systems


def experiment(seed=0):
    model = models.Linear([[1.0, 0.1], [0.0, 0.97]], [[0.005], [0.1]])
    validation = Validation(
        space=TaskSpace(goal=(-2.0, 2.0, "m")),
        task=lambda p: Task(np.stack([0 * p.goal, 0 * p.goal], axis=-1), goal=[p.goal, 0.0], horizon=20, dt=0.1),
        system=systems.Simulated(lambda x, u: model.step(x, u + 0.3), vectorized=True),
        model=model,
        synthesizer=controllers.LQR([1.0, 0.1], [0.1]),
        distance=distances.MaximumDeviation(components=(0,)),
    )
    return Experiment("cart", validation, threshold=0.5, units="m", states=["position", "speed"], inputs=["force [N]"])
'''


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Return a folder with a store of three executions, and one of a single execution."""
    folder = tmp_path_factory.mktemp("why")
    (folder / "offset_cart.py").write_text(MODULE)
    sys.path.insert(0, str(folder))
    validation = importlib.import_module("offset_cart").experiment().validation
    for name, goals in (("cart", (-1.6, 0.7, 1.4)), ("one", (1.0,))):
        campaign = Campaign(validation, store=folder / f"{name}.sqlite", seed=0, name="cart")
        for goal in goals:
            point = validation.space.point({"goal": goal})
            campaign.add({"goal": goal}, validation.execute(validation.plan(point)))
    yield folder
    sys.path.remove(str(folder))
    del sys.modules["offset_cart"]


@pytest.fixture
def invoke(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Invoke:
    monkeypatch.chdir(folder)
    monkeypatch.setenv("COLUMNS", "160")
    return calling("why", "--experiment", "offset_cart:experiment", "--most", "1")


def test_the_cause_is_said_and_no_trial_is_changed(folder: Path, invoke: Invoke) -> None:
    before = Store.existing(folder / "cart.sqlite").digest()
    found = report(invoke("cart.sqlite", "--json"))
    assert found["answer"] == "named"
    assert found["explained"][0]["causes"][0]["sizes"] == pytest.approx([0.3])
    printed = invoke("cart.sqlite")
    assert printed.exit_code == 0
    assert_names(printed.stdout, 0.3, "N")
    assert "causes.InputOffset((0.3,), input=0)" in printed.stdout
    assert Store.existing(folder / "cart.sqlite").digest() == before


def test_the_report_says_the_cause_on_its_first_screen(folder: Path, invoke: Invoke) -> None:
    said = report(invoke("cart.sqlite", "--json"))["sentence"]
    written = calling("report", "--experiment", "offset_cart:experiment")("cart.sqlite", "--out", "cart.html", "--json")
    assert written.exit_code in (0, 1), written.output
    page = (folder / "cart.html").read_text()
    assert 0 < page.find("Why M fails") < page.find("Assumptions and diagnostics")
    assert said in page


@pytest.mark.parametrize(
    ("arguments", "facts"),
    [
        (["one.sqlite"], (1, "--envelope")),
        (["nowhere.sqlite"], ("nowhere.sqlite",)),
    ],
)
def test_bad_input_is_one_sentence(invoke: Invoke, arguments: list[str], facts: tuple[object, ...]) -> None:
    result = invoke(*arguments)
    assert result.exit_code == 2
    assert_names(" ".join(result.stderr.split()), *facts)
    assert "Traceback" not in result.stderr


def test_a_refined_model_has_the_cause_and_is_in_no_file(invoke: Invoke) -> None:
    refine = calling("refine", "cart.sqlite", "--experiment", "offset_cart:experiment", "--method", "causes")
    refused = refine("--out", "better.npz")
    assert refused.exit_code == 2
    assert_names(" ".join(refused.stderr.split()), "--out", "--method", "causes")
    found = report(refine("--threshold", "0.01", "--budget", "4", "--json"))
    assert found["rounds"][-1]["method"] == "causes"
    assert found["distance_after"] < 1e-3 < found["distance_before"]
