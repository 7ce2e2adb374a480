# SPDX-License-Identifier: Apache-2.0
"""Which files a command may write: all of them are looked at before the first is written."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from loopcal.errors import FileError
from loopcal.io.core.text_file import target_of


def refuse_outputs(
    outputs: Sequence[Path | None], inputs: Sequence[Path | None], force: bool
) -> None:
    """Refuse outputs that cannot or should not be written; None among outputs and inputs is passed
    over.

    Parameters
    ----------
    outputs : sequence of Path or None
        The files to write.
    inputs : sequence of Path or None
        What is read: files, or folders whose files are read.
    force : bool
        Files that are there may be replaced; those that are read may not.

    Raises
    ------
    FileError
        An output is an input or another output, is there without `force`, is a folder or no file,
        or has no folder to stand in; that of the file that a symbolic link names counts.
    """
    read = [
        file
        for path in inputs
        if path is not None
        for file in (path.iterdir() if path.is_dir() else (path,))
    ]
    wanted = [path for path in outputs if path is not None]
    for i, path in enumerate(wanted):
        folder = target_of(path).parent
        if any(_same(path, other) for other in read):
            raise FileError(
                "this file is read by the same command, which would replace it; choose another name",
                path,
            )
        if any(_same(path, other) for other in wanted[:i]):
            raise FileError("two outputs have this name; choose another for one of them", path)
        if not folder.is_dir():
            raise FileError(
                f"this cannot be written because there is no folder {folder}; make it first", path
            )
        if not os.access(folder, os.W_OK):
            raise FileError(
                "this cannot be written (permission denied); choose another place", path
            )
        if path.is_file() and not force:
            raise FileError(
                "this file exists; choose another name, or replace it with --force", path
            )


@contextmanager
def restore_on_failure(outputs: Sequence[Path | None]) -> Iterator[None]:
    """Put these files back as they were before the body, or take them away, where the body fails;
    None is passed over.
    """
    before = {
        path: path.read_bytes() if path.is_file() else None for path in outputs if path is not None
    }
    done = False
    try:
        yield
        done = True
    finally:
        for path, content in () if done else before.items():
            if content is not None:
                path.write_bytes(content)
            elif path.is_file():
                target_of(path).unlink()


def _same(one: Path, other: Path) -> bool:
    """Tell whether two names are of one file, whether it is there or not."""
    if one.exists() and other.exists():
        return one.samefile(other)
    return one.resolve() == other.resolve()
