"""The reader of each kind of log, by the suffix of a file or the content of a folder."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from ctxval.data.log import Log
from ctxval.data.matlab import read_mat
from ctxval.data.messages import BagLog, McapLog
from ctxval.data.parquet import ParquetTable, read_lerobot
from ctxval.data.tables import CsvLog, read_npz
from ctxval.errors import InputError

READERS: dict[str, Callable[[Path], list[Log]]] = {
    ".csv": lambda path: [CsvLog(path)],
    ".npz": read_npz,
    ".mat": read_mat,
    ".parquet": lambda path: [ParquetTable(path)],
    ".mcap": lambda path: [McapLog(path)],
    ".db3": lambda path: [BagLog(path)],
    ".bag": lambda path: [BagLog(path)],
}
"""The reader of each suffix."""


def read_logs(paths: Sequence[str | Path]) -> list[Log]:
    """Return the logs in files and folders; nothing in them is ever run.

    A folder is a bag of ROS 2 if it has a file ``metadata.yaml``, a LeRobot data set if it has ``meta/info.json``, and
    otherwise all logs in it are read, in the order of their names.
    """
    logs = [log for path in paths for log in _logs(Path(path))]
    if not logs:
        raise InputError("there is no log: give at least one file or folder.")
    return logs


def is_log(path: Path) -> bool:
    """Return whether a path can only be a log of a program: no CSV or NPZ file, and no plain folder."""
    if path.is_dir():
        return (path / "metadata.yaml").is_file() or is_lerobot(path)
    return path.suffix.lower() in READERS and path.suffix.lower() not in (".csv", ".npz")


def is_lerobot(path: Path) -> bool:
    """Return whether a folder is a LeRobot data set."""
    return (path / "meta" / "info.json").is_file()


def _logs(path: Path) -> list[Log]:
    if path.is_dir():
        if (path / "metadata.yaml").is_file():
            return [BagLog(path)]
        if is_lerobot(path):
            return read_lerobot(path)
        files = [file for file in sorted(path.iterdir()) if file.suffix.lower() in READERS]
        if not files:
            raise InputError(f"the folder {path} has no log: {_KINDS}.")
        return [log for file in files for log in _logs(file)]
    if not path.exists():
        raise InputError(f"there is no file {path}.")
    reader = READERS.get(path.suffix.lower())
    if reader is None:
        raise InputError(f"{path} is not a log that can be read: {_KINDS}.")
    return reader(path)


_KINDS = (
    f"files must end in {', '.join(READERS)}, and folders must be bags of ROS 2 or LeRobot data sets, or contain such "
    "files"
)
