"""Every page of the manual does what it says: its blocks run one after the other, in a fresh folder."""

from __future__ import annotations

import os
import re
import shlex
import signal
import subprocess
import sys
import tomllib
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer

from ctxval.cli import app
from ctxval.cli.config.settings import ExperimentSettings
from ctxval.controllers import PolicyContract
from ctxval.data import LogMapping
from page_blocks import DOCS, blocks, python_files
from page_blocks import PAGES as EVERY_PAGE
from rig_cli import calling

HOW_TO = sorted((DOCS / "how-to").glob("*.md"))
PAGES = [*HOW_TO, *sorted(DOCS.glob("tutorials/*.md")), *sorted(DOCS.glob("explanation/*.md"))]
PAGES += sorted(DOCS.glob("reference/*.md"))
NEEDS = {
    "gymnasium": ["gymnasium", "mujoco"],
    "mujoco": ["mujoco"],
    "robot-knowledge": ["mujoco"],
    "fmu": ["fmpy", "pythonfmu"],
    "mpc": ["casadi", "do_mpc"],
}
NEEDS |= {"onnx": ["onnx", "onnxruntime"], "scikit-learn": ["sklearn", "pysindy"], "state-space": ["control"]}
NEEDS |= {"policy-and-mjcf": ["mujoco"], "flight-logs": ["pyulog"], "ros-bags": ["rosbags", "mcap"]}
NEEDS |= {"robot-datasets": ["h5py", "pyarrow"]}
NEEDS |= {"pybullet": ["mujoco", "pybullet"]}
NEEDS |= {"gymnasium-and-network": ["gymnasium", "mujoco", "sklearn"]}
NEEDS |= {"fit": ["mujoco", "sklearn", "onnx"]}
NEEDS |= {"clusters": ["submitit", "ray", "distributed"]}
NEEDS |= {"operate": ["starlette", "uvicorn", "jinja2", "python_multipart"]}
LONG = ("aspect1", "causes", "clusters", "compare-controllers", "controllers", "envelope", "fit")
LONG += ("gymnasium-and-network", "noise", "outputs", "retrain", "safety")
LONG += ("choose-threshold", "decide", "experiment-file", "fmu", "operate", "report", "start", "watch", "workers")
LONG += ("policy-and-mjcf", "pybullet")
LONG += ("replay",)  # an example and a script of the gallery replay recordings, too
"""Pages that only `make docs` and `make thorough` run: long campaigns, several of them, or many processes."""
CTXVAL = ["-c", "from ctxval.cli import main; main()"]


def require_server(command: list[str]) -> None:
    """Check that a server starts, at a free port, that its page can be read, and that Ctrl-C stops it."""
    process = subprocess.Popen(
        [*command, "--port", "0"], stdout=subprocess.PIPE, env={**os.environ, "PYTHONUNBUFFERED": "1"}, text=True
    )
    assert process.stdout is not None
    try:
        place = re.search(r":(\d+/\S*)$", process.stdout.readline().strip())
        assert place is not None
        with urllib.request.urlopen(f"http://127.0.0.1:{place[1]}") as page:
            assert page.status == 200
    finally:
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=30)
    assert process.returncode == 130


def run_console(lines: str) -> None:
    for line in lines.splitlines():
        status = int(found[1]) if (found := re.search(r"# exit status (\d+)$", line)) else 0
        program, *arguments = shlex.split(line.removeprefix("$ ").removesuffix(" &"), comments=True)
        if line.endswith(" &"):
            require_server([sys.executable, *CTXVAL, *arguments])
        elif program == "ctxval":  # in this process, which has imported everything
            called = calling()(*arguments)
            assert called.exit_code == status, line + called.output
        else:
            assert program == "python", line
            done = subprocess.run([sys.executable, *arguments], capture_output=True, text=True)
            assert done.returncode == status, line + done.stdout + done.stderr


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The folder of a page, with its modules; another page or test may have modules of the same names."""
    forget_modules(tmp_path.parent)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "100")
    monkeypatch.syspath_prepend(tmp_path)
    yield tmp_path
    forget_modules(tmp_path)


def forget_modules(folder: Path) -> None:
    for name, module in [*sys.modules.items()]:
        if (getattr(module, "__file__", None) or "").startswith(str(folder)):
            del sys.modules[name]


@pytest.mark.slow
@pytest.mark.usefixtures("folder")
@pytest.mark.parametrize(
    "page",
    [pytest.param(page, id=page.stem, marks=pytest.mark.thorough if page.stem in LONG else ()) for page in PAGES],
)
def test_the_blocks_of_a_page_run(page: Path) -> None:
    for module in NEEDS.get(page.stem, []):
        pytest.importorskip(module)
    names: dict[str, object] = {"__name__": "page"}
    for language, content in blocks(page):
        first, _, rest = content.partition("\n")
        if first.startswith("# file: "):
            Path(first.removeprefix("# file: ")).write_text(rest)
        elif language == "console":
            run_console(content)
        elif language == "text":
            continue  # what is printed, or an installation
        else:
            assert language == "python", f"{page.name} has a block that nobody runs: {language}"
            exec(compile(content, page.name, "exec"), names)


@pytest.mark.parametrize("page", EVERY_PAGE, ids=lambda page: page.stem)
def test_commands_and_files_of_a_page_have_names_that_exist(page: Path) -> None:
    """Without running them, which only `make docs` does on every page."""
    for language, content in blocks(page):
        if language == "console":
            for line in content.splitlines():
                parse_command(line)
        elif language == "toml":
            table = tomllib.loads(content)
            is_mapping = "mapping.toml" in content.partition("\n")[0] or "observer" in table
            reads = LogMapping.from_table if is_mapping else ExperimentSettings.model_validate
            (PolicyContract.from_table if "network" in table else reads)(table)


def parse_command(line: str) -> None:
    """Check the command and its options, if a line calls ``ctxval``."""
    program, *arguments = shlex.split(line.removeprefix("$ ").removesuffix(" &"), comments=True) or [""]
    if program.rpartition("/")[2] != "ctxval":
        return
    group: Any = typer.main.get_command(app)
    name, command, rest = group.resolve_command(group.context_class(group), arguments)
    command.make_parser(command.context_class(command, info_name=name)).parse_args(rest)


@pytest.mark.parametrize("line", ["runs pendulum", "run pendulum --bugdet 3"])
def test_a_command_or_an_option_that_does_not_exist_is_noticed(line: str) -> None:
    with pytest.raises(Exception, match="No such"):
        parse_command(f"$ ctxval {line}")


@pytest.mark.slow
@pytest.mark.thorough
def test_mypy_finds_names_that_do_not_exist_in_scripts_and_in_pages(tmp_path: Path) -> None:
    """`make check` checks the manual, the examples and the benchmarks; each of these contents of a file is wrong."""
    page = tmp_path / "page.md"
    page.write_text("```python\nimport ctxval\nctxval.Task([0.0], goal=[0.0], horizont=3)\n```\n")
    wrong = {
        "docs/conf.py": python_files(page)["page.py"],
        "examples/gallery/plot_4_linear.py": "from ctxval.no_such_module import Task\n",
        "benchmarks/walks.py": "import ctxval\n\n\ndef untyped(pair):\n    return ctxval.Task.no_such_name\n",
        "src/ctxval/__main__.py": "def untyped(x):\n    return x\n",
    }
    command = [sys.executable, "-m", "mypy"]
    for number, (name, content) in enumerate(wrong.items()):
        (tmp_path / f"{number}.py").write_text(content)
        command += ["--shadow-file", name, str(tmp_path / f"{number}.py")]
    done = subprocess.run([*command, *wrong], capture_output=True, text=True, cwd=DOCS.parent, check=False)
    for name in wrong:
        assert f"{name}:" in done.stdout, done.stdout + done.stderr


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_links_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", page.read_text()):
        assert (page.parent / target).exists(), target


def test_every_adapter_has_a_page() -> None:
    from ctxval import controllers, models, systems

    text = "".join(page.read_text() for page in HOW_TO)
    own = {"MuJoCo", "Gymnasium", "FMU", "Function", "Subprocess", "Manual", "ScikitLearn", "Onnx", "state_space"}
    own |= {"MPC", "StationaryLQR", "LQR", "ILQR", "OnnxPolicy", "Policy", "write_controller", "read_controller"}
    for name in own:
        assert any(hasattr(room, name) for room in (controllers, models, systems)), name
        assert f".{name}" in text or f"`{name}" in text, name
