"""The SQLite statements that create a store or update an older one, in order, each with its title.

A store keeps the titles, and the layout of its tables is compared with these statements: never change an entry.
"""

from __future__ import annotations

MIGRATIONS = (
    (
        "trials, trajectories and the experiment's description",
        """
        CREATE TABLE migrations (version INTEGER PRIMARY KEY, title TEXT NOT NULL, applied_at TEXT NOT NULL);
        CREATE TABLE experiment (key TEXT PRIMARY KEY, value TEXT NOT NULL);
        CREATE TABLE trials (
            number INTEGER PRIMARY KEY,
            origin TEXT NOT NULL,
            state TEXT NOT NULL CHECK (state IN ('open', 'completed', 'failed')),
            unit_point TEXT NOT NULL,
            parameters TEXT NOT NULL,
            attempts INTEGER NOT NULL,
            distance REAL,
            failure TEXT,
            executed INTEGER NOT NULL DEFAULT 0,
            opened_at TEXT NOT NULL,
            closed_at TEXT,
            seconds REAL
        );
        CREATE TABLE trajectories (
            trial INTEGER NOT NULL REFERENCES trials (number),
            side TEXT NOT NULL CHECK (side IN ('model', 'system')),
            npz BLOB NOT NULL,
            PRIMARY KEY (trial, side)
        );
        """,
    ),
    ("what the search thought when it chose a trial", "ALTER TABLE trials ADD COLUMN note TEXT"),
    ("what was run, for commands that go on", "CREATE TABLE settings (key TEXT PRIMARY KEY, value TEXT NOT NULL)"),
    ("a checksum of each trial, as SQLite has none", "ALTER TABLE trials ADD COLUMN checksum INTEGER"),
    ("a checksum of each trajectory with its place", "ALTER TABLE trajectories ADD COLUMN checksum INTEGER"),
    (
        "trials whose distance is not measured, why a task was executed again, and what was changed",
        """
        ALTER TABLE trials ADD COLUMN because TEXT;
        ALTER TABLE trials ADD COLUMN unmeasured INTEGER NOT NULL DEFAULT 0;
        CREATE TABLE history (
            number INTEGER PRIMARY KEY, at TEXT NOT NULL, what TEXT NOT NULL, why TEXT NOT NULL, content TEXT NOT NULL
        )
        """,
    ),
)
