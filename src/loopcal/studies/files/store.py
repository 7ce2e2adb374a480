# SPDX-License-Identifier: Apache-2.0
"""The folder of a study: the study file as written, its robot files, and the store, one SQLite file
with one row for each block of trials. A new folder takes its name when it is complete, so a driver
that is killed leaves no half of one.

Only the driver of a study writes it, one transaction for each block. What was committed survives a
driver that is killed (write-ahead log). The lock of a driver is one of the folder, which the
operating system releases when the driver ends in whatever way. Others can read meanwhile.

Tables: `study` (name -> value), `cells` (levels as JSON) and `blocks` (key, cell, block, trials,
scores as float64 of little end, seconds of computation), each row with the SHA-256 digest of what
it says.

A store may come from others, so nothing in it runs: its tables are compared with ours before
anything else is asked, which excludes triggers and views. The types and the length of a block are
checked before it is read, and its digest when it is; the digests of the other tables always.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
import sqlite3
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from loopcal.engine import get_current_engine
from loopcal.errors import FileError, LoopcalError
from loopcal.findings import report_finding
from loopcal.io.core.limits import YAML_SIZE
from loopcal.io.core.outputs import replace_folder
from loopcal.io.core.text_file import lock, open_folder, read_bytes, resolve_links
from loopcal.studies.specification import NUMERICS, Study, list_conflicts
from loopcal.typing import FloatArray, Progress, report_no_progress
from loopcal.version import __version__

# Types of network and cluster file systems, of folders that a virtual machine shares, and of user
# programs on macOS, most of which reach a network.
NETWORK = (
    *("9p", "acfs", "afpfs", "afs", "beegfs", "ceph", "cephfs", "cifs", "coda", "davfs", "fhgfs"),
    *("ftp", "gfs", "gfs2", "glusterfs", "gpfs", "lustre", "macfuse", "mmfs", "ncpfs", "nfs"),
    *("nfs3", "nfs4", "ocfs2", "orangefs", "osxfuse", "panfs", "pvfs2", "quobyte", "smb3", "smbfs"),
    *("vboxsf", "virtiofs", "wekafs", "webdav"),
)

# File systems of user programs, but for those that are known to use a local disk.
NETWORK_IN_USER_SPACE = re.compile(
    r"fuse\.(?!ext|ntfs|exfat|overlay|fuse-overlayfs|bindfs|portal|gvfsd|lxcfs|gocryptfs|encfs)"
)


def find_network_file_system(folder: Path) -> str | None:
    """Return the type of the network file system that a folder is on, such as `nfs4`.

    None on a local disk, or where the system does not say it. SQLite's write-ahead log needs memory
    that all its users share, which network file systems do not have. Of a folder that does not
    exist, the place where it would be made counts.
    """
    import psutil

    path = folder.resolve()
    if path.anchor.startswith("\\\\"):  # to which Windows resolves the letter of a network drive
        return "network drive"
    found, depth = None, -1
    for mount in psutil.disk_partitions(all=True):  # the last one of equal mounts counts
        place, kind = Path(mount.mountpoint), mount.fstype
        if path.is_relative_to(place) and len(place.parts) >= depth:
            is_network = kind in NETWORK or NETWORK_IN_USER_SPACE.match(kind) is not None
            if sys.platform == "darwin":
                is_network |= "local" not in mount.opts.split(",")
            found, depth = kind if is_network else None, len(place.parts)
    return found


NAME = "study.sqlite"  # file name of a store in the folder of its study
FORMAT = 3  # version of the tables; a store of another one is refused
APPLICATION = 0x6C6F6F70  # by which SQLite knows a file of ours ("loop")
LONGEST_NAME = 200  # characters of the name of a block in messages
PATIENCE = 30.0  # seconds to wait for another program that locks the file
TABLES = f"""
BEGIN;
PRAGMA application_id = {APPLICATION};
PRAGMA user_version = {FORMAT};
CREATE TABLE study (name TEXT PRIMARY KEY, value TEXT NOT NULL, digest BLOB NOT NULL)
    WITHOUT ROWID;
CREATE TABLE cells (id INTEGER PRIMARY KEY, levels TEXT NOT NULL UNIQUE, digest BLOB NOT NULL);
CREATE TABLE blocks (
    key TEXT NOT NULL,
    cell INTEGER NOT NULL REFERENCES cells (id),
    block INTEGER NOT NULL,
    trials INTEGER NOT NULL,
    scores BLOB NOT NULL,
    seconds REAL NOT NULL,
    digest BLOB NOT NULL,
    UNIQUE (cell, block)
);
COMMIT;
"""

Levels = Mapping[str, str]
"""Factor -> name of its level: what a cell is called, whatever else a study contains."""


# Bytes of a value in a store, which SQLite checks before it takes memory. A block of 2,000 trials
# with 1,000 scores has 16 million.
LONGEST = 1 << 26
# Whether a block has the types and the length of one with this number of scores.
HAS_SHAPE = """
typeof(key) = 'text' AND typeof(block) = 'integer' AND block >= 0
AND typeof(trials) = 'integer' AND trials > 0 AND typeof(seconds) = 'real'
AND seconds BETWEEN 0 AND 1e12 AND typeof(scores) = 'blob' AND length(scores) = 8 * trials * ?
AND typeof(blocks.digest) = 'blob' AND typeof(levels) = 'text'
"""

WITH_CELLS = "FROM blocks LEFT JOIN cells ON cells.id = blocks.cell"
OF_CELL = "FROM blocks WHERE cell = (SELECT id FROM cells WHERE levels = ?)"


@dataclass(frozen=True)
class StoreHeader:
    """What a store says about its study.

    specification : the study as JSON. columns : names of the scores. versions : program or part ->
        version that made the store.
    """

    specification: str
    columns: tuple[str, ...]
    versions: Mapping[str, str]


class CellCount(NamedTuple):
    """How much of one cell is stored."""

    blocks: int
    trials: int
    seconds: float


@dataclass(frozen=True, eq=False)
class StudyStore:
    """An open store; see `open_store` and `read_store`."""

    path: Path
    connection: sqlite3.Connection

    def ask(self, question: str, *values: Any) -> Iterator[tuple[Any, ...]]:
        """Yield the rows that answer a question of SQL."""
        with _report_errors(self.path):
            yield from self.connection.execute(question, values)

    @property
    def header(self) -> StoreHeader:
        """What the store says about its study."""
        rows = {}
        try:
            for name, value, digest in self.ask("SELECT * FROM study"):
                if _compute_digest(name, value, b"") != digest:
                    raise ValueError("other texts")
                rows[name] = value
            columns, versions = json.loads(rows["columns"]), json.loads(rows["versions"])
            if not isinstance(columns, list) or not isinstance(versions, dict):
                raise ValueError("other types")
            "".join((rows["specification"], *columns)).encode()  # all are text
            return StoreHeader(rows["specification"], tuple(columns), versions)
        except (KeyError, TypeError, ValueError, RecursionError):
            raise FileError.of("store.damaged", self.path) from None

    @cached_property
    def study(self) -> Study:
        """Its study, see `load_specification`."""
        return load_specification(self)

    @cached_property
    def width(self) -> int:
        """Number of columns."""
        return len(self.header.columns)

    def set_header(self, header: StoreHeader) -> None:
        """Replace what the store says about its study."""
        rows = {
            "specification": header.specification,
            "columns": json.dumps(header.columns),
            "versions": json.dumps(dict(header.versions)),
        }
        with _report_errors(self.path), self.connection:
            digested = [(*row, _compute_digest(*row, b"")) for row in rows.items()]
            self.connection.executemany("REPLACE INTO study VALUES (?, ?, ?)", digested)

    def add_block(
        self, key: str, levels: Levels, block: int, scores: FloatArray, seconds: float
    ) -> bool:
        """Store a block in one transaction, with its number in its cell, its scores (B, s) and the
        seconds of its computation; return whether it is new.

        Raises FileError: it cannot be written, as on a full disk. Then nothing of it is stored.
        """
        assert scores.shape == (len(scores), self.width), scores.shape
        content, trials = np.ascontiguousarray(scores, dtype="<f8").tobytes(), len(scores)
        digest = _compute_digest(_name_cell(levels), key, block, trials, seconds, content)
        # sqlite3 knows "INSERT" by the locale's small letters, which in Turkish are "\u0131nsert":
        # the transaction would not begin, and no row be counted
        with _report_errors(self.path), self.connection:
            done = self.connection.execute(
                "insert INTO blocks VALUES (?, ?, ?, ?, ?, ?, ?) "
                "ON CONFLICT (cell, block) DO NOTHING",
                (key, self._find_cell(levels), block, trials, content, float(seconds), digest),
            )
        return done.rowcount == 1

    def list_keys(self, levels: Levels, blocks: range) -> frozenset[str]:
        """Return the keys of the stored blocks of a cell with these numbers."""
        question = f"SELECT key {OF_CELL} AND block >= ? AND block < ?"
        rows = self.ask(question, _name_cell(levels), blocks.start, blocks.stop)
        return frozenset(key for (key,) in rows)

    def count_cell(self, levels: Levels) -> CellCount:
        """Return how much of a cell is stored."""
        sums = "SELECT count(*), coalesce(sum(trials), 0), coalesce(sum(seconds), 0)"
        return CellCount(*next(self.ask(f"{sums} {OF_CELL}", _name_cell(levels))))

    def count_blocks(self, levels: Levels, blocks: range) -> int:
        """Return how many of these blocks of a cell are stored."""
        question = f"SELECT count(*) {OF_CELL} AND block >= ? AND block < ? AND (block - ?) % ? = 0"
        bounds = (blocks.start, blocks.stop, blocks.start, blocks.step)
        return int(next(self.ask(question, _name_cell(levels), *bounds))[0])

    @contextmanager
    def keep_state(self) -> Iterator[None]:
        """Let the body read one state of the store, although a driver adds blocks meanwhile."""
        if self.connection.in_transaction:
            yield
            return
        with _report_errors(self.path), self.connection:
            self.connection.execute("BEGIN")
            yield

    def read_blocks(self, levels: Levels) -> Iterator[tuple[int, FloatArray]]:
        """Yield the blocks of a cell with their numbers, in this order: (number, (B, s) scores).

        Raises FileError: a block is damaged.
        """
        for _, block, trials, _, content, _ in self._read_intact(levels):
            yield block, np.frombuffer(content, dtype="<f8").reshape(trials, self.width)

    def copy_blocks(self, other: StudyStore, levels: Levels) -> int:
        """Store the blocks of a cell of another store, and return how many are new.

        Raises FileError: a block is damaged.
        """
        with _report_errors(self.path), self.connection:
            cell = self._find_cell(levels)
            before = self.connection.total_changes
            self.connection.executemany(
                "insert INTO blocks (key, block, trials, seconds, scores, digest, cell) "
                f"VALUES (?, ?, ?, ?, ?, ?, {cell}) ON CONFLICT (cell, block) DO NOTHING",
                other._read_intact(levels),  # another store of this class
            )
            return self.connection.total_changes - before

    def _read_intact(self, levels: Levels) -> Iterator[tuple[Any, ...]]:
        """Yield the blocks of a cell: key, number, trials, seconds, content and digest."""
        name = _name_cell(levels)
        question = f"SELECT key, block, trials, seconds, scores, digest {OF_CELL} ORDER BY block"
        for row in self.ask(question, name):
            if _compute_digest(name, *row[:-1]) != row[-1]:
                raise FileError.of(
                    "store.block-damaged", self.path, block=_name_block(name, row[1])
                )
            yield row

    def find_misshapen(self) -> dict[int, str]:
        """Return the rows of blocks with wrong types or lengths, or of a cell whose text has
        another digest, and the names of these blocks.

        Types and lengths are known without the content, which may be longer than LONGEST.
        """
        question = f"SELECT blocks.rowid {WITH_CELLS} WHERE NOT ({HAS_SHAPE})"
        width, usual = self.width, self.connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, 2**31 - 1)
        rows = [row for (row,) in self.ask(question, width)]
        for cell in self._find_changed_cells():
            rows += [row for (row,) in self.ask("SELECT rowid FROM blocks WHERE cell = ?", cell)]
        self.connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, usual)
        question = f"SELECT levels, block {WITH_CELLS} WHERE blocks.rowid = ?"
        found = {row: next(self.ask(question, row), None) for row in rows}
        if None in found.values():  # an index lists rows that the table does not have
            raise FileError.of("store.damaged", self.path)
        return {row: _name_block(*names) for row, names in found.items() if names}

    def remove_damaged(self) -> tuple[str, ...]:
        """Remove all damaged blocks, which are then computed again, and return their names."""
        damaged, cells = self.find_misshapen(), self._find_changed_cells()
        with _report_errors(self.path), self.connection:
            remove = "DELETE FROM blocks WHERE rowid = ?"
            self.connection.executemany(remove, [(row,) for row in damaged])
            self.connection.executemany("DELETE FROM cells WHERE id = ?", [(c,) for c in cells])
            changed = dict(self._find_changed())
            self.connection.executemany(remove, [(row,) for row in changed])
        return (*damaged.values(), *changed.values())

    def check(self) -> None:
        """Read the whole store, and raise FileError where it is damaged."""
        if next(self.ask("PRAGMA quick_check(1)")) != ("ok",):
            raise FileError.of("store.damaged", self.path)
        for _, block in self._find_changed():
            raise FileError.of("store.block-damaged", self.path, block=block)

    def _find_changed(self) -> Iterator[tuple[int, str]]:
        """Yield the rows and names of the well-shaped blocks whose digest is another."""
        columns = "levels, key, block, trials, seconds, scores"
        for row, digest, *block in self.ask(
            f"SELECT blocks.rowid, blocks.digest, {columns} {WITH_CELLS}"
        ):
            if _compute_digest(*block) != digest:
                yield row, _name_block(block[0], block[2])

    def _find_changed_cells(self) -> list[int]:
        """Return the rows of the cells whose digest is another."""
        rows = self.ask("SELECT id, CAST(levels AS TEXT), digest FROM cells")
        return [cell for cell, name, digest in rows if _compute_digest(name, b"") != digest]

    def _find_cell(self, levels: Levels) -> int:
        """Return the row of a cell, which is made where it is missing."""
        name = _name_cell(levels)
        question = "insert OR IGNORE INTO cells (levels, digest) VALUES (?, ?)"
        self.connection.execute(question, (name, _compute_digest(name, b"")))
        (cell,) = self.connection.execute("SELECT id FROM cells WHERE levels = ?", (name,))
        return int(cell[0])


def _name_cell(levels: Levels) -> str:
    """Return a text for the levels of a cell, whatever their order."""
    return json.dumps(dict(levels), sort_keys=True, ensure_ascii=False)


def _name_block(levels: object, block: object) -> str:
    """Return a name of a block for messages."""
    cell = "no cell" if levels is None else f"the cell {levels}"
    return f"block {block} of {cell}"[:LONGEST_NAME]


def _compute_digest(*values: Any) -> bytes:
    """Return the SHA-256 digest of what a row says: texts and numbers, and content (bytes) behind
    them. A block says the name of its cell first.
    """
    *head, content = values
    return hashlib.sha256(json.dumps(head).encode() + content).digest()


def make_store(folder: Path, header: StoreHeader, named: Path | None = None) -> None:
    """Make an empty store in a folder, which messages call `named`.

    Raises FileError: it cannot be written, or the folder is on a network file system.
    """
    path = folder / NAME
    refuse_network(folder)
    shown = path if named is None else named / NAME
    with (
        _report_errors(shown, "store.not-made"),
        closing(sqlite3.connect(path, timeout=PATIENCE)) as connection,
    ):
        connection.executescript(TABLES)
        StudyStore(path, connection).set_header(header)


@contextmanager
def open_store(folder: Path) -> Iterator[StudyStore]:
    """Open the store of a folder to write it, as its only driver.

    Raises FileError: there is none, another driver has it, it is of another format, or on a network
    file system.
    """
    path = _find_store(folder)
    refuse_network(folder)
    descriptor = open_folder(folder)
    try:
        if descriptor is not None and lock(descriptor) is False:
            raise FileError.of("store.other-driver", folder)
        with _report_errors(path), closing(sqlite3.connect(path, timeout=PATIENCE)) as connection:
            _refuse_others(path, connection)
            connection.execute("PRAGMA journal_mode = WAL")
            connection.execute("PRAGMA synchronous = NORMAL")
            yield StudyStore(path, connection)
    finally:
        if descriptor is not None:
            os.close(descriptor)


@contextmanager
def read_store(folder: Path) -> Iterator[StudyStore]:
    """Open the store of a folder to read it, also while a driver writes it.

    Raises FileError: there is none, it is of another format, or a block is damaged.
    """
    path = _find_store(folder)
    # a copy on a network file system can be read where no driver has left an unfinished log
    log = path.with_name(f"{NAME}-wal")
    is_still = not log.exists() or log.stat().st_size == 0
    is_copy = is_still and find_network_file_system(folder) is not None
    # only a connection that could write removes the files of the log when it is the last one
    is_writable = os.access(path, os.W_OK) and os.access(folder, os.W_OK)
    mode = STILL if is_copy else "mode=rw" if is_writable else "mode=ro"
    is_left = mode != STILL and is_still and not is_driven(folder)
    if is_left and (not is_writable or _is_disk_full(path, mode)):
        mode = STILL  # other modes make files for the log
    with _report_errors(path), closing(_connect(path, mode)) as connection:
        connection.execute("PRAGMA query_only = ON")
        _refuse_others(path, connection)
        store = StudyStore(path, connection)
        for block in store.find_misshapen().values():
            raise FileError.of("store.block-damaged", path, block=block)
        yield store


STILL = "immutable=1"  # the mode of reading a store that nobody writes


def _connect(path: Path, mode: str) -> sqlite3.Connection:
    """Return a connection in a mode of SQLite's addresses."""
    return sqlite3.connect(f"{path.resolve().as_uri()}?{mode}", timeout=PATIENCE, uri=True)


def _is_disk_full(path: Path, mode: str) -> bool:
    """Return whether a store cannot be read in this mode because the disk takes no more."""
    try:
        with closing(_connect(path, mode)) as connection:
            connection.execute("SELECT count(*) FROM sqlite_schema").fetchone()
    except (sqlite3.Error, UnicodeError) as error:  # the latter of an overwritten schema
        return getattr(error, "sqlite_errorcode", 0) & 0xFF in FULL
    return False


def is_driven(folder: Path) -> bool:
    """Return whether a driver writes the store of a folder now."""
    descriptor = open_folder(folder)
    if descriptor is None:
        return False
    try:
        return lock(descriptor) is False
    finally:
        os.close(descriptor)


def refuse_network(folder: Path) -> None:
    """Raise FileError where a folder is on a network file system."""
    kind = find_network_file_system(folder)
    if kind is not None:
        raise FileError.of("store.network-file-system", folder, kind=kind)


def _find_store(folder: Path) -> Path:
    """Return the path of a store, or refuse a folder without one."""
    path = folder / NAME
    if not path.is_file():
        raise FileError.of("store.missing", folder, file=NAME)
    return path


def _refuse_others(path: Path, connection: sqlite3.Connection) -> None:
    """Raise FileError for a file of another program or version, or with other tables than ours."""
    connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, LONGEST)
    connection.text_factory = partial(str, encoding="utf-8", errors="surrogateescape")
    connection.execute("PRAGMA trusted_schema = OFF")
    (application,) = connection.execute("PRAGMA application_id").fetchone()
    (version,) = connection.execute("PRAGMA user_version").fetchone()
    if application != APPLICATION:
        raise FileError.of("store.damaged", path)
    if version != FORMAT:
        raise FileError.of("store.other-format", path, found=version, known=FORMAT)
    question = "SELECT type, name, tbl_name, sql FROM sqlite_schema"
    with closing(sqlite3.connect(":memory:")) as ours:
        ours.executescript(TABLES)
        if set(connection.execute(question)) != set(ours.execute(question)):
            raise FileError.of("store.damaged", path)


# Errors of a full disk; SQLite calls a file that must not grow an error of input and output.
FULL = {sqlite3.SQLITE_FULL, sqlite3.SQLITE_IOERR}
UNREADABLE = {
    *(sqlite3.SQLITE_NOTADB, sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_SCHEMA),
    *(sqlite3.SQLITE_TOOBIG, sqlite3.SQLITE_MISMATCH),
}


@contextmanager
def _report_errors(path: Path, full: str = "store.disk-full") -> Iterator[None]:
    """Raise FileError in place of every error of SQLite; `full` is the code of a full disk."""
    try:
        yield
    except UnicodeDecodeError as error:
        raise FileError.of("store.damaged", path) from error
    except sqlite3.Error as error:
        number = getattr(error, "sqlite_errorcode", 0) & 0xFF
        reason = str(error)
        if isinstance(error, sqlite3.IntegrityError):
            raise  # a defect: two blocks of one number
        if number in FULL:
            finding = report_finding(full, reason=reason)
        elif number in UNREADABLE or (isinstance(error, sqlite3.DatabaseError) and not number):
            finding = report_finding("store.damaged")
        else:
            finding = report_finding("store.not-accessible", reason=reason)
        raise FileError(finding, path) from error


STUDY_FILE = "study.yaml"  # name of the study file in the folder

PROGRAM, NUMERICS_PART, ENGINE = "loopcal", "numerics", "engine"
"""What has a version in a store; the engine is that of the process that made the store."""


@dataclass(frozen=True)
class StudySource:
    """A study, and the file that describes it (None where it was made in Python)."""

    study: Study
    file: Path | None = None


@contextmanager
def open_study(folder: Path, source: StudySource, resume: bool = False) -> Iterator[StudyStore]:
    """Open the folder of a study as its driver; it is made where it does not exist.

    A folder that was made is removed where the body raises a LoopcalError before it stored a block,
    as where no worker can be reached.

    resume : a folder of the same study is continued. The study may have more replicates or further
        levels than there.

    Raises FileError: the folder contains something else, or another study, or (without `resume`)
    any; or see `open_store`.
    """
    is_new, was_folder, is_used = not (folder / NAME).is_file(), folder.is_dir(), True
    if is_new:
        _make_folder(folder, source)
    elif not resume:
        raise FileError.of("store.in-use", folder)
    try:
        with open_store(folder) as store:
            header, study = store.header, source.study
            if changes := list_conflicts(load_specification(store).to_json(), study.to_json()):
                raise FileError.of("store.specification-changed", folder, changes=changes)
            if header.specification != study.to_json():
                store.set_header(replace(header, specification=study.to_json()))
            try:
                yield store
            except LoopcalError:
                is_used = not is_new or any(store.ask("SELECT 1 FROM blocks LIMIT 1"))
                raise
    finally:
        if not is_used:
            shutil.rmtree(folder, ignore_errors=True)
            if was_folder:
                folder.mkdir(exist_ok=True)


def read_study(folder: Path) -> Study:
    """Return the study of a folder."""
    with read_store(folder) as store:
        return store.study


def load_specification(store: StudyStore) -> Study:
    """Return the study of a store; settings that are new in this version have their defaults.

    Raises FileError: another version made it, whose blocks or settings differ.
    """
    header, part, known = store.header, NUMERICS_PART, str(NUMERICS)
    try:
        if header.versions.get(NUMERICS_PART, "") == str(NUMERICS):
            return Study.from_json(header.specification)
    except (ValueError, RecursionError):  # it has settings that this version does not know
        part, known = PROGRAM, __version__
    found = header.versions.get(part, "")
    raise FileError.of("store.other-numbers", store.path, part=part, found=found, known=known)


def _make_folder(folder: Path, source: StudySource) -> None:
    """Make the folder of a study, with an empty store."""
    refuse_network(folder)
    names = {STUDY_FILE, *(f"{NAME}{end}" for end in ("", "-journal", "-wal", "-shm"))}
    names |= {Path(name).parts[0] for name, _ in _list_files(source)}
    _refuse_content(folder)
    files = {name: read_bytes(path, "file", YAML_SIZE) for name, path in _list_files(source)}
    with replace_folder(folder, _refuse_content, names) as temporary:
        for name, content in files.items():
            file = temporary / name
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_bytes(content)
        study = source.study
        engine = str(get_current_engine())
        versions = {PROGRAM: __version__, NUMERICS_PART: str(NUMERICS), ENGINE: engine}
        columns = tuple(column.name for column in study.columns)
        make_store(temporary, StoreHeader(study.to_json(), columns, versions), folder)


def _refuse_content(folder: Path) -> None:
    """Raise FileError where a folder contains something, or where its name is that of a file."""
    target = resolve_links(folder)
    if target.exists() and not target.is_dir():
        sentence = "this is a file, but a study is a folder. Choose another name"
        raise FileError(sentence, folder)
    if target.is_dir() and any(target.iterdir()):
        code = "store.in-use" if (target / NAME).is_file() else "store.folder-of-others"
        raise FileError.of(code, folder)


def _list_files(source: StudySource) -> Iterator[tuple[str, Path]]:
    """Yield the name in the folder, and the path, of the study file and of the robots and the poses
    in files beside it.
    """
    if source.file is None:
        return
    yield STUDY_FILE, source.file
    robots = (robot.source for robot in source.study.robots.values())
    poses = (level.file for level in source.study.poses.values() if level.file is not None)
    for name in dict.fromkeys((*robots, *poses)):
        path = source.file.parent / name
        is_inside = not Path(name).is_absolute() and ".." not in Path(name).parts
        if is_inside and path.is_file() and name not in (STUDY_FILE, NAME):
            yield name, path


def merge_studies(
    part_folders: Sequence[Path], folder: Path, progress: Progress = report_no_progress
) -> int:
    """Copy the blocks of several folders of one study, which jobs computed, into one folder that is
    made or continued, and return how many are new.

    Raises FileError: a part is of another study or damaged, or a folder cannot be used.
    """
    studies = [read_study(part) for part in part_folders]
    first, largest = max(enumerate(studies), key=lambda item: item[1].replicates)
    for part, study in zip(part_folders, studies, strict=True):
        if changes := list_conflicts(study.to_json(), largest.to_json()):
            code = "store.part-of-other-study"
            raise FileError.of(code, part, other=str(part_folders[first]), changes=changes)
    for part in (*part_folders, *([folder] if (folder / NAME).is_file() else [])):
        with read_store(part) as other:
            other.check()  # before anything is written
    file = part_folders[0] / STUDY_FILE
    source = StudySource(largest, file if file.is_file() else None)
    count = 0
    with open_study(folder, source, resume=True) as store:
        for i, part in enumerate(part_folders):
            progress(i, len(part_folders), "joining folders")
            with read_store(part) as other:
                for cell in other.study.cells:
                    count += store.copy_blocks(other, cell.levels)
    return count
