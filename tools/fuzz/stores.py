# SPDX-License-Identifier: Apache-2.0
"""Damage to the SQLite file of a study: its tables, its values and its bits."""

from __future__ import annotations

import sqlite3
from contextlib import closing, suppress
from random import Random

from tools.fuzz.values import CELLS, NAMES

JOURNAL = slice(18, 20)
"""Bytes of a file that say whether it has a write-ahead log, which a copy in memory cannot have."""

COLUMNS = {
    "study": ("name", "value"),
    "cells": ("id", "levels"),
    "blocks": ("key", "cell", "block", "trials", "scores", "seconds", "digest"),
}

CHANGES = (
    "CREATE TRIGGER t AFTER INSERT ON blocks BEGIN DELETE FROM blocks; END",
    "CREATE TRIGGER t BEFORE UPDATE ON study BEGIN SELECT RAISE(IGNORE); END",
    "CREATE VIEW v AS SELECT * FROM blocks",
    "CREATE INDEX i ON blocks (seconds)",
    "CREATE INDEX i ON blocks (abs(length(scores)))",
    "CREATE TABLE more (x)",
    "CREATE VIRTUAL TABLE f USING fts5(x)",
    "ALTER TABLE blocks ADD COLUMN more TEXT DEFAULT 'x'",
    "ALTER TABLE blocks RENAME COLUMN seconds TO minutes",
    "ALTER TABLE cells RENAME TO other",
    "DROP TABLE cells",
    "DROP TABLE blocks; CREATE VIEW blocks AS SELECT 1 AS key",
    "DELETE FROM study",
    "DELETE FROM cells",
    "DELETE FROM blocks",
    "INSERT INTO cells VALUES (99, '{}', x'00')",
    "INSERT INTO study VALUES ('more', 'x', x'00')",
    "INSERT INTO blocks SELECT key, cell, block + 9, trials, scores, seconds, digest FROM blocks",
    "UPDATE blocks SET scores = zeroblob(4000000)",
    "UPDATE cells SET levels = replace(levels, '\"', '''')",
    "UPDATE study SET value = replace(value, '1', '2')",
    "UPDATE study SET value = replace(hex(zeroblob(20000)), '00', '[')",
    "PRAGMA user_version = 1",
    "PRAGMA user_version = -1",
    "PRAGMA application_id = 0",
    "PRAGMA encoding = 'UTF-16'; VACUUM",
    "PRAGMA page_size = 512; VACUUM",
    "PRAGMA auto_vacuum = 1; VACUUM",
    "PRAGMA writable_schema = ON; UPDATE sqlite_schema SET sql = replace(sql, 'INTEGER', 'TEXT')",
    "PRAGMA writable_schema = ON; UPDATE sqlite_schema SET rootpage = 99 WHERE name = 'blocks'",
    "PRAGMA writable_schema = ON; DELETE FROM sqlite_schema WHERE name = 'cells'",
)
"""SQL that changes a store, of which nothing may run when the store is read."""


def mutate_store(content: bytes, rng: Random) -> tuple[bytes, str] | None:
    """Return a damaged store and the name of the damage; None where it cannot be opened."""
    with closing(sqlite3.connect(":memory:")) as connection, suppress(sqlite3.Error):
        changed = bytearray(content)
        changed[JOURNAL] = b"\1\1"
        connection.deserialize(bytes(changed))
        if rng.random() < 0.5:
            name, change = "schema", rng.choice(CHANGES)
        else:
            name, change = "value", _draw_update(rng)
        with suppress(sqlite3.Error):  # then the part that ran is the damage
            connection.executescript(change)
        changed = bytearray(connection.serialize())
        changed[JOURNAL] = content[JOURNAL]
        return bytes(changed), name
    return None


def _draw_update(rng: Random) -> str:
    """Return an update of a column of one row, or of all."""
    table = rng.choice([*COLUMNS, "blocks"])
    column = rng.choice(COLUMNS[table])
    text = rng.choice([*CELLS, *NAMES]).replace("'", "''").replace("\0", "")
    value = rng.choice(
        [
            f"'{text}'",
            f"x'{rng.randbytes(rng.choice([1, 8, 32])).hex()}'",
            str(rng.choice([0, 1, -1, 7, 2**62, 1e300, -1.5])),
            "NULL",
            f"CAST({column} AS TEXT)",
            f"CAST({column} AS BLOB)",
            f"substr({column}, 2)",
            f"{column} + 1",
            f"{column} || {column}",
            "9e999",
        ]
    )
    limit = "" if rng.random() < 0.4 else f" WHERE rowid = {rng.choice([1, 2, 3])}"
    return f"UPDATE OR REPLACE {table} SET {column} = {value}{limit}"
