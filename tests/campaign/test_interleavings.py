"""Two processes on one store, switched at every statement of SQLite: nothing is lost, damaged or done twice."""

from __future__ import annotations

import shutil
import sqlite3
import threading
import time
from collections.abc import Callable
from functools import partial
from itertools import combinations_with_replacement
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from ctxval import Campaign, Store, Task, TaskSpace, Validation, controllers, distances, models, searches, systems
from ctxval.campaign.storage import database, schema
from ctxval.errors import CtxvalError
from rig_thorough import more

BUDGET = 2
MODEL = models.Linear([[1.0]], [[0.1]])


class Turns:
    """Lets one of two threads run at a time, and switches after given numbers of statements, or if one must wait."""

    def __init__(self, switches: tuple[int, ...]) -> None:
        self.switches, self.running, self.statements, self.waits = list(switches), 0, 0, 0
        self.alive, self.changed, self.number = {0, 1}, threading.Condition(), threading.local()

    def before_statement(self) -> None:
        me = getattr(self.number, "value", None)
        if me is None:
            return
        with self.changed:
            if self.switches and self.statements == self.switches[0]:
                del self.switches[0]
                self._switch(me)
            self.statements += 1

    def wait(self) -> None:
        """Let the other one run, because this one cannot."""
        self.waits += 1
        assert self.waits < 10_000, "both wait for each other"
        with self.changed:
            self._switch(self.number.value)

    def _switch(self, me: int) -> None:
        if 1 - me in self.alive:
            self.running, self.statements = 1 - me, 0
            self.changed.notify_all()
            assert self.changed.wait_for(lambda: self.running == me, 60)

    def run(self, acts: list[Callable[[], Any]]) -> list[Any]:
        """Return what two functions return or raise."""
        results: list[Any] = [None, None]

        def act(me: int) -> None:
            self.number.value = me
            with self.changed:
                self.changed.wait_for(lambda: self.running == me, 60)
            try:
                results[me] = acts[me]()
            except BaseException as error:
                results[me] = error
            finally:
                with self.changed:
                    self.alive.discard(me)
                    self.running, self.statements = 1 - me, 0
                    self.changed.notify_all()

        threads = [threading.Thread(target=act, args=(me,)) for me in (0, 1)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        return results


class Rig:
    """A system that counts its executions."""

    def __init__(self) -> None:
        self.executed = 0

    def execute(self, controller: Any, task: Task) -> Any:
        self.executed += 1
        return systems.Simulated(models.Linear([[0.9]], [[0.1]])).execute(controller, task)


def validation(rig: Rig) -> Validation:
    return Validation(
        space=TaskSpace(goal=(0.5, 2.0)),
        task=lambda p: Task([0.0], goal=[p.goal], horizon=3, dt=0.1),
        system=rig,
        model=MODEL,
        synthesizer=controllers.LQR([1.0], [0.1]),
        distance=distances.FinalState(),
    )


def act(function: Callable[[Campaign], Any], store: Path, rig: Rig) -> Any:
    one = Store(store)
    try:
        return function(Campaign(validation(rig), search=searches.CMAES(), store=one, seed=0))
    finally:
        one.close()


def tell(one: Campaign) -> int:
    plan = one.validation.plan(one.validation.space.from_unit(one.trials[0].unit_point))
    return one.tell(0, systems.Simulated(models.Linear([[0.9]], [[0.1]])).execute(plan.controller, plan.task)).number


def desk(one: Campaign) -> int:
    """Do what the server does: look again, show what there is, and record a result."""
    one.refresh()
    for trial in one.trials:
        one.trajectories(trial)
    return one.tell(0, distance=0.25).number


ACTS: dict[str, Callable[[Campaign], Any]] = {
    "ask": lambda one: one.ask().number,
    "tell": tell,
    "run": lambda one: one.run(BUDGET).executions,
    "desk": desk,
    "remeasure": lambda one: len(one.remeasure()),
}

SOON = [("tell", "run")]
PAIRS = [*SOON, *more(*((pair,) for pair in combinations_with_replacement(ACTS, 2) if pair not in SOON))]
"""Which acts meet; `make interleavings` and `make thorough` run all of them."""


@pytest.fixture
def interleaved(monkeypatch: pytest.MonkeyPatch) -> Callable[..., tuple[Turns, list[Any]]]:
    turns = [Turns(())]

    class Switched(schema.Guarded):
        def __init__(self, *args: Any, **options: Any) -> None:
            super().__init__(*args, **{**options, "timeout": 0.0})

        def execute(self, *statement: Any) -> sqlite3.Cursor:
            text, *values = statement
            while True:
                if not text.startswith("PRAGMA"):
                    turns[0].before_statement()
                try:
                    return super().execute(text.replace("EXTRA", "OFF"), *values)  # no disk is waited for
                except sqlite3.OperationalError as error:
                    if "locked" not in str(error):
                        raise
                    turns[0].wait()

    def run(acts: list[Callable[[], Any]], switches: tuple[int, ...]) -> tuple[Turns, list[Any]]:
        turns[0] = Turns(switches)
        return turns[0], turns[0].run(acts)

    monkeypatch.setattr(schema, "Guarded", Switched)
    clock = SimpleNamespace(monotonic=time.monotonic, sleep=lambda seconds: turns[0].wait())
    monkeypatch.setattr(database, "time", clock)
    return run


def outcome(template: Path, path: Path, names: tuple[str, str], switches: tuple[int, ...], run: Any) -> int:
    """Check the store after two acts; return the number of switches that did not happen, because an act had ended."""
    shutil.copyfile(template, path)
    rigs = Rig(), Rig()
    turns, results = run([partial(act, ACTS[n], path, rig) for n, rig in zip(names, rigs, strict=True)], switches)
    for result in results:
        if isinstance(result, BaseException):
            assert isinstance(result, CtxvalError), (names, switches, repr(result))
            assert "damaged" not in str(result), (names, switches, str(result))
            assert "cannot be" not in str(result), (names, switches, str(result))
    trials = Store(path).trials()
    told = [r for n, r in zip(names, results, strict=True) if n in ("tell", "desk") and not isinstance(r, Exception)]
    kept = len(list(path.parent.glob(f"{path.stem}.trial-*")))
    executed = sum(trial.executed for trial in trials)
    assert len(told) == len(set(told)), (names, switches)  # no trial is told twice
    assert executed + kept >= sum(rig.executed for rig in rigs) + len(told), (names, switches)  # nothing is lost
    assert executed <= BUDGET + len({"tell", "desk"} & set(names)), (names, switches)
    assert all(trial.state == "completed" for trial in trials if trial.number in told)
    for file in path.parent.glob(f"{path.stem}*"):
        file.unlink()
    return len(turns.switches)


@pytest.fixture(scope="module")
def template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a store with an open trial."""
    path = tmp_path_factory.mktemp("template") / "a.sqlite"
    act(Campaign.ask, path, Rig())
    return path


@pytest.mark.slow
@pytest.mark.parametrize("names", PAIRS, ids="-".join)
def test_two_processes_switched_at_every_statement(
    names: tuple[str, str], template: Path, tmp_path: Path, interleaved: Any, request: pytest.FixtureRequest
) -> None:
    switches = int(request.config.getoption("--switches"))

    def enumerate_from(order: tuple[str, str], before: tuple[int, ...]) -> None:
        at = 1
        while not outcome(template, tmp_path / "a.sqlite", order, (*before, at), interleaved):
            if len(before) + 1 < switches:
                enumerate_from(order, (*before, at))
            at += 1

    for order in {names, names[::-1]}:
        enumerate_from(order, ())
