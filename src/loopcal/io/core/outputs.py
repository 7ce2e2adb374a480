# SPDX-License-Identifier: Apache-2.0
"""Output files, all checked before the first one is written, and result folders.

Files and folders are written whole or not at all, and never over something else.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from loopcal.errors import FileError
from loopcal.findings import report_finding
from loopcal.io.core.json_text import read_json
from loopcal.io.core.limits import TABLE_SIZE
from loopcal.io.core.replacement import create_temporary, place_folder, restore_files
from loopcal.io.core.text_file import report_write_errors, resolve_target

FILES = "files"
"""Key of the list of files in the document of a result folder."""


def refuse_outputs(
    outputs: Sequence[Path | None], inputs: Sequence[Path | None], force: bool
) -> None:
    """Refuse outputs that cannot or should not be written.

    Parameters
    ----------
    outputs : files to write; None is skipped.
    inputs : files that are read, or folders whose files are read; None is skipped.
    force : existing files may be replaced, except those that are read and the documents of result
        folders, without which nothing else in the folder can be read.

    Raises
    ------
    FileError
        An output is an input or another output, exists (without `force`), is a folder or a device,
        or its folder does not exist or is not writable. A symbolic link stands for its target.
    """
    read = [
        file
        for path in inputs
        if path is not None
        for file in (path.iterdir() if path.is_dir() else (path,))
    ]
    wanted = [path for path in outputs if path is not None]
    for i, path in enumerate(wanted):
        folder = resolve_target(path).parent
        if any(_is_same_file(path, other) for other in read):
            raise FileError(
                "this output is also an input of this command; choose another name", path
            )
        if any(_is_same_file(path, other) for other in wanted[:i]):
            raise FileError("two outputs have this name; choose another name for one of them", path)
        if not folder.is_dir():
            raise FileError(
                f"cannot write here: folder {folder} does not exist; create it first", path
            )
        if not os.access(folder, os.W_OK):
            raise FileError("cannot write here (permission denied); choose another folder", path)
        if path.is_file() and not force:
            raise FileError(report_finding("files.output-exists"), path)
        if is_folder_document(path):
            raise FileError(report_finding("files.output-in-result"), path)


@contextmanager
def restore_on_failure(outputs: Sequence[Path | None]) -> Iterator[None]:
    """Restore or remove these files where the body fails; None is skipped."""
    with restore_files([resolve_target(path) for path in outputs if path is not None]):
        yield


def is_folder_document(path: Path) -> bool:
    """Return whether a file is the document of a result folder, such as the result.json of a run:
    it lists the other files of its folder.
    """
    if path.suffix != ".json" or not path.is_file():
        return False
    try:
        content = read_json(path, "output", "choose another name", TABLE_SIZE)
    except FileError:
        return False
    return isinstance(content, dict) and isinstance(content.get(FILES), dict)


def _is_same_file(path: Path, other: Path) -> bool:
    """Return whether two names denote one file, existing or not."""
    if path.exists() and other.exists():
        return path.samefile(other)
    # not Path.resolve, which refuses a link that leads to itself
    return os.path.realpath(path) == os.path.realpath(other)


def resolve_folder(path: Path) -> Path:
    """Return the folder that a write to `path` makes or replaces, without links and dots.

    Raises
    ------
    FileError : the path is a circular link.
    """
    try:
        return path.resolve()
    except (OSError, RuntimeError):
        raise FileError("this symbolic link has no target; choose another name", path) from None


@contextmanager
def replace_folder(path: Path, check: Callable[[Path], None] | None = None) -> Iterator[Path]:
    """Yield a temporary folder that takes the place of `path` where the body succeeds.

    At every moment, `path` is the old or the new folder, complete. A symbolic link to a folder
    stays a link.

    Parameters
    ----------
    check : raises FileError where a folder that is in use must not be replaced.

    Raises
    ------
    FileError : in place of every OSError.
    """
    with report_write_errors(path):
        target = resolve_folder(path)
        target.parent.mkdir(parents=True, exist_ok=True)
        with create_temporary(target, is_folder=True) as temporary:
            yield temporary
            place_folder(temporary, target, path, check)
