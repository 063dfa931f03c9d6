"""The operator's page of a rig that people operate, served by the command line in a process of its own."""

from __future__ import annotations

import contextlib
import csv
import http.client
import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ctxval.core.exchange import read_controller, read_task
from ctxval.core.rollout import rollout
from rig_cli import SMALL, calling

MODULE = """
from ctxval import Experiment, Task, TaskSpace, Validation, controllers, distances, models, systems


def experiment(seed, name="rig", goal="goal", unit="m"):
    rig = systems.Manual(states={"position": "m", "speed": "m/s"}, inputs={"force": "N"}, dt=0.1)
    validation = Validation(
        space=TaskSpace(**{goal: (0.5, 2.0, unit)}),
        task=lambda p: Task([0, 0], goal=[p.points[..., 0], 0], horizon=20, dt=rig.dt),
        system=rig,
        model=models.Linear([[1, 0.1], [0, 1]], [[0], [0.1]]),
        synthesizer=controllers.LQR([10, 1], [0.1], limits=3.0),
        distance=distances.FinalState(weights=[1, 1]),
    )
    return Experiment(name, validation, threshold=2.0, units=unit)


HOSTILE = "<script>document.title='run'</script><img src=x onerror=alert(1)>"


def hostile(seed):
    return experiment(seed, HOSTILE, HOSTILE + " $x {{7*7}}", "'\\"><b>m")


def slow(seed):
    made = experiment(seed)
    designed = made.validation.synthesizer.design

    class Slow:
        def design(self, task, model):
            import sys
            import time

            if "serve" in sys.argv:  # in the server alone
                time.sleep(0.5)
            return designed(task, model)

    made.validation.synthesizer = Slow()
    return made
"""


def ctxval(*arguments: str, folder: Path) -> dict[str, Any]:
    """Run a command of ctxval in a folder with the rig in it; return its JSON object."""
    (folder / "my_rig.py").write_text(MODULE)
    sys.modules.pop("my_rig", None)  # that of another folder
    with contextlib.chdir(folder):
        done = calling()(*arguments, "--json")
    assert done.exit_code in (0, 1), done.output
    report: dict[str, Any] = json.loads(done.stdout)
    return report


@dataclass
class Server:
    """A running server.

    Attributes:
        process: its process.
        address: the address of the page, with the token if there is one.
        port: the port.
    """

    process: subprocess.Popen[str]
    address: str
    port: int

    def request(
        self, method: str, path: str, body: bytes | Iterator[bytes] | None = None, **headers: str | None
    ) -> Response:
        """Send one request; an underscore in the name of a header is a hyphen, and None leaves a header out."""
        given = {name.replace("_", "-"): value for name, value in headers.items()}
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=60)
        try:
            connection.putrequest(method, path, skip_host="Host" in given, skip_accept_encoding=True)
            chunked = body is not None and not isinstance(body, bytes)
            if isinstance(body, bytes):
                given.setdefault("Content-Length", str(len(body)))
            elif chunked:
                given["Transfer-Encoding"] = "chunked"
            for name, value in given.items():
                if value is not None:
                    connection.putheader(name, value)
            # A server may answer and close before it has the whole body.
            with contextlib.suppress(BrokenPipeError, ConnectionResetError):
                connection.endheaders(body, encode_chunked=chunked)
            answer = connection.getresponse()
            return Response(answer.status, dict(answer.getheaders()), answer.read())
        finally:
            connection.close()

    def stop(self) -> tuple[int, str]:
        """Stop the server as Ctrl-C does; return its status and what it printed on stderr."""
        self.process.send_signal(signal.SIGINT)
        _, said = self.process.communicate(timeout=120)
        return self.process.returncode, said


@dataclass(frozen=True)
class Response:
    """The response to one request."""

    status: int
    headers: Mapping[str, str]
    content: bytes

    @property
    def text(self) -> str:
        """The content as text."""
        return self.content.decode()

    @property
    def cookie(self) -> str:
        """The cookie of the session, as the browser sends it back."""
        return self.headers["set-cookie"].partition(";")[0]

    @property
    def token(self) -> str:
        """The token of the forms."""
        found = re.search(r'name="token" value="([0-9a-f]+)"', self.text)
        assert found is not None
        return found[1]


@contextmanager
def serving(folder: Path, *arguments: str, port: int = 0) -> Iterator[Server]:
    """Serve the store of a folder; port 0 is any free one."""
    command = [*SMALL, "serve", "a.sqlite", "--port", str(port), *arguments]
    environment = {**os.environ, "PYTHONUNBUFFERED": "1"}
    process = subprocess.Popen(
        command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment
    )
    assert process.stdout is not None
    first = process.stdout.readline()
    found = re.search(r"http://\S+?:(\d+)/\S*", first)
    if found is None:
        _, said = process.communicate(timeout=120)
        raise AssertionError(f"{first}{said}")
    server = Server(process, found[0], int(found[1]))
    try:
        yield server
    finally:
        if process.poll() is None:
            server.stop()
        for stream in (process.stdout, process.stderr):
            if stream is not None:
                stream.close()


def new_store(folder: Path, reference: str = "rig.toml") -> None:
    """Make a store with one open trial; the experiment of the file needs no tests of predictions."""
    (folder / "rig.toml").write_text('experiment = "my_rig:experiment"\n\n[certificate]\ntests = 0\n')
    ctxval("ask", reference, "--store", "a.sqlite", folder=folder)


def record(files: Path, path: Path, *, rate: float = 0.98, steps: int | None = None) -> Path:
    """Do what a rig does with the files alone: read them, run, and write a recording as CSV."""
    found, task = read_controller(files / "controller.json"), read_task(files / "task.json")

    def step(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        return np.array([x[0] + 0.1 * x[1], rate * x[1] + 0.1 * u[0]])

    run = rollout(step, found.controller, task)
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["t", "position [m]", "speed [m/s]", "force [N]"])
        for k, state in enumerate(run.states.tolist()[:steps]):
            writer.writerow([run.times[k], *state, run.inputs[k, 0] if k < run.horizon else ""])
    return path
