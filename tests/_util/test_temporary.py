from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from ctxval._util import temporary as module
from ctxval._util.locks import FileLock
from ctxval._util.temporary import TemporaryFolder, temporary_folder

HOLD = """
import sys
from ctxval._util.temporary import TemporaryFolder
folder = TemporaryFolder()
(folder.path / "file").write_text("content")
print(folder.path, flush=True)
sys.stdin.read()
"""

FORK = """
import os, subprocess, sys
from ctxval._util.temporary import TemporaryFolder, temporary_folder
mine = TemporaryFolder()
child = os.fork()
if not child:
    with temporary_folder():
        os._exit(0 if mine.path.exists() else 1)
print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0)
code = "from ctxval._util.temporary import TemporaryFolder; TemporaryFolder()"
subprocess.run([sys.executable, "-c", code], check=True)
print(mine.path.exists())
"""


@pytest.fixture(autouse=True)
def own_temporary_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Keep the folders of other tests out of it, here and in the processes that are started."""
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr(tempfile, "tempdir", None)
    return tmp_path


def held_elsewhere() -> tuple[subprocess.Popen[str], Path]:
    """Return a process that has a folder, and the folder."""
    holder = subprocess.Popen([sys.executable, "-c", HOLD], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert holder.stdout is not None
    return holder, Path(holder.stdout.readline().strip())


def ended(holder: subprocess.Popen[str], number: int) -> None:
    holder.send_signal(number)
    holder.communicate()


def test_a_folder_is_empty_and_goes_in_the_end(tmp_path: Path) -> None:
    with temporary_folder() as folder:
        assert folder.is_dir()
        assert not list(folder.iterdir())
        (folder / "file").write_text("content")
    assert not list(tmp_path.iterdir())


def test_it_goes_after_an_error(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError), temporary_folder():
        raise RuntimeError("something else")
    assert not list(tmp_path.iterdir())


def test_what_a_killed_process_leaves_goes_with_the_next() -> None:
    holder, left = held_elsewhere()
    ended(holder, signal.SIGKILL)
    assert (left / "file").exists()
    with temporary_folder():
        assert not left.exists()
        assert not left.parent.exists()


def test_folders_in_use_stay_whoever_has_them() -> None:
    mine = TemporaryFolder()
    holder, theirs = held_elsewhere()
    for _ in range(3):
        with temporary_folder():
            assert mine.path.exists()
            assert (theirs / "file").exists()
    ended(holder, signal.SIGKILL)
    mine.remove()


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="there is no fork on this system")
def test_a_fork_leaves_its_parents_folder_alone() -> None:
    done = subprocess.run([sys.executable, "-c", FORK], capture_output=True, text=True)
    assert done.stdout.split() == ["True", "True"], done.stderr


def test_what_somebody_else_made_there_stays(tmp_path: Path) -> None:
    other = tmp_path / "ctxval-notes"
    other.mkdir()
    with temporary_folder():
        pass
    assert other.exists()


def test_without_locks_a_folder_is_made_and_removed_all_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(path: Path) -> FileLock:
        raise OSError("no locks available")

    monkeypatch.setattr(module, "FileLock", refused)
    with temporary_folder() as folder:
        assert folder.is_dir()
    assert not list(tmp_path.iterdir())
