# SPDX-License-Identifier: Apache-2.0
"""The store keeps what was committed, stores nothing twice, and refuses what it cannot keep."""

from __future__ import annotations

import os
import signal
import sqlite3
import subprocess
import sys
import tempfile
import threading
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from loopcal.errors import FileError
from loopcal.studies.files.store import (
    NAME,
    StoreHeader,
    find_network_file_system,
    is_driven,
    make_store,
    open_store,
    read_store,
)
from loopcal.studies.specification import (
    ErrorsLevel,
    MethodLevel,
    NoiseLevel,
    PosesLevel,
    Robot,
    Study,
    list_conflicts,
)
from tests.findings.expectations import expect_refusal
from tests.io.folder_writing import run_in_copy
from tests.studies.studies import compute_block_key

HEADER = StoreHeader("{}", ("outcome", "position", "rank"), {"numerics": "1"})
A, B = {"robot": "r", "poses": "10"}, {"robot": "r", "poses": "20"}
ROOT = str(Path(__file__).parents[2])
NOBODY = 65534


def make_scores(number: int, trials: int = 4) -> np.ndarray:
    scores = np.random.default_rng(number).normal(size=(trials, 3))
    scores[0, 1] = np.nan
    return scores


@pytest.fixture
def folder(tmp_path) -> Path:
    make_store(tmp_path, HEADER)
    return tmp_path


def test_blocks_are_read_back_to_the_last_bit_in_the_order_of_their_numbers(folder) -> None:
    with open_store(folder) as store:
        for number in (2, 0, 1):
            assert store.add_block(f"key{number}", A, number, make_scores(number), 0.5)
        assert store.add_block("other", B, 0, make_scores(7, 2), 0.25)
    with read_store(folder) as store:
        assert store.header == HEADER
        blocks = list(store.read_blocks(A))
        assert [number for number, _ in blocks] == [0, 1, 2]
        assert all(np.array_equal(b, make_scores(n), equal_nan=True) for n, b in blocks)
        swapped = dict(reversed(A.items()))
        assert [number for number, _ in store.read_blocks(swapped)] == [0, 1, 2]
        assert (store.count_cell(A).blocks, store.count_cell(A).trials) == (3, 12)
        assert store.count_cell(A).seconds == pytest.approx(1.5)
        assert store.count_blocks(A, range(1, 9, 2)) == 1
        assert store.list_keys(B, range(10)) == {"other"}
        assert store.count_cell({"robot": "unknown"}).blocks == 0
        assert list(store.read_blocks({"robot": "unknown"})) == []


def test_block_that_is_computed_twice_is_stored_once(folder) -> None:
    with open_store(folder) as store:
        assert store.add_block("key", A, 0, make_scores(0), 0.5)
        assert not store.add_block("key", A, 0, make_scores(1), 0.5)
        assert np.array_equal(next(store.read_blocks(A))[1], make_scores(0), equal_nan=True)


def test_cells_of_equal_content_have_blocks_of_their_own(folder) -> None:
    with open_store(folder) as store:
        assert store.add_block("same", A, 0, make_scores(0), 0.5)
        assert store.add_block("same", B, 0, make_scores(0), 0.5)


def test_scores_can_be_read_while_they_are_written(folder) -> None:
    with open_store(folder) as store, read_store(folder) as reader:
        assert reader.count_cell(A).blocks == 0
        store.add_block("key", A, 0, make_scores(0), 0.5)
        assert reader.count_cell(A).blocks == 1
        with pytest.raises(FileError, match="readonly"):
            reader.add_block("key1", A, 1, make_scores(0), 0.5)


KILLED = """
import os, signal, sys
from pathlib import Path
from loopcal.studies.files.store import open_store
from tests.studies.test_store import A, make_scores
with open_store(Path(sys.argv[1])) as store:
    for number in range(10):
        store.add_block(f"key{number}", A, number, make_scores(number), 0.1)
        print(number, flush=True)
    store.connection.execute("INSERT INTO cells VALUES (7, 'unfinished', x'')")
    os.kill(os.getpid(), signal.SIGKILL)
"""


def test_every_committed_block_survives_a_killed_driver_and_the_lock_does_not(folder) -> None:
    environment = os.environ | {"PYTHONPATH": f"{ROOT}/src:{ROOT}"}
    done = subprocess.run(
        [sys.executable, "-c", KILLED, folder], env=environment, capture_output=True, check=False
    )
    assert done.returncode == -signal.SIGKILL
    assert not is_driven(folder)
    with open_store(folder) as store:
        assert is_driven(folder)
        blocks = dict(store.read_blocks(A))
        assert sorted(blocks) == list(range(10))
        assert all(np.array_equal(blocks[n], make_scores(n), equal_nan=True) for n in blocks)
        assert store.connection.execute("SELECT count(*) FROM cells").fetchone() == (1,)


def test_second_driver_is_refused_but_may_read(folder) -> None:
    with open_store(folder):
        with expect_refusal("store.other-driver", FileError), open_store(folder):
            pass
        with read_store(folder) as reader:
            assert reader.header == HEADER
    with open_store(folder):
        pass


def test_folder_without_store_and_foreign_files_are_refused(tmp_path) -> None:
    with expect_refusal("store.missing", FileError), open_store(tmp_path):
        pass
    (tmp_path / NAME).write_text("this is not a database, but it has some length" * 40)
    for opens in (open_store, read_store):
        with expect_refusal("store.damaged", FileError), opens(tmp_path):
            pass
    (tmp_path / NAME).unlink()
    foreign = sqlite3.connect(tmp_path / NAME)
    foreign.execute("CREATE TABLE blocks (x)")
    foreign.close()
    with expect_refusal("store.damaged", FileError), open_store(tmp_path):
        pass


def test_store_of_another_format_is_refused_and_unchanged(folder) -> None:
    connection = sqlite3.connect(folder / NAME)
    connection.execute("PRAGMA user_version = 7")
    connection.close()
    before = (folder / NAME).read_bytes()
    for opens in (open_store, read_store):
        with expect_refusal("store.other-format", FileError, found=7, known=3), opens(folder):
            pass
    assert (folder / NAME).read_bytes() == before


@pytest.mark.parametrize("part", ["middle", "end"])
def test_damaged_store_gives_a_sentence(folder, part) -> None:
    with open_store(folder) as store:
        for number in range(200):
            store.add_block(f"key{number}", A, number, make_scores(number, 20), 0.1)
    raw = bytearray((folder / NAME).read_bytes())
    if part == "end":
        raw = raw[: len(raw) // 2]
    else:
        raw[4096 : len(raw) - 4096] = os.urandom(len(raw) - 8192)
    (folder / NAME).write_bytes(raw)
    with pytest.raises(FileError) as caught, read_store(folder) as store:
        list(store.read_blocks(A))
    assert caught.value.code in {"store.damaged", "store.disk-full", "store.not-accessible"}


def test_damaged_part_is_named_where_its_blocks_are_copied(folder, tmp_path) -> None:
    with open_store(folder) as store:
        for number in range(200):
            store.add_block(f"key{number}", A, number, make_scores(number, 20), 0.1)
    raw = (folder / NAME).read_bytes()
    middle = len(raw) // 8192 * 4096
    (folder / NAME).write_bytes(raw[:middle] + bytes(8192) + raw[middle + 8192 :])
    (tmp_path / "whole").mkdir()
    make_store(tmp_path / "whole", HEADER)
    sentence = f"^{folder / NAME}: this file is damaged"
    with pytest.raises(FileError, match=sentence), read_store(folder):
        pass
    with open_store(tmp_path / "whole") as whole, open_store(folder) as part:
        with pytest.raises(FileError, match=f"^{folder / NAME}: this file is damaged"):
            part.check()
        with pytest.raises(FileError, match=f"^{folder / NAME}: this file is damaged"):
            whole.copy_blocks(part, A)


OTHER_TABLES = {
    "trigger": "CREATE TRIGGER t AFTER INSERT ON blocks BEGIN DELETE FROM blocks; END",
    "view": "DROP TABLE study; CREATE VIEW study AS SELECT name, value FROM other",
    "further table": "CREATE TABLE further (x)",
    "virtual table": "CREATE VIRTUAL TABLE further USING fts5(x)",
    "further column": "ALTER TABLE blocks ADD COLUMN more TEXT",
    "other name": "ALTER TABLE cells RENAME TO cell",
    "index": "CREATE INDEX i ON blocks (abs(seconds))",
    "no table": "DROP TABLE blocks",
    "computed column": "ALTER TABLE blocks ADD COLUMN more AS (trials * 2)",
    "statistics": "ANALYZE",
}


@pytest.mark.parametrize("change", OTHER_TABLES.values(), ids=OTHER_TABLES)
def test_store_with_other_tables_is_refused_before_any_of_its_sql_runs(folder, change) -> None:
    with open_store(folder) as store:
        store.add_block("key", A, 0, make_scores(0), 0.1)
    connection = sqlite3.connect(folder / NAME)
    connection.executescript(change)
    connection.close()
    before = (folder / NAME).read_bytes()
    for opens in (open_store, read_store):
        with expect_refusal("store.damaged", FileError), opens(folder):
            pass
    assert (folder / NAME).read_bytes() == before


WRONG_BLOCKS = {
    **{f"{c} text": f"{c} = 'two'" for c in ("block", "trials", "seconds", "scores", "digest")},
    **{f"{c} number": f"{c} = 1.5" for c in ("block", "trials", "scores", "digest", "key")},
    **{f"{c} bytes": f"{c} = x'00ff'" for c in ("block", "trials", "seconds", "key", "scores")},
    **{f"{c} negative": f"{c} = -1" for c in ("block", "trials", "seconds")},
    **{f"{c} huge": f"{c} = 9223372036854775807" for c in ("trials", "cell", "block")},
    "infinite": "seconds = 1e999",
    "no UTF-8": "key = CAST(x'ff' AS TEXT)",
    "other scores": "scores = zeroblob(length(scores))",
    "one bit": "scores = CAST(x'01' || substr(scores, 2) AS BLOB)",
    "other number": "block = 77",
    "other cell": "cell = 2",
    "other key": "key = 'a key'",
    "other seconds": "seconds = 0.2",
    "90 MB": "scores = zeroblob(90000000)",
}
"""What is wrong with a block -> its change."""


@pytest.mark.parametrize("change", WRONG_BLOCKS.values(), ids=WRONG_BLOCKS)
def test_damaged_block_is_named_and_its_place_becomes_free(folder, tmp_path, change) -> None:
    with open_store(folder) as store:
        for number in range(5):
            store.add_block(f"key{number}", A, number, make_scores(number), 0.1)
        store.add_block("key", B, 0, make_scores(9), 0.1)
    with closing(sqlite3.connect(folder / NAME)) as connection, connection:
        connection.execute(f"UPDATE blocks SET {change} WHERE key = 'key3'")
    sentence = r"block .* of (the|no) cell .*is damaged"
    with pytest.raises(FileError, match=sentence) as caught, read_store(folder) as store:
        _ = list(store.read_blocks(A)), list(store.read_blocks(B))
    assert caught.value.code == "store.block-damaged"
    with open_store(folder) as store:
        (name,) = store.remove_damaged()
        assert name in str(caught.value)
        assert store.remove_damaged() == ()
        assert store.add_block("key3", A, 3, make_scores(3), 0.1)
    with read_store(folder) as store:
        for number, scores in store.read_blocks(A):
            np.testing.assert_array_equal(scores, make_scores(number))


COLUMNS = {
    "study": ("name", "value", "digest"),
    "cells": ("id", "levels", "digest"),
    "blocks": ("key", "cell", "block", "trials", "scores", "seconds", "digest"),
}


@pytest.mark.parametrize(("table", "column"), [(t, c) for t in COLUMNS for c in COLUMNS[t]])
def test_a_change_of_any_column_is_named(folder, table, column) -> None:
    with open_store(folder) as store:
        store.add_block("key", A, 0, make_scores(0), 0.1)
        store.add_block("key", B, 0, make_scores(1), 0.1)
    with closing(sqlite3.connect(folder / NAME)) as connection, connection:
        listed = connection.execute(f"SELECT name, type FROM pragma_table_info('{table}')")
        types = dict(listed.fetchall())
        assert tuple(types) == COLUMNS[table]
        blob = f"CAST(substr({column}, 2) || x'07' AS BLOB)"
        text, number = f"replace({column}, substr({column}, 3, 1), 'x')", f"{column} + 7"
        change = {"BLOB": blob, "TEXT": text}.get(types[column], number)
        first = f"(SELECT min({'name' if table == 'study' else 'rowid'}) FROM {table})"
        row = f"{'name' if table == 'study' else 'rowid'} = {first}"
        assert connection.execute(f"UPDATE {table} SET {column} = {change} WHERE {row}").rowcount
    code = "store.damaged" if table == "study" else "store.block-damaged"
    with expect_refusal(code, FileError), read_store(folder) as store:
        _ = store.header, list(store.read_blocks(A)), list(store.read_blocks(B))
    if table != "study":
        with open_store(folder) as store:
            assert len(store.remove_damaged()) == 1
            store.add_block("key", A, 0, make_scores(0), 0.1)
        with read_store(folder) as store:
            assert [len(list(store.read_blocks(levels))) for levels in (A, B)] == [1, 1]


def test_readers_leave_no_file_beside_a_store_that_no_driver_has(folder) -> None:
    with open_store(folder) as store:
        store.add_block("key", A, 0, make_scores(0), 0.5)
        with read_store(folder) as reader:
            assert reader.count_cell(A).blocks == 1
        assert (folder / f"{NAME}-wal").exists()  # of the driver, which goes on
        store.add_block("key2", A, 1, make_scores(1), 0.5)
    before = (folder / NAME).read_bytes()
    for _ in range(2):
        with read_store(folder) as reader:
            assert reader.count_cell(A).blocks == 2
    assert [path.name for path in folder.iterdir()] == [NAME]
    assert (folder / NAME).read_bytes() == before


@pytest.mark.forks
@pytest.mark.skipif(os.name == "nt" or os.geteuid() != 0, reason="needs permissions to drop")
def test_store_in_a_folder_of_another_user_is_read() -> None:
    with tempfile.TemporaryDirectory() as place:
        Path(place).chmod(0o755)
        make_store(Path(place), HEADER)
        with open_store(Path(place)) as store:
            store.add_block("key", A, 0, make_scores(0), 0.5)

        def count_blocks() -> int:
            os.setuid(NOBODY)
            with read_store(Path(place)) as store:
                return store.count_cell(A).blocks

        assert run_in_copy(count_blocks) == (0, 1)
        assert [path.name for path in Path(place).iterdir()] == [NAME]


FULL = """
import sys
from contextlib import suppress
from pathlib import Path
from loopcal.errors import FileError
from loopcal.studies.files.store import make_store, open_store, read_store
from tests.studies.test_store import A, HEADER, make_scores
folder, closed = Path("disk/study"), Path("disk/closed")
for each in (folder, closed):
    each.mkdir()
    make_store(each, HEADER)
with open_store(closed) as store:
    store.add_block("key", A, 0, make_scores(0), 0.1)
number = 0
with open_store(folder) as store:
    try:
        while number < 10000:
            store.add_block(f"key{number}", A, number, make_scores(number, 50), 0.1)
            number += 1
    except FileError as error:
        print(error.code, number > 5)
        print(store.count_cell(A).blocks == number)
with read_store(folder) as store:
    print([n for n, _ in store.read_blocks(A)] == list(range(number)))
with open("disk/other", "wb", buffering=0) as other, suppress(OSError):
    while True:
        other.write(bytes(512))
with read_store(closed) as store:
    print(store.count_cell(A).blocks == 1)
try:
    make_store(Path("disk"), HEADER)
except FileError as error:
    print(error.code)
"""


@pytest.mark.slow
def test_full_disk_loses_only_the_block(tmp_path) -> None:
    (tmp_path / "disk").mkdir()
    mount = "mount -t tmpfs -o size=400k none disk"
    probe = subprocess.run(["unshare", "-m", "sh", "-c", mount], cwd=tmp_path, check=False)
    if probe.returncode != 0:
        pytest.skip("no small disk can be mounted here")
    words = ["unshare", "-m", "sh", "-c", f'{mount} && exec "$0" -c "$1"', sys.executable, FULL]
    environment = os.environ | {"PYTHONPATH": f"{ROOT}/src:{ROOT}"}
    done = subprocess.run(
        words, cwd=tmp_path, capture_output=True, text=True, check=False, env=environment
    )
    assert done.stdout.splitlines() == [
        *("store.disk-full True", "True", "True", "True", "store.not-made")
    ], done.stderr


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("specification", "CAST(x'7ba6' AS TEXT)"),  # no UTF-8
        ("columns", "'7'"),
        ("columns", "'{'"),
        ("columns", "'[1, 2, 3]'"),
        ("columns", "replace(hex(zeroblob(50000)), '00', '[')"),  # deep
        ("versions", "x'7b7d7d'"),
        ("specification", "x'00'"),
        ("versions", "'[]'"),
        ("versions", "CAST(x'ff' AS TEXT)"),
    ],
)
def test_header_that_was_damaged_gives_a_sentence(folder, name, value) -> None:
    with open_store(folder) as store, store.connection:
        store.connection.execute(f"UPDATE study SET value = {value} WHERE name = '{name}'")
    with expect_refusal("store.damaged", FileError), read_store(folder) as store:
        assert store.header


def test_schema_that_is_no_text_gives_a_sentence(folder) -> None:
    with open_store(folder) as store:
        store.add_block("key", A, 1, make_scores(1, 20), 0.1)
    raw = (folder / NAME).read_bytes()
    (folder / NAME).write_bytes(raw.replace(b"CREATE TABLE", b"CREATE\xa0TABLE"))
    (folder / f"{NAME}-wal").touch()  # as a driver that was killed leaves it
    with expect_refusal("store.damaged", FileError), read_store(folder):
        pass


MOUNTS = {
    "linux": [
        *(("/", "ext4", "rw"), ("/proc", "proc", "rw"), ("/srv", "nfs4", "rw")),
        *(("/srv/me/local disk", "xfs", "rw"), ("/mnt/share", "fuse.sshfs", "rw")),
        ("/mnt/share", "cifs", "rw"),
        *((f"/mnt/{k}", f"fuse.{k}", "rw") for k in ("sshfs", "rclone", "ntfs-3g", "overlayfs")),
    ],
    "darwin": [
        *(("/", "apfs", "ro,local"), ("/Volumes/my share", "smbfs", "rw,nosuid")),
        *(("/Volumes/nfs", "nfs", "rw"), ("/Volumes/sshfs", "macfuse", "rw,local")),
        *(("/Volumes/STICK", "msdos", "rw,local"), ("/Volumes/other", "otherfs", "rw")),
    ],
}
"""System -> what psutil says of its mounts: place, type, options."""


def mount(monkeypatch, mounts: list[tuple[str, str, str]], system: str = "linux") -> None:
    """Let psutil find these mounts."""
    found = [SimpleNamespace(mountpoint=p, fstype=kind, opts=opts) for p, kind, opts in mounts]
    monkeypatch.setattr("psutil.disk_partitions", lambda **_: found)
    monkeypatch.setattr(sys, "platform", system)


@pytest.mark.parametrize(
    ("system", "path", "found"),
    [
        ("linux", "/var/study", None),
        ("linux", "/srvwork", None),
        ("linux", "/srv/me/study", "nfs4"),
        ("linux", "/srv/me/local disk/study", None),
        ("linux", "/mnt/share/a", "cifs"),
        ("linux", "/mnt/sshfs/a", "fuse.sshfs"),
        ("linux", "/mnt/rclone/a", "fuse.rclone"),
        ("linux", "/mnt/ntfs-3g/a", None),
        ("linux", "/mnt/overlayfs/a", None),
        ("darwin", "/opt/study", None),
        ("darwin", "/Volumes/my share/study", "smbfs"),
        ("darwin", "/Volumes/nfs", "nfs"),
        ("darwin", "/Volumes/sshfs/a", "macfuse"),
        ("darwin", "/Volumes/STICK/a", None),
        ("darwin", "/Volumes/other/a", "otherfs"),
    ],
)
def test_file_system_is_that_of_the_deepest_and_latest_mount(
    system, path, found, monkeypatch
) -> None:
    mount(monkeypatch, MOUNTS[system], system)
    assert find_network_file_system(Path(path)) == found


def test_mounts_of_this_computer_are_found(tmp_path) -> None:
    assert find_network_file_system(tmp_path) is None


def test_network_file_system_is_refused_but_a_complete_copy_there_is_read(
    folder, tmp_path, monkeypatch
) -> None:
    with open_store(folder) as store:
        store.add_block("key", A, 0, make_scores(0), 0.5)
    mount(monkeypatch, [("/", "ext4", "rw"), (str(tmp_path), "nfs4", "rw")])
    with expect_refusal("store.network-file-system", FileError, kind="nfs4"), open_store(folder):
        pass
    with expect_refusal("store.network-file-system", FileError):
        make_store(tmp_path, HEADER)
    with read_store(folder) as store:
        assert store.count_cell(A).blocks == 1


def test_many_readers_and_a_writer_do_not_disturb_each_other(folder) -> None:
    problems: list[BaseException] = []

    def read() -> None:
        try:
            for _ in range(20):
                with read_store(folder) as reader:
                    assert all(scores.shape == (4, 3) for _, scores in reader.read_blocks(A))
        except BaseException as error:  # noqa: BLE001 shown below
            problems.append(error)

    readers = [threading.Thread(target=read) for _ in range(3)]
    with open_store(folder) as store:
        for reader in readers:
            reader.start()
        for number in range(100):
            store.add_block(f"key{number}", A, number, make_scores(number), 0.1)
        for reader in readers:
            reader.join()
    assert problems == []


STUDY = Study(
    "title",
    robots={"r": Robot("five-bar", "text of the robot")},
    errors={"small": ErrorsLevel(1.0), "wide": ErrorsLevel(2.0)},
)


@pytest.mark.parametrize(
    "changed",
    [
        STUDY,
        replace(STUDY, title="another"),
        replace(STUDY, replicates=5000),
        replace(STUDY, errors={**STUDY.errors, "wider": ErrorsLevel(4.0)}),
        replace(STUDY, noise={"1": NoiseLevel(1.0), "2": NoiseLevel(2.0)}),
        replace(STUDY, order=("errors", "robot")),
    ],
)
def test_more_replicates_and_further_levels_keep_finished_blocks(changed) -> None:
    assert list_conflicts(STUDY.to_json(), changed.to_json()) == ()


@pytest.mark.parametrize(
    ("changed", "sentence"),
    [
        (replace(STUDY, seed=2), "seed: 1 -> 2"),
        (replace(STUDY, block=10), "block: 50 -> 10"),
        (replace(STUDY, replicates=10), "replicates: 1000 -> 10 (allowed: more)"),
        (replace(STUDY, errors={"small": ErrorsLevel(1.0)}), "errors/wide: removed"),
        (
            replace(STUDY, errors={**STUDY.errors, "wide": ErrorsLevel(3.0)}),
            "errors/wide/tolerance_factor: 2.0 -> 3.0",
        ),
        (
            replace(STUDY, methods={"auto": MethodLevel("map")}),
            'methods/auto/method: "auto" -> "map"',
        ),
        (
            replace(STUDY, robots={"r": Robot("five-bar", "another text" * 9)}),
            "robots/r/text: changed",
        ),
        (replace(STUDY, scores=replace(STUDY.scores, held_out=9)), "scores/held_out: 20 -> 9"),
    ],
)
def test_other_changes_are_named(changed, sentence) -> None:
    assert list_conflicts(STUDY.to_json(), changed.to_json()) == (sentence,)


def test_other_names_of_files_with_the_same_content_keep_finished_blocks() -> None:
    old, new = (
        replace(
            STUDY,
            robots={"r": Robot(f"{name}.yaml", "text of the robot")},
            poses={"p": PosesLevel(1, file=f"{name}.csv", coordinates=((0.1, 0.2),))},
        )
        for name in ("old", "new")
    )
    keys = [compute_block_key(study, study.cells[0], 0) for study in (old, new)]
    assert keys[0] == keys[1]
    assert list_conflicts(old.to_json(), new.to_json()) == ()
