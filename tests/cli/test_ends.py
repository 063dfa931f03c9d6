"""However a command ends, it ends with one sentence and a documented exit status, and no store is lost."""

from __future__ import annotations

import json
import os
import resource
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from ctxval import Store
from ctxval.cli import main
from rig_cli import Invoke, calling, report
from rig_thorough import more

RUN = ("run", "experiment.toml", "--budget", "2", "--search", "random", "--no-report", "--store", "a.sqlite")
invoke: Invoke = calling()


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the current folder, with the experiment of ``ctxval init``."""
    monkeypatch.chdir(tmp_path)
    assert invoke("init", "experiment.toml").exit_code == 0
    # A module of another test's folder may have the name.
    name = f"system_{abs(hash(tmp_path)):x}"
    (tmp_path / "experiment_system.py").rename(tmp_path / f"{name}.py")
    toml = tmp_path / "experiment.toml"
    toml.write_text(toml.read_text().replace("experiment_system", name))
    return tmp_path


def module(folder: Path, code: str) -> str:
    """Add code to the module of the system; return the module's name."""
    (path,) = folder.glob("system_*.py")
    path.write_text(f"{path.read_text()}\n{code}\n")
    return path.stem


@pytest.mark.parametrize(
    "code",
    [
        "raise SystemExit(0)",
        "raise SystemExit('bye')",
        "import os; os._exit(0)",
        "raise OSError('\\udcff')",
        "1 / 0",
    ],
)
def test_a_module_that_ends_while_it_is_loaded_is_named(folder: Path, code: str) -> None:
    name = module(folder, code)
    result = invoke(*RUN)
    assert (result.exit_code, name in result.stderr, result.stderr.count("\n")) == (2, True, 1)


@pytest.mark.parametrize("code", ["raise SystemExit(0)", "import os; os._exit(0)"])
def test_a_task_function_that_ends_the_process_does_not_end_it(folder: Path, code: str) -> None:
    module(folder, f"import numpy as np\ndef task(p):\n    {code}")
    toml = folder / "experiment.toml"
    text = toml.read_text()
    (stem,) = (path.stem for path in folder.glob("system_*.py"))
    head, tail = text[: text.index("[task]")], text[text.index("[states]") :]
    toml.write_text(f'task = {{ ref = "{stem}:task" }}\n{head}{tail}')
    result = invoke(*RUN)
    assert (result.exit_code, f"{stem}.py" in result.stderr) == (3, True)


@pytest.mark.parametrize("arguments", [("status", "a.sqlite"), ("init",), RUN, ("run", "pendulum", "--budget", "2")])
def test_a_deleted_folder_is_one_sentence(folder: Path, arguments: tuple[str, ...]) -> None:
    gone = folder / "gone"
    shutil.copytree(folder, gone)
    os.chdir(gone)
    shutil.rmtree(gone)
    result = invoke(*arguments)
    assert (result.exit_code, "[Errno" in result.stderr, result.stderr.count("\n")) == (2, False, 1)


@pytest.mark.slow
@pytest.mark.skipif(not Path("/dev/full").exists(), reason="this system has no /dev/full")
@pytest.mark.parametrize("more", [(), ("--json",)])
def test_an_output_that_cannot_be_written_is_one_sentence(folder: Path, more: tuple[str, ...]) -> None:
    assert invoke(*RUN).exit_code == 0
    command = [sys.executable, "-m", "ctxval", "status", "a.sqlite", *more]
    with open("/dev/full", "w") as full:
        ended = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, timeout=120)
    assert (ended.returncode, ended.stderr.count("\n"), "[Errno" in ended.stderr) == (3, 1, False)


@pytest.mark.parametrize(("kilobytes", "arguments"), [(1, RUN), (60, RUN), (0, ("export", "kept.sqlite"))])
def test_a_full_disk_is_one_sentence_and_loses_nothing(
    folder: Path, kilobytes: int, arguments: tuple[str, ...]
) -> None:
    assert invoke(*RUN[:-1], "kept.sqlite").exit_code == 0
    before, limits = Store("kept.sqlite").digest(), resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1024 * kilobytes, limits[1]))
    try:
        result = invoke(*arguments)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert "[Errno" not in result.output
    assert result.exit_code in ((0, 2) if kilobytes == 60 else (2,))
    assert Store("kept.sqlite").digest() == before


def test_a_closed_standard_output_is_refused_before_anything_is_executed(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["ctxval", *RUN])
    with monkeypatch.context() as patched:
        patched.setattr(sys, "stdout", None)
        with pytest.raises(SystemExit) as ended:
            main()
    assert (ended.value.code, capsys.readouterr().err.count("\n")) == (2, 1)
    assert not Path("a.sqlite").exists()


@pytest.mark.slow  # it waits for the threads
def test_threads_that_go_on_do_not_keep_the_command(folder: Path) -> None:
    module(folder, "import threading, time\nthreading.Thread(target=time.sleep, args=(600,), name='driver').start()")
    command = [sys.executable, "-m", "ctxval", *RUN, "--json"]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=120, stdin=subprocess.DEVNULL)
    assert (ended.returncode, ended.stderr.count("\n"), "driver" in ended.stderr) == (0, 1, True)
    assert json.loads(ended.stdout)["executions"] == 2


@pytest.mark.slow
@pytest.mark.parametrize("closed", ["<&-", ">&-", "2>&-", ">&- 2>&-", "<&- >&- 2>&-"])
def test_closed_streams_are_never_the_first_file_that_is_opened(folder: Path, closed: str) -> None:
    ended = subprocess.run(f"{sys.executable} -m ctxval {' '.join(RUN)} {closed}", shell=True, timeout=120, check=False)
    assert ended.returncode == (2 if ">&-" in closed.replace("2>&-", "") else 0)


def test_a_model_that_failed_executions_falsify_ends_as_falsified(folder: Path) -> None:
    name = module(
        folder,
        "def step(x, u):\n    if x[0] > 0.3:\n        raise OSError('the cable broke')\n"
        "    return [x[0] + 0.05 * x[1] + 0.03, x[1] + 0.05 * u[0]]",
    )
    toml = folder / "experiment.toml"
    text = toml.read_text().replace('type = "FinalState"', 'type = "MaximumDeviation"').replace("norm = 2\n", "")
    toml.write_text(text)
    result = invoke(*RUN, "--threshold", "0.02", "--json")
    summary: dict[str, Any] = json.loads(result.stdout)
    assert (summary["verdict"], summary["failed"], result.exit_code) == ("falsified", 2, 1), name


@pytest.mark.slow
@pytest.mark.parametrize("number", ["1_0", "\N{ARABIC-INDIC DIGIT THREE}", "0x10"])
def test_what_only_python_reads_is_no_number(folder: Path, number: str) -> None:
    assert invoke("run", "experiment.toml", "--budget", number).exit_code == 2
    assert invoke("run", "experiment.toml", "--threshold", number).exit_code == 2
    assert invoke("ask", "experiment.toml", "--set", f"goal={number}", "--set", "start_speed=0.1").exit_code == 2
    assert invoke("run", "pendulum", "--budget", "2", "--option", f"dim={number}").exit_code == 2
    text = (folder / "experiment.toml").read_text()
    for line in ("budget = 40", "seed = 0", "threshold = 0.5", "horizon = 60", "dt = 0.05", "limits = 4.0"):
        (folder / "other.toml").write_text(text.replace(line, f'{line.partition("=")[0]}= "{number}"'))
        assert invoke("check", "other.toml").exit_code == 2, line


@pytest.mark.parametrize("value", ["true", '"1"', '["1", "2"]', "[true, false]"])
@pytest.mark.parametrize("line", ["Q = [10.0, 1.0]", "limits = 4.0", 'goal = [0.5, 3.0, "m"]', "norm = 2", "seed = 0"])
def test_texts_and_booleans_are_no_numbers(folder: Path, line: str, value: str) -> None:
    text = (folder / "experiment.toml").read_text()
    (folder / "other.toml").write_text(text.replace(line, f"{line.partition('=')[0]}= {value}"))
    assert invoke("check", "other.toml").exit_code == 2


@pytest.mark.parametrize("distance", ["-0", *more("-0.0", "5e-324", "1e308", "0")])
def test_a_distance_that_is_told_reads_back(folder: Path, distance: str) -> None:
    assert invoke("ask", "experiment.toml", "--store", "a.sqlite").exit_code == 0
    assert invoke("tell", "a.sqlite", "0", "--distance", distance).exit_code == 0
    Path("table.csv").write_text(f"goal,start_speed,distance\n1.47,-0,{distance}\n2.0,0.1,{distance}\n")
    assert invoke("import", "a.sqlite", "table.csv").exit_code == 0
    summary = report(invoke("status", "a.sqlite", "--json"))
    assert (summary["executions"], summary["worst"]["distance"]) == (3, float(distance))
    assert invoke("ask", "a.sqlite", "--again", "0", "--because", "a \udcff fuse").exit_code == 0
    assert invoke("tell", "a.sqlite", "0", "--distance", "1", "--replace", "a \udcff typo").exit_code == 0
    assert report(invoke("status", "a.sqlite", "--json"))["changes"][0]["why"].startswith("a ")


@pytest.mark.parametrize("distance", ["nan", *more("-1", "inf", "-inf", "1e999", "-5e-324")])
def test_a_distance_that_is_none_is_refused_and_the_trial_stays_open(folder: Path, distance: str) -> None:
    assert invoke("ask", "experiment.toml", "--store", "a.sqlite").exit_code == 0
    assert invoke("tell", "a.sqlite", "0", "--distance", distance).exit_code == 2
    Path("table.csv").write_text(f"goal,start_speed,distance\n1.47,0,{distance}\n")
    assert invoke("import", "a.sqlite", "table.csv").exit_code == 2
    assert report(invoke("status", "a.sqlite", "--json"))["open"] == [0]
