# SPDX-License-Identifier: Apache-2.0
"""Which outputs a command has put in place so far, for what it says and takes back when it stops
early, and which names it found free, so that it replaces no file of another command.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path

Identity = tuple[int, int]
"""Device and number by which an operating system knows a file or folder, whatever its name."""

# Path as the user wrote it, its target, and the identity of what was to take its name, None where
# the name was free; the record of the outermost body first.
Record = list[tuple[Path, Path, Identity | None]]
_RECORDS: ContextVar[tuple[Record, ...]] = ContextVar("records", default=())


@contextmanager
def record_outputs() -> Iterator[Callable[[], dict[Path, Path]]]:
    """Yield a function that returns the files and folders that the body has put in place so far,
    with their targets.

    The answer is exact at every moment, because it compares what has a name now with what was to
    take it. An output that was restored or replaced since does not count.
    """
    record: Record = []
    token = _RECORDS.set((*_RECORDS.get(), record))
    try:
        yield lambda: {
            path: target for path, target, known in record if known and known == identify(target)
        }
    finally:
        _RECORDS.reset(token)


def note_output(path: Path, target: Path, temporary: Path | None) -> None:
    """Note that `temporary` is about to take the name of `target`, which the user calls `path`;
    None where the name is free, and another command may take it meanwhile.
    """
    identity = None if temporary is None else identify(temporary)
    for record in _RECORDS.get():
        record.append((path, target, identity))


def was_free(target: Path) -> bool:
    """Return whether the last note about `target` is that its name was free."""
    return any([i for _, t, i in record if t == target][-1:] == [None] for record in _RECORDS.get())


def identify(path: Path) -> Identity | None:
    """Return the identity of a file or folder, not of what a link names; None if it is missing."""
    try:
        status = path.lstat()
    except OSError:
        return None
    return status.st_dev, status.st_ino
