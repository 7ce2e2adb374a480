# SPDX-License-Identifier: Apache-2.0
"""Open files and folders: locks, identity, and writing to the disk."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from loopcal.output_record import identify

try:
    import fcntl
except ImportError:  # Windows: no locks, so leftovers are never removed
    fcntl = None


@contextmanager
def watch_folder(path: Path) -> Iterator[Callable[[], bool]]:
    """Yield a function that returns whether `path` still names the same folder.

    The folder stays open meanwhile, because a system gives the number of a removed folder to the
    next one.
    """
    descriptor = open_folder(path)
    try:
        yield lambda: descriptor is None or is_open(path, descriptor)
    finally:
        if descriptor is not None:
            os.close(descriptor)


def sync_tree(folder: Path) -> None:
    """Write all files of a folder, and their names, to the disk."""
    for place, _, names in os.walk(folder):
        for name in names:
            sync_file(Path(place, name))
        sync_folder(Path(place))


def sync_file(path: Path) -> None:
    """Write the content of a file to the disk."""
    descriptor = os.open(path, os.O_RDWR | getattr(os, "O_BINARY", 0))
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def sync_folder(path: Path) -> None:
    """Write the names in a folder to the disk, where the file system can."""
    descriptor = open_folder(path)
    if descriptor is None:
        return
    try:
        with suppress(OSError):  # the names are in place, even if not yet on the disk
            os.fsync(descriptor)
    finally:
        os.close(descriptor)


def lock(descriptor: int) -> bool | None:
    """Lock a file or folder until it is closed; return whether it is locked.

    False where another process has the lock, None where locks are not supported.
    """
    if fcntl is None:
        return None
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return None
    return True


def open_folder(path: Path) -> int | None:
    """Return a descriptor of a folder; None where the system has none."""
    try:
        return os.open(path, os.O_RDONLY | getattr(os, "O_DIRECTORY", 0))
    except OSError:
        return None


def is_open(path: Path, descriptor: int) -> bool:
    """Return whether a path still names the file or folder that a descriptor belongs to."""
    status = os.fstat(descriptor)
    return identify(path) == (status.st_dev, status.st_ino)
