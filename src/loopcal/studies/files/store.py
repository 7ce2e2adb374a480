# SPDX-License-Identifier: Apache-2.0
"""The store of a study: one SQLite file, with one row for each block of trials.

Only the driver of a study writes it, one transaction for each block. What was committed survives a
driver that is killed (write-ahead log). The lock of a driver is one of the folder, which the
operating system releases when the driver ends in whatever way. Others can read meanwhile.

Tables: `study` (name -> value), `cells` (levels as JSON) and `blocks` (key, cell, block, trials,
scores as float64 of little end, seconds of computation).
"""

from __future__ import annotations

import json
import os
import re
import sqlite3
import struct
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from loopcal.errors import FileError
from loopcal.findings import report_finding
from loopcal.io.core.replacement import lock, open_folder
from loopcal.typing import FloatArray

# --- On which file system a folder is: SQLite's write-ahead log needs memory that all its users
# share, which network file systems do not have.

MOUNTS = Path("/proc/self/mountinfo")
"""Where Linux lists what is mounted."""

NETWORK = (
    *("9p", "acfs", "afpfs", "afs", "beegfs", "ceph", "cephfs", "cifs", "coda", "davfs", "fhgfs"),
    *("ftp", "gfs", "gfs2", "glusterfs", "gpfs", "lustre", "macfuse", "mmfs", "ncpfs", "nfs"),
    *("nfs3", "nfs4", "ocfs2", "orangefs", "osxfuse", "panfs", "pvfs2", "quobyte", "smb3", "smbfs"),
    *("vboxsf", "virtiofs", "wekafs", "webdav"),
)
"""Types of network and cluster file systems, of folders that a virtual machine shares, and of user
programs on macOS, most of which reach a network.
"""

NETWORK_IN_USER_SPACE = re.compile(
    r"fuse\.(?!ext|ntfs|exfat|overlay|fuse-overlayfs|bindfs|portal|gvfsd|lxcfs|gocryptfs|encfs)"
)
"""File systems of user programs, but for those that are known to use a local disk."""

STATFS = struct.Struct("=Ii5Q2iIIII16s")
"""Beginning of a `statfs` of macOS: sizes and counts, number, owner, type, flags, subtype, name."""

SIZE_OF_STATFS = 4096
"""Bytes that it has at most."""

LOCAL = 0x1000
"""Flag of a local file system (MNT_LOCAL)."""

_OCTAL = re.compile(r"\\([0-7]{3})")


def find_network_file_system(folder: Path) -> str | None:
    """Return the type of the network file system that a folder is on, such as `nfs4`.

    None where it is on a local disk, or where the system does not say it. Of a folder that does not
    exist, the place where it would be made counts.
    """
    path = folder.resolve()
    if sys.platform == "win32":
        return _find_network_drive(path)
    if sys.platform == "darwin":
        return _find_network_of_macos(path)
    if not MOUNTS.exists():
        return None
    kind = find_type(MOUNTS.read_text("utf-8", errors="surrogateescape"), path)
    return kind if is_network(kind) else None


def is_network(kind: str) -> bool:
    """Return whether a type of file system is one of a network."""
    return kind in NETWORK or NETWORK_IN_USER_SPACE.match(kind) is not None


def find_type(mounts: str, path: Path) -> str:
    """Return the type of the file system of an absolute path; empty where there is none.

    Parameters
    ----------
    mounts : text of the form of /proc/self/mountinfo; the last one of equal mounts counts.

    Examples
    --------
    >>> disk = "1 0 8:1 / / rw - ext4 /dev/a rw"
    >>> server = "2 1 0:40 / /srv rw shared:1 - nfs4 host:/b rw"
    >>> mounts = chr(10).join([disk, server])
    >>> find_type(mounts, Path("/srv/user/study")), find_type(mounts, Path("/tmp"))
    ('nfs4', 'ext4')
    """
    kind, depth = "", -1
    for line in mounts.splitlines():
        before, _, after = line.partition(" - ")
        place = Path(_OCTAL.sub(lambda match: chr(int(match[1], 8)), before.split(" ")[4]))
        if path.is_relative_to(place) and len(place.parts) >= depth:
            kind, depth = after.split(" ")[0], len(place.parts)
    return kind


def parse_statfs(content: bytes) -> tuple[str, bool]:
    """Return the type of a file system, and whether it is a local one, of a `statfs` of macOS."""
    *_, flags, _, name = STATFS.unpack_from(content)
    return name.partition(b"\0")[0].decode("ascii", "replace"), bool(flags & LOCAL)


def _find_network_of_macos(path: Path) -> str | None:
    """Return the type of the file system of a path of macOS where it is one of a network."""
    import ctypes

    while not path.exists() and path != path.parent:
        path = path.parent
    library = ctypes.CDLL(None)
    # the processors of Intel have an older function of the same name
    function = getattr(library, "statfs$INODE64", None) or library.statfs
    buffer = ctypes.create_string_buffer(SIZE_OF_STATFS)
    if function(str(path).encode(sys.getfilesystemencoding(), "surrogateescape"), buffer) != 0:
        return None
    kind, is_local = parse_statfs(buffer.raw)
    return kind if is_network(kind) or not is_local else None


def _find_network_drive(path: Path) -> str | None:
    """Return "network drive" for a path of Windows on one."""
    import ctypes

    remote = 4  # DRIVE_REMOTE
    kind = ctypes.windll.kernel32.GetDriveTypeW(path.anchor)  # type: ignore[attr-defined]
    return "network drive" if kind == remote or path.anchor.startswith("\\\\") else None


NAME = "study.sqlite"
"""File name of a store in the folder of its study."""

FORMAT = 1
"""Version of the tables; a store of another one is refused."""

APPLICATION = 0x6C6F6F70
"""By which SQLite knows a file of ours ("loop")."""

PATIENCE = 30.0
"""Seconds to wait for another program that locks the file."""

TABLES = f"""
BEGIN;
PRAGMA application_id = {APPLICATION};
PRAGMA user_version = {FORMAT};
CREATE TABLE study (name TEXT PRIMARY KEY, value TEXT NOT NULL) WITHOUT ROWID;
CREATE TABLE cells (id INTEGER PRIMARY KEY, levels TEXT NOT NULL UNIQUE);
CREATE TABLE blocks (
    key TEXT NOT NULL,
    cell INTEGER NOT NULL REFERENCES cells (id),
    block INTEGER NOT NULL,
    trials INTEGER NOT NULL,
    scores BLOB NOT NULL,
    seconds REAL NOT NULL,
    UNIQUE (cell, block)
);
COMMIT;
"""

Levels = Mapping[str, str]
"""Factor -> name of its level: what a cell is called, whatever else a study contains."""


@dataclass(frozen=True)
class StoreHeader:
    """What a store says about its study.

    Attributes
    ----------
    specification : the study as JSON. columns : names of the scores. versions : program or part ->
        version that made the store.
    """

    specification: str
    columns: tuple[str, ...]
    versions: Mapping[str, str]


@dataclass(frozen=True)
class CellCount:
    """How much of one cell is stored."""

    blocks: int
    trials: int
    seconds: float


@dataclass(frozen=True, eq=False)
class StudyStore:
    """An open store; see `open_store` and `read_store`."""

    path: Path
    connection: sqlite3.Connection

    @property
    def header(self) -> StoreHeader:
        """What the store says about its study."""
        with _report_errors(self.path):
            rows = dict(self.connection.execute("SELECT name, value FROM study"))
        try:
            columns, versions = json.loads(rows["columns"]), json.loads(rows["versions"])
            if not isinstance(columns, list) or not isinstance(versions, dict):
                raise ValueError("other types")
            return StoreHeader(rows["specification"], tuple(columns), versions)
        except (KeyError, TypeError, ValueError):
            raise FileError(report_finding("store.damaged"), self.path) from None

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
            self.connection.executemany("REPLACE INTO study VALUES (?, ?)", rows.items())

    def add_block(
        self, key: str, levels: Levels, block: int, scores: FloatArray, seconds: float
    ) -> bool:
        """Store a block, in one transaction, and return whether it is new.

        Parameters
        ----------
        key : of the block. levels : of its cell. block : its number in the cell.
        scores : (B, s). seconds : of its computation.

        Raises
        ------
        FileError : it cannot be written, as on a full disk. Then nothing of it is stored.
        """
        assert scores.shape == (len(scores), self.width), scores.shape
        content = np.ascontiguousarray(scores, dtype="<f8").tobytes()
        with _report_errors(self.path), self.connection:
            row = (key, self._find_cell(levels), block, len(scores), content, seconds)
            done = self.connection.execute(
                "INSERT INTO blocks VALUES (?, ?, ?, ?, ?, ?) ON CONFLICT (cell, block) DO NOTHING",
                row,
            )
        return done.rowcount == 1

    def has_blocks(self) -> bool:
        """Return whether any block is stored."""
        with _report_errors(self.path):
            return self.connection.execute("SELECT 1 FROM blocks LIMIT 1").fetchone() is not None

    def list_keys(self, levels: Levels, blocks: range) -> frozenset[str]:
        """Return the keys of the stored blocks of a cell with these numbers."""
        question = (
            "SELECT key FROM blocks WHERE cell = (SELECT id FROM cells WHERE levels = ?) "
            "AND block >= ? AND block < ?"
        )
        row = (_name_cell(levels), blocks.start, blocks.stop)
        with _report_errors(self.path):
            return frozenset(key for (key,) in self.connection.execute(question, row))

    def count_cell(self, levels: Levels) -> CellCount:
        """Return how much of a cell is stored."""
        question = (
            "SELECT count(*), coalesce(sum(trials), 0), coalesce(sum(seconds), 0) FROM blocks "
            "WHERE cell = (SELECT id FROM cells WHERE levels = ?)"
        )
        with _report_errors(self.path):
            return CellCount(*self.connection.execute(question, (_name_cell(levels),)).fetchone())

    def count_blocks(self, levels: Levels, blocks: range) -> int:
        """Return how many of these blocks of a cell are stored."""
        question = (
            "SELECT count(*) FROM blocks WHERE cell = (SELECT id FROM cells WHERE levels = ?) "
            "AND block >= ? AND block < ? AND (block - ?) % ? = 0"
        )
        bounds = (blocks.start, blocks.stop, blocks.start, blocks.step)
        with _report_errors(self.path):
            row = self.connection.execute(question, (_name_cell(levels), *bounds)).fetchone()
        return int(row[0])

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
        """Yield the blocks of a cell with their numbers, in this order: (number, (B, s) scores)."""
        question = (
            "SELECT block, trials, scores FROM blocks "
            "WHERE cell = (SELECT id FROM cells WHERE levels = ?) ORDER BY block"
        )
        with _report_errors(self.path):
            for block, trials, content in self.connection.execute(question, (_name_cell(levels),)):
                if len(content) != 8 * trials * self.width:
                    raise FileError(report_finding("store.damaged"), self.path)
                yield block, np.frombuffer(content, dtype="<f8").reshape(trials, self.width)

    def read_scores(self, levels: Levels, columns: Sequence[int]) -> FloatArray:
        """Return some columns of all trials of a cell: (trials, len(columns)), blocks in order.

        Memory is that of the result and of one block.
        """
        with self.keep_state():
            scores = np.empty((self.count_cell(levels).trials, len(columns)))
            first = 0
            for _, block in self.read_blocks(levels):
                last = first + len(block)
                scores[first:last] = block[:, columns]
                first = last
        return scores

    def copy_blocks(self, other: StudyStore, levels: Levels) -> int:
        """Store the blocks of a cell of another store, and return how many are new."""
        question = (
            "SELECT key, block, trials, scores, seconds FROM blocks "
            "WHERE cell = (SELECT id FROM cells WHERE levels = ?)"
        )
        with _report_errors(self.path), self.connection:
            cell = self._find_cell(levels)
            before = self.connection.total_changes
            self.connection.executemany(
                "INSERT INTO blocks (key, block, trials, scores, seconds, cell) "
                f"VALUES (?, ?, ?, ?, ?, {cell}) ON CONFLICT (cell, block) DO NOTHING",
                other.read_rows(question, _name_cell(levels)),
            )
            return self.connection.total_changes - before

    def read_rows(self, question: str, value: str) -> Iterator[tuple[Any, ...]]:
        """Yield the rows that answer a question of SQL, which has one value to fill in."""
        with _report_errors(self.path):
            yield from self.connection.execute(question, (value,))

    def check_pages(self) -> None:
        """Read the whole store, and raise FileError where it is damaged."""
        with _report_errors(self.path):
            (answer,) = self.connection.execute("PRAGMA quick_check(1)").fetchone()
        if answer != "ok":
            raise FileError(report_finding("store.damaged"), self.path)

    def _find_cell(self, levels: Levels) -> int:
        """Return the row of a cell, which is made where it is missing."""
        name = _name_cell(levels)
        self.connection.execute("INSERT OR IGNORE INTO cells (levels) VALUES (?)", (name,))
        (cell,) = self.connection.execute("SELECT id FROM cells WHERE levels = ?", (name,))
        return int(cell[0])


def _name_cell(levels: Levels) -> str:
    """Return a text for the levels of a cell, whatever their order."""
    return json.dumps(dict(levels), sort_keys=True, ensure_ascii=False)


def make_store(folder: Path, header: StoreHeader) -> None:
    """Make an empty store in a folder.

    Raises
    ------
    FileError : it cannot be written, or the folder is on a network file system.
    """
    path = folder / NAME
    refuse_network(folder)
    with _report_errors(path), closing(_connect(path)) as connection:
        connection.executescript(TABLES)
        StudyStore(path, connection).set_header(header)


@contextmanager
def open_store(folder: Path) -> Iterator[StudyStore]:
    """Open the store of a folder to write it, as its only driver.

    Raises
    ------
    FileError : there is none, another driver has it, it is of another format, or on a network file
        system.
    """
    path = _find_store(folder)
    refuse_network(folder)
    descriptor = open_folder(folder)
    try:
        if descriptor is not None and lock(descriptor) is False:
            raise FileError(report_finding("store.other-driver"), folder)
        with _report_errors(path), closing(_connect(path)) as connection:
            _refuse_format(path, connection)
            connection.execute("PRAGMA journal_mode = WAL")
            connection.execute("PRAGMA synchronous = NORMAL")
            yield StudyStore(path, connection)
    finally:
        if descriptor is not None:
            os.close(descriptor)


@contextmanager
def read_store(folder: Path) -> Iterator[StudyStore]:
    """Open the store of a folder to read it, also while a driver writes it.

    Raises
    ------
    FileError : there is none, or it is of another format.
    """
    path = _find_store(folder)
    # a copy on a network file system can be read where no driver has left an unfinished log
    log = path.with_name(f"{NAME}-wal")
    is_still = not log.exists() or log.stat().st_size == 0
    is_copy = is_still and find_network_file_system(folder) is not None
    # only a connection that could write removes the files of the log when it is the last one
    is_writable = os.access(path, os.W_OK) and os.access(folder, os.W_OK)
    mode = "immutable=1" if is_copy else "mode=rw" if is_writable else "mode=ro"
    address = f"{path.resolve().as_uri()}?{mode}"
    with _report_errors(path), closing(_connect(address, uri=True)) as connection:
        connection.execute("PRAGMA query_only = ON")
        _refuse_format(path, connection)
        yield StudyStore(path, connection)


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
        raise FileError(report_finding("store.network-file-system", kind=kind), folder)


def _connect(place: Path | str, uri: bool = False) -> sqlite3.Connection:
    """Open an SQLite file."""
    return sqlite3.connect(place, PATIENCE, uri=uri)


def _find_store(folder: Path) -> Path:
    """Return the path of a store, or refuse a folder without one."""
    path = folder / NAME
    if not path.is_file():
        raise FileError(report_finding("store.missing", file=NAME), folder)
    return path


def _refuse_format(path: Path, connection: sqlite3.Connection) -> None:
    """Raise FileError for a file of another program or version."""
    (application,) = connection.execute("PRAGMA application_id").fetchone()
    (version,) = connection.execute("PRAGMA user_version").fetchone()
    if application != APPLICATION:
        raise FileError(report_finding("store.damaged"), path)
    if version != FORMAT:
        finding = report_finding("store.other-format", found=version, known=FORMAT)
        raise FileError(finding, path)


FULL = {sqlite3.SQLITE_FULL, sqlite3.SQLITE_IOERR}
"""Errors of a disk that takes no more (SQLite calls a file that must not grow an error of input and
output).
"""
UNREADABLE = {sqlite3.SQLITE_NOTADB, sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_SCHEMA}


@contextmanager
def _report_errors(path: Path) -> Iterator[None]:
    """Raise FileError in place of every error of SQLite."""
    try:
        yield
    except UnicodeDecodeError as error:
        raise FileError(report_finding("store.damaged"), path) from error
    except sqlite3.Error as error:
        number = getattr(error, "sqlite_errorcode", 0) & 0xFF
        reason = str(error)
        if isinstance(error, sqlite3.IntegrityError):
            raise  # a defect: two blocks of one number
        if number in FULL:
            finding = report_finding("store.disk-full", reason=reason)
        elif number in UNREADABLE or (isinstance(error, sqlite3.DatabaseError) and not number):
            finding = report_finding("store.damaged")
        else:
            finding = report_finding("store.not-accessible", reason=reason)
        raise FileError(finding, path) from error
