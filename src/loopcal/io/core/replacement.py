# SPDX-License-Identifier: Apache-2.0
"""Files and folders that take a name only when they are complete.

New content has a temporary name beside its target, such as `.loopcal-new-0123456789abcdef-run`. It
is created exclusively, and locked as long as its writer lives. An old folder, also locked, is first
set aside as `.loopcal-old-0123456789abcdef-run`, for the moment between two renames.

What a killed writer leaves behind has such a name and no lock. The next write to the target returns
a folder that was set aside to its name, and removes the rest if it is loopcal's.
"""

from __future__ import annotations

import errno
import os
import re
import secrets
import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import TypeVar

from loopcal.output_record import identify, note_output

# Open files and folders: locks, identity, and writing to the disk.

try:
    import fcntl
except ImportError:  # Windows: no locks, so leftovers are never removed
    fcntl = None


Descriptor = TypeVar("Descriptor", int, int | None)


@contextmanager
def _opened(descriptor: Descriptor) -> Iterator[Descriptor]:
    """Close a descriptor, where there is one, behind the body."""
    try:
        yield descriptor
    finally:
        if descriptor is not None:
            os.close(descriptor)


@contextmanager
def watch_folder(path: Path) -> Iterator[Callable[[], bool]]:
    """Yield a function that returns whether `path` still names the same folder.

    The folder stays open meanwhile, because a system gives the number of a removed folder to the
    next one.
    """
    with _opened(open_folder(path)) as descriptor:
        found = identify(path)  # None between the two renames of another command
        yield lambda: found is not None and (descriptor is None or is_open(path, descriptor))


def sync_file(path: Path) -> None:
    """Write the content of a file to the disk."""
    with _opened(os.open(path, os.O_RDWR | getattr(os, "O_BINARY", 0))) as descriptor:
        os.fsync(descriptor)


def sync_folder(path: Path) -> None:
    """Write the names in a folder to the disk, where the file system can."""
    with _opened(open_folder(path)) as descriptor:
        if descriptor is not None:
            with suppress(OSError):  # the names are in place, even if not yet on the disk
                os.fsync(descriptor)


def lock(descriptor: int) -> bool | None:
    """Lock a file or folder until it is closed; return whether it is locked, False where another
    process has the lock, None where locks are not supported.
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


NEW, OLD = "new", "old"
"""States of a leftover: written beside its target, and set aside for its successor."""

PATIENCE = 10.0
"""Seconds to wait until another command has written the same folder."""

_LEFTOVER = re.compile(r"\.loopcal-(new|old)-[0-9a-f]{16}-(.+)", re.DOTALL)
_NAME_BYTES = 200
"""Of the target's name in a temporary name; file systems allow 255 in all."""


@contextmanager
def create_temporary(target: Path, is_folder: bool = False) -> Iterator[Path]:
    """Yield a new, locked, empty file or folder beside `target`, and remove what is left of it."""
    path, descriptor = _create_locked(target, is_folder)
    try:
        yield path
    finally:
        _remove(path)
        if descriptor is not None:
            os.close(descriptor)


def _create_locked(target: Path, is_folder: bool) -> tuple[Path, int | None]:
    """Create a file or folder of a new name, and lock it.

    Another writer may find it before it is locked and take it for a leftover; then it is created
    again.
    """
    while True:
        path = _name_beside(target, NEW)
        if is_folder:
            path.mkdir()
            descriptor = open_folder(path)
        else:
            flags = os.O_RDWR | os.O_CREAT | os.O_EXCL | getattr(os, "O_NOFOLLOW", 0)
            descriptor = os.open(path, flags | getattr(os, "O_BINARY", 0), 0o666)
        if descriptor is None and path.is_dir():
            return path, None
        if descriptor is None:
            continue
        if lock(descriptor) is not False and is_open(path, descriptor):
            return path, descriptor
        os.close(descriptor)


def place_file(temporary: Path, target: Path, path: Path) -> None:
    """Give a complete, synchronized file its name; `path` is how the user calls it."""
    note_output(path, target, temporary)
    temporary.replace(target)
    sync_folder(target.parent)


def place_folder(
    temporary: Path, target: Path, path: Path, check: Callable[[Path], None] | None = None
) -> None:
    """Give a complete folder its name, and remove the folder that had it.

    `check` is called with a folder that is to be replaced, and raises where it must stay. It is
    called again with what was replaced, which another program may have changed.
    """
    for place, _, names in os.walk(temporary):
        for name in names:
            sync_file(Path(place, name))
        sync_folder(Path(place))
    note_output(path, target, temporary)
    while not _take_free_name(temporary, target):
        with _lock_folder(target) as is_locked:
            if not is_locked:  # another program has replaced or removed the old folder
                continue
            if check is not None:
                check(target)
            if not _exchange(temporary, target):
                continue
            try:
                if check is not None:
                    check(temporary)
            except BaseException:  # it was changed in the last moment, and gets its name again
                _exchange(temporary, target)
                if check is not None:
                    check(target)  # names the folder as the user does
                raise
            sync_folder(target.parent)
            _remove(temporary)
            return
    sync_folder(target.parent)


@contextmanager
def _lock_folder(path: Path) -> Iterator[bool]:
    """Lock a folder that is to be replaced, so that no other command replaces it meanwhile; yield
    whether it is locked, False where the name belongs to another folder now.

    OSError : another command has the lock for `PATIENCE` seconds.
    """
    with _opened(open_folder(path)) as descriptor:
        if descriptor is None:
            yield path.is_dir()  # without a lock, such as on Windows
            return
        end = time.monotonic() + PATIENCE
        while lock(descriptor) is False:
            if time.monotonic() > end:
                raise OSError(errno.EBUSY, "another command writes this folder", str(path))
            time.sleep(0.01)
        yield is_open(path, descriptor)


def _take_free_name(temporary: Path, target: Path) -> bool:
    """Rename a folder where the name is free or that of an empty folder; return whether it was."""
    if os.name == "nt" and target.is_dir() and not any(target.iterdir()):
        target.rmdir()
    try:
        temporary.rename(target)
    except OSError as error:
        # a folder that is not empty, and that another program may have set aside since
        is_taken = error.errno in (errno.ENOTEMPTY, errno.EEXIST)
        if is_taken or (error.errno == errno.EACCES and target.is_dir()):
            return False
        raise
    return True


@contextmanager
def restore_files(targets: Sequence[Path]) -> Iterator[None]:
    """Restore files, or their absence, where the body fails: all of them or none."""
    for target in targets:
        remove_leftovers(target, Path.is_file)
    asides = {target: _name_beside(target, OLD) for target in targets if target.exists()}
    with ExitStack() as locks:
        try:
            for target, aside in asides.items():
                try:
                    aside.hardlink_to(target)
                except OSError:  # the file system has no second names
                    shutil.copy2(target, aside)
                locks.enter_context(_lock_leftover(aside))
            try:
                yield
            except BaseException:
                for target in targets:
                    if target in asides:
                        asides[target].replace(target)
                    else:
                        target.unlink(missing_ok=True)
                raise
        finally:
            for aside in asides.values():
                aside.unlink(missing_ok=True)


def _exchange(new: Path, old: Path) -> bool:
    """Exchange the names of two folders; return False where another program has taken the name of
    the old one, which then stays set aside, while it had none.
    """
    aside = _name_beside(old, OLD)
    try:
        old.rename(aside)
        if not _take_free_name(new, old):
            return False
    except BaseException:
        if aside.exists() and not old.exists():
            aside.rename(old)
        raise
    aside.rename(new)
    return True


def list_leftovers(target: Path, state: str | None = None) -> list[Path]:
    """Return what killed writers left of `target` in a state (NEW, OLD, or both), oldest first."""
    name = _shorten(target.name)
    leftovers = []
    with suppress(OSError), os.scandir(target.parent) as entries:
        for entry in entries:
            match = _LEFTOVER.fullmatch(entry.name)
            if match and match[2] == name and state in (None, match[1]):
                leftovers.append(Path(entry.path))
    return sorted(leftovers, key=lambda path: (_read_time(path), path.name))


def remove_leftovers(target: Path, is_own: Callable[[Path], bool]) -> None:
    """Remove what killed writers left of `target` and `is_own`; rename back what was set aside."""
    for path in reversed(list_leftovers(target, OLD)):
        with _lock_leftover(path) as is_abandoned:
            if is_abandoned and path.is_dir() and not os.path.lexists(target):
                path.rename(target)
    for path in list_leftovers(target):
        with _lock_leftover(path) as is_abandoned:
            if is_abandoned and is_own(path):
                _remove(path)


@contextmanager
def _lock_leftover(path: Path) -> Iterator[bool]:
    """Yield whether a leftover has no living writer; it is locked meanwhile, so that no other
    command takes it for its own.
    """
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
    except (OSError, AttributeError):
        yield False
        return
    with _opened(descriptor):
        yield lock(descriptor) is True and is_open(path, descriptor)


def _remove(path: Path) -> None:
    """Remove a file or a folder, but nothing that a link names."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with suppress(OSError):
            path.unlink()


def _name_beside(target: Path, state: str) -> Path:
    """Return an unpredictable name in the folder of `target`."""
    name = _shorten(target.name)
    return target.with_name(f".loopcal-{state}-{secrets.token_hex(8)}-{name}")


def _shorten(name: str) -> str:
    """Return the end of a file name, which includes its suffix."""
    return os.fsdecode(os.fsencode(name)[-_NAME_BYTES:])


def _read_time(path: Path) -> int:
    """Return when a file or folder was changed last."""
    try:
        return path.lstat().st_mtime_ns
    except OSError:
        return 0
