"""The workflow of docs/how-to/ci.md: its steps run one after the other, twice, as in two nights."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from ctxval import Store
from page_blocks import DOCS, blocks
from rig_cli import calling


@pytest.mark.slow
def test_the_steps_of_the_workflow_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for _, content in blocks(DOCS / "how-to" / "ci.md"):
        first, _, rest = content.partition("\n")
        if first.startswith("# file: "):
            Path(first.removeprefix("# file: ")).write_text(rest)
    assert calling()("init", "robot.toml").exit_code == 0
    (job,) = yaml.safe_load(Path("validation.yml").read_text())["jobs"].values()
    commands = [step["run"] for step in job["steps"] if "run" in step]
    assert len(commands) == 2
    # The plugin is named, because the source may be newer than what is installed.
    named = {"PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1", "PYTEST_ADDOPTS": "-p small_ctxval -p ctxval.pytest_plugin"}
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    named |= {"PATH": path, "PYTHONPATH": os.pathsep.join([str(Path(__file__).parents[1]), *sys.path])}
    environment = {**os.environ, **named, "GITHUB_STEP_SUMMARY": str(tmp_path / "summary.md")}
    store = Path(".pytest_cache/d/ctxval/test_robot.py-test_the_model_predicts_the_robot/campaign.sqlite")
    made = []
    for _ in range(2):
        for command in commands:
            done = subprocess.run(["bash", "-e", "-c", command], env=environment, capture_output=True, text=True)
            assert done.returncode == 0, done.stdout + done.stderr
        made.append(len(Store.existing(store).trials()))
    assert 0 < made[0] <= 5
    assert made[0] <= made[1] <= made[0] + 5
    assert "xychart-beta" in (tmp_path / "summary.md").read_text()
    assert Path("results.xml").is_file()
