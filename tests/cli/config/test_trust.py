"""A store is data: what it names is built only for the user who made it, or who says so."""

from __future__ import annotations

import json
import os
import shutil
import sqlite3
import stat
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from ctxval import Store
from ctxval.cli import app
from ctxval.cli.config.settings import read_settings
from ctxval.cli.config.stored_settings import planned_settings, trusted_settings
from ctxval.cli.config.trust import allow, allowed_folder, is_allowed
from ctxval.errors import InputError
from facts import assert_names
from rig_packages import install

PLAIN: dict[str, Any] = {
    "name": "cart",
    "space": {"goal": [0.5, 2.0, "m"]},
    "task": {"initial_state": [0.0, 0.0], "goal": ["goal", 0.0], "horizon": 4, "dt": 0.1},
    "system": {"type": "Manual", "states": {"position": "m", "speed": "m/s"}, "inputs": {"force": "N"}, "dt": 0.1},
    "model": {"type": "Linear", "A": [[1.0, 0.1], [0.0, 1.0]], "B": [[0.0], [0.1]]},
    "synthesizer": {"type": "LQR", "Q": [10.0, 1.0], "R": [0.1]},
    "distance": {"type": "FinalState", "scales": [0.1, 0.5]},
}
"""An experiment without code."""

MODULE = """
from pathlib import Path
Path({sentinel!r}).write_text("imported")
from ctxval import Experiment, Task, TaskSpace, Validation, controllers, distances, models, systems

def experiment(seed):
    validation = Validation(
        space=TaskSpace(goal=(0.5, 2.0, "m")),
        task=lambda p: Task([0, 0], goal=[p.goal, 0], horizon=4, dt=0.1),
        system=systems.Manual(states={{"position": "m", "speed": "m/s"}}, inputs={{"force": "N"}}, dt=0.1),
        model=models.Linear([[1, 0.1], [0, 1]], [[0], [0.1]]),
        synthesizer=controllers.LQR([10, 1], [0.1]),
        distance=distances.FinalState(weights=(1, 1)),
    )
    return Experiment("rig", validation)
"""

COMMANDS = {
    "tell": ("tell", "a.sqlite", "0", "--distance", "0.1"),
    "ask": ("ask", "a.sqlite"),
    "import": ("import", "a.sqlite", "runs.csv"),
    "audit": ("certify", "a.sqlite", "--audit", "3"),
    "remeasure": ("remeasure", "a.sqlite"),
}
"""All that build the experiment of a store."""


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Work in a folder of its own, on a path of modules of its own."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.delitem(sys.modules, "my_rig", raising=False)
    Path("runs.csv").write_text("goal,distance\n1.0,0.1\n")
    return tmp_path


def invoke(*arguments: str) -> Result:
    return CliRunner().invoke(app, list(arguments))


def refusal(*arguments: str) -> str:
    result = invoke(*arguments)
    assert result.exit_code == 2, result.stdout + result.stderr
    assert "Traceback" not in result.stderr
    return result.stderr.replace("\n", " ")


def done(*arguments: str) -> Result:
    result = invoke(*arguments)
    assert result.exit_code == 0, result.stdout + result.stderr
    return result


def plain_store(path: str = "a.sqlite") -> Store:
    """Make a store of an experiment without code, with one open trial."""
    settings = read_settings_of(PLAIN)
    campaign = settings.campaign(settings.load(), Path(path))
    campaign.ask()
    return campaign.store


def read_settings_of(content: dict[str, Any]) -> Any:
    from ctxval.cli.config.settings import ExperimentSettings

    return ExperimentSettings.model_validate(content)


def store_with(settings: dict[str, Any], path: str = "a.sqlite") -> Store:
    """Make a store and write other settings into it, as somebody else would."""
    store = plain_store(path)
    store.keep_settings(settings)
    return store


def rig_store(folder: Path, sentinel: str = "imported.txt") -> None:
    """Make a store of a module, as its user does, who may run its code."""
    Path(folder, "my_rig.py").write_text(MODULE.format(sentinel=str(folder / sentinel)))
    done("ask", "my_rig:experiment", "--store", "a.sqlite")
    Path(folder, sentinel).unlink()
    sys.modules.pop("my_rig")


# The store of the attack


HOSTILE = {
    **PLAIN,
    "system": {"type": "subprocess:Popen", "args": "id > PWNED", "shell": True},
    "task": {"ref": "os:getcwd"},
}

EVIL_CALL = {"type": "Subprocess", "command": ["sh", "-c", "id > PWNED"], "timeout": 5.0}

FILTERED = {"type": "OutputFeedback", "outputs": [0], "process": 0.1, "measurement": 0.1}

ATTACKS: dict[str, dict[str, Any]] = {
    "issue": HOSTILE,
    "class": {**PLAIN, "system": HOSTILE["system"]},
    "module": {**PLAIN, "task": {"ref": "evil:task"}},
    "module alone": {**PLAIN, "task": {"ref": "evil"}},
    "outputs": {**PLAIN, "outputs": {"ref": "evil:outputs"}},
    "observer": {**PLAIN, "recordings": {"states": {"x": "x"}, "observer": {"function": {"ref": "evil:estimate"}}}},
    "inner part": {**PLAIN, "synthesizer": {**FILTERED, "synthesizer": {"type": "evil:make"}}},
    "inner class": {**PLAIN, "synthesizer": {**FILTERED, "synthesizer": {"type": "evil:Make"}}},
    "inner command": {**PLAIN, "system": {"type": "WithOutputs", "system": EVIL_CALL, "outputs": [0]}},
    "inner inner": {
        **PLAIN,
        "synthesizer": {**FILTERED, "synthesizer": {**FILTERED, "synthesizer": {"type": "evil:make"}}},
    },
    "experiment": {"experiment": "evil:experiment"},
    "function": {**PLAIN, "model": {"type": "subprocess:getoutput", "cmd": "id > PWNED"}},
    "argument": {**PLAIN, "system": {"type": "Simulated", "step": {"ref": "evil:step"}}},
    "distance": {**PLAIN, "distance": {"type": "evil:distance"}},
    "search": {**PLAIN, "search": {"type": "gp-ucb", "kernel": {"ref": "evil:kernel"}}},
    "options": {"experiment": "pendulum", "options": {"settings": {"ref": "evil:settings"}}},
    "command": {**PLAIN, "system": EVIL_CALL},
    "environment": {**PLAIN, "system": {"type": "Gymnasium", "environment": "evil:Environment-v0"}},
    "fmu": {**PLAIN, "system": {"type": "FMU", "source": "evil.fmu", "states": {"x": ""}, "inputs": {"u": ""}}},
    "installed distance": {**PLAIN, "distance": {"type": "Speed"}},
    "installed search": {**PLAIN, "search": {"type": "corners"}},
    "installed case": {"experiment": "swing"},
    "folder": {**PLAIN, "task": {"ref": "evil:task"}, "folder": "."},
    "deep": {**PLAIN, "system": {"type": "Simulated", "step": [[{"a": [{"ref": "evil:step"}]}]]}},
}


def plant(folder: Path) -> None:
    """Put a module that leaves a mark when it is imported where a careless program would find it."""
    (folder / "evil.py").write_text("from pathlib import Path\nPath('PWNED').write_text('')\n")


@pytest.mark.parametrize("attack", ATTACKS)
def test_nothing_that_a_foreign_store_names_is_imported_or_run(attack: str, folder: Path) -> None:
    plant(folder)
    store_with(ATTACKS[attack])
    before = set(sys.modules)
    for command in COMMANDS.values():
        said = refusal(*command)
        assert "--trust" in said
        assert "--experiment FILE.toml" in said
    assert not Path("PWNED").exists()
    assert "evil" not in set(sys.modules) - before
    assert [trial.state for trial in Store("a.sqlite").trials()] == ["open"]


@pytest.mark.thorough
@pytest.mark.slow
def test_the_store_of_the_attack_runs_nothing_through_the_real_command_line(folder: Path) -> None:
    store_with(HOSTILE)
    started = [
        subprocess.Popen([sys.executable, "-m", "ctxval", *command], stderr=subprocess.PIPE, text=True)
        for command in [*COMMANDS.values()][::6]  # all of them are called in this process above
    ]
    for process in started:
        said = process.communicate(timeout=60)[1]
        assert process.returncode == 2
        assert "task = {'ref': 'os:getcwd'}" in said.replace("\n", " ")
        assert "id > PWNED" in said
    assert not list(folder.glob("PWNED*"))


WATCHED = """
import sys
seen = []
sys.addaudithook(lambda event, args: seen.append((event, args)))
from typer.testing import CliRunner
from ctxval.cli import app
for command in ("status", "export", "certify"):
    result = CliRunner().invoke(app, [command, "a.sqlite"])
    print(command, result.exit_code, result.stderr)
assert not [args for event, args in seen if event == "import" and args[0] == "evil"]
assert not [event for event, _ in seen if event in ("subprocess.Popen", "os.system", "os.exec", "os.posix_spawn")]
"""


@pytest.mark.slow
def test_looking_at_a_store_imports_and_runs_nothing(folder: Path) -> None:
    plant(folder)
    store_with({**HOSTILE, "model": {"type": "evil:model"}, "system": EVIL_CALL})
    done("status", "a.sqlite")
    result = subprocess.run([sys.executable, "-c", WATCHED], capture_output=True, text=True, timeout=60)
    assert result.returncode == 0, result.stdout + result.stderr
    assert "status 0" in result.stdout
    assert "export 0" in result.stdout
    assert not Path("PWNED").exists()


def test_what_is_shown_of_a_store_steers_no_terminal(folder: Path) -> None:
    store_with(
        {**PLAIN, "task": {"ref": "evil:\x1b[2J\u202etask" + "a" * 10_000}, "search": {"type": "auto", "\x1b[2J": {}}}
    )
    said = refusal("ask", "a.sqlite")
    assert r"\x1b[2J\u202etask" in said
    assert "\x1b" not in said
    assert len(said) < 1_500


# Whose store it is


def test_the_user_who_made_a_store_is_not_asked(folder: Path) -> None:
    rig_store(folder)
    assert Store("a.sqlite").settings()["folder"] == str(folder)
    done("ask", "a.sqlite")
    done("tell", "a.sqlite", "0", "--distance", "0.1")
    done("import", "a.sqlite", "runs.csv")
    assert Path("imported.txt").exists()


def test_a_store_of_another_user_is_asked_about_once(
    folder: Path, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch, state_folder: Path
) -> None:
    rig_store(folder)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path_factory.mktemp("other")))
    said = refusal("ask", "a.sqlite")
    assert_names(said, "my_rig:experiment")
    assert not Path("imported.txt").exists()
    assert_names(done("ask", "a.sqlite", "--trust").stderr, "a.sqlite")
    assert "allowed" not in done("ask", "a.sqlite").stderr
    # and its first user is not asked either
    monkeypatch.setenv("XDG_STATE_HOME", str(state_folder))
    done("tell", "a.sqlite", "0", "--distance", "0.1")


def test_settings_that_were_edited_are_not_those_that_were_allowed(folder: Path) -> None:
    rig_store(folder)
    plant(folder)
    kept = Store("a.sqlite").settings()
    for change in ({"experiment": "evil:experiment"}, {"folder": "/elsewhere"}, {"seed": 1}, {"options": {"a": 1}}):
        Store("a.sqlite").keep_settings({**kept, **change})
        refusal("ask", "a.sqlite")
    Store("a.sqlite").keep_settings(kept)
    done("ask", "a.sqlite")
    assert not Path("PWNED").exists()


@pytest.mark.slow
@pytest.mark.thorough
def test_a_module_beside_a_copied_store_is_not_found(folder: Path) -> None:
    rig_store(folder)
    elsewhere = folder / "downloads"
    elsewhere.mkdir()
    shutil.move("a.sqlite", elsewhere / "a.sqlite")
    (elsewhere / "my_rig.py").write_text("from pathlib import Path\nPath('PWNED').write_text('')\n")
    os.chdir(elsewhere)  # the fixture goes back
    done("ask", "a.sqlite")
    assert (folder / "imported.txt").exists()
    # and not even where the module that is meant has gone
    sys.modules.pop("my_rig")
    (folder / "my_rig.py").unlink()
    shutil.rmtree(folder / "__pycache__", ignore_errors=True)
    program = [sys.executable, "-m", "ctxval", "ask", "a.sqlite"]
    result = subprocess.run(program, capture_output=True, text=True, timeout=60)
    assert result.returncode == 2
    assert_names(result.stderr, "my_rig", folder)
    assert not list(folder.rglob("PWNED"))


def test_where_code_is_sought_is_known_of_settings_from_python_too(folder: Path) -> None:
    Path("my_rig.py").write_text(MODULE.format(sentinel="imported.txt"))
    settings = read_settings_of({"experiment": "my_rig:experiment"})
    settings.campaign(settings.load(), Path("a.sqlite")).ask()
    assert Store("a.sqlite").settings()["folder"] == str(folder)
    for settings in ({"experiment": "my_rig:experiment", "folder": None}, {"experiment": "my_rig:experiment"}):
        allow(settings)
        Store("a.sqlite").keep_settings(settings)
        refusal("ask", "a.sqlite")


def test_a_store_of_plain_numbers_is_asked_about_too(folder: Path) -> None:
    store_with({**PLAIN, "model": {"type": "Onnx", "source": "/home/you/network.onnx"}})
    assert_names(refusal("ask", "a.sqlite"), "network.onnx", folder)
    assert_names(refusal("ask", "pendulum", "--trust"), "--experiment", "--trust")
    settings = read_settings("linear", {"search": "random", "threshold": 99.0})
    settings.campaign(settings.load(), Path("p.sqlite")).run(budget=2)
    done("certify", "p.sqlite", "--audit", "3")
    shutil.rmtree(allowed_folder())
    refusal("certify", "p.sqlite", "--audit", "3")


def test_a_store_of_an_older_version_is_asked_about(folder: Path) -> None:
    rig_store(folder)
    old = {k: v for k, v in Store("a.sqlite").settings().items() if k != "folder"}
    Store("a.sqlite").keep_settings(old)
    refusal("ask", "a.sqlite")
    done("ask", "a.sqlite", "--trust")
    assert Store("a.sqlite").settings()["folder"] == str(folder)
    done("ask", "a.sqlite")


def test_an_experiment_that_was_moved_is_named_where_it_is_now(folder: Path) -> None:
    (folder / "old").mkdir()
    os.chdir(folder / "old")
    rig_store(folder / "old")
    os.chdir(folder)
    (folder / "old").rename("new")
    os.chdir("new")
    said = refusal("ask", "a.sqlite")
    assert_names(said, "my_rig", folder / "old")
    assert_names(said, "--experiment", "FILE.toml")
    Path("my_rig.py").write_text(MODULE.format(sentinel="imported.txt"))
    done("ask", "a.sqlite", "--experiment", "my_rig:experiment")
    done("ask", "a.sqlite")


# Parts of installed packages: code that the user installed, but that this store's maker chose


@pytest.fixture
def site(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A package with a distance ``Speed``, a search ``corners``, a case ``swing`` and a certificate ``theirs``."""
    monkeypatch.delitem(sys.modules, "their_parts", raising=False)
    monkeypatch.syspath_prepend(str(install(folder / "site")))
    return folder / "site"


INSTALLED: dict[str, dict[str, Any]] = {
    **{name: content for name, content in ATTACKS.items() if name.startswith("installed")},
    "installed certificate": {**PLAIN, "certificate": {"kind": "theirs"}},
}


@pytest.mark.slow
@pytest.mark.parametrize("attack", INSTALLED)
def test_a_foreign_store_imports_no_part_of_an_installed_package(attack: str, site: Path) -> None:
    store_with(INSTALLED[attack])
    for command in (*COMMANDS.values(), ("status", "a.sqlite"), ("export", "a.sqlite"), ("certify", "a.sqlite")):
        assert invoke(*command).exit_code in (0, 1, 2)
    for command in COMMANDS.values():
        refusal(*command)
    assert "their_parts" not in sys.modules
    assert not (site / "imported.txt").exists()


def test_what_the_user_names_may_be_of_an_installed_package(site: Path) -> None:
    lines = [f"{key} = {_toml(PLAIN[key])}" for key in ("space", "task", "system", "model", "synthesizer")]
    Path("cart.toml").write_text("\n".join([*lines, 'distance = { type = "Speed" }', 'search = { type = "corners" }']))
    done("ask", "cart.toml", "--store", "a.sqlite")
    assert (site / "imported.txt").exists()
    done("ask", "a.sqlite")  # it is the user's own store
    shutil.rmtree(allowed_folder())
    said = refusal("ask", "a.sqlite")  # it is not any more
    assert "distance = {'type': 'Speed'}; search = {'type': 'corners'}" in said
    done("ask", "a.sqlite", "--trust")
    done("ask", "a.sqlite")


# Naming the experiment again


def test_naming_the_experiment_replaces_what_the_store_names(folder: Path) -> None:
    plant(folder)
    rig_store(folder)
    Store("a.sqlite").keep_settings({**Store("a.sqlite").settings(), "experiment": "evil:experiment"})
    named = ("--experiment", "my_rig:experiment")
    assert_names(refusal("ask", "a.sqlite", *named, "--trust"), "--trust", "--experiment")
    done("tell", "a.sqlite", "0", "--distance", "0.1", *named)
    assert Store("a.sqlite").settings()["experiment"] == "my_rig:experiment"
    done("ask", "a.sqlite")
    assert not Path("PWNED").exists()


def test_another_experiment_is_refused_and_allows_nothing(folder: Path) -> None:
    store_with(HOSTILE)
    refusal("ask", "a.sqlite", "--experiment", "pendulum")
    assert Store("a.sqlite").settings() == HOSTILE
    assert not is_allowed(HOSTILE)


def test_seed_and_search_remain_the_stores(folder: Path) -> None:
    Path("my_rig.py").write_text(MODULE.format(sentinel="imported.txt"))
    done("ask", "my_rig:experiment", "--store", "a.sqlite", "--seed", "3", "--search", "random")
    kept = Store("a.sqlite").settings()
    shutil.rmtree(allowed_folder())
    done("ask", "a.sqlite", "--experiment", "my_rig:experiment")
    assert (Store("a.sqlite").settings()["seed"], Store("a.sqlite").settings()["search"]["type"]) == (3, "random")
    # but code is not taken along
    search = {"type": "random", "kernel": {"ref": "evil:kernel"}}
    Store("a.sqlite").keep_settings({**kept, "search": search})
    assert trusted_settings(Store("a.sqlite"), experiment="pendulum").search.type == "auto"


def test_a_store_that_says_nothing_can_be_named(folder: Path) -> None:
    plain_store()
    sqlite3.connect("a.sqlite", isolation_level=None).execute("DELETE FROM settings")
    assert "--experiment FILE.toml" in refusal("ask", "a.sqlite")
    lines = [
        'name = "cart"',
        *(f"{key} = {_toml(PLAIN[key])}" for key in ("space", "task", "system", "model", "synthesizer", "distance")),
    ]
    Path("cart.toml").write_text("\n".join(lines))
    done("ask", "a.sqlite", "--experiment", "cart.toml")


def _toml(value: Any) -> str:
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{key} = {_toml(item)}" for key, item in value.items()) + " }"
    return json.dumps(value)


def test_only_an_audit_builds_anything(folder: Path) -> None:
    store_with(HOSTILE)
    for option in (("--trust",), ("--experiment", "pendulum")):
        assert "--trust and --experiment need --audit" in refusal("certify", "a.sqlite", *option)


def test_what_is_trusted_must_still_be_a_part(folder: Path) -> None:
    store_with(HOSTILE)
    refusal("tell", "a.sqlite", "0", "--distance", "0.1", "--trust")
    assert not Path("PWNED").exists()


# The list


def test_the_list_is_the_users_own(state_folder: Path) -> None:
    assert allowed_folder() == state_folder / "ctxval" / "allowed"
    settings = {"experiment": "my_rig:experiment"}
    assert not is_allowed(settings)
    assert allow(settings) is None
    assert is_allowed(settings)
    assert not is_allowed({**settings, "seed": 1})
    assert [file.read_bytes() for file in allowed_folder().iterdir()] == [b""]
    if os.name != "nt":
        assert stat.S_IMODE(allowed_folder().stat().st_mode) == 0o700


def test_a_state_folder_that_is_not_absolute_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", "here")
    monkeypatch.setenv("HOME", "/home/me")
    assert allowed_folder() == Path("/home/me/.local/state/ctxval/allowed")


@pytest.mark.skipif(os.name != "posix", reason="files have modes on POSIX")
@pytest.mark.parametrize("mode", [0o720, 0o702, 0o770])
def test_a_list_to_which_others_can_write_is_refused(mode: int, folder: Path) -> None:
    rig_store(folder)
    allowed_folder().chmod(mode)
    refusal("ask", "a.sqlite")
    allowed_folder().chmod(0o700)
    done("ask", "a.sqlite")


def test_without_a_place_for_the_list_the_question_is_asked_again(folder: Path, state_folder: Path) -> None:
    (state_folder / "ctxval").write_text("in the way")
    Path("my_rig.py").write_text(MODULE.format(sentinel="imported.txt"))
    done("ask", "my_rig:experiment", "--store", "a.sqlite")
    refusal("ask", "a.sqlite")
    done("ask", "a.sqlite", "--trust")
    refusal("ask", "a.sqlite")


def test_a_user_without_a_home_has_no_list(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("XDG_STATE_HOME")
    monkeypatch.setattr(Path, "home", lambda: (_ for _ in ()).throw(RuntimeError("no home")))
    assert "home folder" in str(allow({"seed": 1}))
    assert not is_allowed({"seed": 1})


def test_numbers_and_texts_survive_the_store(folder: Path) -> None:
    settings = {"threshold": 0.1 + 0.2, "name": "\ud800é\x00", "options": {"b": (1, 2.0, None), "a": True}}
    store = plain_store()
    store.keep_settings(settings)
    allow(settings)
    assert is_allowed(Store("a.sqlite").settings())


def test_what_is_nested_too_deeply_is_not_allowed() -> None:
    value: Any = {}
    for _ in range(100_000):
        value = [value]
    assert not is_allowed({"options": {"x": value}})


def test_stored_settings_are_read_before_they_are_allowed(folder: Path) -> None:
    rig_store(folder)
    assert planned_settings(Store("a.sqlite")).experiment == "my_rig:experiment"


# The Subprocess of a file is trusted as what it is: named by the user


def test_a_file_that_the_user_names_runs_what_it_says(folder: Path) -> None:
    program = folder / "rig.py"
    program.write_text(
        "import sys\nfrom pathlib import Path\n"
        "rows = ''.join(f'{t * 0.1},0,0,{0 if t < 4 else str()}\\n' for t in range(5))\n"
        "(Path(sys.argv[1]) / 'trajectory.csv').write_text(f't,x0,x1,u0\\n{rows}')\n"
    )
    command = f"{sys.executable} rig.py"
    content = {**PLAIN, "system": {"type": "Subprocess", "command": command, "timeout": 60}, "folder": folder}
    settings = read_settings_of(content)
    os.chdir(folder.parent)
    system = settings.load().validation.system
    described = system.describe()
    assert described["program"] == Path(sys.executable).name  # wherever it is
    assert list(described["files"]) == ["rig.py"]
    plan = settings.load().validation.plan(np.array([1.0]))
    assert system.execute(plan.controller, plan.task).states.shape == (5, 2)


def test_settings_of_a_damaged_shape_are_a_sentence(folder: Path) -> None:
    store_with({"experiment": 3})
    assert_names(refusal("ask", "a.sqlite"), "experiment")
    with pytest.raises(InputError):
        trusted_settings(Store("a.sqlite"), trust=True)
    assert read_settings("pendulum", {}).folder is None
