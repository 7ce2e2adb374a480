# SPDX-License-Identifier: Apache-2.0
"""Which outputs a command has put in place so far, for what it says when it stops early."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path

Identity = tuple[int, int]
"""Device and number by which an operating system knows a file or folder, whatever its name."""

# Path as the user wrote it, its target, and the identity of what was to take its name.
_RECORD: ContextVar[list[tuple[Path, Path, Identity]] | None] = ContextVar("record", default=None)


@contextmanager
def record_outputs() -> Iterator[Callable[[], tuple[Path, ...]]]:
    """Yield a function that returns the files and folders that the body has put in place so far.

    The answer is exact at every moment, because it compares what has a name now with what was to
    take it. An output that was restored or replaced since does not count.
    """
    record: list[tuple[Path, Path, Identity]] = []
    token = _RECORD.set(record)
    try:
        yield lambda: tuple(
            dict.fromkeys(path for path, target, known in record if identify(target) == known)
        )
    finally:
        _RECORD.reset(token)


def note_output(path: Path, target: Path, temporary: Path) -> None:
    """Note that `temporary` is about to take the name of `target`, which the user calls `path`."""
    record, identity = _RECORD.get(), identify(temporary)
    if record is not None and identity is not None:
        record.append((path, target, identity))


def identify(path: Path) -> Identity | None:
    """Return the identity of a file or folder, not of what a link names; None if it is missing."""
    try:
        status = path.lstat()
    except OSError:
        return None
    return status.st_dev, status.st_ino
