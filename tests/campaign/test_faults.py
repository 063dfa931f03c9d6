"""Everything that goes wrong with a store: damage, full and read-only disks, clocks, many trials, any order of acts."""

from __future__ import annotations

import contextlib
import csv
import json
import os
import shutil
import sqlite3
import subprocess
import sys
import tempfile
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule
from typer.testing import CliRunner

from conftest import make_validation
from ctxval import Campaign, Store, Trajectory, searches
from ctxval.campaign.storage.disks import StoreWarning, file_system
from ctxval.campaign.storage.recovery import recover
from ctxval.campaign.storage.rows import Side
from ctxval.cli import app
from ctxval.errors import CtxvalError, ForeignStoreError, InputError, StoreAccessError, StoreError
from facts import assert_names, refuses, warns
from rig_cli import SMALL
from rig_thorough import more

HERE = Path(__file__).parents[1]
SEARCH = searches.Random


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store with trials of every kind."""
    path = tmp_path_factory.mktemp("store") / "whole.sqlite"
    campaign = Campaign(make_validation(), search=SEARCH(), store=path, seed=2).run(12)
    campaign.tell(campaign.ask(), failed="motor stalled")
    campaign.ask()
    campaign.add({"goal": 1.0}, distance=0.5)
    campaign.store.close()
    return path


def facts(store: Store) -> list[tuple[object, ...]]:
    return [
        (t.number, t.origin, t.state, t.unit_point.tobytes(), t.distance, t.failure, t.executed, t.attempts)
        for t in store.trials()
    ]


def command(*arguments: str) -> tuple[int, str, str]:
    result = CliRunner().invoke(app, list(arguments))
    return result.exit_code, result.stdout, result.stderr.replace("\n", " ")


# Damage


def test_a_whole_store_is_exported_whole(whole: Path, tmp_path: Path) -> None:
    status, stdout, _ = command("export", str(whole), "--out", str(tmp_path / "out"), "--json")
    report = json.loads(stdout)
    assert (status, report["trials"], report["damaged"]) == (0, 15, [])
    assert report["trajectories"] == 12 * 2 + 3
    with (tmp_path / "out" / "trials.csv").open() as file:
        rows = list(csv.DictReader(file))
    trials = Store(whole).trials()
    assert [float(row["distance"]) for row in rows[:12]] == [trial.distance for trial in trials[:12]]
    assert (rows[12]["failure"], rows[14]["origin"], rows[14]["goal"]) == ("motor stalled", "manual", "1.0")
    content = json.loads((tmp_path / "out" / "trials.json").read_text())
    assert content["experiment"]["seed"] == 2
    kept = Trajectory.from_csv(tmp_path / "out" / "trajectories" / "3.system.csv")
    original = Store(whole).trajectory(3, "system")
    assert original is not None
    np.testing.assert_array_equal(kept.states, original.states)


@pytest.mark.parametrize("share", [0.02, 0.25, 0.5, 0.75, 0.98])
def test_a_cut_store_is_a_clear_error_and_what_is_readable_is_exported(
    whole: Path, tmp_path: Path, share: float
) -> None:
    cut = tmp_path / "cut.sqlite"
    data = whole.read_bytes()
    cut.write_bytes(data[: int(share * len(data))])
    before = cut.read_bytes()
    status, _, stderr = command("status", str(cut))
    assert status == 2
    assert_names(stderr, "cut.sqlite")
    status, stdout, stderr = command("export", str(cut), "--json")
    assert cut.read_bytes() == before
    found = recover(cut)
    if not found.trials and not found.trajectories:
        assert share < 0.1
        assert status == 2
        return
    assert status == 0, stderr
    report = json.loads(stdout)
    assert report["damaged"]
    assert report["trials"] == 15 or share < 0.5
    trials = {trial.number: trial.distance for trial in Store(whole).trials()}
    for number, trial in found.trials.items():
        assert trial.distance == trials[number]


def test_rows_that_cannot_be_read_are_told_together(whole: Path, tmp_path: Path) -> None:
    broken = tmp_path / "broken.sqlite"
    shutil.copy(whole, broken)
    with contextlib.closing(sqlite3.connect(broken)) as connection:
        page = connection.execute("PRAGMA page_size").fetchone()[0]
        root = connection.execute("SELECT rootpage FROM sqlite_master WHERE name = 'trajectories'").fetchone()[0]
    data = bytearray(broken.read_bytes())
    data[(root - 1) * page : root * page] = b"\xff" * page
    broken.write_bytes(bytes(data))
    found = recover(broken)
    assert len(found.trials) == 15
    assert len(found.damaged) < 5
    assert_names(found.damaged, 0)


Everything = tuple[list[tuple[object, ...]], list[tuple[bytes, bytes, bytes] | None]]


def everything(store: Store) -> Everything:
    """Read all that a store holds."""
    assert isinstance(store.description(), dict)
    assert isinstance(store.settings(), dict)
    both: tuple[Side, Side] = ("model", "system")
    sides = [store.trajectory(trial.number, side) for trial in store.trials() for side in both]
    kept = [None if t is None else (t.times.tobytes(), t.states.tobytes(), t.inputs.tobytes()) for t in sides]
    return facts(store), kept


def check_damaged(path: Path, expected: Everything) -> bool:
    """Whether the damage is noticed; where it is not, everything must be as it was."""
    try:
        store = Store.existing(path)
    except (ForeignStoreError, StoreAccessError, InputError):
        return True
    try:
        found = everything(store)
    except (ForeignStoreError, StoreAccessError):
        return True
    finally:
        store.close()
    assert found == expected
    return False


@pytest.mark.thorough
def test_flipped_bytes_are_noticed_or_harmless(whole: Path, tmp_path: Path) -> None:
    expected, data = everything(Store(whole)), whole.read_bytes()
    rng = np.random.default_rng(0)
    noticed = 0
    for number in range(60):
        broken = bytearray(data)
        for position in rng.integers(len(data), size=1 + number % 3):
            broken[position] ^= int(rng.integers(1, 256))
        path = tmp_path / "flipped.sqlite"
        path.write_bytes(bytes(broken))
        noticed += check_damaged(path, expected)
        if number % 10 == 0:
            for arguments in (("status", str(path)), ("export", str(path), "--out", str(tmp_path / "out"))):
                status, _, stderr = command(*arguments)
                assert status in (0, 2), stderr
                assert "Traceback" not in stderr
        for trial in recover(path).trials.values() if number % 5 == 0 else ():
            assert (trial.number, trial.distance) == (expected[0][trial.number][0], expected[0][trial.number][4])
    assert noticed > 24


def test_an_edited_distance_is_noticed(whole: Path, tmp_path: Path) -> None:
    path = tmp_path / "edited.sqlite"
    shutil.copy(whole, path)
    store = Store(path)
    store._execute("UPDATE trials SET distance = distance * 1.5 WHERE number = 3")
    with refuses(ForeignStoreError, 3, "edited.sqlite"):
        store.trials()
    assert 3 not in recover(path).trials
    assert_names(recover(path).damaged, 3)


def test_a_missing_trial_is_noticed(whole: Path, tmp_path: Path) -> None:
    path = tmp_path / "short.sqlite"
    shutil.copy(whole, path)
    store = Store(path)
    store._execute("DELETE FROM trials WHERE number = 3")
    with refuses(ForeignStoreError, 3, "short.sqlite"):
        store.trials()


@pytest.mark.parametrize("content", [b"", b"\x00" * 5000, b"SQLite format 3\x00", b"hello"])
def test_what_is_no_store_is_said_so(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "a.sqlite"
    path.write_bytes(content)
    for name in ("status", "certify", "export"):
        status, _, stderr = command(name, str(path))
        assert status == 2
        assert "store" in stderr
    assert path.read_bytes() == content
    assert not path.with_suffix(".export").exists()
    assert command("export", str(tmp_path / "none"))[0] == 2


# Disks


def long_campaign(store: Path | None) -> Campaign:
    """Return a campaign whose trajectories take several pages of a store."""
    return Campaign(make_validation(horizon=300), search=SEARCH(), store=store, seed=2)


def run_limited(store: Path, budget: int, size: int) -> str:
    """Run while no file can grow beyond a size; return the error."""
    import resource  # no other system than those of POSIX has it

    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    campaign = long_campaign(store)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))
    try:
        with pytest.raises(StoreError) as caught:
            campaign.run(budget)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    campaign.store.close()
    return str(caught.value)


@pytest.mark.slow
def test_a_full_disk_loses_no_execution(tmp_path: Path) -> None:
    store = tmp_path / "a.sqlite"
    campaign = long_campaign(store).run(3)
    campaign.store.close()
    rescued = 0
    for extra in (0, 16384):
        copy = tmp_path / f"{extra}.sqlite"
        shutil.copy(store, copy)
        said = run_limited(copy, 20, store.stat().st_size + extra)
        assert "disk" in said
        campaign = long_campaign(copy)
        kept = list(tmp_path.glob(f"{extra}.trial-*.npz"))
        for path in kept:
            number = int(path.stem.rpartition("-")[2])
            assert f"ctxval tell STORE {number} --npz {path}" in said
            campaign.tell(number, Trajectory.from_npz(path))
        rescued += len(kept)
        assert campaign.run(6).executions == 6
        # Nothing was executed twice.
        assert [trial.attempts for trial in campaign.trials] == [1] * 6
        campaign.store.close()
    expected = long_campaign(None).run(6)
    assert [t.distance for t in campaign.trials] == [t.distance for t in expected.trials]
    assert rescued


@pytest.mark.slow
def test_a_read_only_folder_is_a_clear_error_and_can_still_be_read(whole: Path) -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        shutil.copy(whole, folder / "a.sqlite")
        (folder / "a.sqlite").chmod(0o444)
        folder.chmod(0o555)
        code = (
            "import os, encodings.cp437, encodings.utf_32_le\n"
            "from conftest import make_validation; from ctxval import Campaign, Store, searches\n"
            "from ctxval.errors import StoreAccessError\n"
            "Campaign(make_validation(), search=searches.Random()).run(1)\n"  # imports all that is needed
            "if os.getuid() == 0: os.setgroups([]); os.setgid(65534); os.setuid(65534)\n"
            f"store = {str(folder / 'a.sqlite')!r}\n"
            "print(len(Store.existing(store).trials()))\n"
            "campaign = Campaign(make_validation(), search=searches.Random(), store=store, seed=2)\n"
            "for act in (lambda: campaign.run(20), campaign.ask, lambda: campaign.tell(13, failed='x'),\n"
            f"            lambda: Store({str(folder / 'new.sqlite')!r})):\n"
            "    try: act()\n"
            "    except StoreAccessError as error: print(error)\n"
        )
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=HERE, check=False)
        folder.chmod(0o755)
    lines = done.stdout.splitlines()
    assert lines[0] == "15", done.stderr
    assert len(lines) == 5, done.stdout + done.stderr
    assert all("a.sqlite" in line or "new.sqlite" in line for line in lines[1:])


def test_a_network_file_system_is_warned_of(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    mounts = "proc /proc proc rw 0 0\n/dev/sda1 / ext4 rw 0 0\nserver:/home /home/all\\040of\\040us nfs4 rw 0 0\n"
    assert file_system(Path("/home/all of us/x/a.sqlite"), mounts) == "nfs4"
    assert file_system(Path("/home/x/a.sqlite"), mounts) == "ext4"
    assert file_system(Path("/a.sqlite"), "") == ""
    monkeypatch.setattr("ctxval.campaign.storage.disks.file_system", lambda path, mounts: "nfs4")
    with warns(StoreWarning, "nfs4", "a.sqlite"):
        Store(tmp_path / "a.sqlite")


# Clocks


def test_a_clock_that_is_set_back_changes_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    years = iter(range(2040, 1970, -1))
    monkeypatch.setattr("ctxval.campaign.storage.store.now", lambda: f"{next(years)}-01-01T00:00:00.000+00:00")
    store = tmp_path / "a.sqlite"
    for budget in (3, 6, 8):
        campaign = Campaign(make_validation(), search=SEARCH(), store=store, seed=2).run(budget)
    expected = Campaign(make_validation(), search=SEARCH(), seed=2).run(8)
    assert [t.distance for t in campaign.trials] == [t.distance for t in expected.trials]


# Any order of acts, from two terminals, cut off anywhere


class Acts(RuleBasedStateMachine):
    """Two campaigns on one file, against a list of what must be in it."""

    validation = make_validation(horizon=2)

    def __init__(self) -> None:
        super().__init__()
        self.folder = tempfile.TemporaryDirectory(dir=os.environ.get("PYTEST_DEBUG_TEMPROOT"))
        self.path = Path(self.folder.name) / "a.sqlite"
        self.terminals = [self.opened(), self.opened()]
        self.expected: list[tuple[str, float | None, str | None]] = []

    def opened(self) -> Campaign:
        return Campaign(self.validation, search=SEARCH(), store=self.path, seed=1)

    def teardown(self) -> None:
        for terminal in self.terminals:
            terminal.store.close()
        self.folder.cleanup()

    @rule(who=st.integers(0, 1))
    def ask(self, who: int) -> None:
        assert self.terminals[who].ask().number == len(self.expected)
        self.expected.append(("open", None, None))

    @rule(who=st.integers(0, 1), goal=st.sampled_from([0.5, 1.0, 1.5]))
    def ask_for(self, who: int, goal: float) -> None:
        assert self.terminals[who].ask({"goal": goal}).number == len(self.expected)
        self.expected.append(("open", None, None))

    @rule(who=st.integers(0, 1), number=st.integers(0, 8), distance=st.floats(0, 9), cut=st.booleans())
    def tell(self, who: int, number: int, distance: float, cut: bool) -> None:
        campaign = self.terminals[who]
        if number >= len(self.expected) or self.expected[number][0] != "open":
            with refuses(InputError, number):
                campaign.tell(number, distance=distance)
        elif cut:
            self.cut_off(who, lambda: campaign.tell(number, distance=distance))
        else:
            campaign.tell(number, distance=distance)
            self.expected[number] = ("completed", distance, None)

    @rule(who=st.integers(0, 1), number=st.integers(0, 8))
    def tell_failure(self, who: int, number: int) -> None:
        with contextlib.suppress(InputError):
            self.terminals[who].tell(number, failed="x")
            self.expected[number] = ("failed", None, "x")

    @rule(who=st.integers(0, 1), goal=st.sampled_from([0.5, 2.0]), distance=st.sampled_from([1.0, 2.0]))
    def add(self, who: int, goal: float, distance: float) -> None:
        if self.terminals[who].add({"goal": goal}, distance=distance) is not None:
            self.expected.append(("completed", distance, None))

    @precondition(lambda self: len(self.expected) < 8)
    @rule(who=st.integers(0, 1))
    def run(self, who: int) -> None:
        campaign = self.terminals[who]
        done = sum(state != "open" for state, _, _ in self.expected)
        ended = campaign.run(done + 1).trials[-1]
        self.expected.append((ended.state, ended.distance, ended.failure))

    @rule(who=st.integers(0, 1))
    def die(self, who: int) -> None:
        """Leave without closing, and come again."""
        self.terminals[who].store.close()
        self.terminals[who] = self.opened()

    @rule(who=st.integers(0, 1))
    def die_while_asking(self, who: int) -> None:
        self.cut_off(who, self.terminals[who].ask)

    def cut_off(self, who: int, act: Any) -> None:
        """Interrupt an act in its transaction: it must not have happened."""
        store = self.terminals[who].store

        execute = store._execute

        def cut(statement: str, *values: Any) -> Any:
            if statement == "COMMIT":
                raise KeyboardInterrupt
            return execute(statement, *values)

        store._execute = cut
        with pytest.raises(KeyboardInterrupt):
            act()
        store._execute = execute
        self.die(who)

    @invariant()
    def the_store_has_what_was_done(self) -> None:
        for store in (self.terminals[0].store, self.terminals[1].store):
            assert [(t.state, t.distance, t.failure) for t in store.trials()] == self.expected


TestActs = Acts.TestCase
TestActs.settings = settings(max_examples=settings().max_examples // 2, stateful_step_count=12, deadline=None)


# Readers of files from others


@given(st.binary(max_size=300), st.sampled_from([".csv", ".npz"]))
def test_no_bytes_make_a_reader_of_recordings_stumble(data: bytes, suffix: str) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"run{suffix}"
        path.write_bytes(data)
        with warnings.catch_warnings():
            warnings.simplefilter("error", ResourceWarning)
            for read in (
                lambda: Trajectory.from_csv(path, states=["a"], inputs=["b"]),
                lambda: Trajectory.from_npz(path),
            ):
                with contextlib.suppress(CtxvalError):
                    read()


CELLS = st.sampled_from(["t", "a", "b", "x0", "u0", "1", "2", "nan", "", " ", '"', "1e999"])


@given(st.lists(st.lists(CELLS, max_size=4), max_size=6))
def test_no_cells_make_the_reader_of_csv_stumble(rows: list[list[str]]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "run.csv"
        path.write_text("\n".join(",".join(row) for row in rows))
        with contextlib.suppress(CtxvalError):
            Trajectory.from_csv(path, states=["a"], inputs=["b"])


def test_lines_are_counted_with_the_blank_ones(tmp_path: Path) -> None:
    path = tmp_path / "run.csv"
    path.write_text('t,x0,u0\n\n0,1,2\n\n\n1,"a\nb",2\n')
    with refuses(InputError, 7, "x0"):
        Trajectory.from_csv(path)


# Programs that talk


@pytest.mark.slow
@pytest.mark.parametrize("workers", [*more("1"), "2"])
def test_what_a_system_prints_does_not_spoil_the_json(workers: str, tmp_path: Path) -> None:
    (tmp_path / "talking.py").write_text(
        "import os\nfrom conftest import make_validation\n\n"
        "class Talking:\n"
        "    def execute(self, controller, task):\n"
        "        print('printed')\n"
        "        os.write(1, b'written')\n"
        "        os.system('echo echoed')\n"
        "        return make_validation().system.execute(controller, task)\n\n"
        "validation = make_validation(system=Talking())\n"
    )
    done = subprocess.run(
        [
            *(*SMALL, "run", "talking:validation", "--search", "random"),
            *("--budget", "2", "--store", "a.sqlite", "--workers", workers, "--no-report", "--json"),
        ],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(HERE), *sys.path])},
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["executions"] == 2
    assert all(word in done.stderr for word in ("written", "echoed"))
