from __future__ import annotations

import os
import sqlite3
from contextlib import closing
from pathlib import Path

from conftest import make_validation
from ctxval import Campaign, models, searches
from ctxval.campaign.storage.other_stores import other_stores


def campaign(path: Path, seed: int = 0, budget: int = 2, **parts: object) -> Path:
    made = Campaign(make_validation(**parts), search=searches.Random(), store=path, seed=seed)  # type: ignore[arg-type]
    if budget:
        made.run(budget)
    made.store.close()
    return path


def test_other_campaigns_of_the_same_validation_are_found_and_nothing_is_changed(tmp_path: Path) -> None:
    own = campaign(tmp_path / "own.sqlite")
    rerun = campaign(tmp_path / "rerun.sqlite", seed=1)
    other_search = tmp_path / "search.db"
    Campaign(make_validation(), store=other_search).run(1)
    learned = make_validation().model
    campaign(tmp_path / "again.sqlite", model=models.Linear(learned.A, 1.01 * learned.B, data=learned.data))
    campaign(tmp_path / "other.sqlite", model=models.Linear([[1.0, 0.02], [0.1, 1.0]], [[0.0], [0.1]]))
    campaign(tmp_path / "empty.sqlite", seed=2, budget=0)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    assert [other.path for other in other_stores(own)] == [rerun, other_search]
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_what_is_no_store_or_damaged_is_passed_over(tmp_path: Path) -> None:
    own = campaign(tmp_path / "own.sqlite")
    whole = campaign(tmp_path / "whole.sqlite", seed=1)
    (tmp_path / "text.sqlite").write_text("no database at all")
    (tmp_path / "nothing.sqlite").touch()
    (tmp_path / "folder.sqlite").mkdir()
    (tmp_path / "gone.db").symlink_to(tmp_path / "nowhere")
    content = whole.read_bytes()
    for k in range(8):
        cut = bytearray(content)
        cut[len(cut) * k // 8 : len(cut) * k // 8 + 900] = b"\xff" * 900
        (tmp_path / f"damaged{k}.sqlite").write_bytes(bytes(cut))
    (tmp_path / "short.sqlite").write_bytes(content[: len(content) // 2])
    os.mkfifo(tmp_path / "pipe.sqlite")
    endless = tmp_path / "endless.sqlite"
    endless.write_bytes(content)
    with closing(sqlite3.connect(endless)) as connection:
        connection.executescript(
            "DROP TABLE experiment; CREATE VIEW experiment AS WITH RECURSIVE n(key) AS (SELECT 1 UNION ALL "
            "SELECT key + 1 FROM n) SELECT 'validation' AS key, key AS value FROM n WHERE key < 0"
        )
    beside = {other.path: other.worst for other in other_stores(own)}
    assert beside[whole] is not None
    assert endless not in beside
    assert other_stores(tmp_path / "none.sqlite") == []
    assert other_stores(tmp_path / "text.sqlite") == []
    assert other_stores(tmp_path / "nowhere" / "none.sqlite") == []
